"""Attacks on the light, shapes, materials and poses of a scene, and checks of their results."""
