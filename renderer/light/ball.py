"""Norm-balls, and the projection onto the intersection of a box and a norm-ball."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

# Largest number of Newton steps in `_nearest_in_box_and_sphere`. Four are usual. With
# too few steps, the result would lie inside of the ball instead of on its surface.
_MAX_STEPS = 20
# A point counts as lying on the surface of a ball if its squared distance from the center
# differs from the squared radius r² by at most this number times r² times `eps` of the
# dtype.
_ROUNDING_UNITS = 8


@dataclass(frozen=True)
class Ball:
    """Norm-balls with one radius around N centers, one ball for each row of a batch.

    Attributes:
        center: Center of each ball, shape (N, ...).
        radius: Radius of all balls.
        norm: "linf" for the maximum norm, or "l2" for the Euclidean norm over
            all values of a row.
    """

    center: Float[Tensor, "N ..."]
    radius: float
    norm: str

    def unflatten(self, *shape: int) -> Ball:
        """Return the same balls for rows that are reshaped from (N, D) to (N, *shape)."""
        return Ball(self.center.unflatten(1, shape), self.radius, self.norm)

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest value of each coordinate in the balls, if the norm is "linf".

        Both tensors have the shape (N, ...).
        """
        return self.center - self.radius, self.center + self.radius


def nearest_in_box(
    values: Float[Tensor, "N ..."], low: Any, high: Any, within: Ball | None = None
) -> Float[Tensor, "N ..."]:
    """Project each row of values onto a box, or onto the intersection of a box and a norm-ball.

    The projection is the nearest point with respect to the Euclidean distance. Centers of
    `within` must lie in the box. None uses the box alone.
    """
    if within is None:
        return values.clamp(low, high)
    if within.norm == "linf":
        return values.clamp(low, high).clamp(*within.ends)
    return _nearest_in_box_and_sphere(values, low, high, within)


def _nearest_in_box_and_sphere(
    values: Float[Tensor, "N ..."], low: Any, high: Any, ball: Ball
) -> Float[Tensor, "N ..."]:
    """Project each row of values onto the intersection of a box and an L2 ball.

    Let v be a row and c the center of its ball. The projection is the point of the box that is
    nearest to c + f (v - c), with a factor f from 0 to 1. (It is 1 / (1 + λ) with the Lagrange
    multiplier λ of the ball.) The squared distance of this point from c is a concave and piecewise
    linear function of f². Newton's method, which starts at f² = 0, therefore reaches the squared
    radius without passing it.
    """
    offset = values - ball.center
    squared_radius = ball.radius**2
    rounding = _ROUNDING_UNITS * torch.finfo(values.dtype).eps * squared_radius
    # The factor f² of each row, in a shape that broadcasts to `values`.
    squared_factor = offset.new_zeros(())
    # Squared distance between the center and the nearest point of the box, and its
    # derivative with respect to f².
    squared_distance = offset.new_zeros(())
    slope = _squared_norm(offset)
    for _ in range(_MAX_STEPS):
        missing = squared_radius - squared_distance
        step = missing / slope.clamp(min=torch.finfo(values.dtype).tiny)
        squared_factor = (squared_factor + step.clamp(min=0)).clamp(max=1)
        # The point between the center (factor 0) and the row of `values` (factor 1). For
        # factor 1, `values` has no rounding errors.
        between = ball.center + squared_factor.sqrt() * offset
        target = torch.where(squared_factor < 1, between, values)
        nearest = target.clamp(low, high)
        # Clamped values do not change with the factor.
        slope = _squared_norm(offset * (nearest == target))
        squared_distance = _squared_norm(nearest - ball.center)
        is_inside = squared_radius - squared_distance > rounding
        is_too_short = (squared_factor < 1) & is_inside
        if not is_too_short.any():
            break
    return nearest


def _squared_norm(offsets: Float[Tensor, "N ..."]) -> Tensor:
    """Compute the squared L2 norm of each row of a batch.

    All axes but the first one have size 1, so that the result broadcasts.
    """
    return offsets.square().sum(tuple(range(1, offsets.dim())), keepdim=True)
