"""Meshes, images and whole scenes as files, in and out."""
