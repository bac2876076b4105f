"""Evaluation of networks: scores on photographs, and a laboratory that renders test images."""
