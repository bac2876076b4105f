"""The folder of a run: its settings, log, checkpoints and results."""
