"""Norm-balls, and the projection onto the intersection of a box and a norm-ball."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

# Newton steps to the surface of a ball. Four are usual. If more were needed, the
# result would be inside of the ball instead of on its surface.
_MAX_STEPS = 20
# Relative error of the squared distance from the center, in units of the dtype's eps.
_ROUNDING_UNITS = 8


@dataclass(frozen=True)
class Ball:
    """A norm-ball for each of A rows of values.

    Attributes:
        center: Centers of the balls, shape (A, ...).
        radius: Radius of each ball.
        norm: "linf" for the maximum norm, or "l2" for the Euclidean norm over
            all values of a row.
    """

    center: Tensor
    radius: float
    norm: str

    def unflatten(self, *shape: int) -> Ball:
        """Return the ball of values (A, *shape) that corresponds to this ball of values (A, D)."""
        return Ball(self.center.unflatten(1, shape), self.radius, self.norm)

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """Return the lowest and the highest values in a ball of the norm "linf"."""
        return self.center - self.radius, self.center + self.radius


def nearest_in_box(values: Tensor, low: Any, high: Any, within: Ball | None = None) -> Tensor:
    """Project values onto a box, or onto the intersection of a box and a norm-ball.

    The result is the nearest point in the Euclidean sense.

    Args:
        values: Values, shape (A, ...).
        low: Lowest values of the box, a number or a tensor that broadcasts.
        high: Highest values of the box, a number or a tensor that broadcasts.
        within: Norm-ball whose centers lie in the box. None for the box alone.

    Returns:
        The projections, with the shape of the values.

    Example:
        >>> ball = Ball(torch.zeros(1, 2), radius=1.0, norm="l2")
        >>> nearest_in_box(torch.tensor([[0.0, 3.0]]), -2, 2, ball).tolist()
        [[0.0, 1.0]]
    """
    if within is None:
        return values.clamp(low, high)
    if within.norm == "linf":
        return values.clamp(low, high).clamp(*within.ends)
    return _nearest_in_box_and_sphere(values, low, high, within)


def _nearest_in_box_and_sphere(values: Tensor, low: Any, high: Any, ball: Ball) -> Tensor:
    """Project values v (A, ...) onto the intersection of a box and an L2 ball.

    With a multiplier λ for the ball, the projection is the box's nearest point
    to c + (v - c) / (1 + λ), in which c is the center. Its squared distance from
    c is a concave and piecewise linear function of s = 1 / (1 + λ)². Newton's
    method from s = 0 therefore reaches the radius without passing it.
    """
    offset = values - ball.center
    squared_radius = ball.radius**2
    rounding = _ROUNDING_UNITS * torch.finfo(values.dtype).eps * squared_radius
    # The current s, and the squared distance and its derivative by s. They have
    # the shape (A, 1, ...), or () before the first step.
    s = offset.new_zeros(())
    squared_distance = offset.new_zeros(())
    slope = _squared_norm(offset)
    for _ in range(_MAX_STEPS):
        missing = squared_radius - squared_distance
        step = missing / slope.clamp(min=torch.finfo(values.dtype).tiny)
        s = (s + step.clamp(min=0)).clamp(max=1)
        # The target at s = 1 is the values themselves, without rounding.
        target = torch.where(s < 1, ball.center + s.sqrt() * offset, values)
        nearest = target.clamp(low, high)
        slope = _squared_norm(offset * (nearest == target))
        squared_distance = _squared_norm(nearest - ball.center)
        is_short = (s < 1) & (squared_radius - squared_distance > rounding)
        if not is_short.any():
            break
    return nearest


def _squared_norm(offsets: Tensor) -> Tensor:
    """Return the squared L2 norm of each row of offsets (A, ...), shape (A, 1, ...)."""
    return offsets.square().sum(tuple(range(1, offsets.dim())), keepdim=True)
