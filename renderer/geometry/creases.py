"""Groups of face corners with a common normal, which end at the sharp edges of a mesh.

With smooth normals, each group has one normal. It is recomputed whenever the
vertices move, but the groups stay as they are.

Shapes use these letters: a mesh has V vertices and F faces.
"""

from __future__ import annotations

import numpy as np

from renderer.geometry.normals import CANCELLATION, doubled_area_vectors

# Faces that meet at an edge at a larger angle in degrees have separate normals there.
CREASE = 40.0
# Rounding errors of at most this angle in degrees do not make an edge sharp.
ROUNDING_ANGLE = 0.01
# The normals of a file are rounded to this fraction before they are compared.
FILE_NORMAL_STEP = 1e-3
# Only so many of the faces around one edge are compared with each other.
# Without the limit, a file whose faces all share one edge would take forever.
MAX_FACES_AT_EDGE = 8


def normal_groups(
    vertices: np.ndarray,
    faces: np.ndarray,
    file_normals: np.ndarray | None = None,
    crease: float = CREASE,
) -> np.ndarray:
    """Divide the corners of faces into groups, each at one vertex and with a normal of its own.

    Two corners of a vertex with normals from a file are in one group if these
    normals agree. Other corners are in one group if a fan of faces connects them in
    which no two neighbors meet at a larger angle than `crease`.

    A group whose face normals cancel would have no normal. It is divided at the
    creases, and if that does not help, into its corners. So the two sides of a leaf
    with the same vertices are always in different groups.

    Args:
        vertices: Vertex positions, shape (V, 3).
        faces: Vertex indices of the faces, shape (F, 3).
        file_normals: Normal of each corner in a file, shape (F, 3, 3). Normals that
            are zero or NaN are ignored. None if the file has no normals.
        crease: Angle in degrees.

    Returns:
        Index of the group of each corner, int64, shape (F, 3).
    """
    faces = faces.astype(np.int64, copy=False)
    # Positions may be NaN or infinite here. Renders refuse them later.
    with np.errstate(invalid="ignore", over="ignore"):
        area_vectors = doubled_area_vectors(vertices, faces)
        lengths = np.linalg.norm(area_vectors, axis=1)
        has_area = lengths > 0
        unit_normals = area_vectors / np.where(has_area, lengths, 1)[:, None]
        sharpest = np.cos(np.radians(min(crease + ROUNDING_ANGLE, 180)))
        by_crease = _fans(faces, unit_normals, sharpest)
    groups = by_crease
    if file_normals is not None:
        by_file, is_given = _groups_of_file(faces, file_normals)
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


def _groups_of_file(faces: np.ndarray, file_normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the vertex and normal of each corner, and whether a normal is given."""
    lengths = np.linalg.norm(file_normals.astype(np.float64), axis=-1)
    is_given = (lengths > 0) & np.isfinite(lengths)
    safe_normals = np.where(is_given[..., None], file_normals, 1)
    unit_normals = safe_normals / np.where(is_given, lengths, 1)[..., None]
    steps = round(1 / FILE_NORMAL_STEP)
    # Each component becomes a digit from 0 to 2 · steps of one integer.
    digits = np.rint(steps * unit_normals.clip(-1, 1)).astype(np.int64) + steps
    base = 2 * steps + 1
    keys = faces * base**3 + digits @ [base**2, base, 1]
    return np.unique(keys, return_inverse=True)[1].reshape(-1, 3), is_given


def _fans(faces: np.ndarray, unit_normals: np.ndarray, min_cosine: float) -> np.ndarray:
    """Number the fans of faces around each vertex that end at sharp edges, shape (F, 3).

    An edge is sharp if the cosine of the angle between the normals of its faces is
    below `min_cosine`.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    # Side 3 f + s leads from corner s of face f to the next corner,
    # so that a side has the number of the corner at which it starts.
    start = faces.ravel()
    end = faces[:, [1, 2, 0]].ravel()
    next_corner = np.arange(faces.size).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    edge = np.minimum(start, end) * (start.max() + 1) + np.maximum(start, end)
    sides = np.argsort(edge, kind="stable")
    sorted_edges = edge[sides]
    links = []
    for distance in range(1, MAX_FACES_AT_EDGE):
        is_shared = sorted_edges[distance:] == sorted_edges[:-distance]
        if not is_shared.any():
            break
        first = sides[:-distance][is_shared]
        second = sides[distance:][is_shared]
        cosines = np.einsum("ni,ni->n", unit_normals[first // 3], unit_normals[second // 3])
        first, second = first[cosines >= min_cosine], second[cosines >= min_cosine]
        # The corners of both faces at the start and at the end of the first side.
        is_parallel = start[first] == start[second]
        at_start = np.where(is_parallel, second, next_corner[second])
        at_end = np.where(is_parallel, next_corner[second], second)
        links += [(first, at_start), (next_corner[first], at_end)]
    rows, columns = np.concatenate(links, axis=1) if links else np.zeros((2, 0), np.int64)
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), (faces.size, faces.size))
    return connected_components(graph, directed=False)[1].astype(np.int64).reshape(-1, 3)


def _cancels(groups: np.ndarray, area_vectors: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Tell for each corner whether the area vectors of its group add up to zero, shape (F, 3)."""
    flat_groups = groups.ravel()
    sums = [np.bincount(flat_groups, component.repeat(3)) for component in area_vectors.T]
    length_sums = np.bincount(flat_groups, lengths.repeat(3))
    is_canceled = np.linalg.norm(sums, axis=0) <= CANCELLATION * length_sums
    return is_canceled[groups]
