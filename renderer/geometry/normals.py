"""Normals of a mesh's faces and vertices, differentiable in the vertices' positions.

Computed in float64 and, for slivers, with the rounding errors of differences and products added back: a plain float32
normal of a face of height 1e-6 is off by 0.01 rad, and a plain float64 one of height 1e-12 by 1e-4.
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

ROUNDING = 64 * torch.finfo(torch.float64).eps  # of a sum of areas
FEW = 2  # vertices of the mesh per corner of faces: with more, sums are taken over these faces' vertices alone
SLIVER = 1 / 16  # sine of a corner's angle below which plain float64 would lose more than some 64 of its ulps


def face_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Unit normals, outward for counter-clockwise faces, in the dtype of `vertices`.

    A face without area has the zero vector and a gradient of zero. InputError: NaN.
    Source: the paper's Section 3, ∂n/∂v = -h nᵀ/|h|² with h from the opposite edge to the corner v; the sign in print
    is the wrong way round.
    """
    return unit(area_vectors(vertices, faces)).T.to(vertices.dtype)


def vertex_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Unit normals: those of the faces around a vertex, weighted with their areas.
    Vertices of no face, or whose faces cancel, have the zero vector. Errors as in `face_normals`."""
    weighted, corners = area_vectors(vertices, faces).repeat(1, 3), faces.T.flatten()
    summed = weighted.new_zeros(3, len(vertices)).index_add(1, corners, weighted)
    areas = weighted.new_zeros(len(vertices)).index_add(0, corners, _length(weighted.detach()))
    canceled = _length(summed.detach()) <= ROUNDING * areas
    return unit(summed.masked_fill(canceled, 0)).T.to(vertices.dtype)


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
    """Compute vectors that are normal to faces and twice as long as the faces have area.

    Args:
        vertices: Positions, shape (V, 3).
        faces: Indices of vertices, shape (F, 3), counter-clockwise from outside.

    Returns:
        Outward vectors, shape (F, 3).
    """
    # Components come first, since np.cross takes several times as long.
    corners = vertices.T.take(faces.T, axis=1)
    ax, ay, az = corners[:, 1] - corners[:, 0]
    bx, by, bz = corners[:, 2] - corners[:, 0]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def corner_normals(vertices: np.ndarray, faces: np.ndarray, normals: str, crease: float = -2.0) -> np.ndarray:
    """Compute the unit normals that the corners of faces are shaded with.

    Args:
        vertices: Positions, shape (V, 3), float64.
        faces: Indices of vertices, shape (F, 3).
        normals: "smooth" for those of the vertices, "flat" for those of the
            faces.
        crease: A corner is flat if the cosine of the angle between the normals
            of its vertex and its face is below this. The default smooths all.

    Returns:
        Unit normals, shape (F, 3, 3), float64; up, if a corner has none.

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


def area_vectors(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float64[Tensor, "3 F"]:
    """Normals with the faces' areas as their lengths, up to one factor for all of them. Errors as in `face_normals`."""
    require_finite(vertices=vertices)
    return _AreaVectors.apply(vertices, faces)


class _AreaVectors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor) -> Tensor:
        corners = vertices.index_select(0, faces.T.flatten()).T.contiguous().double().unflatten(1, (3, -1))
        edges = corners[:, 1:] - corners[:, :1]
        scale = _power_of_two(edges) if vertices.dtype == torch.float64 else edges.new_ones(())  # room enough
        first, second = edges.div_(scale).unbind(1)
        product, lengths = _cross(first, second), edges.square().sum(0)
        thin = torch.nonzero(product.square().sum(0) <= SLIVER**2 * lengths[0] * lengths[1]).squeeze(1)
        if len(thin):
            product[:, thin] = _exact_cross(*(corners[:, :, thin] / scale).unbind(1))
        ctx.save_for_backward(faces, first, second, scale)
        ctx.vertices = vertices.shape, vertices.dtype
        return product

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        faces, first, second, scale = ctx.saved_tensors
        shape, dtype = ctx.vertices
        by_second, by_third = _cross(second, upstream), _cross(upstream, first)
        corners = torch.cat([-by_second - by_third, by_second, by_third], dim=1)
        corners, index = corners.div_(scale), faces.T.flatten()
        if shape[0] < FEW * len(index):
            return upstream.new_zeros(shape[::-1]).index_add_(1, index, corners).T.to(dtype), None
        touched, index = index.unique(return_inverse=True)
        sums = corners.new_zeros(3, len(touched)).index_add_(1, index, corners)
        gradient = torch.zeros(shape[::-1], dtype=dtype, device=sums.device)
        return gradient.index_copy_(1, touched, sums.to(dtype)).T, None


def _length(vectors: Tensor) -> Tensor:
    """(N,) of (3, N): torch's norm takes fifty times as long along so short an axis."""
    return vectors.square().sum(0).sqrt()


def _power_of_two(edges: Tensor) -> Tensor:
    """About the extent of the faces: dividing by it rounds nothing, and keeps products in range at any size."""
    if not edges.numel():
        return edges.new_ones(())
    _, exponent = torch.frexp(edges.abs().max())
    return torch.ldexp(edges.new_ones(()), exponent)


def _cross(u: Tensor, v: Tensor) -> Tensor:
    """Cross products (3, N). torch's own fuses multiply and add, so that parallel vectors do not give zero."""
    (x, y, z), (r, s, t) = u, v
    return torch.stack([y * t - z * s, z * r - x * t, x * s - y * r])


def _exact_cross(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """(b - a) × (c - a) of corners (3, N), right to rounding: Dekker's products, Knuth's differences."""
    (u, du), (v, dv) = _difference(b, a), _difference(c, a)
    (x, y, z), (r, s, t) = u, v
    rows = [_difference_of_products(*factors) for factors in ((y, t, z, s), (z, r, x, t), (x, s, y, r))]
    return torch.stack(rows) + (_cross(u, dv) + _cross(du, v))


def _difference(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """(a - b rounded, its rounding error)."""
    rounded = a - b
    back = rounded - a
    return rounded, (a - (rounded - back)) - (b + back)


def _product(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """(a b rounded, its rounding error), by halves of the digits."""
    rounded, (scaled_a, scaled_b) = a * b, ((2.0**27 + 1) * a, (2.0**27 + 1) * b)
    a_high, b_high = scaled_a - (scaled_a - a), scaled_b - (scaled_b - b)
    a_low, b_low = a - a_high, b - b_high
    return rounded, ((a_high * b_high - rounded) + a_high * b_low + a_low * b_high) + a_low * b_low


def _difference_of_products(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    (first, first_error), (second, second_error) = _product(a, b), _product(c, d)
    rounded, error = _difference(first, second)
    return rounded + (error + (first_error - second_error))
