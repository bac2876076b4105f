"""A few successful attacks of an epoch as a file of at most half a megabyte."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor
from torch.nn.functional import interpolate

from augment.service import AttackExamples
from renderer.errors import InputError, in_one_line
from renderer.image import to_bytes
from renderer.rendering import light_sphere

SUFFIX = ".safetensors"
LARGEST_SIDE = 128  # pixels; larger images are reduced
SPHERE = 64  # pixels per side of the ball that shows the light
OTHER = "other things"  # the label of hard negatives that belong to no class


class Side(NamedTuple):
    """An example before or after the attack: image and white ball in its light, (3, H, W) uint8, and the prediction."""

    image: Tensor
    sphere: Tensor
    predicted: str
    confidence: float


def write_attack_examples(path: Path, shown: AttackExamples, classes: Sequence[str]) -> None:
    """Images as bytes in the safetensors format; labels and predictions in its metadata."""
    labels = [classes[index] if index >= 0 else OTHER for index in shown.labels.tolist()]
    tensors, predictions = {}, {"label": labels}
    sides = zip(("before", "after"), shown.images, shown.lights, shown.predictions, strict=True)
    for name, images, lights, probabilities in sides:
        images = images.detach().cpu()
        if images.shape[-1] > LARGEST_SIDE:
            images = interpolate(images, LARGEST_SIDE, mode="area")
        tensors[f"images_{name}"] = to_bytes(images).contiguous()
        spheres = [to_bytes(light_sphere(light, SPHERE, basis=shown.basis)) for light in lights]
        tensors[f"spheres_{name}"] = torch.stack(spheres)
        best = probabilities.max(1)
        predictions[name] = [classes[index] for index in best.indices.tolist()]
        predictions[f"confidence_{name}"] = best.values.tolist()
    path.write_bytes(save(tensors, {"predictions": json.dumps(predictions)}))  # save_file names no file in its errors


def read_attack_examples(path: Path) -> list[tuple[str, Side, Side]]:
    """The label of each example, and its sides before and after; InputError naming a damaged file."""
    try:
        with safe_open(path, "pt") as file:
            predictions = json.loads(file.metadata()["predictions"])
            sides = []
            for name in ("before", "after"):
                images, spheres = file.get_tensor(f"images_{name}"), file.get_tensor(f"spheres_{name}")
                rows = zip(images, spheres, predictions[name], predictions[f"confidence_{name}"], strict=True)
                sides.append([Side(*row) for row in rows])
        return list(zip(predictions["label"], *sides, strict=True))
    except Exception as error:  # safetensors raises its own type
        raise InputError(f"{path} is damaged or of another version ({in_one_line(error)})") from error
