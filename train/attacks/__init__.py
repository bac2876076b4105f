"""Attacks on one picture or several views of it, and what they leave behind: pictures, shapes, lights, numbers."""
