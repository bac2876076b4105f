"""Normals of faces and vertices, differentiable by the vertex positions, and sharp edges.

Normals are computed in float64. For slivers (faces with a very small angle), the
rounding errors of differences and products are computed and added back.
Otherwise, the float32 normal of a face of height 1e-6 would be off by 0.01 rad,
and the float64 normal of a face of height 1e-12 by 1e-4 rad.

With smooth normals, corners of faces are divided into groups that end at sharp
edges. Each group has one normal. It is recomputed whenever the vertices move,
but the groups stay as they are.

Shapes use these letters: a mesh has V vertices and F faces.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, Num
from torch import Tensor

from renderer.errors import require_bounded
from renderer.modes import once_differentiable
from renderer.vectors import unit

# `vertex_normals` adds up the area vectors of the faces around a vertex.
# They cancel if their sum is shorter than this fraction of the sum of
# their lengths. Such a short sum consists of rounding errors only.
CANCELLATION = 64 * torch.finfo(torch.float64).eps
# A triangle counts as a sliver if the sine of the angle at its first corner is
# at most this number. Below it, a plain float64 cross product of the two edges
# would have a rounding error of more than about 64 units in the last place.
MAX_SLIVER_SINE = 1 / 16
# `_halves` multiplies a float64 number by this constant to
# split its 53 binary digits into two halves (Dekker 1971).
_SPLITTER = 2.0**27 + 1


# Positions of vertices in world axes, and vertex indices of the corners of faces.
Vertices = Float[Tensor, "V 3"]
# One row of vertex indices, or of indices of normals, for each face.
Corners = Int[Tensor, "F 3"]
# Vectors with their components along the first axis.
Vectors = Float[Tensor, "3 N"]


def face_normals(vertices: Vertices, faces: Corners) -> Float[Tensor, "F 3"]:
    """Compute the unit normals of faces, differentiable with respect to the vertices.

    The derivative of the normal n with respect to a corner v of the face is
    ∂n/∂v = -h nᵀ / |h|². The vector h is the height of the triangle: it leads from
    the opposite edge to v and is perpendicular to this edge. (Section 3 of the
    paper "Beyond Pixel Norm-Balls" prints the wrong sign.) Faces are counter-clockwise seen
    from outside. A face without area has a normal and a gradient of zero.
    """
    return unit(area_vectors(vertices, faces)).T.to(vertices.dtype)


def vertex_normals(
    vertices: Vertices, faces: Corners, normal_ids: Corners | None = None, count: int | None = None
) -> Float[Tensor, "N 3"]:
    """Compute the unit normals of vertices, differentiable with respect to the vertices.

    The normal of a vertex is the mean of the normals of the faces around the
    vertex, weighted with the areas of the faces. At sharp edges, a vertex has
    several normals, each of which belongs to some of these faces. Without `normal_ids` (see
    `Mesh.normal_ids`), each vertex has one normal. A normal is zero for an index without
    faces, and where face normals cancel.
    """
    # Each corner of a face gets the area vector of the
    # face, shape (3 components, 3 F corners). The F first
    # corners come first, then all second and third corners.
    corner_vectors = area_vectors(vertices, faces).repeat(1, 3)
    normal_of_corner = (faces if normal_ids is None else normal_ids).T.flatten()
    zero_vectors = corner_vectors.new_zeros(3, len(vertices) if count is None else count)
    sums = zero_vectors.index_add(1, normal_of_corner, corner_vectors)
    # Sum of the lengths of the area vectors of each normal, shape (N,).
    corner_lengths = _length(corner_vectors.detach())
    length_sums = torch.zeros_like(sums[0]).index_add(0, normal_of_corner, corner_lengths)
    is_canceled = _length(sums.detach()) <= CANCELLATION * length_sums
    return unit(sums.masked_fill(is_canceled, 0)).T.to(vertices.dtype)


def doubled_area_vectors(
    vertices: Num[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Num[np.ndarray, "F 3"]:
    """Compute a vector along the normal of each face, whose length is twice the face area."""
    # Positions of the corners of F faces, shape (3 components, 3 corners, F).
    corners = vertices.T.take(faces.T, axis=1)
    edges = corners[:, 1:] - corners[:, :1]
    # np.cross is several times slower.
    return np.stack(_components(edges[:, 0], edges[:, 1]), axis=1)


def area_vectors(vertices: Vertices, faces: Corners) -> Float64[Tensor, "3 F"]:
    """Compute a vector along the normal of each face, whose length is twice the face area.

    The vectors are differentiable with respect to the vertices.
    """
    require_bounded(vertices=vertices)
    return _AreaVectors.apply(vertices, faces)


class _AreaVectors(torch.autograd.Function):
    """Area vectors of faces, with their gradient with respect to the vertices.

    The area vector of a face is u × v, where the edges u and v lead from the
    first corner of the face to the second and the third corner. It is normal to
    the face, and its length is twice the area.
    """

    @staticmethod
    def forward(ctx: Any, vertices: Vertices, faces: Corners) -> Float[Tensor, "3 F"]:
        """Compute the area vector u × v of each face from its edges u and v."""
        corners = vertices.index_select(0, faces.T.flatten()).T.contiguous().double()
        # Positions of the corners of F faces, shape (3 components, 3 corners, F).
        corners = corners.unflatten(1, (3, -1))
        # The edges from the first corner of each face to the second
        # and the third corner, shape (3 components, 2 edges, F).
        edges = corners[:, 1:] - corners[:, :1]
        edge_u, edge_v = edges.unbind(1)
        area_vectors = _cross(edge_u, edge_v)
        squared_u, squared_v = edges.square().sum(0)
        # The length |u × v| is |u| |v| times the
        # sine of the angle between u and v.
        # Rounding errors are large for nearly parallel edges (slivers), so these are computed
        # exactly.
        max_squared_length = MAX_SLIVER_SINE**2 * squared_u * squared_v
        slivers = torch.nonzero(area_vectors.square().sum(0) <= max_squared_length).squeeze(1)
        if len(slivers):
            first, second, third = corners[:, :, slivers].unbind(1)
            area_vectors[:, slivers] = _exact_cross(first, second, third)
        ctx.save_for_backward(faces, edge_u, edge_v)
        ctx.vertex_shape = vertices.shape
        ctx.dtype = vertices.dtype
        return area_vectors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "3 F"]) -> tuple[Tensor, None]:
        """Compute the gradient of the loss with respect to the vertices."""
        faces, edge_u, edge_v = ctx.saved_tensors
        # With g for `upstream`, the gradient of g · (u × v) is v × g
        # with respect to u, and g × u with respect to v. The edge u
        # ends at the second corner, and the edge v at the third corner.
        second, third = _cross(edge_v, upstream), _cross(upstream, edge_u)
        # The first corner is the start of both edges, so the signs are reversed. Shape
        # (3 components, 3 F corners): all first corners, then all second and all third corners.
        corner_gradients = torch.cat([-second - third, second, third], dim=1)
        # Add up the gradients of all corners that lie at the same vertex.
        zeros = corner_gradients.new_zeros(3, ctx.vertex_shape[0])
        return zeros.index_add_(1, faces.T.flatten(), corner_gradients).to(ctx.dtype).T, None


def _length(vectors: Vectors) -> Float[Tensor, " N"]:
    """Compute the lengths of N vectors; torch.norm would be fifty times slower along short axes."""
    return vectors.square().sum(0).sqrt()


def _cross(u: Vectors, v: Vectors) -> Vectors:
    """Compute u × v unfused, unlike torch.linalg.cross: it is exactly zero for parallel vectors."""
    return torch.stack(_components(u, v))


def _components(u: Any, v: Any) -> list[Any]:
    """Compute the components of cross products of vectors with components along the first axis."""
    ux, uy, uz = u
    vx, vy, vz = v
    return [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx]


def _exact_cross(a: Vectors, b: Vectors, c: Vectors) -> Vectors:
    """Compute (b - a) × (c - a), and add the rounding errors (Knuth 1969, Dekker 1971) back."""
    u, u_error = _difference(b, a)
    v, v_error = _difference(c, a)
    # The components of u × v, with the rounding errors of the products added back.
    first, second = [1, 2, 0], [2, 0, 1]
    product, error = _product(u[first], v[second])
    subtracted, subtracted_error = _product(u[second], v[first])
    rounded, rounding_error = _difference(product, subtracted)
    product = rounded + (rounding_error + (error - subtracted_error))
    # (u + u_error) × (v + v_error) = u × v + u × v_error + u_error × v, because
    # u_error × v_error is negligible.
    return product + (_cross(u, v_error) + _cross(u_error, v))


def _difference(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Compute a - b, and the exact minus the rounded difference (Knuth 1969)."""
    rounded = a - b
    # `negative_b` would be -b without rounding, and both errors would be 0.
    negative_b = rounded - a
    error_of_a = a - (rounded - negative_b)
    error_of_b = b + negative_b
    return rounded, error_of_a - error_of_b


