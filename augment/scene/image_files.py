"""Read randomly chosen images of a folder."""

from pathlib import Path

import torch
from torch import Tensor

from augment.progress import progress
from renderer.errors import InputError
from renderer.io.images import SUFFIXES, read_image


def draw_image_files(
    folder: str | Path, key: str, count: int, size: int, draws: torch.Generator
) -> Tensor:
    """Read randomly chosen images of a folder, with replacement.

    Args:
        folder: Folder of the image files. Its sub-folders are searched, too.
        key: Name of the setting that has the folder, for the error message.
        count: Number of images, at least 1.
        size: Pixels per side to which each image is scaled.
        draws: Generator of the random numbers.

    Returns:
        Image values in [0, 1], shape (count, 3, size, size).

    Raises:
        InputError: If the folder has no images.
    """
    files = sorted(path for path in Path(folder).rglob("*") if path.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"{key}={folder} has no images: give a folder of .jpg or .png files")
    chosen = torch.randint(len(files), (count,), generator=draws).tolist()
    images = [read_image(files[index], size) for index in progress(chosen, f"reading {key}")]
    return torch.stack(images)
