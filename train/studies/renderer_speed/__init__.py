"""What scripts/benchmark_renderer.py is made of: scenes and reference, clocks, panels, peers, targets, report.

`training` is what scripts/benchmark_training.py is made of; results, measure and plots serve both.
"""
