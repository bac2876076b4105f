"""An audit of a classifier: what it recognizes in strange light, and what hardening it costs, on one page."""
