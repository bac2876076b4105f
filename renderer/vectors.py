"""Vectors in space: unit vectors, tangents, and rotations."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def unit_vectors(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Divide vectors by their lengths, without overflow or underflow of squares.

    The three components are along the first axis, because adding rows is faster
    than adding columns.

    Args:
        vectors: Vectors, shape (3, ...).

    Returns:
        A tuple of
        - the unit vectors, shape (3, ...). A zero vector stays zero;
        - the lengths of the vectors, shape (...).

    Example:
        >>> directions, lengths = unit_vectors(torch.tensor([[3.0], [0.0], [4.0]]))
        >>> directions.flatten().tolist(), lengths.tolist()
        ([0.6000000238418579, 0.0, 0.800000011920929], [5.0])
    """
    largest = vectors.abs().amax(0)
    scaled = vectors / largest.masked_fill(largest == 0, 1)
    # The largest component is now ±1. The norm is therefore at least 1, except for a zero
    # vector.
    norm = scaled.square().sum(0).sqrt()
    return scaled / norm.clamp(min=1), norm * largest


def unit(vectors: Tensor) -> Tensor:
    """Divide vectors by their lengths. The result can be differentiated once.

    Args:
        vectors: Vectors, with the three components along the first axis,
            shape (3, ...).

    Returns:
        Unit vectors, shape (3, ...). A zero vector stays zero, and its gradient
        is zero.

    Example:
        >>> unit(torch.tensor([[0.0], [2.0], [0.0]])).flatten().tolist()
        [0.0, 1.0, 0.0]
    """
    return _Unit.apply(vectors)


class _Unit(torch.autograd.Function):
    """Unit vectors, with a derivative that is finite for a zero vector. See `unit`."""

    @staticmethod
    def forward(ctx: Any, vectors: Tensor) -> Tensor:
        """Divide vectors by their lengths.

        Args:
            ctx: Context of autograd.
            vectors: Vectors, shape (3, ...).

        Returns:
            Unit vectors, shape (3, ...).
        """
        directions, lengths = unit_vectors(vectors)
        ctx.save_for_backward(directions, lengths)
        return directions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        """Compute the gradient by the vectors.

        Args:
            ctx: Context of autograd.
            upstream: Gradient by the unit vectors, shape (3, ...).

        Returns:
            Gradient by the vectors, shape (3, ...).
        """
        directions, lengths = ctx.saved_tensors
        # Only the part at right angles to the vector changes the unit vector. Dividing by
        # infinity gives a zero vector the gradient 0.
        tangential = upstream - directions * (directions * upstream).sum(0)
        return tangential / lengths.masked_fill(lengths == 0, torch.inf)


def tangent_axes(x: Any, y: Any, z: Any, sign: Any) -> list[list[Any]]:
    """Compute two unit vectors that are orthogonal to a unit vector (x, y, z) and to each other.

    The source is Duff et al. 2017, "Building an orthonormal basis, revisited".

    Args:
        x: First component, a number, or an array or tensor of any shape for
            several vectors.
        y: Second component, same shape.
        z: Third component, same shape.
        sign: 1 or -1 for each vector. z must not be equal to -sign. The results
            are continuous for vectors with the same sign.

    Returns:
        Components [x, y, z] of the first and of the second orthogonal vector.

    Example:
        >>> tangent_axes(0.0, 0.0, 1.0, 1)
        [[1.0, -0.0, -0.0], [-0.0, 1.0, -0.0]]
    """
    a = -1 / (sign + z)
    b = x * y * a
    first = [1 + sign * x * x * a, sign * b, -sign * x]
    second = [b, sign + y * y * a, -y]
    return [first, second]


def rotation_matrices(vectors: Tensor) -> Tensor:
    """Convert rotation vectors to rotation matrices.

    Args:
        vectors: Rotation vectors, shape (..., 3). The direction of a vector is
            the axis of the rotation, and its length is the angle in degrees.

    Returns:
        Rotation matrices, shape (..., 3, 3). They are differentiable with respect
        to the vectors.

    Example:
        >>> quarter = torch.tensor([0, 0, 90.0])
        >>> (rotation_matrices(quarter) @ torch.tensor([1.0, 0, 0])).round() + 0
        tensor([0., 1., 0.])
    """
    radians = torch.deg2rad(vectors)
    axes = torch.eye(3).to(radians).expand(*radians.shape, 3)
    cross_products = torch.linalg.cross(radians[..., None, :].expand_as(axes), axes)
    return torch.matrix_exp(cross_products.mT)
