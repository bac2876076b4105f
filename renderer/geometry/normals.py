"""Normals of a mesh's faces and vertices, differentiable in the vertex positions.

They are computed in float64. For slivers (faces with a very small angle), the
rounding errors of differences and products are added back. Otherwise, the
float32 normal of a face of height 1e-6 would be off by 0.01 rad, and the
float64 normal of a face of height 1e-12 by 1e-4 rad.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.errors import require_choice, require_finite
from renderer.settings import NORMALS
from renderer.vectors import unit

if TYPE_CHECKING:
    from jaxtyping import Float, Float64, Int

# The normals around a vertex cancel if their sum is at most this fraction of the
# sum of their areas.
ROUNDING = 64 * torch.finfo(torch.float64).eps
# If a mesh has more vertices than this number times the corners of the given
# faces, sums are taken over the vertices of these faces alone.
FEW = 2
# Sine of the angle at a corner below which a face is a sliver: plain float64
# would lose more than about 64 units in the last place.
SLIVER = 1 / 16
# Multiplier that splits a float64 number into two halves of its 53 binary digits
# (Dekker 1971).
_SPLITTER = 2.0**27 + 1


def face_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Compute the unit normals of faces, differentiable in the vertices.

    The derivative is ∂n/∂v = -h nᵀ/|h|², with the vector h from the opposite
    edge to the corner v (the paper's Section 3, which prints the wrong sign).

    Args:
        vertices: Positions, shape (V, 3).
        faces: Indices of vertices, shape (F, 3), counter-clockwise from outside.

    Returns:
        Outward unit normals, shape (F, 3), in the dtype of the vertices. A face
        without area has the zero vector and a gradient of zero.

    Raises:
        InputError: If a position is NaN or infinite.

    Example:
        >>> corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> face_normals(corners, torch.tensor([[0, 1, 2]])).tolist()
        [[0.0, 0.0, 1.0]]
    """
    return unit(area_vectors(vertices, faces)).T.to(vertices.dtype)


