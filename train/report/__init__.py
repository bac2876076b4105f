"""Reports of runs and attacks: tables, comparisons, and a page with plots and images."""
