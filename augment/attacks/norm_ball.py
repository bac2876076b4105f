"""Norm-balls in a space of parameters: the exact projection into them and uniform draws from them."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from renderer.errors import FACTOR, InputError, require_choice, require_range
from renderer.light.convex import Ball, nearest_in_box

NORMS = ("linf", "l2")


class Domain(Protocol):
    """A convex set of values (D,)."""

    def __call__(self, values: Tensor, within: Ball | None = None) -> Tensor:
        """Its nearest points to values (A, D), within a ball whose centers are of it."""


def anywhere(values: Tensor, within: Ball | None = None) -> Tensor:
    """The domain without a bound."""
    return nearest_in_box(values, -math.inf, math.inf, within)


@dataclass
class NormBall:
    """All values (D,) within a radius of a center; radius None is the whole space.

    The paper's radii (Section 4.1): linf 0.1 per lighting coefficient and 0.002 per vertex axis.
    InputError: unknown norm, radius below zero.
    """

    norm: str = "linf"
    radius: float | None = None

    def __post_init__(self) -> None:
        require_choice("attack: norm", self.norm, NORMS)
        require_range("attack: radius", self.radius, 0, FACTOR)  # no limit: null

    def project(self, values: Tensor, center: Tensor, domain: Domain = anywhere) -> Tensor:
        """The nearest points of what ball and domain share, in the Euclidean sense; values and center (A, D).

        The domain holds the center.
        """
        return domain(values, within=None if self.radius is None else Ball(center, self.radius, self.norm))

    def sample(self, center: Tensor, generator: torch.Generator, used: Tensor | None = None) -> Tensor:
        """A uniform draw around each center (A, D), on the generator's device. InputError where there is no radius.

        used: (A, D) bool, the axes along which each is drawn; None for all.
        """
        if self.radius is None:
            raise InputError("attack: radius=null has no uniform draw: set a radius to compare with random ones")
        if self.norm == "linf":
            offset = 2 * torch.rand(center.shape, generator=generator) - 1
        else:
            direction = torch.randn(center.shape, generator=generator)
            axes: int | Tensor = center.shape[1]
            if used is not None:
                direction, axes = direction * used.cpu(), used.cpu().sum(1, keepdim=True)
            share = torch.rand(len(center), 1, generator=generator) ** (1 / axes)
            offset = direction / direction.norm(dim=1, keepdim=True) * share
        if used is not None:
            offset = offset * used.cpu()
        return center + self.radius * offset.to(center)
