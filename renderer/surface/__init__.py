"""What surfaces are made of: albedo, textures, and the reflectance of rough materials."""
