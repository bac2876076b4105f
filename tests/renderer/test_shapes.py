"""Procedural solids: closed shells of faces that point outward."""

from collections import Counter

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from renderer.mesh import Mesh
from renderer.solids import HARD_NEGATIVES, SOLIDS, solid

ALL = SOLIDS | HARD_NEGATIVES
# The handle of a cup is a second shell.
SHELL_COUNTS = dict.fromkeys(ALL, 1) | {"cup": 2}
# Euler characteristic of a surface without holes or handles.
SPHERE = 2


def shells(mesh: Mesh) -> list[np.ndarray]:
    a, b, c = mesh.faces.T
    rows = np.concatenate([a, b])
    columns = np.concatenate([b, c])
    vertex_count = len(mesh.vertices)
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(vertex_count, vertex_count))
    count, shell_of_vertex = connected_components(links, directed=False)
    return [mesh.faces[shell_of_vertex[a] == shell] for shell in range(count)]


@pytest.mark.parametrize("name", ALL)
def test_a_solid_has_closed_shells_with_faces_outward_and_fills_the_unit_box(name):
    mesh = solid(name, 1)
    # Each directed edge occurs once, and its reverse, too.
    edges = Counter((face[i], face[(i + 1) % 3]) for face in mesh.faces.tolist() for i in range(3))
    assert set(edges.values()) == {1}
    assert all((end, start) in edges for start, end in edges)
    parts = shells(mesh)
    assert len(parts) == SHELL_COUNTS[name]
    for faces in parts:
        edge_count = 3 * len(faces) / 2
        assert len(np.unique(faces)) - edge_count + len(faces) == SPHERE
        # Signed tetrahedra between the origin and each face (divergence theorem).
        assert np.linalg.det(mesh.vertices[faces]).sum() / 6 > 1e-3
    assert mesh.face_areas().min() > 1e-6
    np.testing.assert_array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
    assert 0.8 < np.abs(mesh.vertices).max() < 1.05
    assert 0 <= mesh.corner_colors.min() <= mesh.corner_colors.max() <= 1


def test_a_seed_picks_one_instance():
    for name in ALL:
        first, again, other = (solid(name, seed) for seed in (1, 1, 2))
        np.testing.assert_array_equal(first.vertices, again.vertices)
        np.testing.assert_array_equal(first.faces, again.faces)
        np.testing.assert_array_equal(first.corner_colors, again.corner_colors)
        assert not np.array_equal(first.corner_colors, other.corner_colors)
        # All balls have one shape.
        assert name == "ball" or not np.array_equal(first.vertices, other.vertices)
