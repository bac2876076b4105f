"""A regeneration's specimens as a file of at most half a megabyte beside the epoch's grid of renders."""

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

from augment.specimens import MOST, Specimens
from renderer.errors import InputError
from renderer.image import to_bytes

SUFFIX = ".safetensors"
LARGEST_SIDE = 128  # pixels; larger images are reduced
OTHER = "other things"  # whose label is anything but a class
KINDS, NAMES = ("images", "lights"), ("before", "after")
DEGREES = 50  # more than any light has bands


@dataclass(frozen=True)
class Side:
    """A specimen, before or after: image (3, H, W) uint8, light ((degree + 1)², 3), the model's answer."""

    image: Tensor
    light: Tensor
    answer: str
    confidence: float


def write_specimens(path: Path, specimens: Specimens, classes: Sequence[str]) -> None:
    """Images as bytes and lights as float32, in the safetensors format; labels and answers in its metadata."""
    tensors, answers = {}, {"label": [classes[index] if index >= 0 else OTHER for index in specimens.labels.tolist()]}
    for name, images, lights, probabilities in [
        ("before", specimens.images_before, specimens.lights_before, specimens.answers_before),
        ("after", specimens.images, specimens.lights, specimens.answers),
    ]:
        tensors[f"images_{name}"] = to_bytes(_reduced(images.detach().cpu())).contiguous()
        tensors[f"lights_{name}"] = lights.detach().float().cpu().contiguous()
        best = probabilities.max(1)
        answers[name] = [classes[index] for index in best.indices.tolist()]
        answers[f"confidence_{name}"] = best.values.tolist()
    path.write_bytes(save(tensors, {"answers": json.dumps(answers)}))  # an error of which names the file


def read_specimens(path: Path) -> list[tuple[str, Side, Side]]:
    """The label, before and after of each; InputError naming a file that is none of `write_specimens`."""
    try:
        if not path.is_file():
            raise ValueError("there is no such file")
        with safe_open(path, "pt") as file:
            answers = json.loads(file.metadata()["answers"])
            tensors = {f"{kind}_{name}": file.get_tensor(f"{kind}_{name}") for kind in KINDS for name in NAMES}
        labels = [str(label) for label in answers["label"]]
        sides = [_sides(tensors, answers, name, len(labels)) for name in NAMES]
        return list(zip(labels, *sides, strict=True))
    except Exception as error:  # safetensors raises a kind of its own
        raise InputError(f"{path} is damaged or of another version ({' '.join(str(error).split())})") from error


def _sides(tensors: dict[str, Tensor], answers: dict[str, Any], name: str, count: int) -> list[Side]:
    images, lights = tensors[f"images_{name}"], tensors[f"lights_{name}"]
    if not (len(images) == len(lights) == count <= MOST and images.dtype == torch.uint8):
        raise ValueError(f"{len(images)} images and {len(lights)} lights for {count} answers")
    if images.shape[1] != 3 or images.shape[2] > LARGEST_SIDE or images.shape[2] != images.shape[3]:
        raise ValueError(f"images of shape {tuple(images.shape)}")
    if lights.shape[1] not in {(degree + 1) ** 2 for degree in range(DEGREES)} or not lights.isfinite().all():
        raise ValueError(f"lights of shape {tuple(lights.shape)}, or infinite ones")
    told = zip(answers[name], answers[f"confidence_{name}"], strict=True)
    rows = zip(images, lights, told, strict=True)
    return [Side(image, light, str(answer), float(share)) for image, light, (answer, share) in rows]


def _reduced(images: Tensor) -> Tensor:
    return images if images.shape[-1] <= LARGEST_SIDE else interpolate(images, LARGEST_SIDE, mode="area")
