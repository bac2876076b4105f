"""Projections onto a ball, a box and their intersection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

_SECANTS = 20  # four are usual; what they end with is within the ball, at most that much short of the nearest


@dataclass(frozen=True)
class Ball:
    """Values (A, ...), each within a radius of its center, in the norm "linf" or "l2"."""

    center: Tensor
    radius: float
    norm: str

    def unflatten(self, *shape: int) -> Ball:
        """That of values (A, *shape), of one of values (A, D)."""
        return Ball(self.center.unflatten(1, shape), self.radius, self.norm)

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """The lowest and the highest values, where the norm is "linf"."""
        return self.center - self.radius, self.center + self.radius


def nearest_in_box(values: Tensor, low: Any, high: Any, within: Ball | None = None) -> Tensor:
    """The values from `low` to `high`, numbers or tensors, that are nearest to values (A, ...) in the Euclidean sense.

    within: a ball, whose centers lie there.
    """
    if within is None:
        return values.clamp(low, high)
    if within.norm == "linf":
        return values.clamp(low, high).clamp(*within.ends)
    return _nearest_in_box_and_sphere(values, low, high, within)


def _nearest_in_box_and_sphere(values: Tensor, low: Any, high: Any, ball: Ball) -> Tensor:
    """The box's nearest points to points on the way from the center to the values, as far as the radius goes.

    With a multiplier λ for the ball, what is nearest to values v is the box's nearest to c + (v - c) / (1 + λ), and
    the farther on the way, the farther from the center. How far is found by secants of the squared distance over the
    squared fraction of the way, which is straight between the corners that the box cuts off.
    """
    offset, squared = values - ball.center, ball.radius**2

    def at(fraction: Tensor) -> tuple[Tensor, Tensor]:
        nearest = torch.where(fraction < 1, ball.center + fraction.sqrt() * offset, values).clamp(low, high)
        return nearest, _square(nearest - ball.center)

    fraction = (squared / _square(offset)).clamp(max=1)  # a box's nearest points are no farther
    nearest, distance = at(fraction)
    other, other_distance = torch.zeros_like(fraction), torch.zeros_like(distance)
    rounding = 8 * torch.finfo(values.dtype).eps * squared
    for _ in range(_SECANTS):
        left = squared - distance
        going = (fraction < 1) & (fraction != other) & (left > rounding)
        if not going.any():
            break
        slope = ((distance - other_distance) / (fraction - other)).clamp(min=torch.finfo(values.dtype).tiny)
        trial = torch.where(going, fraction + left / slope, fraction).clamp(max=1)
        candidate, trial_distance = at(trial)
        inside = trial_distance <= squared + rounding
        other = torch.where(inside, fraction, trial)
        other_distance = torch.where(inside, distance, trial_distance)
        fraction, distance = torch.where(inside, trial, fraction), torch.where(inside, trial_distance, distance)
        nearest = torch.where(inside, candidate, nearest)
    return nearest


def _square(offsets: Tensor) -> Tensor:
    """(A, 1, ...): the squared length of offsets (A, ...)."""
    return offsets.square().sum(tuple(range(1, offsets.dim())), keepdim=True)
