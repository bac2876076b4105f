"""Backgrounds of a scene: gray values and image files."""

import math
import reprlib
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from renderer.errors import InputError
from renderer.io.images import read_image


def load_backgrounds(choices: Sequence[float | str | Path], size: int) -> Tensor:
    """(B, 3, size, size) of gray values or image files, or (B, 1, size, size) where all are gray; in [0, 1]."""
    if not choices:
        raise InputError("backgrounds is empty: give gray values in [0, 1] or image files")
    images = [load_background(choice, size) for choice in choices]
    channels = max(len(image) for image in images)
    return torch.stack([image.expand(channels, -1, -1) for image in images])


def load_background(choice: float | str | Path, size: int, name: str = "backgrounds") -> Tensor:
    """A gray value (1, size, size), or an image's center square (3, size, size), in [0, 1]. name: of the argument in
    errors."""
    if isinstance(choice, Path):
        return _image(choice, size, name)
    try:
        gray = float(choice)
    except (ValueError, TypeError, OverflowError):
        if isinstance(choice, str):
            return _image(Path(choice), size, name)
        gray = math.nan
    if not 0 <= gray <= 1:
        raise InputError(f"{name}={reprlib.repr(choice)}: give gray values in [0, 1] or image files")
    return torch.full((1, size, size), gray)


def _image(path: Path, size: int, name: str) -> Tensor:
    try:
        return read_image(path, size)
    except InputError as error:
        raise InputError(f"{name}: {error} or a gray value") from error
