"""A projector: a pattern of pixels thrown from a place onto what is there."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from renderer.basis import Placed, Reach
from renderer.camera import OrthographicCamera
from renderer.errors import FACTOR, require_range

LARGEST = 256  # pixels per side


@dataclass(frozen=True)
class Projector(Placed):
    """Patterns of pixels² coefficients, row by row from the top left, as a screen shows them.

    It stands at polar angle θ off +z and azimuth φ off +x, in radians, `distance` from the origin, which it aims at;
    field_of_view: the angle between opposite sides, in radians. A coefficient of 1 makes a white surface at the origin
    that faces it as bright as radiance 1; it falls with the square of the distance, and on a flat screen it is even, as
    projectors are made. power: the largest coefficient; the least is 0. InputError: settings out of range.
    """

    pixels: int = 16
    polar: float = math.pi / 3
    azimuth: float = 0.5
    distance: float = 4.0
    field_of_view: float = math.radians(30)
    power: float = 1.0

    name = "projector"

    def __post_init__(self) -> None:
        require_range("projector.pixels", self.pixels, 1, LARGEST)
        require_range("projector.distance", self.distance, 2, FACTOR)
        require_range("projector.field_of_view", self.field_of_view, 1e-3, 3)
        require_range("projector.power", self.power, 1 / FACTOR, FACTOR)

    def __str__(self) -> str:
        return f"a {self.name} of {self.pixels}² pixels"

    @property
    def size(self) -> int:
        return self.pixels**2

    def reach(self, points: Tensor, normals: Tensor) -> Reach:
        """One pixel reaches a point."""
        axes = torch.from_numpy(OrthographicCamera(self.polar, self.azimuth, 1.0).axes()).to(points)
        place = self.distance * axes[2]
        right, up, back = ((points - place) @ axes.T).unbind(1)
        depth, edge = -back, math.tan(self.field_of_view / 2)
        column = ((1 + right / (depth * edge)) / 2 * self.pixels).floor()
        row = ((1 - up / (depth * edge)) / 2 * self.pixels).floor()
        cosine = ((place - points) * normals).sum(1) / depth  # over that of the angle from the axis
        within = (row >= 0) & (row < self.pixels) & (column >= 0) & (column < self.pixels)
        (point,) = torch.nonzero(within & (depth > 0) & (cosine > 0), as_tuple=True)
        function = (row * self.pixels + column)[point].long()
        irradiance = (cosine * (self.distance / depth) ** 2)[point]
        return Reach(point, function, place.expand(len(point), 3), irradiance)
