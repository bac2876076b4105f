"""Point lamps at given places."""

from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from renderer.basis import Reach
from renderer.convex import Ball, nearest_in_box
from renderer.errors import FACTOR, InputError, require_range


@dataclass(frozen=True)
class Lamps:
    """A coefficient for each of the places (x, y, z): the irradiance head on at distance 1, from which it falls with
    the square. power: the largest; the least is 0. InputError: no place, or one on the origin.

    No surface is farther away than a lamp on the same way, so that nothing behind a lamp is in the way.
    """

    places: tuple[tuple[float, float, float], ...]
    power: float = 10.0

    name = "lamps"
    signed = False

    def __post_init__(self) -> None:
        if not self.places or not all(len(place) == 3 and any(place) for place in self.places):
            raise InputError(f"lamps.places={self.places}: give [x, y, z] of at least one lamp, none at the origin")
        for value in chain(*self.places):
            require_range("a coordinate of lamps.places", value, -FACTOR, FACTOR)
        require_range("lamps.power", self.power, 1 / FACTOR, FACTOR)

    def __str__(self) -> str:
        return f"{len(self.places)} {self.name}"

    @property
    def size(self) -> int:
        return len(self.places)

    def nearest_physical(self, coefficients: Tensor, within: Ball | None = None) -> Tensor:
        return nearest_in_box(coefficients, 0, self.power, within)

    def reach(self, points: Tensor, normals: Tensor) -> Reach:
        toward = points.new_tensor(self.places) - points[:, None]
        distance = toward.norm(dim=2)
        cosine = (toward * normals[:, None]).sum(2) / distance
        point, lamp = torch.nonzero(cosine > 0, as_tuple=True)
        irradiance = (cosine / distance**2)[point, lamp]
        return Reach(point, lamp, points.new_tensor(self.places)[lamp], irradiance)
