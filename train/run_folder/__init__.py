"""What a run has on disk: configuration and metrics, checkpoints, attack examples, and its network as a classifier."""
