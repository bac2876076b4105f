"""A regeneration's attack examples as a file of at most half a megabyte beside the epoch's grid of renders."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor
from torch.nn.functional import interpolate

from augment.service import SHOWN_EXAMPLES, AttackExamples
from renderer.errors import InputError, in_one_line
from renderer.image import to_bytes
from renderer.light.light_sphere import light_sphere

SUFFIX = ".safetensors"
LARGEST_SIDE = 128  # pixels; larger images are reduced
OTHER = "other things"  # whose label is anything but a class
KINDS, NAMES = ("images", "spheres"), ("before", "after")
SPHERE = 64  # pixels


@dataclass(frozen=True)
class Side:
    """An attack example, before or after: its image and a white ball in its light, (3, H, W) uint8, and the model's
    predicted."""

    image: Tensor
    sphere: Tensor
    predicted: str
    confidence: float


def write_attack_examples(path: Path, attack_examples: AttackExamples, classes: Sequence[str]) -> None:
    """Images as bytes, in the safetensors format; labels and predictions in its metadata."""
    tensors, predictions = (
        {},
        {"label": [classes[index] if index >= 0 else OTHER for index in attack_examples.labels.tolist()]},
    )
    for name, images, lights, probabilities in [
        ("before", attack_examples.images_before, attack_examples.lights_before, attack_examples.predictions_before),
        ("after", attack_examples.images, attack_examples.lights, attack_examples.predictions),
    ]:
        tensors[f"images_{name}"] = to_bytes(_reduced(images.detach().cpu())).contiguous()
        spheres = [to_bytes(light_sphere(light, SPHERE, basis=attack_examples.basis)) for light in lights]
        tensors[f"spheres_{name}"] = torch.stack(spheres)
        best = probabilities.max(1)
        predictions[name] = [classes[index] for index in best.indices.tolist()]
        predictions[f"confidence_{name}"] = best.values.tolist()
    path.write_bytes(save(tensors, {"predictions": json.dumps(predictions)}))  # an error of which names the file


def read_attack_examples(path: Path) -> list[tuple[str, Side, Side]]:
    """The label, before and after of each; InputError naming a file that is none of `write_attack_examples`."""
    try:
        if not path.is_file():
            raise ValueError("there is no such file")
        with safe_open(path, "pt") as file:
            predictions = json.loads(file.metadata()["predictions"])
            tensors = {f"{kind}_{name}": file.get_tensor(f"{kind}_{name}") for kind in KINDS for name in NAMES}
        labels = [str(label) for label in predictions["label"]]
        sides = [_sides(tensors, predictions, name, len(labels)) for name in NAMES]
        return list(zip(labels, *sides, strict=True))
    except Exception as error:  # safetensors raises a kind of its own
        raise InputError(f"{path} is damaged or of another version ({in_one_line(error)})") from error


def _sides(tensors: dict[str, Tensor], predictions: dict[str, Any], name: str, count: int) -> list[Side]:
    for images in (shown := [tensors[f"{kind}_{name}"] for kind in KINDS]):
        if not (len(images) == count <= SHOWN_EXAMPLES and images.dtype == torch.uint8):
            raise ValueError(f"{len(images)} images for {count} predictions")
        if images.shape[1] != 3 or images.shape[2] > LARGEST_SIDE or images.shape[2] != images.shape[3]:
            raise ValueError(f"images of shape {tuple(images.shape)}")
    told = zip(predictions[name], predictions[f"confidence_{name}"], strict=True)
    rows = zip(*shown, told, strict=True)
    return [Side(image, sphere, str(predicted), float(share)) for image, sphere, (predicted, share) in rows]


def _reduced(images: Tensor) -> Tensor:
    return images if images.shape[-1] <= LARGEST_SIDE else interpolate(images, LARGEST_SIDE, mode="area")
