"""Procedural solids: closed shells of faces that point outward."""

import numpy as np
import pytest
import trimesh

from renderer.solids import HARD_NEGATIVES, SOLIDS, solid

ALL = SOLIDS | HARD_NEGATIVES
# The handle of a cup is a second shell.
SHELL_COUNTS = dict.fromkeys(ALL, 1) | {"cup": 2}
# Euler characteristic of a surface without holes or handles.
SPHERE = 2


@pytest.mark.parametrize("name", ALL)
def test_a_solid_has_closed_shells_with_faces_outward_and_fills_the_unit_box(name):
    mesh = solid(name, 1)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    # Each directed edge occurs once, and its reverse, too.
    assert shape.is_watertight
    assert shape.is_winding_consistent
    shells = shape.split(repair=False)
    assert len(shells) == SHELL_COUNTS[name]
    for shell in shells:
        assert shell.euler_number == SPHERE
        assert shell.volume > 1e-3
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
