"""Lamps: points that emit in all directions, or discs that cast soft shadows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.camera import PerspectiveCamera
from renderer.errors import MAX_SCALE, InputError, require_range
from renderer.io.mitsuba_entries import pose_of
from renderer.light.basis import LightPaths, LocalBasis
from renderer.light.light_files import read_light
from renderer.settings import require_field_types
from renderer.validation import as_array, as_tensor
from renderer.vectors import tangent_axes

# Neighboring samples cast rays to different points of a disc: to one of SETS
# sets, of RAYS points each.
SETS, RAYS = 4, 8


@dataclass(frozen=True)
class Lamps(LocalBasis):
    """Lamps at fixed positions, of which each has one coefficient.

    The coefficient of a lamp is its irradiance at normal incidence at distance
    1. The irradiance falls with the squared distance.

    Attributes:
        positions: Position (x, y, z) of each lamp, none at the origin.
        power: The largest coefficient. The smallest is 0.
        radius: Radius of discs that face the origin. They emit to the front as
            diffuse surfaces do, with the cosine of the angle off their axis. Their
            coefficient is that of a point that is as bright from afar. With 0, the
            lamps are points, which shine all around.

    Raises:
        InputError: If there is no position, or one at the origin.

    Example:
        >>> import norm_balls as nb
        >>> lamps = nb.Lamps(((2.0, 0.0, 2.0), (0.0, 2.0, 2.0)), radius=0.2)
        >>> lamps.size, str(lamps)
        (2, '2 lamps')
    """

    positions: tuple[tuple[float, float, float], ...]
    power: float = 10.0
    radius: float = 0.0

    name = "lamps"
    is_movable = True

    def __post_init__(self) -> None:
        positions = as_array("positions", self.positions)
        if positions.shape[1:] != (3,) or not all(map(any, positions)):
            raise InputError(
                f"lamps.positions={self.positions}: give [x, y, z] of lamps, none at the origin"
            )
        object.__setattr__(self, "positions", tuple(map(tuple, positions.tolist())))
        require_field_types(self, "positions")
        for value in chain(*self.positions):
            require_range("a coordinate of lamps.positions", value, -MAX_SCALE, MAX_SCALE)
        require_range("lamps.power", self.power, 1 / MAX_SCALE, MAX_SCALE)
        require_range("lamps.radius", self.radius, 0, MAX_SCALE)

    @classmethod
    def from_settings(cls, settings: Any) -> tuple[Self, Tensor]:
        if isinstance(settings.start, str | Path):
            lamps, powers = read_light(settings.start, cls)
            return lamps, lamps.project_nonnegative(powers)
        try:
            positions = tuple((float(x), float(y), float(z)) for x, y, z in settings.positions)
            start = as_tensor("start", settings.start).float().expand(len(positions), 3)
        except InputError:
            raise
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            remedy = "give positions [x, y, z], and a number or [r, g, b]s as start"
            raise InputError(f"lamps: {remedy} ({error})") from error
        lamps = cls(positions, settings.power, settings.radius)
        # NaN is not in the range, either.
        if not ((start >= 0) & (start <= settings.power)).all():
            limit = f"power={settings.power:g}"
            raise InputError(f"start={settings.start}: give powers from 0 to {limit}")
        return lamps, lamps.project_nonnegative(start)

    def __str__(self) -> str:
        return f"{len(self.positions)} {self.name}"

    @property
    def size(self) -> int:
        return len(self.positions)

    def source_positions(self) -> Tensor:
        return torch.tensor(self.positions)

    def moved(self, positions: Tensor) -> Self:
        return replace(self, positions=tuple(map(tuple, positions.tolist())))

    def connect(
        self, points: Tensor, normals: Tensor, positions: Tensor | None = None
    ) -> LightPaths:
        positions = points.new_tensor(self.positions) if positions is None else positions
        # Shape (sets, L, rays, 3). A point has one set of one ray.
        sources = self._disc_points(positions) if self.radius else positions[None, :, None]
        set_of_point = torch.arange(len(points), device=points.device) % len(sources)
        with torch.no_grad():
            toward = sources[set_of_point] - points[:, None, None]
            received = self._irradiance(toward, normals[:, None, None], positions[:, None])
            point, lamp, ray = torch.nonzero(received > 0, as_tuple=True)
        source = sources[set_of_point[point], lamp, ray]
        received = self._irradiance(source - points[point], normals[point], positions[lamp])
        return LightPaths(point, lamp, source, received / sources.shape[2])

    def mitsuba_emitters(self, coefficients: Tensor, albedo_scale: float) -> list[dict[str, Any]]:
        intensities = math.pi * albedo_scale * coefficients
        describe = self._mitsuba_disc if self.radius else self._mitsuba_point
        return [
            describe(position, intensity.tolist())
            for position, intensity in zip(self.positions, intensities, strict=True)
        ]

    def _disc_points(self, positions: Tensor) -> Tensor:
        """Return points (SETS, L, RAYS, 3) that divide each disc at positions (L, 3) equally.

        They lie on Vogel's spiral (1979), which is turned in each set.
        """
        number, ray = torch.meshgrid(torch.arange(SETS), torch.arange(RAYS), indexing="ij")
        distance = self.radius * ((ray + (number + 0.5) / SETS) / RAYS).sqrt()
        angle = ray * math.pi * (3 - math.sqrt(5)) + number * 2 * math.pi / SETS
        across = torch.stack([distance * angle.cos(), distance * angle.sin()], dim=2).to(positions)
        x, y, z = F.normalize(positions, dim=1).unbind(1)
        # The axes jump where a disc faces 30° off straight down.
        sign = torch.where(z < -0.5, -1.0, 1.0).to(z)
        axes = [torch.stack(axis, dim=1) for axis in tangent_axes(x, y, z, sign)]
        offsets = torch.einsum("sra,laj->slrj", across, torch.stack(axes, dim=1))
        return positions[:, None] + offsets

    def _irradiance(self, toward: Tensor, normals: Tensor, positions: Tensor) -> Tensor:
        """Return the irradiance (...) of surfaces from lamps with a coefficient of 1.

        The arguments are the vectors from surface to lamp, the unit normals of
        the surface and the positions of the lamps, (..., 3) each. The result is
        not above 0 behind a surface or a disc.
        """
        squared = toward.square().sum(-1)
        received = (toward * normals).sum(-1) / squared**1.5
        if not self.radius:
            return received
        cosine = (toward * F.normalize(positions, dim=-1)).sum(-1) / squared.sqrt()
        return received * cosine.clamp(min=0)

    def _mitsuba_point(
        self, position: tuple[float, float, float], intensity: list[float]
    ) -> dict[str, Any]:
        """Describe a lamp without extent for Mitsuba."""
        color = {"type": "rgb", "value": intensity}
        return {"type": "point", "position": list(position), "intensity": color}

    def _mitsuba_disc(
        self, position: tuple[float, float, float], intensity: list[float]
    ) -> dict[str, Any]:
        """Describe a disc for Mitsuba, whose disks have radius 1 and shine along +z.

        The radiance is that of a far point's intensity on the disc's area.
        """
        x, y, z = position
        polar = math.degrees(math.atan2(math.hypot(x, y), z))
        azimuth = math.degrees(math.atan2(y, x))
        camera = PerspectiveCamera(polar, azimuth, 1.0, distance=math.hypot(x, y, z))
        area = math.pi * self.radius**2
        radiance = {"type": "rgb", "value": [channel / area for channel in intensity]}
        emitter = {"type": "area", "radiance": radiance}
        return {"type": "disk", "to_world": pose_of(camera, self.radius), "emitter": emitter}
