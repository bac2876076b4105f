"""What a run has on disk: configuration and metrics, checkpoints, specimens, and its network as a classifier."""
