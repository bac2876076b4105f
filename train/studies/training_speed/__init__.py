"""The speed of training: both arms, a plain loop and matrix products, in turns, and the page."""
