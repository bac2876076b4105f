"""Runs and attacks, read from their folders: tables, comparisons, and a page of tables, plots and images."""
