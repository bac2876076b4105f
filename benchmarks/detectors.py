"""Attacks on FastestDet, a detector of COCO, compared with random search of as many passes.

Run it as a module in the root of the repository, after `pip install ".[ecosystem]"`:

    python -m benchmarks.detectors --data DATA --out detectors.md

DATA has `meshes/` and, in `weights/`, fastestdet_coco.onnx and coco.names. The table has a row for
each attacked quantity and radius. It is written anew after each object. The following audit of a
detector that finds an orange in each image is for its time:

    pnb-audit network=python:benchmarks.detectors:ssdlite meshes=[solid:orange]
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

import norm_balls as nb
from augment.attack_settings import GRADIENT, RANDOM_SEARCH
from benchmarks.common import machine
from train.results import tables
from train.results.detections import estimate
from train.results.intervals import Units
from train.results.tables import Estimate

SIZE = 352
# Files below DATA/meshes or generated solids, their classes in COCO and factors of their albedo.
OBJECTS = (
    ("orange_studio.glb", "orange", 1.0),
    ("apple_scan.glb", "apple", 1.0),
    ("banana.glb", "banana", 1.0),
    ("solid:cup:0", "cup", 1.0),
    ("orange_scan.glb", "orange", 1.0),
    ("orange_sketchfab.glb", "orange", 3.0),
    ("solid:bottle:3", "bottle", 1.0),
    ("orange_leaf.glb", "orange", 1.0),
    ("solid:apple:3", "apple", 1.0),
    ("solid:orange:3", "orange", 1.0),
    ("solid:cup:3", "cup", 1.0),
)
# Radii of the norm-balls: L2 of the light, L∞ of the pixels of a projector and of the pose.
RADII = {"lighting": (0.5, 1.0, 2.0), "projector": (0.25, 0.5, 1.0), "pose": (0.5, 1.0, 2.0)}
STEPS_PER_RADIUS = 4
OPTIMIZERS = (GRADIENT, RANDOM_SEARCH)
PROJECTOR = {"pixels": 16, "polar": 50.0, "azimuth": 20.0, "pattern": 0.3}
# Views of an object that were detected before an attack, and those of them that no longer are.
Counts = tuple[int, int]


class FastestDet(nn.Module):
    """FastestDet, converted from ONNX. It takes RGB images, and returns its raw outputs."""

    def __init__(self, path: Path):
        super().__init__()
        from onnx2torch import convert

        self.network = convert(str(path)).requires_grad_(True)
        # The file is for one image: its channel shuffles reshape 2 · C channels to (C, 2, pixels).
        for name, shape in self.network.named_buffers():
            if name.startswith("initializers") and shape.numel() == 3:
                shape[0] = -1

    def forward(self, images: Tensor) -> Tensor:
        """Return 85 numbers for each of 22 × 22 cells. The file takes BGR."""
        return self.network(images.flip(1))


def decode(raw: Tensor) -> list[dict[str, Tensor]]:
    """Return the box and the scores of each cell: objectness^0.6 · probability^0.4."""
    rows, columns = raw.shape[-2:]
    objectness, offsets, probabilities = raw.split([1, 4, raw.shape[1] - 5], dim=1)
    tiny = torch.finfo(raw.dtype).tiny
    scores = objectness.clamp(min=tiny) ** 0.6 * probabilities.clamp(min=tiny) ** 0.4
    x = (torch.arange(columns) + offsets[:, 0].tanh()) / columns
    y = (torch.arange(rows)[:, None] + offsets[:, 1].tanh()) / rows
    half_width, half_height = offsets[:, 2:].sigmoid().unbind(1)
    half_width, half_height = half_width / 2, half_height / 2
    sides = [x - half_width, y - half_height, x + half_width, y + half_height]
    boxes = SIZE * torch.stack(sides, -1).flatten(1, 2)
    pairs = zip(boxes, scores.flatten(2).transpose(1, 2), strict=True)
    return [{"boxes": box, "scores": score} for box, score in pairs]


def ssdlite() -> tuple[nn.Module, int, list[str]]:
    """Return an SSDlite of torchvision, whose random weights find a large orange in each image.

    Hardly any attack succeeds, so its audit takes longest. Returned are also size and classes.
    """
    from torchvision.models.detection import ssdlite320_mobilenet_v3_large

    network = ssdlite320_mobilenet_v3_large(weights=None, weights_backbone=None).eval()
    names = [*nb.Detection().class_names(network, 91)]
    # The last layers are those of the largest boxes.
    layers = network.head.classification_head.module_list[-1]
    layers[-1].bias.data.view(-1, len(names))[:, names.index("orange")] = 5.0
    return network, 320, names


def settings_of(quantity: str, radius: float, optimizer: str, passes: int) -> nb.AttackSettings:
    """Return settings of an attack on one quantity within a radius."""
    step = radius / STEPS_PER_RADIUS
    ball: nb.StepSettings = nb.StepSettings("linf", radius, "sign", step)
    if quantity == "lighting":
        ball = nb.StepSettings("l2", radius, "unit", step)
    elif quantity == "pose":
        ball = nb.PoseSettings("linf", radius, "sign", step)
    parameter: dict[str, Any] = {quantity: ball}
    return nb.AttackSettings(**parameter, optimizer=optimizer, max_queries=passes, max_steps=passes)


def fraction(counts: Sequence[Counts]) -> Estimate:
    """Return the part of the detected views that an attack hides. Its interval is over objects."""
    detected, hidden = np.array(counts).T

    def of_objects(weights: np.ndarray) -> np.ndarray:
        return (weights @ hidden) / (weights @ detected)

    objects = np.arange(len(counts))
    return estimate(of_objects, [objects], Units([objects], tables.OBJECTS))


def table(results: Mapping[tuple[str, float], Mapping[str, Sequence[Counts]]]) -> str:
    """Write a Markdown table of the results."""
    lines = ["|quantity|radius|objects|views|gradient|random search|", "|-|-|-|-|-|-|"]
    for (quantity, radius), by_optimizer in results.items():
        counted = {
            name: [counts for counts in items if counts[0]] for name, items in by_optimizer.items()
        }
        objects = counted[GRADIENT]
        if not objects:
            continue
        cells = [
            quantity,
            f"{radius:g}",
            str(len(objects)),
            str(sum(count for count, _ in objects)),
        ]
        for optimizer in OPTIMIZERS:
            hidden = fraction(counted[optimizer])
            interval = "" if hidden.low is None else f" [{hidden.low:.2f}, {hidden.high:.2f}]"
            cells.append(f"{hidden.value:.2f}{interval}")
        lines.append(f"|{'|'.join(cells)}|")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Attack all objects, and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder with meshes/ and weights/")
    add("--out", type=Path, required=True, help="file of the table")
    add("--quantities", nargs="+", default=list(RADII), choices=list(RADII))
    add("--objects", type=int, default=len(OBJECTS), help="number of objects")
    add("--views", type=int, default=8, help="views of each object")
    add("--passes", type=int, default=30, help="forward passes for each view")
    options = parser.parse_args(arguments)
    weights = options.data / "weights"
    names = (weights / "coco.names").read_text().splitlines()
    network = FastestDet(weights / "fastestdet_coco.onnx").eval()
    task = nb.Detection(decode=decode)
    keys = [(quantity, radius) for quantity in options.quantities for radius in RADII[quantity]]
    results: dict[tuple[str, float], dict[str, list[Counts]]] = {
        key: {optimizer: [] for optimizer in OPTIMIZERS} for key in keys
    }
    described = f"{machine()}; {options.views} views, {options.passes} passes"
    for mesh, label, albedo_scale in OBJECTS[: options.objects]:
        path = mesh if mesh.startswith("solid:") else str(options.data / "meshes" / mesh)
        item = nb.ObjectSettings(path, label=label, albedo_scale=albedo_scale)
        for quantity, radius in keys:
            projector = PROJECTOR if quantity == "projector" else None
            looks: dict[str, Any] = {"width": 3.2, "encoding": "srgb", "projector": projector}
            if quantity == "pose":
                # Each step renders all views anew, with 4 instead of 64 samples in a pixel.
                looks |= {"silhouettes": True, "samples": 2}
            scene = nb.build_scene([item], SIZE, options.views, **looks)
            for optimizer in OPTIMIZERS:
                settings = settings_of(quantity, radius, optimizer, options.passes)
                result = nb.attack(
                    network, scene, settings=settings, task=task, classes=names, force=True
                )
                detected = result.clean_correct
                counts = int(detected.sum()), int((result.success & detected).sum())
                results[quantity, radius][optimizer].append(counts)
                print(mesh, quantity, radius, optimizer, *counts, flush=True)
        options.out.write_text(f"{table(results)}\n\n{described}\n")


if __name__ == "__main__":
    main()
