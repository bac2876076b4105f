"""What a view sees of a mesh, against loops over the rasterized image."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from renderer.camera import OrthographicCamera
from renderer.settings import ImageSettings
from renderer.visibility.fragments import Fragments, build_fragments
from renderer.visibility.rasterizers import choose

EPS = torch.finfo(torch.float64).eps
RASTERIZER = choose("numpy")
CAMERA = OrthographicCamera(1.0, 0.4, 2.2)
CAMERAS = [CAMERA, OrthographicCamera(2.5, -2.0, 1.6)]


def dented_sphere() -> tuple[np.ndarray, np.ndarray]:
    sphere = trimesh.creation.icosphere(subdivisions=1)
    dents = np.random.default_rng(0).uniform(0.7, 1, (len(sphere.vertices), 1))
    return sphere.vertices * dents, np.array(sphere.faces)


def open_shell() -> tuple[np.ndarray, np.ndarray]:
    """Two thirds of the dented sphere: some faces are seen from behind."""
    vertices, faces = dented_sphere()
    return vertices, faces[: 2 * len(faces) // 3]


def fragments_of(mesh, settings: ImageSettings, camera: OrthographicCamera = CAMERA, closed: bool = False) -> Fragments:
    [fragments] = build_fragments(*mesh, [camera], settings, RASTERIZER, closed)
    return fragments


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(("size", "samples"), [(9, 3), (20, 1), (1, 16)])
def test_the_samples_are_those_of_the_image_pixel_by_pixel(size, samples, camera):
    vertices, faces = open_shell()
    fragments = fragments_of((vertices, faces), ImageSettings(size, samples), camera)
    points, resolution = camera.project(vertices), size * samples
    ids = RASTERIZER.rasterize(points[None], faces, resolution)[0]
    seen = sorted(set(ids[ids >= 0]))
    expected = []
    for pixel in range(size**2):
        for row in range(pixel // size * samples, (pixel // size + 1) * samples):
            for column in range(pixel % size * samples, (pixel % size + 1) * samples):
                if ids[row, column] >= 0:
                    x, y = (2 * column + 1) / resolution - 1, 1 - (2 * row + 1) / resolution
                    expected.append((pixel, ids[row, column], x, y))
    pixel, face, x, y = (np.array(column) for column in zip(*expected, strict=True))

    assert fragments.faces.tolist() == seen
    assert fragments.pixels.tolist() == sorted(set(pixel))
    np.testing.assert_array_equal(fragments.pixels[fragments.pixel], pixel)
    np.testing.assert_array_equal(fragments.faces[fragments.face], face)
    np.testing.assert_allclose(fragments.positions(), np.stack([x, y], axis=1), rtol=0, atol=2 * EPS)
    np.testing.assert_array_equal(fragments.coverage, [np.sum(pixel == p) / samples**2 for p in sorted(set(pixel))])
    np.testing.assert_array_equal(fragments.corners, faces[seen])
    a, b, c = vertices[faces[seen]].transpose(1, 0, 2)
    np.testing.assert_array_equal(fragments.facing[:, 0], np.sign(np.cross(b - a, c - a) @ camera.axes()[2]))
    np.testing.assert_array_equal(fragments.outlines, points[faces[seen], :2])


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_barycentric_weights_solve_for_the_sample_and_are_clipped_into_the_face(shift):
    """Corners are snapped when they are drawn, so that a sample may lie just outside; here, some lie well outside."""
    fragments = fragments_of(open_shell(), ImageSettings(8, 4))
    fragments = replace(fragments, outlines=fragments.outlines + shift)
    outside = 0
    for weight, face, at in zip(fragments.barycentric, fragments.face, fragments.positions(), strict=True):
        corners = np.vstack([fragments.outlines[face].T, np.ones(3)])
        solved = np.linalg.solve(corners, [*at, 1])
        outside += solved.min() < 0
        clipped = solved.clip(0, 1) / solved.clip(0, 1).sum()
        np.testing.assert_allclose(weight, clipped, rtol=0, atol=8 * EPS * np.linalg.cond(corners))
    assert (outside > 20) == (shift > 0)


@pytest.mark.parametrize(
    "flatten", [lambda o: 0 * o, lambda o: o[:, :1].expand(-1, 3, -1), lambda o: o[..., :1] * 1e-9]
)
def test_an_outline_without_area_has_finite_barycentric_weights(flatten):
    fragments = fragments_of(open_shell(), ImageSettings(4, 1))
    weights = replace(fragments, outlines=flatten(fragments.outlines).expand(-1, -1, 2)).barycentric
    assert (weights >= 0).all()
    torch.testing.assert_close(weights.sum(1), torch.ones(len(weights), dtype=torch.float64), rtol=0, atol=4 * EPS)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_closed_mesh_covers_the_same_samples_without_its_far_faces(camera):
    settings = ImageSettings(16, 4)
    whole, culled = (fragments_of(dented_sphere(), settings, camera, closed) for closed in (False, True))
    assert torch.equal(culled.pixels, whole.pixels) and torch.equal(culled.coverage, whole.coverage)
    assert (culled.facing == 1).all()
    # Only along the outline may a face turned away be as near as its neighbor.
    assert (culled.faces[culled.face] != whole.faces[whole.face]).double().mean() < 0.01


def test_a_closed_mesh_that_the_near_plane_cuts_open_shows_its_inside():
    vertices, faces = dented_sphere()
    mesh, settings = (3 * vertices, faces), ImageSettings(8, 2)
    camera = OrthographicCamera(1.0, 0.4, 8.0)
    inside = fragments_of(mesh, settings, camera, closed=True)
    assert (inside.facing == -1).any()
    whole = fragments_of(mesh, settings, camera)
    assert torch.equal(inside.sample, whole.sample) and torch.equal(inside.faces[inside.face], whole.faces[whole.face])
