"""Meshes, images, lights and whole scenes as files, in and out."""
