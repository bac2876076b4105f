"""Lights that stand in a scene, from its settings."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from augment.backgrounds import load_background
from renderer.arguments import require_fields
from renderer.errors import InputError, require_range
from renderer.files.light_files import read_light
from renderer.lamps import Lamps
from renderer.projector import Projector


@dataclass
class ProjectorSettings:
    """A `Projector`, its angles in degrees. pattern: where attacks begin, in shares of its power: a grey value or an
    image file."""

    pixels: int = 16
    polar: float = 45.0
    azimuth: float = 45.0
    distance: float = 4.0
    field_of_view: float = 30.0
    power: float = 1.0
    pattern: Any = 0.0

    def __post_init__(self) -> None:
        require_fields(self)

    def build(self) -> tuple[Projector, Tensor]:
        """The basis, and the pattern (pixels², 3)."""
        require_range("scene.projector.polar", self.polar, 0, 180)
        require_range("scene.projector.azimuth", self.azimuth, -360, 360)
        require_range("scene.projector.field_of_view", self.field_of_view, 0.1, 170)
        polar, azimuth, field_of_view = map(math.radians, (self.polar, self.azimuth, self.field_of_view))
        basis = Projector(self.pixels, polar, azimuth, self.distance, field_of_view, self.power)
        pattern = load_background(self.pattern, self.pixels, "scene.projector.pattern").expand(3, -1, -1)
        return basis, self.power * pattern.flatten(1).T


@dataclass
class LampsSettings:
    """`Lamps` at places [x, y, z], above four corners unless told otherwise, points or discs of a radius. start: the
    powers that attacks begin with, a number, [r, g, b] of each lamp, or the lamps.json of an adversary, whose places,
    power and radius take the others' place."""

    places: list[Any] = field(default_factory=lambda: [[x, y, 2.0] for x in (2.0, -2.0) for y in (2.0, -2.0)])
    power: float = 10.0
    radius: float = 0.0
    start: Any = 0.0

    def __post_init__(self) -> None:
        require_fields(self)

    def build(self) -> tuple[Lamps, Tensor]:
        """The basis, and the powers (L, 3)."""
        if isinstance(self.start, str):
            lamps, powers = read_light(Path(self.start), Lamps)
            return lamps, lamps.nearest_physical(powers)
        try:
            places = tuple((float(x), float(y), float(z)) for x, y, z in self.places)
            start = torch.tensor(self.start, dtype=torch.float32).expand(len(places), 3)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise InputError(
                f"scene.lamps: give places [x, y, z] and, as start, a number or [r, g, b]s ({error})"
            ) from error
        basis = Lamps(places, self.power, self.radius)
        if not ((start >= 0) & (start <= self.power)).all():  # NaN is neither
            raise InputError(f"scene.lamps.start={self.start}: give powers from 0 to scene.lamps.power={self.power:g}")
        return basis, basis.nearest_physical(start)