def vertex_normals(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """Compute the unit normals of vertices, differentiable in the vertices.

    The normal of a vertex is the mean of the normals of its faces, weighted with
    their areas.

    Args:
        vertices: Positions, shape (V, 3).
        faces: Indices of vertices, shape (F, 3), counter-clockwise from outside.

    Returns:
        Outward unit normals, shape (V, 3), in the dtype of the vertices. A
        vertex without faces, or whose normals cancel, has the zero vector.

    Raises:
        InputError: If a position is NaN or infinite.
    """
    by_corner = area_vectors(vertices, faces).repeat(1, 3)
    vertex_of_corner = faces.T.flatten()
    summed = by_corner.new_zeros(3, len(vertices)).index_add(1, vertex_of_corner, by_corner)
    areas = by_corner.new_zeros(len(vertices))
    areas = areas.index_add(0, vertex_of_corner, _length(by_corner.detach()))
    is_canceled = _length(summed.detach()) <= ROUNDING * areas
    return unit(summed.masked_fill(is_canceled, 0)).T.to(vertices.dtype)


def plain_face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute the unit normals of faces in plain float64, for meshes that stay as they are.

    Args:
        vertices: Positions, shape (V, 3).
        faces: Indices of vertices, shape (F, 3), counter-clockwise from outside.

    Returns:
        Outward unit normals, shape (F, 3). A face without area has the zero
        vector.
    """
    doubled = doubled_area_vectors(vertices, faces)
    length = np.linalg.norm(doubled, axis=1, keepdims=True)
    return np.divide(doubled, length, out=np.zeros_like(doubled), where=length > 0)


def doubled_area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute vectors that are normal to faces, with twice their areas as lengths.

    Args:
        vertices: Positions, shape (V, 3).
        faces: Indices of vertices, shape (F, 3), counter-clockwise from outside.

    Returns:
        Outward vectors, shape (F, 3).
    """
    # The components are the first axis, since np.cross takes several times as
    # long. The shape is (3 components, 3 corners, F).
    corners = vertices.T.take(faces.T, axis=1)
    ax, ay, az = corners[:, 1] - corners[:, 0]
    bx, by, bz = corners[:, 2] - corners[:, 0]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def corner_normals(
    vertices: np.ndarray, faces: np.ndarray, normals: str, crease: float = -2.0
) -> np.ndarray:
    """Compute the unit normals that the corners of faces are shaded with.

    Args:
        vertices: Positions, shape (V, 3), float64.
        faces: Indices of vertices, shape (F, 3).
        normals: "smooth" for the normals of the vertices, "flat" for the normals
            of the faces.
        crease: Cosine of an angle. A corner has the normal of its face if the
            angle between the normals of its vertex and its face is larger. The
            default smooths all corners.

    Returns:
        Unit normals, shape (F, 3, 3), float64. A corner without a normal gets
        the direction up.

    Raises:
        InputError: If `normals` is neither "smooth" nor "flat".
    """
    require_choice("normals", normals, NORMALS)
    by_face = plain_face_normals(vertices, faces)
    chosen = np.broadcast_to(by_face[:, None], (len(faces), 3, 3))
    if normals == "smooth":
        by_vertex = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
        smooth = by_vertex[faces]
        cosine = (smooth * chosen).sum(axis=-1)
        is_flat = ~smooth.any(axis=-1) | (cosine < crease)
        chosen = np.where(is_flat[..., None], chosen, smooth)
    return np.where(chosen.any(axis=-1, keepdims=True), chosen, [0.0, 0.0, 1.0])


def area_vectors(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float64[Tensor, "3 F"]:
    """Compute the normals of faces with lengths in proportion to the areas of the faces.

    Args:
        vertices: Positions, shape (V, 3).
        faces: Indices of vertices, shape (F, 3), counter-clockwise from outside.

    Returns:
        Outward vectors, shape (3, F), float64, differentiable in the vertices.
        The ratio of length and area is a power of two, which is the same for all
        faces.

    Raises:
        InputError: If a position is NaN or infinite.
    """
    require_finite(vertices=vertices)
    return _AreaVectors.apply(vertices, faces)


class _AreaVectors(torch.autograd.Function):
    """`area_vectors` with its analytic derivative.

    With the edges u and v from the first corner of a face to the second and
    third corner, the area vector is u × v.
    """

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor) -> Tensor:
        corners = vertices.index_select(0, faces.T.flatten()).T.contiguous().double()
        # Shape (3 components, 3 corners, F).
        corners = corners.unflatten(1, (3, -1))
        edges = corners[:, 1:] - corners[:, :1]
        # The products of float32 values are always in the range of float64.
        is_float64 = vertices.dtype == torch.float64
        scale = _power_of_two(edges) if is_float64 else edges.new_ones(())
        first_edge, second_edge = edges.div_(scale).unbind(1)
        product = _cross(first_edge, second_edge)
        squared_first, squared_second = edges.square().sum(0)
        is_thin = product.square().sum(0) <= SLIVER**2 * squared_first * squared_second
        thin = torch.nonzero(is_thin).squeeze(1)
        if len(thin):
            product[:, thin] = _exact_cross(*(corners[:, :, thin] / scale).unbind(1))
        ctx.save_for_backward(faces, first_edge, second_edge, scale)
        ctx.vertex_shape = vertices.shape
        ctx.dtype = vertices.dtype
        return product

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        faces, first_edge, second_edge, scale = ctx.saved_tensors
        by_second_corner = _cross(second_edge, upstream)
        by_third_corner = _cross(upstream, first_edge)
        by_first_corner = -by_second_corner - by_third_corner
        by_corner = torch.cat([by_first_corner, by_second_corner, by_third_corner], dim=1)
        by_corner = by_corner.div_(scale)
        vertex_of_corner = faces.T.flatten()
        vertex_count, components = ctx.vertex_shape
        if vertex_count < FEW * len(vertex_of_corner):
            gradient = upstream.new_zeros(components, vertex_count)
            return gradient.index_add_(1, vertex_of_corner, by_corner).T.to(ctx.dtype), None
        touched, row_of_corner = vertex_of_corner.unique(return_inverse=True)
        sums = by_corner.new_zeros(3, len(touched)).index_add_(1, row_of_corner, by_corner)
        gradient = torch.zeros(components, vertex_count, dtype=ctx.dtype, device=sums.device)
        return gradient.index_copy_(1, touched, sums.to(ctx.dtype)).T, None


def _length(vectors: Tensor) -> Tensor:
    """Return the lengths (N,) of vectors (3, N).

    torch's norm takes fifty times as long along an axis of three.
    """
    return vectors.square().sum(0).sqrt()


def _power_of_two(edges: Tensor) -> Tensor:
    """Return a power of two that is about the length of the longest edge.

    Dividing by it rounds nothing, and keeps products in the range of float64.
    """
    if not edges.numel():
        return edges.new_ones(())
    _, exponent = torch.frexp(edges.abs().max())
    return torch.ldexp(edges.new_ones(()), exponent)


def _cross(u: Tensor, v: Tensor) -> Tensor:
    """Return the cross products (3, N) of vectors (3, N).

    torch's own cross product fuses multiplication and addition. Its result for
    parallel vectors is therefore not exactly zero.
    """
    ux, uy, uz = u
    vx, vy, vz = v
    return torch.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx])


def _exact_cross(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return (b - a) × (c - a) of corners (3, N), exact up to one rounding.

    The rounding errors of differences (Knuth 1969) and of products (Dekker 1971)
    are computed and added back.
    """
    u, u_error = _difference(b, a)
    v, v_error = _difference(c, a)
    ux, uy, uz = u
    vx, vy, vz = v
    x = _difference_of_products(uy, vz, uz, vy)
    y = _difference_of_products(uz, vx, ux, vz)
    z = _difference_of_products(ux, vy, uy, vx)
    return torch.stack([x, y, z]) + (_cross(u, v_error) + _cross(u_error, v))


def _difference(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return a - b as computed, and its rounding error."""
    rounded = a - b
    back = rounded - a
    return rounded, (a - (rounded - back)) - (b + back)


def _product(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return a b as computed, and its rounding error.

    The products of halves of the digits are exact.
    """
    rounded = a * b
    a_high, a_low = _halves(a)
    b_high, b_low = _halves(b)
    error = (a_high * b_high - rounded) + a_high * b_low + a_low * b_high
    return rounded, error + a_low * b_low


def _halves(value: Tensor) -> tuple[Tensor, Tensor]:
    """Return two numbers of half the digits each, with the value as their sum."""
    scaled = _SPLITTER * value
    high = scaled - (scaled - value)
    return high, value - high


def _difference_of_products(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Return a b - c d, exact up to one rounding."""
    first, first_error = _product(a, b)
    second, second_error = _product(c, d)
    rounded, error = _difference(first, second)
    return rounded + (error + (first_error - second_error))