def _product(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Compute a · b, and the rounding error of this product (Dekker 1971).

    The binary digits of each factor are split into an upper and a lower half. Products of two
    halves have no rounding error. The error is the exact product minus the rounded one.
    """
    rounded = a * b
    a_high, a_low = _halves(a)
    b_high, b_low = _halves(b)
    # Subtract `rounded` from the four products
    # of halves, the largest product first.
    error = (a_high * b_high - rounded) + a_high * b_low + a_low * b_high
    return rounded, error + a_low * b_low


def _halves(numbers: Tensor) -> tuple[Tensor, Tensor]:
    """Split numbers into halves of their binary digits that add up exactly (Dekker 1971)."""
    scaled = _SPLITTER * numbers
    # Both subtractions round away the lower half of the digits.
    high = scaled - (scaled - numbers)
    return high, numbers - high


# Faces that meet at an edge at a larger angle in degrees have separate normals there.
CREASE = 40.0
# Rounding errors of at most this angle in degrees do not make an edge sharp.
ROUNDING_ANGLE = 0.01
# Normals of a file that differ by at most this angle in degrees are rounded values of one normal.
FILE_ANGLE = 1.0
# Only so many of the faces around one edge are compared with each other.
# Without the limit, a file whose faces all share one edge would take forever.
MAX_FACES_AT_EDGE = 8


def normal_groups(
    vertices: Num[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    file_normals: Float[np.ndarray, "F 3 3"] | None = None,
    crease: float = CREASE,
) -> Int[np.ndarray, "F 3"]:
    """Divide the corners of faces into groups, each at one vertex and with a normal of its own.

    Two corners of a vertex with normals from a file are in one group if these
    normals agree. Other corners are in one group if a fan of faces connects them in
    which no two neighbors meet at a larger angle than `crease`.

    A group whose face normals cancel would have no normal. It is divided at the
    creases, and if that does not help, into its corners. So the two sides of a leaf
    with the same vertices are always in different groups. Normals from a file that are zero
    or NaN are ignored, and `crease` is in degrees. The result is the index of the group of
    each corner.
    """
    faces = faces.astype(np.int64, copy=False)
    # Positions may be NaN or infinite here. Renders refuse them later.
    with np.errstate(invalid="ignore", over="ignore"):
        area_vectors = doubled_area_vectors(vertices, faces)
        lengths = np.linalg.norm(area_vectors, axis=1)
        has_area = lengths > 0
        unit_normals = area_vectors / np.where(has_area, lengths, 1)[:, None]
        # Pairs of corners 3 f + c at one vertex, of faces f that share an edge there.
        pairs = _neighbors(faces)
        is_smooth = _are_similar(unit_normals, pairs // 3, min(crease + ROUNDING_ANGLE, 180))
        by_crease = _joined(faces, pairs[:, is_smooth])
    groups = by_crease
    if file_normals is not None:
        by_file, is_given = _groups_of_file(faces, unit_normals, file_normals, pairs)
        # Groups by crease have numbers behind those of the groups of the file.
        groups = np.where(is_given, by_file, by_crease + by_file.max() + 1)
    separate = np.arange(faces.size).reshape(-1, 3)
    for finer in (by_crease, separate):
        # The area vectors of these groups add up to zero. Their corners move to the finer groups.
        is_canceled = _cancels(groups, area_vectors, lengths) & has_area[:, None]
        groups = np.where(is_canceled, finer + groups.max() + 1, groups)
    # A corner of a face without area belongs to any other group of its vertex.
    # Without another group, each vertex has a new group of its own.
    group_of_vertex = groups.max() + 1 + np.arange(len(vertices))
    group_of_vertex[faces[has_area]] = groups[has_area]
    groups = np.where(has_area[:, None], groups, group_of_vertex[faces])
    # Number the groups without gaps.
    return np.unique(groups, return_inverse=True)[1].reshape(-1, 3)


def _groups_of_file(
    faces: np.ndarray, face_normals: np.ndarray, file_normals: np.ndarray, pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Group corners by their normals in a file, and tell which corners have one, shape (F, 3) each.

    `pairs` are corners of neighboring faces (see `_neighbors`). Corners of faces that only touch at
    a vertex are compared, too, in the order of their normals. Faces of opposite winding, which run
    along a common edge in the same direction, are in different groups.
    """
    lengths = np.linalg.norm(file_normals.astype(np.float64), axis=-1)
    is_given = (lengths > 0) & np.isfinite(lengths)
    unit_normals = np.where(is_given[..., None], file_normals, 0)
    unit_normals = unit_normals / np.where(is_given, lengths, 1)[..., None]
    # 1 if the normal of the file is on the side of the face normal, and -1 on the other side.
    side = np.sign(np.einsum("fci,fi->fc", unit_normals, face_normals)).ravel()
    unit_normals = unit_normals.reshape(-1, 3)
    vertex = faces.ravel()
    # One integer is sorted much faster than four numbers.
    rounded = np.rint(1000 * unit_normals).astype(int)
    # Corners of one vertex with similar normals become neighbors in this order. Each pair of
    # neighbors is compared.
    order = np.argsort(vertex * 2**33 + rounded @ [2**22, 2**11, 1])
    is_same_vertex = vertex[order[1:]] == vertex[order[:-1]]
    pairs = np.concatenate([pairs, np.stack([order[:-1], order[1:]])[:, is_same_vertex]], axis=1)
    agree = _are_similar(unit_normals, pairs, FILE_ANGLE)
    count = vertex.max() + 1
    directed_edges = vertex * count + np.roll(faces, -1, axis=1).ravel()
    edges, counts = np.unique(directed_edges, return_counts=True)
    is_mixed = np.isin(np.arange(count), np.divmod(edges[counts > 1], count))
    agree &= ~is_mixed[vertex[pairs[0]]] | (side[pairs].prod(axis=0) > 0)
    return _joined(faces, pairs[:, agree]), is_given


def _are_similar(unit_normals: np.ndarray, pairs: np.ndarray, angle: float) -> np.ndarray:
    """Tell for which pairs of indices (2, N) the normals differ by at most an angle in degrees."""
    return np.einsum("ni,ni->n", *unit_normals[pairs]) >= np.cos(np.radians(angle))


def _neighbors(faces: np.ndarray) -> Int[np.ndarray, "2 N"]:
    """Return pairs of corners 3 f + c at one vertex whose faces f share an edge that ends there."""
    # Side 3 f + s leads from corner s of face f to the next corner.
    start = faces.ravel()
    end = faces[:, [1, 2, 0]].ravel()
    next_corner = np.arange(faces.size).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    edge = np.minimum(start, end) * (start.max() + 1) + np.maximum(start, end)
    # Sides of the same edge follow each other in this order. All pairs of up to MAX_FACES_AT_EDGE
    # sides are found by their distance in the order.
    sides = np.argsort(edge, kind="stable")
    sorted_edges = edge[sides]
    pairs = [np.zeros((2, 0), np.int64)]
    for distance in range(1, MAX_FACES_AT_EDGE):
        is_shared = sorted_edges[distance:] == sorted_edges[:-distance]
        if not is_shared.any():
            break
        first = sides[:-distance][is_shared]
        second = sides[distance:][is_shared]
        # The corners of both faces at the start and at the end of the first side.
        # True if both sides start at the same vertex. Sides of neighbors usually run in opposite
        # directions.
        is_parallel = start[first] == start[second]
        pairs.append(np.stack([first, np.where(is_parallel, second, next_corner[second])]))
        at_end = np.where(is_parallel, next_corner[second], second)
        pairs.append(np.stack([next_corner[first], at_end]))
    return np.concatenate(pairs, axis=1)


def _joined(faces: np.ndarray, pairs: Int[np.ndarray, "2 N"]) -> np.ndarray:
    """Number the groups of corners that pairs of corners connect, shape (F, 3)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(pairs.shape[1], np.int8), tuple(pairs)), (faces.size, faces.size))
    return connected_components(graph, directed=False)[1].astype(np.int64).reshape(-1, 3)


def _cancels(groups: np.ndarray, area_vectors: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Tell for each corner whether the area vectors of its group add up to zero, shape (F, 3)."""
    flat_groups = groups.ravel()
    sums = [np.bincount(flat_groups, component.repeat(3)) for component in area_vectors.T]
    length_sums = np.bincount(flat_groups, lengths.repeat(3))
    return (np.linalg.norm(sums, axis=0) <= CANCELLATION * length_sums)[groups]
