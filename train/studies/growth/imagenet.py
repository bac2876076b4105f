"""The parts of hardening an ImageNet network that can be measured without eight GPUs, as ratios."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torchvision.models import resnet50

from augment.build import build_scene
from train.studies.growth.cost import GRAYS
from train.studies.renderer_speed.measure import seconds

IMAGES = 1_281_167  # of ImageNet's training set
BATCH, SIZE = 4, 224


@dataclass(frozen=True)
class Parts:
    """Seconds per image of ResNet-50 at 224²: a step of training, the pass of an attack, a render with its gradient."""

    training: float
    attack: float
    render: float


def measure_parts(rounds: int) -> Parts:
    """Medians, on one thread; the three take turns, so that a busy machine disturbs all alike."""
    network, images, labels = resnet50(), torch.rand(BATCH, 3, SIZE, SIZE), torch.zeros(BATCH, dtype=torch.int64)
    optimizer = torch.optim.SGD(network.parameters(), lr=1e-3, momentum=0.9)
    scene = build_scene([("solid:orange", "orange")], SIZE, 1, backgrounds=GRAYS[:BATCH], rasterizer="numpy")
    everything, light = torch.arange(BATCH), scene.lights.clone().requires_grad_(True)

    def training() -> None:
        network.train()
        optimizer.zero_grad()
        F.cross_entropy(network(images), labels).backward()
        optimizer.step()

    def attack() -> None:
        network.eval()
        shown = images.clone().requires_grad_(True)
        torch.autograd.grad(F.cross_entropy(network(shown), labels), shown)

    def render() -> None:
        conditions = scene.conditions(everything)
        rendered = scene.render(type(conditions)(light), everything)
        torch.autograd.grad(rendered.sum(), light)

    rows = [[seconds(part) / BATCH for part in (training, attack, render)] for _ in range(rounds + 1)]
    return Parts(*np.median(rows[1:], axis=0).tolist())


def added_share(parts: Parts, renders: int, steps: int) -> float:
    """How much longer an epoch of ImageNet takes with renders that are attacked anew in it, and trained on."""
    by_render = (steps + 1) * (parts.attack + parts.render) + parts.training
    return renders * by_render / (IMAGES * parts.training)
