"""Attacks on one image or several views of it, and what they leave behind: images, shapes, lights, numbers."""
