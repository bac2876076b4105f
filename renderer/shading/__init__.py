"""How a surface reflects light: diffuse shading, gloss and its lobes."""
