"""Vectors: unit vectors, tangents, rotations, norm-balls and projections onto them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from renderer.modes import once_differentiable

# Type for the x, y and z components of S vectors, shape (S,) each.
Components = tuple[Tensor, Tensor, Tensor]


# Rows of a batch.
Rows = Float[Tensor, "N ..."]


def unit_vectors(vectors: Float[Tensor, "3 ..."]) -> tuple[Tensor, Tensor]:
    """Compute the unit vectors and the lengths of vectors.

    No square overflows or underflows. The three components are along the first
    axis, because adding rows is faster than adding columns. A zero vector stays zero.
    """
    largest = vectors.abs().amax(0)
    # The largest component of each scaled vector is 1 or -1.
    scaled = vectors / largest.masked_fill(largest == 0, 1)
    # A scaled vector has a length of at least 1, except for a zero vector.
    scaled_length = scaled.square().sum(0).sqrt()
    return scaled / scaled_length.clamp(min=1), scaled_length * largest


def unit(vectors: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
    """Divide vectors by their lengths.

    The result can be differentiated once with respect to the vectors, but has no
    second derivatives. A zero vector and its gradient are zero.
    """
    return _Unit.apply(vectors)


class _Unit(torch.autograd.Function):
    """Division of vectors by their lengths, with the gradient 0 for a zero vector."""

    @staticmethod
    def forward(ctx: Any, vectors: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
        """Divide vectors by their lengths."""
        directions, lengths = unit_vectors(vectors)
        ctx.save_for_backward(directions, lengths)
        return directions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "3 ..."]) -> Float[Tensor, "3 ..."]:
        """Compute the gradient of the loss with respect to the vectors."""
        directions, lengths = ctx.saved_tensors
        # A change of a vector along itself does not change its unit vector.
        perpendicular = upstream - directions * (directions * upstream).sum(0)
        # Dividing by infinity gives a zero vector the gradient 0.
        return perpendicular / lengths.masked_fill(lengths == 0, torch.inf)


def tangent_axes(x: Any, y: Any, z: Any, sign: Any) -> list[list[Any]]:
    """Compute two unit vectors that are orthogonal to a unit vector (x, y, z) and to each other.

    The source of the formula is Duff et al. 2017, "Building an orthonormal
    basis, revisited". `sign` is 1 or -1. For z = -sign, the formula divides by 0. Nearby
    vectors with the same sign have nearby results, each as components [x, y, z].
    """
    a = -1 / (sign + z)
    b = x * y * a
    first = [1 + sign * x * x * a, sign * b, -sign * x]
    return [first, [b, sign + y * y * a, -y]]


def rotation_matrices(vectors: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3 3"]:
    """Convert rotation vectors, the axis times the angle in degrees, to rotation matrices."""
    radians = torch.deg2rad(vectors)
    axes = torch.eye(3, dtype=radians.dtype, device=radians.device).expand(*radians.shape, 3)
    # Row i is the cross product of the rotation
    # vector and the unit vector of axis i.
    cross_products = torch.linalg.cross(radians[..., None, :].expand_as(axes), axes)
    # The transposed matrix times a vector p is the cross product of the
    # rotation vector and p. The exponential of this matrix is the rotation.
    return torch.matrix_exp(cross_products.mT)


class Angle(NamedTuple):
    """Rotation angle, given by its sine and cosine of shape (), or (S,) for each sample."""

    sine: Tensor
    cosine: Tensor

    def reversed(self) -> Angle:
        """Return the negative angle, for the inverse rotation."""
        return Angle(sine=-self.sine, cosine=self.cosine)

    def for_columns(self, coefficients: Tensor) -> Angle:
        """Convert an angle of shape () to shape (1,), and to another dtype and device."""
        return Angle(self.sine[None].to(coefficients), self.cosine[None].to(coefficients))


def _rotate(axis: int, vectors: Components, angle: Angle) -> Components:
    """Rotate vectors about an axis, from the next axis toward the one after it."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotated = list(vectors)
    rotated[first] = vectors[first] * angle.cosine - vectors[second] * angle.sine
    rotated[second] = vectors[first] * angle.sine + vectors[second] * angle.cosine
    return rotated[0], rotated[1], rotated[2]


# Functions of vectors and an angle. For example, the first one rotates from y toward z.
rotate_about_x, rotate_about_y, rotate_about_z = (partial(_rotate, axis) for axis in range(3))

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

    center: Rows
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


def nearest_in_box(values: Rows, low: Any, high: Any, within: Ball | None = None) -> Rows:
    """Project each row of values onto a box, or onto the intersection of a box and a norm-ball.

    The projection is the nearest point with respect to the Euclidean distance. Centers of
    `within` must lie in the box. None uses the box alone.
    """
    if within is None:
        return values.clamp(low, high)
    if within.norm == "linf":
        return values.clamp(low, high).clamp(*within.ends)
    return _nearest_in_box_and_sphere(values, low, high, within)


def _nearest_in_box_and_sphere(values: Rows, low: Any, high: Any, ball: Ball) -> Rows:
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
    # Without a box, the function is linear.
    is_ball = isinstance(low, float) and low == -math.inf and high == math.inf
    for _ in range(1 if is_ball else _MAX_STEPS):
        # Newton step for squared distance = squared radius.
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
        is_too_short = (squared_factor < 1) & (squared_radius - squared_distance > rounding)
        # A GPU takes all steps, so that the CPU need not wait for it.
        if values.device.type == "cpu" and not is_too_short.any():
            break
    return nearest


def _squared_norm(offsets: Rows) -> Tensor:
    """Compute the squared L2 norm of each row, which broadcasts: all other axes have size 1."""
    return offsets.square().sum(tuple(range(1, offsets.dim())), keepdim=True)
