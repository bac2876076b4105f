"""Subdivision: closed forms, trimesh's own, and the renderer's images before and after."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from renderer.mesh import Mesh, concatenate, refine, subdivide
from renderer.shapes import solid

EPS, EPS32 = np.finfo(np.float64).eps, np.finfo(np.float32).eps


def plain(geometry: trimesh.Trimesh) -> Mesh:
    return Mesh.plain(geometry.vertices, geometry.faces)


def once(mesh: Mesh) -> Mesh:
    return subdivide(mesh, len(mesh.vertices))


def corners(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces]


def euler_number(mesh: Mesh) -> int:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).euler_number


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
    "box": plain(trimesh.creation.box()),
    "cup": solid("cup"),
    "two that touch": concatenate([plain(trimesh.creation.box()), plain(trimesh.creation.icosphere(subdivisions=1))]),
    "open": SHEET,
}
every_mesh = pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)


@pytest.mark.parametrize(("asked", "found"), [(0, 12), (11, 12), (12, 42), (42, 162), (5000, 10_242)])
def test_an_icosahedron_is_subdivided_until_it_has_more_vertices_than_asked(asked, found):
    mesh = subdivide(plain(trimesh.creation.icosahedron()), asked)
    assert (len(mesh.vertices), len(mesh.faces)) == (found, 2 * found - 4)


@every_mesh
def test_the_old_vertices_stay_and_the_new_ones_are_the_middles_of_the_edges(mesh):
    finer = once(mesh)
    assert_array_equal(finer.vertices[: len(mesh.vertices)], mesh.vertices)
    a, b, c = corners(mesh).swapaxes(0, 1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])
    assert_array_equal(corners(finer).reshape(-1, 4, 3, 3), quarters.transpose(2, 0, 1, 3))


@every_mesh
def test_shape_and_topology_are_kept(mesh):
    """Corners are rounded once each and coordinates are below 2: areas are off by a few EPS."""
    finer = subdivide(mesh, 16 * len(mesh.vertices))
    quarters = len(finer.faces) // len(mesh.faces)
    assert_allclose(finer.face_areas().reshape(-1, quarters).sum(axis=1), mesh.face_areas(), rtol=0, atol=16 * EPS)
    volumes = [np.linalg.det(corners(each)).sum() / 6 for each in (mesh, finer)]
    assert volumes[1] == pytest.approx(volumes[0], abs=16 * EPS * len(mesh.faces))
    assert finer.closed is mesh.closed
    assert euler_number(finer) == euler_number(mesh)


def test_colors_and_uvs_are_the_faces_linear_functions_at_the_new_corners():
    """Values that are linear in a face's plane, another function for each face; rounded to float32 at each round."""
    rng = np.random.default_rng(1)
    slopes = rng.uniform(-0.2, 0.2, (len(SHEET.faces), 3, 5))

    def values(mesh: Mesh) -> np.ndarray:
        quarters = len(mesh.faces) // len(SHEET.faces)
        return 0.5 + np.einsum("fcd,fde->fce", corners(mesh), slopes.repeat(quarters, axis=0))

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
