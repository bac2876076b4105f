"""Audit of a classifier: what it recognizes under unusual lighting, and what hardening costs."""
