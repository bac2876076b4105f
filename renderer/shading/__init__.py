"""Reflection of light by surfaces: diffuse shading, gloss and its lobes."""
