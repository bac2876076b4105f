"""Normals of faces and vertices, differentiable with respect to the vertex positions.

Normals are computed in float64. For slivers (faces with a very small angle), the
rounding errors of differences and products are computed and added back.
Otherwise, the float32 normal of a face of height 1e-6 would be off by 0.01 rad,
and the float64 normal of a face of height 1e-12 by 1e-4 rad.

Shapes use these letters: a mesh has V vertices and F faces.
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

# `vertex_normals` adds up area vectors of the faces around a vertex. If the sum is
# shorter than this fraction of the sum of the lengths, it is only rounding error.
ROUNDING = 64 * torch.finfo(torch.float64).eps
# If a mesh has at least FEW times as many vertices as the given faces have corners,
# it is faster to renumber the vertices of these faces than to process all vertices.
FEW = 2
# A face is a sliver if the sine of the angle at its first corner is at most this
# number. With a smaller angle, the cross product in plain float64 would lose more
# than about 64 units in the last place.
SLIVER = 1 / 16
# `_halves` multiplies a float64 number by this number to split its 53 binary digits
# into two halves (Dekker 1971).
_SPLITTER = 2.0**27 + 1


def face_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Compute the unit normals of faces, differentiable with respect to the vertices.

    The derivative of a normal n by a corner v is ∂n/∂v = -h nᵀ / |h|², with the
    perpendicular vector h from the opposite edge to v. The paper's Section 3
    prints the wrong sign.

    Args:
        vertices: Vertex positions, shape (V, 3).
        faces: Vertex indices of the faces, counter-clockwise seen from outside,
            shape (F, 3).

    Returns:
        Outward unit normals in the dtype of `vertices`, shape (F, 3). The normal
        of a face without area is zero, and so is its gradient.

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
    """Compute the unit normals of vertices, differentiable with respect to the vertices.

    The normal of a vertex is the mean of the normals of the faces around the
    vertex, weighted with the areas of the faces.

    Args:
        vertices: Vertex positions, shape (V, 3).
        faces: Vertex indices of the faces, counter-clockwise seen from outside,
            shape (F, 3).

    Returns:
        Outward unit normals in the dtype of `vertices`, shape (V, 3). The normal
        is zero for a vertex without faces, and for a vertex whose face normals
        cancel.

    Raises:
        InputError: If a position is NaN or infinite.
    """
    # All first corners come first. Shape (3 components, 3 F corners).
    corner_vectors = area_vectors(vertices, faces).repeat(1, 3)
    vertex_of_corner = faces.T.flatten()
    zero_vectors = corner_vectors.new_zeros(3, len(vertices))
    vertex_vectors = zero_vectors.index_add(1, vertex_of_corner, corner_vectors)
    # Sum of the lengths of the vectors around each vertex, shape (V,).
    length_sums = corner_vectors.new_zeros(len(vertices))
    length_sums = length_sums.index_add(0, vertex_of_corner, _length(corner_vectors.detach()))
    is_canceled = _length(vertex_vectors.detach()) <= ROUNDING * length_sums
    return unit(vertex_vectors.masked_fill(is_canceled, 0)).T.to(vertices.dtype)


def plain_face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute the unit normals of faces with NumPy, without a gradient.

    Unlike in `face_normals`, rounding errors are not corrected.

    Args:
        vertices: Vertex positions, shape (V, 3).
        faces: Vertex indices of the faces, counter-clockwise seen from outside,
            shape (F, 3).

    Returns:
        Outward unit normals, shape (F, 3). The normal of a face without area is
        zero.
    """
    doubled_vectors = doubled_area_vectors(vertices, faces)
    lengths = np.linalg.norm(doubled_vectors, axis=1, keepdims=True)
    zeros = np.zeros_like(doubled_vectors)
    return np.divide(doubled_vectors, lengths, out=zeros, where=lengths > 0)


