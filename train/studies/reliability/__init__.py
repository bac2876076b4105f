"""Hostile inputs at every door: files, names, settings and circumstances, and whether each is used or refused."""
