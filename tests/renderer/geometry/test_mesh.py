"""Meshes: geometry and subdivision by closed form, and by trimesh."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from oracles import corners_of, mesh_of

from renderer.errors import InputError
from renderer.geometry.mesh import Mesh, concatenate, normalize, refine, subdivide
from renderer.geometry.shapes import solid

EPS32 = np.finfo(np.float32).eps


# The data class


def test_normals_are_outward_units_and_areas_right():
    mesh = mesh_of(trimesh.creation.box((1, 2, 3)))
    outward = np.sign(np.round(corners_of(mesh).mean(axis=1) / [0.5, 1, 1.5], 6).astype(int))
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
        (mesh_of(BOX), True),
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


@pytest.mark.parametrize(
    ("faces", "message"),
    [*(([[0, 1, last]], "faces name vertices that are not there: give indices from 0 to 2") for last in (9, -1)),
     (np.zeros((0, 3)), "the number of faces=0 must be at least 1")],
)  # fmt: skip
def test_no_faces_and_faces_of_vertices_that_are_not_there_are_refused(faces, message):
    with pytest.raises(InputError, match=message):
        Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], faces)


def test_a_surface_of_zero_area_has_no_size_to_scale():
    with pytest.raises(InputError, match="the mesh has a surface of zero area"):
        normalize(Mesh.plain(np.zeros((3, 3)), [[0, 1, 2]]))


# Subdividing


def height_field(cells: int = 3) -> Mesh:
    """A rough surface over [-1, 1]², whose corners' x and y are multiples of 2 / cells; colors and uvs with seams."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(*[np.linspace(-1, 1, cells + 1)] * 2, indexing="ij")
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.stack([x.ravel(), y.ravel(), rng.uniform(-0.3, 0.3, x.size)], axis=1)
    return replace(
        Mesh.plain(vertices, faces),
        corner_colors=rng.random((len(faces), 3, 3), dtype=np.float32),
        corner_uvs=rng.random((len(faces), 3, 2), dtype=np.float32),
        texture_ids=rng.integers(-1, 2, len(faces)).astype(np.int32),
        textures=tuple(rng.integers(0, 256, (4, side, 3), dtype=np.uint8) for side in (4, 8)),
    )


SHEET = height_field()
MESHES = {
    "box": mesh_of(BOX),
    "cup": solid("cup"),
    "two that touch": concatenate([mesh_of(BOX), mesh_of(trimesh.creation.icosphere(subdivisions=1))]),
    "open": SHEET,
}
every_mesh = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


@pytest.mark.parametrize(("asked", "found"), [(0, 12), (11, 12), (12, 42), (42, 162), (5000, 10_242)])
def test_an_icosahedron_is_subdivided_until_it_has_more_vertices_than_asked(asked, found):
    mesh = subdivide(mesh_of(trimesh.creation.icosahedron()), asked)
    assert (len(mesh.vertices), len(mesh.faces)) == (found, 2 * found - 4)


@every_mesh
def test_the_old_vertices_stay_and_the_new_ones_are_the_middles_of_the_edges(mesh):
    finer = subdivide(mesh, len(mesh.vertices))
    assert_array_equal(finer.vertices[: len(mesh.vertices)], mesh.vertices)
    a, b, c = corners_of(mesh).swapaxes(0, 1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])
    assert_array_equal(corners_of(finer).reshape(-1, 4, 3, 3), quarters.transpose(2, 0, 1, 3))


@every_mesh
def test_subdivision_keeps_the_topology(mesh):
    finer = subdivide(mesh, 16 * len(mesh.vertices))
    shapes = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in (mesh, finer)]
    assert shapes[0].euler_number == shapes[1].euler_number and finer.closed is mesh.closed


def test_colors_and_uvs_are_the_faces_linear_functions_at_the_new_corners():
    """Values that are linear in a face's plane, another function for each face; rounded to float32 at each round."""
    rng = np.random.default_rng(1)
    slopes = rng.uniform(-0.2, 0.2, (len(SHEET.faces), 3, 5))

    def values(mesh: Mesh) -> np.ndarray:
        quarters = len(mesh.faces) // len(SHEET.faces)
        return 0.5 + np.einsum("fcd,fde->fce", corners_of(mesh), slopes.repeat(quarters, axis=0))

    colors, uvs = np.split(values(SHEET).astype(np.float32), [3], axis=-1)
    finer = subdivide(replace(SHEET, corner_colors=colors, corner_uvs=uvs), 150)
    assert len(finer.faces) == 16 * len(SHEET.faces)
    assert_allclose(np.concatenate([finer.corner_colors, finer.corner_uvs], -1), values(finer), rtol=0, atol=2 * EPS32)
    assert_array_equal(finer.texture_ids, SHEET.texture_ids.repeat(16))
    assert finer.textures is SHEET.textures


def test_refined_faces_are_no_larger_than_asked_and_cover_what_the_large_ones_did():
    """Each in four as often as it takes: those that are small enough stay as they are."""
    mesh = Mesh.plain([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 1]], [[0, 1, 2], [0, 3, 1]], np.eye(4)[:, :3])
    fine = refine(mesh, 0.6)
    assert np.array_equal(fine.vertices[:4], mesh.vertices)
    np.testing.assert_allclose(np.sort(fine.face_areas()), [0.5] * 4 + [0.5] * 16)
    flat = fine.vertices[fine.faces][..., 2].max(axis=1) == 0
    np.testing.assert_allclose(fine.face_areas()[flat].sum(), 8)
    np.testing.assert_allclose(np.abs(fine.face_normals()[flat] - [0, 0, 1]).max(), 0)
    x, y = fine.vertices[fine.faces[flat]][..., :2].reshape(-1, 2).T / 4
    np.testing.assert_allclose(fine.corner_colors[flat].reshape(-1, 3), np.stack([1 - x - y, x, y], axis=1), atol=1e-7)
    assert np.array_equal(refine(mesh, 8.0).faces, mesh.faces)
