"""Normals of a mesh's faces and vertices, differentiable in the vertices' positions."""

import torch
from torch import Tensor

from renderer.errors import require_finite
from renderer.harmonics import unit_vectors


def face_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """(F, 3) unit normals, outward for counter-clockwise faces, in the dtype of `vertices`.

    vertices: (V, 3). faces: (F, 3) int64. A face without area has the zero vector and a gradient of zero.
    Computed in float64, since a sliver's float32 normal is off by 0.01 rad and more. InputError: NaN.
    Source: the paper's Section 3, ∂n/∂v = -h nᵀ/|h|² with h from the opposite edge to the corner v; the sign in print
    is the wrong way round.
    """
    require_finite(vertices=vertices)
    return _FaceNormals.apply(vertices, faces)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """(V, 3) unit normals: those of the faces around a vertex, weighted with their areas.

    Vertices of no face, or whose faces cancel, have the zero vector. Shapes and errors as in `face_normals`.
    """
    require_finite(vertices=vertices)
    weighted = torch.linalg.cross(*_edges(vertices, faces), dim=0).T
    summed = weighted.new_zeros(vertices.shape).index_add(0, faces.flatten(), weighted.repeat_interleave(3, dim=0))
    return _Unit.apply(summed).to(vertices.dtype)


def _edges(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """(3, F) float64 each: from the first corner to the second and to the third."""
    corners = vertices.index_select(0, faces.T.flatten()).double().T.unflatten(1, (3, -1)).contiguous()
    first, second, third = corners.unbind(1)
    return second - first, third - first


class _FaceNormals(torch.autograd.Function):
    @staticmethod
    def forward(ctx, vertices: Tensor, faces: Tensor) -> Tensor:
        first, second = _edges(vertices, faces)
        scale = torch.maximum(first.abs(), second.abs()).amax(0)
        scale = torch.where(scale > 0, scale, 1)  # keeps products of tiny or huge edges in range
        first, second = first / scale, second / scale
        unit, length = unit_vectors(torch.linalg.cross(first, second, dim=0))
        ctx.save_for_backward(faces, unit, first, second, length * scale)
        ctx.vertices = vertices.shape, vertices.dtype
        return unit.to(vertices.dtype).T

    @staticmethod
    def backward(ctx, upstream: Tensor) -> tuple[Tensor, None]:
        faces, unit, first, second, length = ctx.saved_tensors
        shape, dtype = ctx.vertices
        weighted = _tangential(upstream.double().T, unit) / torch.where(length > 0, length, torch.inf)
        second_corner = torch.linalg.cross(second, weighted, dim=0)
        third_corner = torch.linalg.cross(weighted, first, dim=0)
        corners = torch.cat([-second_corner - third_corner, second_corner, third_corner], dim=1)
        gradient = unit.new_zeros(shape[::-1]).index_add_(1, faces.T.flatten(), corners)
        return gradient.to(dtype).T, None


class _Unit(torch.autograd.Function):
    """Vectors (N, 3) at unit length, with a gradient of zero where the vector is zero."""

    @staticmethod
    def forward(ctx, vectors: Tensor) -> Tensor:
        unit, length = unit_vectors(vectors.T)
        ctx.save_for_backward(unit, length)
        return unit.T

    @staticmethod
    def backward(ctx, upstream: Tensor) -> Tensor:
        unit, length = ctx.saved_tensors
        return (_tangential(upstream.T, unit) / torch.where(length > 0, length, torch.inf)).T


def _tangential(vectors: Tensor, unit: Tensor) -> Tensor:
    return vectors - unit * (unit * vectors).sum(0)
