"""The experiment: data, network, training loop, checkpoints, photographs and logs."""
