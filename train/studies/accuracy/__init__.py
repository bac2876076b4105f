"""The renderer's largest errors, condition by condition: what scripts/stress_renderer.py measures."""
