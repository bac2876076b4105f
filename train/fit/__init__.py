"""Training: epochs of data and renders, steps, schedules, distortions, validation, checkpoints."""
