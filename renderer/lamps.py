"""Point lamps at given places."""

from dataclasses import dataclass, replace
from itertools import chain

import torch
from torch import Tensor

from renderer.basis import Basis, Reach, Sum, parts_of
from renderer.convex import Ball, nearest_in_box
from renderer.errors import FACTOR, InputError, require_range


@dataclass(frozen=True)
class Lamps:
    """A coefficient for each of the places (x, y, z): the irradiance head on at distance 1, from which it falls with
    the square. power: the largest; the least is 0. InputError: no place, or one on the origin.
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

    def reach(self, points: Tensor, normals: Tensor, places: Tensor | None = None) -> Reach:
        """places: (L, 3) of the lamps, in place of their own; the irradiance is differentiable in them, too."""
        places = points.new_tensor(self.places) if places is None else places
        with torch.no_grad():
            point, lamp = torch.nonzero(_irradiance(places - points[:, None], normals[:, None]) > 0, as_tuple=True)
        return Reach(point, lamp, places[lamp], _irradiance(places[lamp] - points[point], normals[point]))


def _irradiance(toward: Tensor, normals: Tensor) -> Tensor:
    """(...) at surfaces of unit normals (..., 3) from lamps of power 1 that are `toward` (..., 3) from there, negative
    behind a surface."""
    return (toward * normals).sum(-1) / toward.square().sum(-1) ** 1.5


def moved(basis: Basis, places: Tensor) -> Basis:
    """The basis with its lamps at places (L, 3)."""
    points = tuple(map(tuple, places.tolist()))
    parts = [replace(part, places=points) if isinstance(part, Lamps) else part for _, part in parts_of(basis)]
    return Sum(tuple(parts)) if isinstance(basis, Sum) else parts[0]
