"""Hydra's configuration: one choice per group. A package, so that it travels with an installation."""
