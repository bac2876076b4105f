"""Norm-balls, and the nearest values within a box and a ball."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

_STEPS = 20  # four are usual; after fewer than needed the result is within the ball, but not at its surface


@dataclass(frozen=True)
class Ball:
    """Values (A, ...), each within a radius of its center, in the norm "linf" or "l2"."""

    center: Tensor
    radius: float
    norm: str

    def unflatten(self, *shape: int) -> Ball:
        """The ball of values (A, *shape), of a ball of values (A, D)."""
        return Ball(self.center.unflatten(1, shape), self.radius, self.norm)

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """The lowest and the highest values, where the norm is "linf"."""
        return self.center - self.radius, self.center + self.radius


def nearest_in_box(values: Tensor, low: Any, high: Any, within: Ball | None = None) -> Tensor:
    """The values from `low` to `high`, numbers or tensors, that are nearest to values (A, ...) in the Euclidean sense.
    within: a ball, whose centers lie there."""
    if within is None:
        return values.clamp(low, high)
    if within.norm == "linf":
        return values.clamp(low, high).clamp(*within.ends)
    return _nearest_in_box_and_sphere(values, low, high, within)


def _nearest_in_box_and_sphere(values: Tensor, low: Any, high: Any, ball: Ball) -> Tensor:
    """With a multiplier λ for the ball, the nearest point is the box's nearest to c + (v - c) / (1 + λ).

    Its squared distance from the center c is a concave and piecewise linear function of s = 1 / (1 + λ)². From s = 0
    on, Newton's steps therefore end where the distance is the radius, without going beyond.
    """
    offset, squared = values - ball.center, ball.radius**2
    fraction, slope, distance = offset.new_zeros(()), _square(offset), offset.new_zeros(())
    for _ in range(_STEPS):
        step = (squared - distance) / slope.clamp(min=torch.finfo(values.dtype).tiny)
        fraction = (fraction + step.clamp(min=0)).clamp(max=1)
        target = torch.where(fraction < 1, ball.center + fraction.sqrt() * offset, values)
        nearest = target.clamp(low, high)
        slope, distance = _square(offset * (nearest == target)), _square(nearest - ball.center)
        if not ((fraction < 1) & (squared - distance > 8 * torch.finfo(values.dtype).eps * squared)).any():
            break
    return nearest


def _square(offsets: Tensor) -> Tensor:
    """(A, 1, ...): the squared length of offsets (A, ...)."""
    return offsets.square().sum(tuple(range(1, offsets.dim())), keepdim=True)
