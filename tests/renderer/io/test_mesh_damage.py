"""Flipped and degenerate faces by closed forms."""

import math

import numpy as np
import pytest
import trimesh

from renderer.io.mesh_damage import mesh_damage

NONE = (0.0, 0.0, 0.0)
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float64)
FACE = np.array([[0, 1, 2]])
BALL = trimesh.creation.icosphere(subdivisions=3)


def counts(before: np.ndarray, after: np.ndarray, faces: np.ndarray) -> tuple[int, int]:
    """(flipped, degenerate) faces."""
    damage = mesh_damage(before, after, faces)
    return damage["flipped"], damage["degenerate"]


def with_corners(*corners) -> np.ndarray:
    """The triangle with other positions of some of its corners."""
    vertices = TRIANGLE.copy()
    for index, position in corners:
        vertices[index] = position
    return vertices


@pytest.mark.parametrize("degrees", [0, 60, 89.999, 90.001, 180, 269.999, 270.001])
def test_a_face_is_flipped_if_its_normal_turned_by_more_than_90_degrees(degrees):
    angle = math.radians(degrees)
    after = with_corners((2, (0, math.cos(angle), math.sin(angle))))
    assert counts(TRIANGLE, after, FACE) == (math.cos(angle) < 0, 0)


@pytest.mark.parametrize(
    "after",
    [with_corners((2, (1, 0, 0))), with_corners((2, (3, 0, 0))), with_corners((1, NONE), (2, NONE))],
    ids=["two corners as one", "corners in a row", "all corners as one"],
)
def test_a_face_without_area_is_degenerate_and_not_flipped(after):
    assert counts(TRIANGLE, after, FACE) == (0, 1)


def test_a_face_that_had_no_area_is_not_damaged():
    flat = with_corners((2, (3, 0, 0)))
    for after in (flat, TRIANGLE, -TRIANGLE):
        assert counts(flat, after, FACE) == (0, 0)


def test_points_in_a_row_are_degenerate_as_float32_and_64_times_that_height_is_not():
    """Points in a row of any position and length, the middle one also beside it by 64 half units of float32."""
    rng, count = np.random.default_rng(0), 20_000
    a, b = rng.uniform(-1, 1, (2, count, 3)) * 10 ** rng.uniform(-3, 3, (count, 1))
    middle = a + rng.random((count, 1)) * (b - a)
    across = np.cross(b - a, rng.normal(size=(count, 3)))
    across *= (np.abs([a, b]).max(axis=(0, 2)) / np.linalg.norm(across, axis=1))[:, None]
    faces = np.arange(3 * count).reshape(-1, 3)

    def stored(apex: np.ndarray) -> np.ndarray:
        return np.stack([a, b, apex], axis=1).reshape(-1, 3).astype(np.float32)

    before, in_a_row = stored(middle + across), stored(middle)
    assert (trimesh.Trimesh(in_a_row, faces, process=False).area_faces > 0).mean() > 0.9
    assert counts(before, in_a_row, faces)[1] == count
    assert counts(before, stored(middle + 64 * 2.0**-24 * across), faces)[1] == 0


def test_a_mirror_flips_the_faces_that_look_along_it():
    """Mirrored in x, a counter-clockwise face of normal (x, y, z) has the normal (x, -y, -z)."""
    flipped = (2 * BALL.face_normals[:, 0] ** 2 < 1).sum()
    assert counts(BALL.vertices, BALL.vertices * [-1, 1, 1], BALL.faces) == (flipped, 0)


def test_the_displacement_is_the_largest_along_each_axis_in_either_direction():
    after = with_corners((0, (0.25, -0.5, 0)), (1, (0.5, 0, 0.125)))
    assert mesh_damage(TRIANGLE, after, FACE)["displacement"] == [0.5, 0.5, 0.125]
