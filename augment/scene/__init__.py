"""Scenes: objects, cameras and backgrounds, and how they are built, varied and rendered."""
