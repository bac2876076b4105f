"""Path-traced photographs of objects on a dark table under a projector, to score networks on."""
