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

# Largest number of pixels along one side of a projected pattern.
MAX_PIXELS = 256


@dataclass(frozen=True)
class Projector(LocalBasis):
    """Projector that aims at the origin, with one RGB coefficient for each pixel of its pattern.

    The pattern has pixels² pixels. Their coefficients are in row-major order
    from the top left, as a screen would show the pattern. A white surface at the
    origin that faces the projector gets the radiance 1 from a coefficient of 1.
    The light falls with the squared distance. A pattern with equal coefficients
    lights a flat screen at the origin uniformly.

    Attributes:
        pixels: Number of pixels along one side of the pattern, at most 256.
        polar: Angle between +z and the position of the projector, in degrees.
        azimuth: Azimuth of the projector in degrees, measured from +x toward +y.
        distance: Distance from the origin in world units, at least 2.
        fov: Angle between opposite sides of the pattern, in degrees, from 0.05
            to 172.
        power: Largest coefficient. The smallest coefficient is 0.

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
        """Check the fields."""
        require_field_types(self)
        require_range("projector.pixels", self.pixels, 1, MAX_PIXELS)
        require_range("projector.distance", self.distance, 2, MAX_SCALE)
        require_range("projector.fov", self.fov, MIN_FOV, MAX_FOV)
        require_range("projector.power", self.power, 1 / MAX_SCALE, MAX_SCALE)

    @classmethod
    def from_settings(cls, settings: Any) -> tuple[Self, Tensor]:
        """Create a projector and its pattern from settings.

        Args:
            settings: `ProjectorSettings` of `augment.settings`. Its field `pattern`
                is a gray value in [0, 1] or the path of an image.

        Returns:
            A tuple of
            - the projector;
            - the RGB coefficients of its pixels, shape (pixels², 3).

        Raises:
            InputError: If a setting is out of range, or if the image cannot be
                read.
        """
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
        """Number of pixels of the projector."""
        return self.pixels**2

    def picture(self, coefficients: Tensor) -> Tensor:
        """Convert coefficients to an image of the pattern.

        Args:
            coefficients: RGB coefficients, shape (pixels², 3).

        Returns:
            Image in [0, 1], in which 1 is a coefficient of `power`,
            shape (pixels, pixels, 3).
        """
        return coefficients.view(self.pixels, self.pixels, 3) / self.power

    def connect(
        self, points: Tensor, normals: Tensor, positions: Tensor | None = None
    ) -> LightPaths:
        """Find the straight path from the projector to each surface point that it lights.

        Args:
            points: N surface points in world axes, shape (N, 3).
            normals: Unit normals at the points, shape (N, 3).
            positions: Not used, because a projector cannot be moved.

        Returns:
            One path for each point that lies within the pattern and faces the
            projector, also if an object blocks the path.
        """
        # Axes of the pattern, one for each row: right, up and back (away from the origin). A
        # camera at the position of the projector has the same axes.
        axes = torch.from_numpy(OrthographicCamera(self.polar, self.azimuth, 1.0).axes()).to(points)
        source = self.distance * axes[2]
        right, up, back = ((points - source) @ axes.T).unbind(1)
        depth = -back
        # Half the width of the pattern on a screen at distance 1 from the projector.
        half_width = math.tan(math.radians(self.fov) / 2)
        column = ((1 + right / (depth * half_width)) / 2 * self.pixels).floor()
        row = ((1 - up / (depth * half_width)) / 2 * self.pixels).floor()
        # Cosine between path and normal, divided by the cosine between path and axis.
        cosine_ratio = ((source - points) * normals).sum(1) / depth
        in_rows = (row >= 0) & (row < self.pixels)
        in_columns = (column >= 0) & (column < self.pixels)
        is_lit = in_rows & in_columns & (depth > 0) & (cosine_ratio > 0)
        lit_point = torch.nonzero(is_lit).squeeze(1)
        irradiance = cosine_ratio * (self.distance / depth) ** 2
        pattern_pixel = (row * self.pixels + column)[lit_point].long()
        return LightPaths(
            point=lit_point,
            function=pattern_pixel,
            source=source.expand(len(lit_point), 3),
            irradiance=irradiance[lit_point],
        )

    def mitsuba_emitters(self, coefficients: Tensor, albedo_scale: float) -> list[dict[str, Any]]:
        """Create the entry of the projector in a Mitsuba scene.

        Args:
            coefficients: RGB coefficients of the pixels, shape (pixels², 3).
            albedo_scale: Factor for the albedo of the mesh. Here it multiplies the
                light, which gives the same image.

        Returns:
            List with one entry.
        """
        texels = coefficients.view(self.pixels, self.pixels, 3).numpy()
        pattern = {"bitmap": texels, "filter_type": "nearest", "wrap_mode": "clamp"}
        camera = PerspectiveCamera(self.polar, self.azimuth, 1.0, distance=self.distance)
        # The coefficients are irradiances at the origin. Mitsuba needs those at distance 1
        # from the projector, which are larger by the factor distance². Mitsuba
        # itself multiplies them by π.
        scale = albedo_scale * self.distance**2
        return [projector(pose_of(camera), self.fov, pattern, scale)]
