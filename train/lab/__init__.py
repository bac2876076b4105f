"""The laboratory: path-traced renders of objects on a table under a projector, to score networks on."""
