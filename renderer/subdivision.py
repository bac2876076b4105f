"""Finer meshes of the same shape, so that an attack can move more vertices."""

from dataclasses import replace
from typing import Any

import numpy as np

from renderer.errors import require_range
from renderer.mesh import Mesh

MOST_VERTICES = 10**7  # some 5 GB
PER_FACE = ("faces", "corner_colors", "corner_uvs", "texture_ids")
_EDGES = ((0, 1), (1, 2), (2, 0))
_QUARTERS = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))  # corners 0 to 2 and the middles of the edges as 3 to 5


def subdivide(mesh: Mesh, vertices: int) -> Mesh:
    """The same surface with more vertices than `vertices`: every face is divided into four until there are enough.

    New vertices are the middles of edges, shared by the faces that share the edge, so that a closed mesh stays closed;
    colors (as they are stored, sRGB-encoded) and texture coordinates are interpolated. The old vertices keep their
    indices, and the quarters of face f are the faces 4f to 4f + 3. A mesh with enough vertices comes back as it is.

    >>> table = renderer.solid("table")
    >>> finer = subdivide(table, vertices=1000)
    >>> len(finer.vertices) > 1000, len(finer.faces) % len(table.faces)
    (True, 0)
    """
    require_range("vertices", vertices, 0, MOST_VERTICES)
    while len(mesh.vertices) <= vertices:
        mesh = _quartered(mesh)
    return mesh


def refine(mesh: Mesh, area: float) -> Mesh:
    """The same surface with faces of at most an area: larger ones are divided into four until none is left.

    The faces come in another order; the old vertices keep their indices, and new ones may lie on a neighbor's edge.
    """
    large = mesh.face_areas() > area
    if not large.any():
        return mesh
    small, finer = _select(mesh, ~large), refine(_quartered(_select(mesh, large)), area)
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in (small, finer)]) for name in PER_FACE
    }
    return replace(finer, **joined)


def _select(mesh: Mesh, faces: np.ndarray) -> Mesh:
    """Some of the faces, over all vertices."""
    return replace(mesh, **{name: getattr(mesh, name)[faces] for name in PER_FACE})


def _quartered(mesh: Mesh) -> Mesh:
    count = len(mesh.vertices)
    ends = np.sort(mesh.faces[:, _EDGES].reshape(-1, 2), axis=1)
    edges, edge = np.unique(ends @ [count, 1], return_inverse=True)  # one number is sorted faster than a pair
    middles = mesh.vertices[np.stack(np.divmod(edges, count), axis=1)].mean(axis=1)
    around = np.concatenate([mesh.faces, count + edge.reshape(-1, 3)], axis=1)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, middles]),
        faces=around[:, _QUARTERS].reshape(-1, 3),
        corner_colors=_interpolated(mesh.corner_colors),
        corner_uvs=_interpolated(mesh.corner_uvs),
        texture_ids=mesh.texture_ids.repeat(4),
    )


def _interpolated(corners: np.ndarray) -> np.ndarray:
    """Values (4F, 3, D) at the corners of the quarters, of values (F, 3, D) at the corners of the faces."""
    middles = corners[:, _EDGES].mean(axis=2)
    return np.concatenate([corners, middles], axis=1)[:, _QUARTERS].reshape(-1, *corners.shape[1:])
