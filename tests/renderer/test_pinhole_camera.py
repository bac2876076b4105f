"""Pinhole cameras, compared with K (R p + t) in pixels; see test_mitsuba_scene.py, too."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import fragments_of
from scipy.spatial.transform import Rotation

import renderer
from renderer.errors import InputError
from renderer.operators.rays import Surface
from renderer.pinhole import PinholeCamera
from renderer.settings import ImageSettings
from tests.renderer.test_camera import open_torus

SIZE = 64
INTRINSICS = np.array([[70.0, 0.0, 27.0], [0.0, 76.0, 39.0], [0.0, 0.0, 1.0]])
# Matrix from the axes of OpenCV to the axes of OpenGL.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# Position of the mesh, far from the origin of the world.
PLACE = np.array([20.0, -7.0, 3.0])


def view_matrix(seed: int) -> np.ndarray:
    """Return a view from a random side of PLACE, which lies 4 units ahead, in OpenCV's axes."""
    view = np.eye(4)
    view[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    view[:3, 3] = [0.1, -0.2, 4.0] - view[:3, :3] @ PLACE
    return view


def pixels_of(points: np.ndarray, view: np.ndarray) -> np.ndarray:
    in_camera = points @ view[:3, :3].T + view[:3, 3]
    positions = in_camera @ INTRINSICS.T
    return positions[:, :2] / positions[:, 2:]


def as_pixels(image_positions: np.ndarray) -> np.ndarray:
    return SIZE / 2 * (1 + image_positions * [1, -1])


def points_around(place: np.ndarray) -> np.ndarray:
    return place + np.random.default_rng(0).uniform(-1, 1, (30, 3))


@pytest.mark.parametrize("convention", ["opencv", "opengl"])
@pytest.mark.parametrize("seed", range(2))
def test_points_are_projected_by_the_matrices(seed, convention):
    view = view_matrix(seed)
    points = points_around(PLACE)
    given = view if convention == "opencv" else FLIP @ view
    camera = PinholeCamera.from_matrix(given, INTRINSICS, SIZE, convention)
    expected = pixels_of(points, view)
    found = as_pixels(camera.project(points)[:, :2])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)

    positions, _ = camera.homogeneous(torch.from_numpy(points))
    x, y, w = positions.numpy().T
    found = as_pixels(np.stack([x / w, y / w], axis=1))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("axis", [2, -2])
def test_cameras_along_the_vertical_are_projected_by_their_matrices(axis):
    """The polar angle is 0 or 180 degrees, where the azimuth alone is not determined."""
    view = np.eye(4)
    view[:3, :3] = Rotation.from_euler("zx", [50, 0 if axis < 0 else 180], degrees=True).as_matrix()
    view[:3, 3] = [0.0, 0.1, 5.0]
    points = points_around(np.zeros(3))
    camera = PinholeCamera.from_matrix(view, INTRINSICS, SIZE)
    found = as_pixels(camera.project(points)[:, :2])
    np.testing.assert_allclose(found, pixels_of(points, view), rtol=0, atol=1e-9)


def test_pose_is_the_inverse_of_the_view():
    view = view_matrix(5)
    camera = PinholeCamera.from_matrix(view, INTRINSICS, SIZE)
    np.testing.assert_allclose(camera.pose(), np.linalg.inv(FLIP @ view), atol=1e-12)
    np.testing.assert_allclose(camera.eye(), np.linalg.inv(view)[:, 3], atol=1e-12)


def test_a_normalized_camera_sees_the_moved_mesh_in_the_same_place():
    camera = PinholeCamera.from_matrix(view_matrix(2), INTRINSICS, SIZE)
    ours = renderer.PerspectiveCamera(57.3, 40.0, 2.0, 0.3, -0.2, distance=30.0)
    parallel = renderer.OrthographicCamera(57.3, 40.0, 2.0, 0.3, -0.2)
    points = points_around(PLACE)
    for given in (camera, ours, parallel):
        moved = given.normalized(PLACE, 0.25)
        found = moved.project((points - PLACE) * 0.25)[:, :2]
        np.testing.assert_allclose(found, given.project(points)[:, :2], rtol=0, atol=1e-11)


def test_a_sample_shows_the_point_of_its_own_pixel():
    """The samples of the mesh are projected by the matrices to the centers of their pixels."""
    view = view_matrix(3)
    camera = PinholeCamera.from_matrix(view, INTRINSICS, SIZE)
    torus = open_torus()
    mesh = replace(torus, vertices=torus.vertices + PLACE)
    settings = ImageSettings(SIZE, 1)
    seen = fragments_of(mesh, camera, settings)
    assert len(seen.sample_numbers) > 300
    points = Surface(mesh, seen, settings).points.numpy()
    row, column = np.divmod(seen.sample_numbers.numpy(), SIZE)
    centers = np.stack([column, row], axis=1) + 0.5
    errors = np.abs(pixels_of(points, view) - centers).max(axis=1)
    # A corner is rounded by up to 1/512 of a sample.
    assert (errors > 1e-6).sum() <= 8
    assert errors.max() < 0.1


def test_a_mesh_behind_the_camera_is_refused():
    camera = PinholeCamera.from_matrix(view_matrix(0), INTRINSICS, SIZE)
    behind = 2 * camera.pose()[:3, 3] - PLACE
    with pytest.raises(InputError, match="in front"):
        camera.project(points_around(behind))
    with pytest.raises(InputError, match=r"^cameras"):
        camera.normalized(behind, 1.0)
