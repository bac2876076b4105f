"""Finished runs and attacks, read from their folders: tables, comparisons, model cards, and a page to look at."""
