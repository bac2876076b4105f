"""Vectors in space: unit vectors, tangents, and rotations."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def unit_vectors(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the unit vectors and the lengths of vectors.

    No square overflows or underflows. The three components are along the first
    axis, because adding rows is faster than adding columns.

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
    # The largest component of each scaled vector is 1 or -1.
    scaled = vectors / largest.masked_fill(largest == 0, 1)
    # A scaled vector has a length of at least 1, except for a zero vector.
    scaled_length = scaled.square().sum(0).sqrt()
    return scaled / scaled_length.clamp(min=1), scaled_length * largest


def unit(vectors: Tensor) -> Tensor:
    """Divide vectors by their lengths.

    The result can be differentiated once with respect to the vectors, but has no
    second derivatives.

    Args:
        vectors: Vectors, with the three components along the first axis,
            shape (3, ...).

    Returns:
        Unit vectors, shape (3, ...). A zero vector stays zero, and the gradient
        with respect to this vector is zero.

    Example:
        >>> unit(torch.tensor([[0.0], [2.0], [0.0]])).flatten().tolist()
        [0.0, 1.0, 0.0]
    """
    return _Unit.apply(vectors)


class _Unit(torch.autograd.Function):
    """Division of vectors by their lengths, with the gradient 0 for a zero vector."""

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
        """Compute the gradient of the loss with respect to the vectors.

        Args:
            ctx: Context of autograd.
            upstream: Gradient of the loss with respect to the unit vectors,
                shape (3, ...).

        Returns:
            Gradient with respect to the vectors, shape (3, ...).
        """
        directions, lengths = ctx.saved_tensors
        # A change of a vector along itself does not change its unit vector.
        perpendicular = upstream - directions * (directions * upstream).sum(0)
        # Dividing by infinity gives a zero vector the gradient 0.
        return perpendicular / lengths.masked_fill(lengths == 0, torch.inf)


def tangent_axes(x: Any, y: Any, z: Any, sign: Any) -> list[list[Any]]:
    """Compute two unit vectors that are orthogonal to a unit vector (x, y, z) and to each other.

    The source of the formula is Duff et al. 2017, "Building an orthonormal
    basis, revisited".

    Args:
        x: First component of the unit vector: a number, or an array or a tensor
            of any shape for several vectors.
        y: Second component, same shape.
        z: Third component, same shape.
        sign: 1 or -1 for each vector. For z = -sign, the formula divides by 0.
            Nearby vectors with the same sign have nearby results.

    Returns:
        Components [x, y, z] of the first orthogonal vector, and then those of
        the second one.

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
    # Row i is the cross product of the rotation
    # vector and the unit vector of axis i.
    cross_products = torch.linalg.cross(radians[..., None, :].expand_as(axes), axes)
    # The transposed matrix times a vector p is the cross product of the
    # rotation vector and p. The exponential of this matrix is the rotation.
    return torch.matrix_exp(cross_products.mT)
