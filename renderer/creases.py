"""Groups of face corners with a common normal, which end at the sharp edges of a mesh.

With smooth normals, each group has one normal. It is recomputed whenever the
vertices move, but the groups stay as they are.

Shapes use these letters: a mesh has V vertices and F faces.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, Num

from renderer.normals import CANCELLATION, doubled_area_vectors

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
        first, second = _neighbors(faces)
        cosines = np.einsum("ni,ni->n", unit_normals[first // 3], unit_normals[second // 3])
        is_smooth = cosines >= np.cos(np.radians(min(crease + ROUNDING_ANGLE, 180)))
        by_crease = _joined(faces, first[is_smooth], second[is_smooth])
    groups = by_crease
    if file_normals is not None:
        by_file, is_given = _groups_of_file(faces, file_normals, first, second)
        groups = np.where(is_given, by_file, by_crease + by_file.max() + 1)
    separate = np.arange(faces.size).reshape(-1, 3)
    for finer in (by_crease, separate):
        is_canceled = _cancels(groups, area_vectors, lengths) & has_area[:, None]
        groups = np.where(is_canceled, finer + groups.max() + 1, groups)
    # A corner of a face without area belongs to any other group of its vertex.
    group_of_vertex = groups.max() + 1 + np.arange(len(vertices))
    group_of_vertex[faces[has_area]] = groups[has_area]
    groups = np.where(has_area[:, None], groups, group_of_vertex[faces])
    return np.unique(groups, return_inverse=True)[1].reshape(-1, 3)


def _groups_of_file(
    faces: np.ndarray, file_normals: np.ndarray, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Group corners by their normals in a file, and tell which corners have one, shape (F, 3) each.

    `first` and `second` are the corners of neighboring faces (see `_neighbors`).
    Corners of faces that only touch at a vertex are compared, too, in the order of
    their normals.
    """
    lengths = np.linalg.norm(file_normals.astype(np.float64), axis=-1)
    is_given = (lengths > 0) & np.isfinite(lengths)
    unit_normals = np.where(is_given[..., None], file_normals, 0)
    unit_normals = (unit_normals / np.where(is_given, lengths, 1)[..., None]).reshape(-1, 3)
    vertex = faces.ravel()
    # One integer is sorted much faster than four numbers.
    order = np.argsort(
        vertex * 2**33 + np.rint(1000 * unit_normals).astype(int) @ [2**22, 2**11, 1]
    )
    is_same_vertex = vertex[order[1:]] == vertex[order[:-1]]
    first = np.concatenate([first, order[:-1][is_same_vertex]])
    second = np.concatenate([second, order[1:][is_same_vertex]])
    cosines = np.einsum("ni,ni->n", unit_normals[first], unit_normals[second])
    agree = cosines >= np.cos(np.radians(FILE_ANGLE))
    return _joined(faces, first[agree], second[agree]), is_given


def _neighbors(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of corners at one vertex whose faces share an edge that ends there.

    Corner c of face f has the number 3 f + c.
    """
    # Side 3 f + s leads from corner s of face f to the next corner.
    start = faces.ravel()
    end = faces[:, [1, 2, 0]].ravel()
    next_corner = np.arange(faces.size).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    edge = np.minimum(start, end) * (start.max() + 1) + np.maximum(start, end)
    sides = np.argsort(edge, kind="stable")
    sorted_edges = edge[sides]
    firsts, seconds = [], []
    for distance in range(1, MAX_FACES_AT_EDGE):
        is_shared = sorted_edges[distance:] == sorted_edges[:-distance]
        if not is_shared.any():
            break
        first = sides[:-distance][is_shared]
        second = sides[distance:][is_shared]
        # The corners of both faces at the start and at the end of the first side.
        is_parallel = start[first] == start[second]
        firsts += [first, next_corner[first]]
        seconds += [
            np.where(is_parallel, second, next_corner[second]),
            np.where(is_parallel, next_corner[second], second),
        ]
    nothing = np.zeros(0, np.int64)
    return np.concatenate([nothing, *firsts]), np.concatenate([nothing, *seconds])


def _joined(faces: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Number the groups of corners that pairs of corners connect, shape (F, 3)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(first), np.int8), (first, second)), (faces.size, faces.size))
    return connected_components(graph, directed=False)[1].astype(np.int64).reshape(-1, 3)


def _cancels(groups: np.ndarray, area_vectors: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Tell for each corner whether the area vectors of its group add up to zero, shape (F, 3)."""
    flat_groups = groups.ravel()
    sums = [np.bincount(flat_groups, component.repeat(3)) for component in area_vectors.T]
    length_sums = np.bincount(flat_groups, lengths.repeat(3))
    is_canceled = np.linalg.norm(sums, axis=0) <= CANCELLATION * length_sums
    return is_canceled[groups]
