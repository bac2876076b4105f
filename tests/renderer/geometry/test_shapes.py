from collections import Counter

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from renderer.geometry.shapes import HARD_NEGATIVES, SOLIDS, solid

ALL = SOLIDS | HARD_NEGATIVES
SHELLS = dict.fromkeys(ALL, 1) | {"cup": 2}  # a cup's handle is a shell of its own
SEEDS = range(2)


def enclosed_volume(vertices, faces):
    """Divergence theorem: the signed tetrahedra from the origin to each face."""
    return np.linalg.det(vertices[faces]).sum() / 6


def shells(mesh):
    """The faces (F_i, 3) of each connected component."""
    a, b, c = mesh.faces.T
    rows, columns = np.concatenate([a, b]), np.concatenate([b, c])
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(mesh.vertices),) * 2)
    count, of_vertex = connected_components(links, directed=False)
    return [mesh.faces[of_vertex[a] == shell] for shell in range(count)]


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_solid_has_closed_shells_outward_with_faces_of_some_area_about_the_unit_box(name, seed):
    """Each directed edge occurs once, and so does its reverse; each shell is a topological sphere."""
    mesh = solid(name, seed)
    edges = Counter((face[i], face[(i + 1) % 3]) for face in mesh.faces.tolist() for i in range(3))
    assert set(edges.values()) == {1} and all((b, a) in edges for a, b in edges)
    parts = shells(mesh)
    assert len(parts) == SHELLS[name]
    for faces in parts:
        assert len(np.unique(faces)) - 3 * len(faces) / 2 + len(faces) == 2
        assert enclosed_volume(mesh.vertices, faces) > 1e-3
    assert mesh.face_areas().min() > 1e-6
    np.testing.assert_array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
    assert 0.8 < np.abs(mesh.vertices).max() < 1.05
    assert mesh.corner_colors.min() >= 0 and mesh.corner_colors.max() <= 1


@pytest.mark.parametrize("name", ALL)
def test_a_seed_picks_one_instance(name):
    one, again, other = solid(name, 1), solid(name, 1), solid(name, 2)
    for field in ("vertices", "faces", "corner_colors"):
        np.testing.assert_array_equal(getattr(one, field), getattr(again, field))
    assert name == "ball" or not np.array_equal(one.vertices, other.vertices)
    assert not np.array_equal(one.corner_colors, other.corner_colors)
