"""Meshes: areas, closedness, normalization and subdivision, against closed forms and trimesh."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from oracles import corners_of, mesh_of, patchwork

from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from renderer.light.files import load_light
from renderer.mesh import Mesh, concatenate, normalize, refine, subdivide
from renderer.rendering import render
from renderer.solids import solid

EPS32 = np.finfo(np.float32).eps


def test_faces_without_area_have_a_zero_normal():
    mesh = Mesh.plain([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2], [0, 0, 1], [1, 1, 1]])
    assert_array_equal(mesh.face_normals(), np.zeros((3, 3)))
    assert_array_equal(mesh.face_areas(), np.zeros(3))


BOX = trimesh.creation.box()
BOX_MESH = mesh_of(BOX)
INSIDE_OUT = Mesh.plain(BOX.vertices, BOX.faces[:, ::-1])


def moved_box(offset: float, scale: float = 1.0, faces: np.ndarray = BOX.faces) -> Mesh:
    return Mesh.plain(scale * BOX.vertices + offset, faces)


def weld(mesh: Mesh) -> Mesh:
    vertices, ids = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return Mesh.plain(vertices, ids.reshape(-1)[mesh.faces])


def with_faces(*faces: np.ndarray) -> Mesh:
    return Mesh.plain(BOX.vertices, np.concatenate(faces))


# A quarter of the box, moved by 5/8, touches the large one with a corner.
TOUCHING = moved_box(5 / 8, 1 / 4)
TOUCHING_INSIDE_OUT = moved_box(5 / 8, 1 / 4, INSIDE_OUT.faces)
CLOSED_MESHES = {
    "box": BOX_MESH,
    "two boxes": concatenate([BOX_MESH, moved_box(3, 1 / 4)]),
    "overlapping boxes": concatenate([BOX_MESH, moved_box(0.5)]),
    "boxes with a common corner": weld(concatenate([BOX_MESH, TOUCHING])),
}
OPEN_MESHES = {
    "inside out": INSIDE_OUT,
    "mirrored": Mesh.plain(-BOX.vertices, BOX.faces),
    "a missing face": with_faces(BOX.faces[1:]),
    "a reversed face": with_faces(BOX.faces[:1, ::-1], BOX.faces[1:]),
    "every face twice": with_faces(BOX.faces, BOX.faces),
    "a face without area": with_faces(BOX.faces, [[0, 0, 1]]),
    "a sheet with two sides": with_faces([[0, 1, 2], [0, 2, 1]]),
    "one of two boxes inside out": concatenate([BOX_MESH, moved_box(3, 1 / 4, INSIDE_OUT.faces)]),
    "a hollow box": concatenate([BOX_MESH, moved_box(0, 1 / 4, INSIDE_OUT.faces)]),
    "a touching box inside out": weld(concatenate([BOX_MESH, TOUCHING_INSIDE_OUT])),
}


@pytest.mark.parametrize("name", CLOSED_MESHES | OPEN_MESHES)
def test_a_mesh_is_closed_if_none_of_its_faces_may_be_visible_from_behind(name):
    assert (CLOSED_MESHES | OPEN_MESHES)[name].closed is (name in CLOSED_MESHES)


def test_a_normalized_mesh_is_centered_at_its_centroid_and_fits_the_unit_cube():
    """The tolerance is half of float32's spacing below 1."""
    cone = trimesh.creation.cone(radius=0.3, height=2)
    cone.apply_translation([7, -3, 11])
    mesh = normalize(mesh_of(cone))
    centered = cone.vertices - cone.centroid
    assert_allclose(mesh.vertices, centered / np.abs(centered).max(), atol=2**-25)
    assert np.abs(mesh.vertices).max() == 1
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert_allclose(shape.centroid, 0, atol=2**-25)
    assert_array_equal(mesh.vertices, mesh.vertices.astype(np.float32))


def test_a_surface_of_zero_area_cannot_be_normalized():
    with pytest.raises(InputError):
        normalize(Mesh.plain(np.zeros((3, 3)), [[0, 1, 2]]))


ICOSAHEDRON = trimesh.creation.icosahedron()
SHEET = patchwork(ICOSAHEDRON.vertices, ICOSAHEDRON.faces[:13])
MESHES = {
    "box": BOX_MESH,
    "cup": solid("cup"),
    "two that touch": concatenate([BOX_MESH, mesh_of(trimesh.creation.icosphere(1))]),
    "open": SHEET,
}


