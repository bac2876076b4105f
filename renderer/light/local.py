"""Local lights: lamps (points, or discs that throw soft shadows) and a projector of pixel patterns."""

import math
from dataclasses import dataclass, replace
from itertools import chain

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.camera import OrthographicCamera
from renderer.errors import FACTOR, InputError, require_range
from renderer.light.basis import Basis, LightPaths, LocalBasis, SumBasis, parts_of
from renderer.normals import tangent_axes
from renderer.validation import as_array, require_field_types

SETS, RAYS = 4, 8  # neighboring samples cast rays to different points of a disc: SETS of RAYS points
LARGEST = 256  # pixels per side of a projector


@dataclass(frozen=True)
class Lamps(LocalBasis):
    """Lamps at positions (x, y, z); the coefficient of each is its irradiance at normal incidence at distance 1, which
    falls with the squared distance. power: the largest coefficient; the least is 0.

    radius: of discs that face the origin and emit to the front as diffuse surfaces do, with the cosine of the angle off
    their axis; their coefficient is that of a point that is as bright from afar. 0: points, which shine all around.
    InputError: no position, or one at the origin.
    """

    positions: tuple[tuple[float, float, float], ...]
    power: float = 10.0
    radius: float = 0.0

    name = "lamps"

    def __post_init__(self) -> None:
        positions = as_array("positions", self.positions)
        if positions.shape[1:] != (3,) or not all(map(any, positions)):
            raise InputError(f"lamps.positions={self.positions}: give [x, y, z] of lamps, none at the origin")
        object.__setattr__(self, "positions", tuple(map(tuple, positions.tolist())))
        require_field_types(self, "positions")
        for value in chain(*self.positions):
            require_range("a coordinate of lamps.positions", value, -FACTOR, FACTOR)
        require_range("lamps.power", self.power, 1 / FACTOR, FACTOR)
        require_range("lamps.radius", self.radius, 0, FACTOR)

    def __str__(self) -> str:
        return f"{len(self.positions)} {self.name}"

    @property
    def size(self) -> int:
        return len(self.positions)

    def connect(self, points: Tensor, normals: Tensor, positions: Tensor | None = None) -> LightPaths:
        positions = points.new_tensor(self.positions) if positions is None else positions
        sources = self._discs(positions) if self.radius else positions[None, :, None]
        of_point = torch.arange(len(points), device=points.device) % len(sources)
        with torch.no_grad():
            toward = sources[of_point] - points[:, None, None]
            received = self._irradiance(toward, normals[:, None, None], positions[:, None])
            point, lamp, ray = torch.nonzero(received > 0, as_tuple=True)
        source = sources[of_point[point], lamp, ray]
        received = self._irradiance(source - points[point], normals[point], positions[lamp])
        return LightPaths(point, lamp, source, received / sources.shape[2])

    def _discs(self, positions: Tensor) -> Tensor:
        """(SETS, L, RAYS, 3) points that divide each disc equally: Vogel's spiral (1979), turned in each set."""
        number, ray = torch.meshgrid(torch.arange(SETS), torch.arange(RAYS), indexing="ij")
        distance = self.radius * ((ray + (number + 0.5) / SETS) / RAYS).sqrt()
        angle = ray * math.pi * (3 - math.sqrt(5)) + number * 2 * math.pi / SETS
        across = torch.stack([distance * angle.cos(), distance * angle.sin()], dim=2).to(positions)
        x, y, z = F.normalize(positions, dim=1).unbind(1)
        sign = torch.where(z < -0.5, -1.0, 1.0).to(z)  # the axes jump where a disc faces 30° off straight down
        axes = torch.stack([torch.stack(axis, dim=1) for axis in tangent_axes(x, y, z, sign)], dim=1)
        return positions[:, None] + torch.einsum("sra,laj->slrj", across, axes)

    def _irradiance(self, toward: Tensor, normals: Tensor, positions: Tensor) -> Tensor:
        """(...) irradiance at power 1 of surfaces with unit normals (..., 3) from lamps at positions (..., 3); toward:
        from surface to lamp. Not above 0 behind a surface or a disc."""
        squared = toward.square().sum(-1)
        received = (toward * normals).sum(-1) / squared**1.5
        if not self.radius:
            return received
        return received * ((toward * F.normalize(positions, dim=-1)).sum(-1) / squared.sqrt()).clamp(min=0)


def moved(basis: Basis, positions: Tensor) -> Basis:
    """The basis with its lamps at positions (L, 3)."""
    points = tuple(map(tuple, positions.tolist()))
    parts = [replace(part, positions=points) if isinstance(part, Lamps) else part for _, part in parts_of(basis)]
    return SumBasis(tuple(parts)) if isinstance(basis, SumBasis) else parts[0]


@dataclass(frozen=True)
class Projector(LocalBasis):
    """Patterns of pixels² coefficients, row by row from the top left, as a screen shows them.

    polar, azimuth: of its position off +z and +x, in radians; it aims at the origin from `distance`. fov: the angle
    between opposite sides, in radians. A coefficient of 1 gives a white surface at the origin that faces the projector
    the radiance 1; the light falls with the squared distance and is even on a flat screen. power: the largest
    coefficient; the least is 0. InputError: settings out of range.
    """

    pixels: int = 16
    polar: float = math.pi / 3
    azimuth: float = 0.5
    distance: float = 4.0
    fov: float = math.radians(30)
    power: float = 1.0

    name = "projector"

    def __post_init__(self) -> None:
        require_field_types(self)
        require_range("projector.pixels", self.pixels, 1, LARGEST)
        require_range("projector.distance", self.distance, 2, FACTOR)
        require_range("projector.fov", self.fov, 1e-3, 3)
        require_range("projector.power", self.power, 1 / FACTOR, FACTOR)

    def __str__(self) -> str:
        return f"a {self.name} of {self.pixels}² pixels"

    @property
    def size(self) -> int:
        return self.pixels**2

    def connect(self, points: Tensor, normals: Tensor, positions: Tensor | None = None) -> LightPaths:
        """One path for each point within the pattern."""
        axes = torch.from_numpy(OrthographicCamera(self.polar, self.azimuth, 1.0).axes()).to(points)
        source = self.distance * axes[2]
        right, up, back = ((points - source) @ axes.T).unbind(1)
        depth, edge = -back, math.tan(self.fov / 2)
        column = ((1 + right / (depth * edge)) / 2 * self.pixels).floor()
        row = ((1 - up / (depth * edge)) / 2 * self.pixels).floor()
        cosine = ((source - points) * normals).sum(1) / depth  # over that of the angle from the axis
        within = (row >= 0) & (row < self.pixels) & (column >= 0) & (column < self.pixels)
        point = torch.nonzero(within & (depth > 0) & (cosine > 0)).squeeze(1)
        irradiance = cosine * (self.distance / depth) ** 2
        function = (row * self.pixels + column)[point].long()
        return LightPaths(point, function, source.expand(len(point), 3), irradiance[point])
