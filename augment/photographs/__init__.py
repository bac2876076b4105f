"""Photographs in the light of a projector: random slides, shading, and attacks on the light.

A photograph is treated as a flat print, whose linear values are its albedo. No mesh is needed.
"""
