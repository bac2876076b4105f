"""Attacks on what a scene shows, and what they leave behind: checks, images, lights, shapes, numbers."""
