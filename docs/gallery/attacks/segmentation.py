"""
An attack on a segmenter
========================

A segmenter gives each pixel a class. Here, a formula stands for a network: it calls pixels an
orange that are more red than blue. The attack changes the lighting until the pixels of the class
overlap the orange by less than half (IoU).
"""

import torch

import norm_balls as nb


def segment(images: torch.Tensor) -> torch.Tensor:
    """Return logits of the classes "background" and "orange" for each pixel."""
    warmth = 20 * (images[:, 0] - images[:, 2] - 0.1)
    return torch.stack([-warmth, warmth], 1)


scene = nb.build_scene([("solid:orange:3", "orange")], 96, width=3.0, encoding="srgb")
settings = nb.AttackSettings(lighting=nb.StepSettings("l2", radius=3.0, step_size=0.3))
result = nb.attack(segment, scene, settings=settings, classes=["background", "orange"])
figure = result.plot()