def doubled_area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute a normal vector of each face whose length is twice the area of the face.

    Args:
        vertices: Vertex positions, shape (V, 3).
        faces: Vertex indices of the faces, counter-clockwise seen from outside,
            shape (F, 3).

    Returns:
        Outward vectors, shape (F, 3).
    """
    # Positions of the corners of F faces, shape (3 components, 3 corners, F).
    corners = vertices.T.take(faces.T, axis=1)
    # The edges a and b lead from the first corner to the second and the third
    # corner. Their cross product is written out, because np.cross is several times
    # slower.
    ax, ay, az = corners[:, 1] - corners[:, 0]
    bx, by, bz = corners[:, 2] - corners[:, 0]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def corner_normals(
    vertices: np.ndarray, faces: np.ndarray, normals: str, crease: float = -2.0
) -> np.ndarray:
    """Compute the unit normals with which the corners of faces are shaded.

    Args:
        vertices: Vertex positions, float64, shape (V, 3).
        faces: Vertex indices of the faces, counter-clockwise seen from outside,
            shape (F, 3).
        normals: "smooth" for vertex normals, or "flat" for face normals.
        crease: Cosine of the largest angle between the normals of a vertex and a
            face at which "smooth" uses the vertex normal. If the angle is
            larger, the corner gets the face normal. The default -2 allows all
            angles.

    Returns:
        Unit normals of the three corners of each face, float64,
        shape (F, 3, 3). A corner gets (0, 0, 1) if both normals are zero.

    Raises:
        InputError: If `normals` is neither "smooth" nor "flat".
    """
    require_choice("normals", normals, NORMALS)
    normals_by_face = plain_face_normals(vertices, faces)
    # Repeat the normal of each face for its three corners, shape (F, 3, 3).
    chosen = np.broadcast_to(normals_by_face[:, None], (len(faces), 3, 3))
    if normals == "smooth":
        normals_by_vertex = vertex_normals(
            torch.from_numpy(vertices), torch.from_numpy(faces)
        ).numpy()
        smooth = normals_by_vertex[faces]
        cosine = (smooth * chosen).sum(axis=-1)
        is_flat = ~smooth.any(axis=-1) | (cosine < crease)
        chosen = np.where(is_flat[..., None], chosen, smooth)
    has_normal = chosen.any(axis=-1, keepdims=True)
    return np.where(has_normal, chosen, [0.0, 0.0, 1.0])


def area_vectors(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float64[Tensor, "3 F"]:
    """Compute a normal vector of each face whose length is proportional to the area of the face.

    The vectors are differentiable with respect to the vertices.

    Args:
        vertices: Vertex positions, shape (V, 3).
        faces: Vertex indices of the faces, counter-clockwise seen from outside,
            shape (F, 3).

    Returns:
        Outward vectors, float64, shape (3, F). The length divided by the area is
        the same power of two for all faces.

    Raises:
        InputError: If a position is NaN or infinite.
    """
    require_finite(vertices=vertices)
    return _AreaVectors.apply(vertices, faces)


class _AreaVectors(torch.autograd.Function):
    """Area vectors of faces with their derivative, see `area_vectors`.

    The area vector of a face is u × v. The edges u and v lead from the first
    corner of the face to the second and the third corner.
    """

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor) -> Tensor:
        """Compute the area vector u × v of each face from scaled edges u and v.

        All edges are divided by the same power of two, so that products of large
        edges do not overflow. The area vectors are therefore divided by the
        square of this power. For positions that are not float64, the power is 1.

        Args:
            ctx: Context of autograd.
            vertices: Vertex positions, shape (V, 3).
            faces: Vertex indices of the faces, shape (F, 3).

        Returns:
            Area vectors, float64, shape (3, F).
        """
        corners = vertices.index_select(0, faces.T.flatten()).T.contiguous().double()
        # Positions of the corners of F faces, shape (3 components, 3 corners, F).
        corners = corners.unflatten(1, (3, -1))
        # Both edges of each face, shape (3 components, 2 edges, F).
        edges = corners[:, 1:] - corners[:, :1]
        # Products of float64 values may overflow, so float64 edges are scaled.
        is_float64 = vertices.dtype == torch.float64
        scale = _power_of_two(edges) if is_float64 else edges.new_ones(())
        edge_u, edge_v = edges.div_(scale).unbind(1)
        product = _cross(edge_u, edge_v)
        squared_u, squared_v = edges.square().sum(0)
        # |u × v| is |u| |v| times the sine of the angle at the first corner.
        is_sliver = product.square().sum(0) <= SLIVER**2 * squared_u * squared_v
        slivers = torch.nonzero(is_sliver).squeeze(1)
        if len(slivers):
            product[:, slivers] = _exact_cross(*(corners[:, :, slivers] / scale).unbind(1))
        ctx.save_for_backward(faces, edge_u, edge_v, scale)
        ctx.vertex_shape = vertices.shape
        ctx.dtype = vertices.dtype
        return product

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        """Compute the gradient by the vertices.

        Args:
            ctx: Context of autograd.
            upstream: Gradient by the area vectors, shape (3, F).

        Returns:
            Gradient by the vertices, shape (V, 3), and None for the faces.
        """
        faces, edge_u, edge_v, scale = ctx.saved_tensors
        # The gradient of g · (u × v) is v × g by u, and g × u by v. The second
        # corner moves u, the third corner moves v, and the first corner moves both
        # edges in the opposite direction.
        second_corner_gradient = _cross(edge_v, upstream)
        third_corner_gradient = _cross(upstream, edge_u)
        first_corner_gradient = -second_corner_gradient - third_corner_gradient
        # Shape (3 components, 3 F corners), with all first corners first.
        corner_gradients = torch.cat(
            [first_corner_gradient, second_corner_gradient, third_corner_gradient], dim=1
        )
        corner_gradients = corner_gradients.div_(scale)
        vertex_of_corner = faces.T.flatten()
        vertex_count, component_count = ctx.vertex_shape
        if vertex_count < FEW * len(vertex_of_corner):
            # Add the gradients of the corners at each vertex.
            gradient = upstream.new_zeros(component_count, vertex_count)
            gradient.index_add_(1, vertex_of_corner, corner_gradients)
            return gradient.T.to(ctx.dtype), None
        # Only few of the vertices have faces. Adding the gradients of these
        # vertices alone avoids a float64 tensor of all vertices.
        used_vertices, corner_to_used = vertex_of_corner.unique(return_inverse=True)
        zeros = corner_gradients.new_zeros(3, len(used_vertices))
        sums = zeros.index_add_(1, corner_to_used, corner_gradients)
        gradient = torch.zeros(component_count, vertex_count, dtype=ctx.dtype, device=sums.device)
        return gradient.index_copy_(1, used_vertices, sums.to(ctx.dtype)).T, None


def _length(vectors: Tensor) -> Tensor:
    """Compute the lengths of N vectors.

    torch.norm is fifty times slower along an axis of length three.

    Args:
        vectors: Vectors, shape (3, N).

    Returns:
        Lengths, shape (N,).
    """
    return vectors.square().sum(0).sqrt()


def _power_of_two(edges: Tensor) -> Tensor:
    """Find a power of two that is about the largest component of all edges.

    A division by a power of two has no rounding error. Products of edges that
    are divided by it do not overflow.

    Args:
        edges: Edge vectors of any shape.

    Returns:
        Power of two, shape (). It is 1 if there are no edges.
    """
    if not edges.numel():
        return edges.new_ones(())
    _, exponent = torch.frexp(edges.abs().max())
    return torch.ldexp(edges.new_ones(()), exponent)


def _cross(u: Tensor, v: Tensor) -> Tensor:
    """Compute the cross products of N pairs of vectors.

    Unlike torch.linalg.cross, the result for parallel vectors is exactly zero,
    because multiplications and additions are not fused.

    Args:
        u: First vector of each pair, shape (3, N).
        v: Second vector of each pair, shape (3, N).

    Returns:
        Cross products u × v, shape (3, N).
    """
    ux, uy, uz = u
    vx, vy, vz = v
    return torch.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx])


def _exact_cross(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Compute (b - a) × (c - a) for the corners of N triangles, almost without rounding errors.

    The rounding errors of differences (Knuth 1969) and of products (Dekker 1971)
    are computed and added back.

    Args:
        a: First corners, float64, shape (3, N).
        b: Second corners, float64, shape (3, N).
        c: Third corners, float64, shape (3, N).

    Returns:
        Cross products, shape (3, N).
    """
    u, u_error = _difference(b, a)
    v, v_error = _difference(c, a)
    ux, uy, uz = u
    vx, vy, vz = v
    # Components of u × v, in which the rounding errors of the products are corrected.
    x = _difference_of_products(uy, vz, uz, vy)
    y = _difference_of_products(uz, vx, ux, vz)
    z = _difference_of_products(ux, vy, uy, vx)
    # The rounding errors of u and v change the product by u × v_error and u_error × v.
    # The product u_error × v_error is negligible.
    return torch.stack([x, y, z]) + (_cross(u, v_error) + _cross(u_error, v))


