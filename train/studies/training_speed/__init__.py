"""What scripts/benchmark_training.py is made of: both arms, the plain loop, the matrix products, the page."""
