"""The largest errors of the renderer, condition by condition."""