def _difference(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Compute a - b, and the rounding error of the difference (Knuth 1969).

    Args:
        a: Minuend, shape (N,) or (3, N).
        b: Subtrahend, same shape.

    Returns:
        The rounded difference, and the exact difference minus the rounded one.
    """
    rounded = a - b
    negative_b = rounded - a
    return rounded, (a - (rounded - negative_b)) - (b + negative_b)


def _product(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Compute a · b, and the rounding error of the product (Dekker 1971).

    Each factor is split into two halves of its digits. Products of halves are
    exact.

    Args:
        a: First factor, shape (N,).
        b: Second factor, shape (N,).

    Returns:
        The rounded product, and the exact product minus the rounded one.
    """
    rounded = a * b
    a_high, a_low = _halves(a)
    b_high, b_low = _halves(b)
    error = (a_high * b_high - rounded) + a_high * b_low + a_low * b_high
    return rounded, error + a_low * b_low


def _halves(value: Tensor) -> tuple[Tensor, Tensor]:
    """Split numbers into the upper and the lower half of their binary digits.

    Args:
        value: Numbers, float64, shape (N,).

    Returns:
        The upper and the lower halves, whose sums are exactly the numbers.
    """
    scaled = _SPLITTER * value
    high = scaled - (scaled - value)
    return high, value - high


def _difference_of_products(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Compute a · b - c · d almost without rounding errors.

    Args:
        a: First factor of the first product, float64, shape (N,).
        b: Second factor of the first product, same shape.
        c: First factor of the second product, same shape.
        d: Second factor of the second product, same shape.

    Returns:
        Differences, shape (N,).
    """
    product_ab, error_ab = _product(a, b)
    product_cd, error_cd = _product(c, d)
    rounded, error = _difference(product_ab, product_cd)
    return rounded + (error + (error_ab - error_cd))
