"""Path-traced photographs of objects in light that no training shows."""
