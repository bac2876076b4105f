"""Results of networks: predictions, metrics, comparisons, tables and report pages."""
