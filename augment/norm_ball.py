"""Norm-balls in a space of parameters: the exact projection into them and uniform draws from them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from renderer.errors import InputError

NORMS = ("linf", "l2")


@dataclass
class NormBall:
    """All values (D,) within a radius of a centre; radius None is the whole space.

    The paper's radii (Section 4.1): linf 0.1 per lighting coefficient and 0.002 per vertex axis.
    InputError: unknown norm, radius below zero.
    """

    norm: str = "linf"
    radius: float | None = None

    def __post_init__(self):
        if self.norm not in NORMS:
            raise InputError(f"attack: norm={self.norm}: choose one of {', '.join(NORMS)}")
        if self.radius is not None and not self.radius >= 0:
            raise InputError(f"attack: radius={self.radius} must not be below zero, or null for no limit")

    def project(self, values: Tensor, centre: Tensor) -> Tensor:
        """The nearest points of the ball in the Euclidean sense; values and centre (A, D)."""
        if self.radius is None:
            return values
        if self.norm == "linf":
            return values.clamp(centre - self.radius, centre + self.radius)
        offset = values - centre
        length = offset.norm(dim=1, keepdim=True)
        return torch.where(length > self.radius, centre + offset * (self.radius / length), values)

    def sample(self, centre: Tensor, generator: torch.Generator) -> Tensor:
        """A uniform draw around each centre (A, D), on the generator's device. InputError where there is no radius."""
        if self.radius is None:
            raise InputError("attack: radius=null has no uniform draw: set a radius to compare with random ones")
        if self.norm == "linf":
            offset = 2 * torch.rand(centre.shape, generator=generator) - 1
        else:
            direction = torch.randn(centre.shape, generator=generator)
            share = torch.rand(len(centre), 1, generator=generator) ** (1 / centre.shape[1])
            offset = direction / direction.norm(dim=1, keepdim=True) * share
        return centre + self.radius * offset.to(centre)
