"""Functions for any network: `load`, `evaluate`, `audit` and `harden`."""
