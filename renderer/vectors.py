"""Vectors in space: unit vectors, axes at right angles to one, and rotations."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def unit_vectors(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Divide vectors by their lengths, without overflow or underflow on the way.

    The components are the first dimension, since a processor adds rows fastest.

    Args:
        vectors: Vectors, shape (3, ...).

    Returns:
        Unit vectors (3, ...), in which a zero vector stays zero, and the lengths
        (...) of the given vectors.

    Example:
        >>> directions, lengths = unit_vectors(torch.tensor([[3.0], [0.0], [4.0]]))
        >>> directions.flatten().tolist(), lengths.tolist()
        ([0.6000000238418579, 0.0, 0.800000011920929], [5.0])
    """
    largest = vectors.abs().amax(0)
    scaled = vectors / largest.masked_fill(largest == 0, 1)
    # The norm is at least 1, unless the vector is zero.
    norm = scaled.square().sum(0).sqrt()
    return scaled / norm.clamp(min=1), norm * largest


def unit(vectors: Tensor) -> Tensor:
    """Divide vectors by their lengths, differentiable once.

    Args:
        vectors: Vectors, shape (3, ...).

    Returns:
        Unit vectors (3, ...). A zero vector stays zero and has a gradient of
        zero.

    Example:
        >>> unit(torch.tensor([[0.0], [2.0], [0.0]])).flatten().tolist()
        [0.0, 1.0, 0.0]
    """
    return _Unit.apply(vectors)


class _Unit(torch.autograd.Function):
    """`unit` with its analytic derivative, which is finite for a zero vector."""

    @staticmethod
    def forward(ctx: Any, vectors: Tensor) -> Tensor:
        directions, lengths = unit_vectors(vectors)
        ctx.save_for_backward(directions, lengths)
        return directions

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        directions, lengths = ctx.saved_tensors
        tangential = upstream - directions * (directions * upstream).sum(0)
        return tangential / lengths.masked_fill(lengths == 0, torch.inf)


def tangent_axes(x: Any, y: Any, z: Any, sign: Any) -> list[list[Any]]:
    """Compute two unit vectors at right angles to unit vectors (x, y, z) and to each other.

    Source: Duff et al. 2017, "Building an orthonormal basis, revisited".

    Args:
        x: First components, numbers, arrays or tensors of one shape.
        y: Second components.
        z: Third components.
        sign: 1 or -1 for each vector, such that z is not -sign. The axes jump
            where the sign changes.

    Returns:
        The components [x, y, z] of the first axis and those of the second.

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
    """Return the matrices of rotations that are given by vectors.

    Args:
        vectors: Rotation vectors, shape (..., 3). The direction is the axis,
            and the length is the angle in degrees.

    Returns:
        Rotation matrices, shape (..., 3, 3), differentiable with respect to the
        vectors, per degree.

    Example:
        >>> quarter = torch.tensor([0, 0, 90.0])
        >>> (rotation_matrices(quarter) @ torch.tensor([1.0, 0, 0])).round() + 0
        tensor([0., 1., 0.])
    """
    radians = torch.deg2rad(vectors)
    axes = torch.eye(3).to(radians).expand(*radians.shape, 3)
    cross_products = torch.linalg.cross(radians[..., None, :].expand_as(axes), axes)
    return torch.matrix_exp(cross_products.mT)
