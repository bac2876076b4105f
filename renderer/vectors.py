"""Vectors in space: rotations."""

import torch
from torch import Tensor


def rotation_matrices(vectors: Tensor) -> Tensor:
    """Return the matrices of rotations that are given by vectors.

    Args:
        vectors: Rotation vectors, shape (..., 3). The direction is the axis,
            and the length is the angle in radians.

    Returns:
        Rotation matrices, shape (..., 3, 3), differentiable with respect to the
        vectors.

    Example:
        >>> quarter = torch.tensor([0, 0, torch.pi / 2])
        >>> (rotation_matrices(quarter) @ torch.tensor([1.0, 0, 0])).round() + 0
        tensor([0., 1., 0.])
    """
    axes = torch.eye(3).to(vectors).expand(*vectors.shape, 3)
    cross_products = torch.linalg.cross(vectors[..., None, :].expand_as(axes), axes)
    return torch.matrix_exp(cross_products.mT)
