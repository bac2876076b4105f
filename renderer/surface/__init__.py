"""Albedo, textures, and the reflectance of rough materials."""
