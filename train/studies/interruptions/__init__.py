"""Training runs that are interrupted in many ways, and whether they end as if nothing had happened."""
