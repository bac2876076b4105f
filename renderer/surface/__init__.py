"""How a surface reflects light: albedo, diffuse shading and gloss."""
