"""One training run: its network, its loss, its loop and its averages."""
