"""Rows drawn afresh: where a mesh lies in the frame, how large, how bright, and before which image."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from augment.scene import Example, Scene
from renderer.cache import OperatorCache
from renderer.errors import FACTOR, InputError
from renderer.image_files import SUFFIXES, read_image

UNCHANGED = (1.0, 1.0)


@dataclass
class VariationSettings:
    """What is drawn for each example in each round; by default nothing, which leaves the grid of the paper.

    place: the mesh's middle is moved by at most this share of the frame's width, to either side and up and down.
    scale, exposure: [least, most] that its size in the frame and the light are multiplied by, uniform in the logarithm.
    backgrounds: a folder of images, each example before one of them.
    """

    place: float = 0.0
    scale: list[float] = field(default_factory=lambda: list(UNCHANGED))
    exposure: list[float] = field(default_factory=lambda: list(UNCHANGED))
    backgrounds: str | None = None

    def __post_init__(self):
        if not 0 <= self.place <= 1:
            raise InputError(f"augment.vary.place={self.place} must be a share of the frame's width, from 0 to 1")
        for name in ("scale", "exposure"):
            limits = getattr(self, name)
            if len(limits) != 2 or not 1 / FACTOR <= limits[0] <= limits[1] <= FACTOR:
                raise InputError(
                    f"augment.vary.{name}={list(limits)}: give [least, most], both from {1 / FACTOR:g} to {FACTOR:g}"
                )

    @property
    def moves(self) -> bool:
        """Whether views change, which then are rasterised in every round."""
        return self.place > 0 or tuple(self.scale) != UNCHANGED

    @property
    def varies(self) -> bool:
        """Whether anything is drawn at all."""
        return self.moves or tuple(self.exposure) != UNCHANGED or self.backgrounds is not None


def vary(scene: Scene, settings: VariationSettings, draws: torch.Generator) -> Scene:
    """The scene with rows drawn afresh around its own; the scene itself where nothing varies.

    All views of a row are moved alike. InputError where the folder of backgrounds has no readable image.
    """
    if not settings.varies:
        return scene
    place = settings.place * (2 * torch.rand(len(scene), 2, generator=draws, dtype=torch.float64) - 1)
    scale, exposure = (_between(limits, len(scene), draws) for limits in (settings.scale, settings.exposure))
    rows = [
        replace(_moved(row, *moved, size) if settings.moves else row, exposure=row.exposure * bright)
        for row, moved, size, bright in zip(scene.examples, place.tolist(), scale, exposure, strict=True)
    ]
    backgrounds = None
    if settings.backgrounds is not None:
        backgrounds = _images(Path(settings.backgrounds), len(scene), scene.settings.size, draws)
        rows = [replace(row, background=index) for index, row in enumerate(rows)]
    # Views that never come again are not worth a place on the disk.
    return scene.with_rows(rows, backgrounds, OperatorCache() if settings.moves else None)


def _between(limits: Sequence[float], count: int, draws: torch.Generator) -> list[float]:
    low, high = (math.log(limit) for limit in limits)
    return (low + (high - low) * torch.rand(count, generator=draws, dtype=torch.float64)).exp().tolist()


def _moved(row: Example, right: float, up: float, scale: float) -> Example:
    def moved(camera):
        width = camera.field_of_view / scale
        return replace(camera, field_of_view=width, right=camera.right + right * width, up=camera.up + up * width)

    return replace(row, cameras=tuple(moved(camera) for camera in row.cameras))


def _images(folder: Path, count: int, size: int, draws: torch.Generator) -> Tensor:
    """(count, 3, size, size), with repetition."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"augment.vary.backgrounds={folder} holds no image: give a folder of .jpg or .png files")
    chosen = torch.randint(len(files), (count,), generator=draws).tolist()
    return torch.stack([read_image(files[index], size) for index in chosen])
