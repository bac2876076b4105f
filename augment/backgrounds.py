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
    try:
        gray = float(choice)  # type: ignore[arg-type]  # of a path it raises
    except (ValueError, TypeError, OverflowError):
        gray = math.nan
    if math.isnan(gray) and isinstance(choice, str | Path):
        try:
            return read_image(Path(choice), size)
        except InputError as error:
            raise InputError(f"{name}: {error} or a gray value") from error
    if not 0 <= gray <= 1:
        raise InputError(f"{name}={reprlib.repr(choice)}: give gray values in [0, 1] or image files")
    return torch.full((1, size, size), gray)
