"""What scripts/benchmark_renderer.py is made of: scenes and reference, clocks, panels, peers, targets, report."""
