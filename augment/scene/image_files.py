"""Read randomly chosen images of a folder."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from augment.progress import progress
from renderer.errors import InputError
from renderer.io.images import SUFFIXES, read_image


def draw_image_files(
    folder: str | Path, key: str, count: int, size: int, draws: torch.Generator
) -> Float[Tensor, "count 3 size size"]:
    """Read randomly chosen images of a folder, with replacement."""
    files = sorted(path for path in Path(folder).rglob("*") if path.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"{key}={folder} has no images: give a folder of .jpg or .png files")
    chosen = torch.randint(len(files), (count,), generator=draws).tolist()
    images = [read_image(files[index], size) for index in progress(chosen, f"reading {key}")]
    return torch.stack(images)
