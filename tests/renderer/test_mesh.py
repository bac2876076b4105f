"""Meshes: geometry by closed form, and by trimesh."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from renderer.errors import InputError
from renderer.mesh import Mesh, concatenate, normalize


def corner_positions(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces]


# The data class


def test_normals_are_outward_units_and_areas_right():
    box = trimesh.creation.box((1, 2, 3))
    mesh = Mesh.plain(box.vertices, box.faces)
    outward = np.sign(np.round(corner_positions(mesh).mean(axis=1) / [0.5, 1, 1.5], 6).astype(int))
    assert_array_equal(mesh.face_normals(), outward)
    assert_array_equal(np.sort(mesh.face_areas()), np.repeat([1, 1.5, 3], 4))


def test_zero_area_faces_have_a_zero_normal():
    mesh = Mesh.plain([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2], [0, 0, 1], [1, 1, 1]])
    assert_array_equal(mesh.face_normals(), np.zeros((3, 3)))
    assert_array_equal(mesh.face_areas(), np.zeros(3))


# Closed or open

BOX = trimesh.creation.box()
SMALLER = BOX.vertices / 4
AT_A_CORNER = SMALLER + 5 / 8  # a box of a quarter's width, whose lowest corner is the large one's highest
INSIDE_OUT = BOX.faces[:, ::-1]


def beside(*parts) -> Mesh:
    """Boxes with corners and faces of their own."""
    return concatenate([Mesh.plain(vertices, faces) for vertices, faces in parts])


def welded(mesh: Mesh) -> Mesh:
    vertices, ids = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return Mesh.plain(vertices, ids.reshape(-1)[mesh.faces])


def with_face(*face: int) -> Mesh:
    return Mesh.plain(BOX.vertices, np.concatenate([BOX.faces, [face]]))


@pytest.mark.parametrize(
    ("mesh", "closed"),
    [
        (Mesh.plain(BOX.vertices, BOX.faces), True),
        (Mesh.plain(BOX.vertices, INSIDE_OUT), False),
        (Mesh.plain(-BOX.vertices, BOX.faces), False),
        (Mesh.plain(BOX.vertices, BOX.faces[1:]), False),
        (Mesh.plain(BOX.vertices, np.concatenate([BOX.faces[:1, ::-1], BOX.faces[1:]])), False),
        (Mesh.plain(BOX.vertices, np.concatenate([BOX.faces, BOX.faces])), False),
        (with_face(0, 0, 1), False),
        (Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]]), False),
        (beside((BOX.vertices, BOX.faces), (SMALLER + 3, BOX.faces)), True),
        (beside((BOX.vertices, BOX.faces), (BOX.vertices + 0.5, BOX.faces)), True),
        (beside((BOX.vertices, BOX.faces), (SMALLER + 3, INSIDE_OUT)), False),
        (beside((BOX.vertices, BOX.faces), (SMALLER, INSIDE_OUT)), False),
        (welded(beside((BOX.vertices, BOX.faces), (AT_A_CORNER, BOX.faces))), True),
        (welded(beside((BOX.vertices, BOX.faces), (AT_A_CORNER, INSIDE_OUT))), False),
    ],
    ids=[
        "box", "inside out", "mirrored", "a face missing", "a face turned round", "every face twice",
        "a face without area", "a sheet of two sides", "two boxes", "two that overlap", "one of two inside out",
        "a hollow", "two that touch at a corner", "one of two that touch is inside out",
    ],
)  # fmt: skip
def test_a_mesh_is_closed_if_no_face_of_it_is_ever_seen_from_behind(mesh, closed):
    assert mesh.closed is closed


def test_a_changed_mesh_is_examined_anew_for_being_closed():
    mesh = Mesh.plain(BOX.vertices, BOX.faces)
    assert mesh.closed
    assert not replace(mesh, vertices=-mesh.vertices).closed


# Normalizing


def test_normalize_centers_on_the_centroid_of_the_surface_and_fits_the_unit_cube():
    """trimesh's centroid is the same average of the faces, by their area."""
    cone = trimesh.creation.cone(radius=0.3, height=2)
    cone.apply_translation([7, -3, 11])
    mesh = normalize(Mesh.plain(cone.vertices, cone.faces))
    assert_allclose(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).centroid, 0, atol=2**-25)
    assert np.abs(mesh.vertices).max() == 1
    centered = cone.vertices - cone.centroid
    assert_allclose(mesh.vertices, centered / np.abs(centered).max(), atol=2**-25)  # half of float32's step below 1
    assert_array_equal(mesh.vertices, mesh.vertices.astype(np.float32))


# Errors


@pytest.mark.parametrize("faces", [[[0, 1, 9]], [[0, 1, -1]]])
def test_faces_of_vertices_that_are_not_there_are_refused(faces):
    with pytest.raises(InputError, match="faces name vertices that are not there: give indices from 0 to 2"):
        Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], faces)


def test_a_surface_of_zero_area_has_no_size_to_scale():
    with pytest.raises(InputError, match="the mesh has a surface of zero area"):
        normalize(Mesh.plain(np.zeros((3, 3)), [[0, 1, 2]]))
