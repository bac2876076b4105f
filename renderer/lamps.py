"""Lamps at given places: points, or discs that throw soft shadows."""

import math
from dataclasses import dataclass, replace
from itertools import chain

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.basis import Basis, Placed, Reach, Sum, parts_of
from renderer.errors import FACTOR, InputError, require_range

SHARES, RAYS = 4, 8  # neighbouring samples look at other points of a disc, in turns of so many, at so many each


@dataclass(frozen=True)
class Lamps(Placed):
    """A coefficient for each of the places (x, y, z): the irradiance head on at distance 1, from which it falls with
    the square. power: the largest; the least is 0.

    radius: of discs that face the origin and shine to the front as diffuse surfaces do, so that off their axis it is
    less by the cosine; the coefficient is that of a point as bright from afar. 0: points, which shine all around.
    InputError: no place, or one on the origin.
    """

    places: tuple[tuple[float, float, float], ...]
    power: float = 10.0
    radius: float = 0.0

    name = "lamps"

    def __post_init__(self) -> None:
        if not self.places or not all(len(place) == 3 and any(place) for place in self.places):
            raise InputError(f"lamps.places={self.places}: give [x, y, z] of at least one lamp, none at the origin")
        for value in chain(*self.places):
            require_range("a coordinate of lamps.places", value, -FACTOR, FACTOR)
        require_range("lamps.power", self.power, 1 / FACTOR, FACTOR)
        require_range("lamps.radius", self.radius, 0, FACTOR)

    def __str__(self) -> str:
        return f"{len(self.places)} {self.name}"

    @property
    def size(self) -> int:
        return len(self.places)

    def reach(self, points: Tensor, normals: Tensor, places: Tensor | None = None) -> Reach:
        """places: (L, 3) of the lamps, in place of their own; the irradiance is differentiable in them, too."""
        places = points.new_tensor(self.places) if places is None else places
        sources = self._discs(places) if self.radius else places[None, :, None]
        share = torch.arange(len(points), device=points.device) % len(sources)
        with torch.no_grad():
            toward = sources[share] - points[:, None, None]
            received = self._irradiance(toward, normals[:, None, None], places[:, None])
            point, lamp, ray = torch.nonzero(received > 0, as_tuple=True)
        source = sources[share[point], lamp, ray]
        received = self._irradiance(source - points[point], normals[point], places[lamp])
        return Reach(point, lamp, source, received / sources.shape[2])

    def _discs(self, places: Tensor) -> Tensor:
        """(SHARES, L, RAYS, 3) points, each of which stands for as much of its disc: Vogel's spiral (1979), in each
        share turned and a little farther out."""
        share, ray = torch.meshgrid(torch.arange(SHARES), torch.arange(RAYS), indexing="ij")
        distance = self.radius * ((ray + (share + 0.5) / SHARES) / RAYS).sqrt()
        angle = ray * math.pi * (3 - math.sqrt(5)) + share * 2 * math.pi / SHARES
        across = torch.stack([distance * angle.cos(), distance * angle.sin()], dim=2).to(places)
        return places[:, None] + torch.einsum("sra,laj->slrj", across, _axes_across(F.normalize(places, dim=1)))

    def _irradiance(self, toward: Tensor, normals: Tensor, places: Tensor) -> Tensor:
        """(...) at surfaces of unit normals (..., 3) from power 1 that is `toward` (..., 3) from there, of lamps at
        places (..., 3); not above 0 behind a surface or a disc."""
        squared = toward.square().sum(-1)
        received = (toward * normals).sum(-1) / squared**1.5
        if not self.radius:
            return received
        return received * ((toward * F.normalize(places, dim=-1)).sum(-1) / squared.sqrt()).clamp(min=0)


def _axes_across(back: Tensor) -> Tensor:
    """(L, 2, 3) at right angles to unit vectors (L, 3) and to each other (Duff et al. 2017), smooth but where a disc is
    halfway to straight below."""
    x, y, z = back.unbind(1)
    sign = torch.where(z < -0.5, -1.0, 1.0).to(back)
    share = -1 / (sign + z)
    first = torch.stack([1 + sign * x * x * share, sign * x * y * share, -sign * x], dim=1)
    return torch.stack([first, torch.stack([x * y * share, sign + y * y * share, -y], dim=1)], dim=1)


def moved(basis: Basis, places: Tensor) -> Basis:
    """The basis with its lamps at places (L, 3)."""
    points = tuple(map(tuple, places.tolist()))
    parts = [replace(part, places=points) if isinstance(part, Lamps) else part for _, part in parts_of(basis)]
    return Sum(tuple(parts)) if isinstance(basis, Sum) else parts[0]