@pytest.mark.parametrize(("min_count", "expected_count"), [(0, 12), (11, 12), (12, 42), (42, 162)])
def test_an_icosahedron_is_divided_until_it_has_more_vertices_than_asked(min_count, expected_count):
    mesh = subdivide(mesh_of(trimesh.creation.icosahedron()), min_count)
    assert len(mesh.vertices) == expected_count
    # Euler's formula for a closed surface of triangles.
    assert len(mesh.faces) == 2 * expected_count - 4


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_a_subdivided_face_has_its_corners_and_the_centers_of_its_edges(mesh):
    finer = subdivide(mesh, len(mesh.vertices))
    assert_array_equal(finer.vertices[: len(mesh.vertices)], mesh.vertices)
    a, b, c = corners_of(mesh).swapaxes(0, 1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])
    expected = quarters.transpose(2, 0, 1, 3)
    assert_array_equal(corners_of(finer).reshape(-1, 4, 3, 3), expected)
    # The topology stays.
    shapes = [trimesh.Trimesh(m.vertices, m.faces, process=False) for m in (mesh, finer)]
    assert shapes[0].euler_number == shapes[1].euler_number
    assert finer.closed is mesh.closed


def linear_values(mesh: Mesh) -> np.ndarray:
    """Evaluate five functions, linear on each face of SHEET, at the corners of a subdivision."""
    slopes = np.random.default_rng(1).uniform(-0.2, 0.2, (len(SHEET.faces), 3, 5))
    parts_per_face = len(mesh.faces) // len(SHEET.faces)
    return 0.5 + corners_of(mesh) @ slopes.repeat(parts_per_face, axis=0)


def test_colors_and_texture_coordinates_are_linear_on_the_original_faces():
    """Values are rounded to float32 at each of two subdivisions."""
    values = linear_values(SHEET).astype(np.float32)
    mesh = replace(SHEET, corner_colors=values[..., :3], corner_uvs=values[..., 3:])
    finer = subdivide(mesh, 100)
    assert len(finer.faces) == 16 * len(SHEET.faces)
    found = np.concatenate([finer.corner_colors, finer.corner_uvs], axis=-1)
    assert_allclose(found, linear_values(finer), rtol=0, atol=2 * EPS32)
    assert_array_equal(finer.texture_ids, SHEET.texture_ids.repeat(16))
    assert all(a is b for a, b in zip(finer.textures, SHEET.textures, strict=True))


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_a_subdivided_mesh_has_the_same_image(encoding):
    corners = [[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]
    quad = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]], np.eye(4)[:, :3])
    camera = OrthographicCamera(polar=90, azimuth=0, width=2.0)
    light = load_light("uniform")
    finer = subdivide(quad, 100, encoding)
    images = [render(mesh, camera, light, size=8, encoding=encoding) for mesh in (quad, finer)]
    torch.testing.assert_close(images[1], images[0], rtol=0, atol=1e-5)


def test_a_mesh_that_needs_no_division_is_refused_in_an_unknown_encoding():
    with pytest.raises(InputError, match="encoding=gamma"):
        subdivide(SHEET, 0, "gamma")


# One face of area 8 in the plane z = 0, and one of area 2.
CORNER = Mesh.plain(
    [[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 1]], [[0, 1, 2], [0, 3, 1]], np.eye(4)[:, :3]
)


def test_a_face_is_refined_as_often_as_its_area_needs():
    finer = refine(CORNER, 0.6, "linear")
    is_flat = (corners_of(finer)[..., 2] == 0).all(axis=1)
    assert_allclose(finer.face_areas()[is_flat], [0.5] * 16)
    assert_allclose(finer.face_areas()[~is_flat], [0.5] * 4)
    assert_array_equal(refine(CORNER, 8.0, "linear").faces, CORNER.faces)
    assert_array_equal(finer.vertices[:4], CORNER.vertices)
    assert_array_equal(finer.face_normals()[is_flat], np.tile([0, 0, 1], (16, 1)))
    x, y, _ = corners_of(finer)[is_flat].reshape(-1, 3).T / 4
    colors = finer.corner_colors[is_flat].reshape(-1, 3)
    assert_allclose(colors, np.stack([1 - x - y, x, y], axis=1), atol=1e-7)
