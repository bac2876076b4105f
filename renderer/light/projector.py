"""A projector of pixel patterns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

from renderer.camera import MAX_FOV, MIN_FOV, OrthographicCamera, PerspectiveCamera
from renderer.errors import MAX_SCALE, require_range
from renderer.io.images import gray_or_image
from renderer.io.mitsuba_entries import pose_of, projector
from renderer.light.basis import LightPaths, LocalBasis
from renderer.settings import require_field_types

MAX_PIXELS = 256  # The largest number of pixels per side.


@dataclass(frozen=True)
class Projector(LocalBasis):
    """A projector that aims at the origin, with a coefficient for each of its pixels² pixels.

    The pixels follow row by row from the top left, as a screen shows them. A
    coefficient of 1 gives a white surface at the origin that faces the projector
    the radiance 1. The light falls with the squared distance and is even on a
    flat screen.

    Attributes:
        pixels: Pixels per side, at most 256.
        polar: Angle of the position off +z, in degrees.
        azimuth: Angle of the position off +x toward +y, in degrees.
        distance: Distance from the origin, at least 2.
        fov: Angle between opposite sides of the pattern, in degrees, from 0.05 to 172.
        power: The largest coefficient. The smallest is 0.

    Raises:
        InputError: If an attribute is out of range.

    Example:
        >>> import norm_balls as nb
        >>> beamer = nb.Projector(pixels=4)
        >>> beamer.size, str(beamer)
        (16, 'a projector of 4² pixels')
    """

    pixels: int = 16
    polar: float = 60.0
    azimuth: float = 30.0
    distance: float = 4.0
    fov: float = 30.0
    power: float = 1.0

    name = "projector"

    def __post_init__(self) -> None:
        require_field_types(self)
        require_range("projector.pixels", self.pixels, 1, MAX_PIXELS)
        require_range("projector.distance", self.distance, 2, MAX_SCALE)
        require_range("projector.fov", self.fov, MIN_FOV, MAX_FOV)
        require_range("projector.power", self.power, 1 / MAX_SCALE, MAX_SCALE)

    @classmethod
    def from_settings(cls, settings: Any) -> tuple[Self, Tensor]:
        require_range("polar", settings.polar, 0, 180)
        require_range("azimuth", settings.azimuth, -360, 360)
        require_range("fov", settings.fov, 0.1, 170)
        light = cls(
            pixels=settings.pixels,
            polar=settings.polar,
            azimuth=settings.azimuth,
            distance=settings.distance,
            fov=settings.fov,
            power=settings.power,
        )
        pattern = gray_or_image("pattern", settings.pattern, light.pixels).expand(3, -1, -1)
        return light, light.power * pattern.flatten(1).T

    def __str__(self) -> str:
        return f"a {self.name} of {self.pixels}² pixels"

    @property
    def size(self) -> int:
        return self.pixels**2

    def picture(self, coefficients: Tensor) -> Tensor:
        """Return coefficients (size, 3) as an image (pixels, pixels, 3). Its 1 is the power."""
        return coefficients.view(self.pixels, self.pixels, 3) / self.power

    def connect(
        self, points: Tensor, normals: Tensor, positions: Tensor | None = None
    ) -> LightPaths:
        """Find one path for each point within the pattern.

        Args:
            points: Points of surfaces, shape (N, 3).
            normals: Unit normals at the points, shape (N, 3).
            positions: Not used, because a projector cannot be moved.

        Returns:
            Paths from pixels of the pattern to points.
        """
        axes = torch.from_numpy(OrthographicCamera(self.polar, self.azimuth, 1.0).axes()).to(points)
        source = self.distance * axes[2]
        right, up, back = ((points - source) @ axes.T).unbind(1)
        depth = -back
        edge = math.tan(math.radians(self.fov) / 2)
        column = ((1 + right / (depth * edge)) / 2 * self.pixels).floor()
        row = ((1 - up / (depth * edge)) / 2 * self.pixels).floor()
        # The cosine at the surface over that of the angle from the axis.
        cosine = ((source - points) * normals).sum(1) / depth
        in_rows = (row >= 0) & (row < self.pixels)
        in_columns = (column >= 0) & (column < self.pixels)
        is_lit = in_rows & in_columns & (depth > 0) & (cosine > 0)
        point = torch.nonzero(is_lit).squeeze(1)
        irradiance = cosine * (self.distance / depth) ** 2
        function = (row * self.pixels + column)[point].long()
        return LightPaths(point, function, source.expand(len(point), 3), irradiance[point])

    def mitsuba_emitters(self, coefficients: Tensor, albedo_scale: float) -> list[dict[str, Any]]:
        # The radiance of Mitsuba's projector is over π already.
        texels = coefficients.view(self.pixels, self.pixels, 3).numpy()
        pattern = {"bitmap": texels, "filter_type": "nearest", "wrap_mode": "clamp"}
        camera = PerspectiveCamera(self.polar, self.azimuth, 1.0, distance=self.distance)
        scale = albedo_scale * self.distance**2
        return [projector(pose_of(camera), self.fov, pattern, scale)]
