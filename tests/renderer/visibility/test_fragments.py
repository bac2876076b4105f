"""Samples that a camera sees of a mesh, compared with loops over the rasterized image."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from renderer.camera import OrthographicCamera
from renderer.settings import ImageSettings
from renderer.visibility import choose
from renderer.visibility.fragments import Fragments, build_fragments

EPS = torch.finfo(torch.float64).eps
RASTERIZER = choose("numpy")
CAMERA = OrthographicCamera(57.3, 22.9, 2.2)
CAMERAS = [CAMERA, OrthographicCamera(143.2, -114.6, 1.6)]


def dented_sphere() -> tuple[np.ndarray, np.ndarray]:
    sphere = trimesh.creation.icosphere(subdivisions=1)
    radii = np.random.default_rng(0).uniform(0.7, 1, (len(sphere.vertices), 1))
    return sphere.vertices * radii, np.array(sphere.faces)


def open_shell() -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = dented_sphere()
    return vertices, faces[: 2 * len(faces) // 3]


def fragments_of(mesh, settings, camera=CAMERA, closed=False) -> Fragments:
    vertices, faces = mesh
    [fragments] = build_fragments(vertices, faces, [camera], settings, RASTERIZER, closed)
    return fragments


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_barycentric_weights_solve_for_the_sample_and_are_clipped_into_the_face(shift):
    """Corners are rounded, so that a sample may lie just outside. With a shift, some lie far."""
    fragments = fragments_of(open_shell(), ImageSettings(8, 4))
    fragments = replace(fragments, outlines=fragments.outlines + shift)
    outside_count = 0
    samples = zip(
        fragments.barycentric, fragments.sample_to_seen_face, fragments.positions(), strict=True
    )
    for weight, face, position in samples:
        corners = np.vstack([fragments.outlines[face].T, np.ones(3)])
        solved = np.linalg.solve(corners, [*position, 1])
        outside_count += solved.min() < 0
        clipped = solved.clip(0, 1)
        tolerance = 8 * EPS * np.linalg.cond(corners)
        np.testing.assert_allclose(weight, clipped / clipped.sum(), rtol=0, atol=tolerance)
    assert (outside_count > 20) == (shift > 0)


@pytest.mark.parametrize(
    "flatten",
    [
        lambda corners: 0 * corners,
        lambda corners: corners[:, :1].expand(-1, 3, -1),
        lambda corners: corners[..., :1] * 1e-9,
    ],
    ids=["all at the center", "all at the first corner", "on a short line"],
)
def test_a_face_without_area_in_the_image_has_finite_barycentric_weights(flatten):
    fragments = fragments_of(open_shell(), ImageSettings(4, 1))
    outlines = flatten(fragments.outlines).expand(-1, -1, 2)
    weights = replace(fragments, outlines=outlines).barycentric
    assert (weights >= 0).all()
    ones = torch.ones(len(weights), dtype=torch.float64)
    torch.testing.assert_close(weights.sum(1), ones, rtol=0, atol=4 * EPS)


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_closed_mesh_covers_the_same_samples_without_its_far_faces(camera):
    settings = ImageSettings(16, 4)
    whole = fragments_of(dented_sphere(), settings, camera)
    culled = fragments_of(dented_sphere(), settings, camera, closed=True)
    assert torch.equal(culled.pixels, whole.pixels)
    assert torch.equal(culled.coverage, whole.coverage)
    assert (culled.facing == 1).all()
    # A face that is seen from behind can be as near as its neighbor along
    # silhouettes only.
    differs = culled.faces[culled.sample_to_seen_face] != whole.faces[whole.sample_to_seen_face]
    assert differs.double().mean() < 0.01


def test_a_closed_mesh_that_the_near_plane_cuts_open_shows_its_inside():
    vertices, faces = dented_sphere()
    mesh = (3 * vertices, faces)
    settings = ImageSettings(8, 2)
    camera = OrthographicCamera(57.3, 22.9, 8.0)
    inside = fragments_of(mesh, settings, camera, closed=True)
    assert (inside.facing == -1).any()
    whole = fragments_of(mesh, settings, camera)
    assert torch.equal(inside.sample_numbers, whole.sample_numbers)
    assert torch.equal(
        inside.faces[inside.sample_to_seen_face], whole.faces[whole.sample_to_seen_face]
    )
