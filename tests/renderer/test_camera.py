import math

import numpy as np
import pytest

from renderer.camera import OrthographicCamera, ring
from renderer.errors import InputError

EPS = np.finfo(np.float64).eps
CAMERAS = [*ring(7, 2.0), OrthographicCamera(0, 0, 2.0), OrthographicCamera(math.pi, 1, 3.0)]


def test_a_ring_has_equal_azimuths_from_0_at_the_papers_polar_angle():
    cameras = ring(10, 2.5)
    assert [camera.polar for camera in cameras] == [math.pi / 3] * 10
    assert {camera.field_of_view for camera in cameras} == {2.5}
    azimuths = np.unwrap([math.atan2(*camera.axes()[2, 1::-1]) for camera in cameras])
    np.testing.assert_allclose(azimuths, np.arange(10) * math.pi / 5, rtol=0, atol=8 * EPS)
    np.testing.assert_allclose([camera.axes()[2, 2] for camera in cameras], 0.5, rtol=2 * EPS)


@pytest.mark.parametrize("camera", CAMERAS)
def test_right_up_and_back_are_right_handed_and_orthonormal(camera):
    axes = camera.axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=4 * EPS)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=4 * EPS)


@pytest.mark.parametrize("camera", ring(7, 2.0))
def test_world_z_points_straight_up_in_the_image(camera):
    (x, y, _) = camera.project(np.array([[0.0, 0.0, 1.0]]))[0]
    assert x == 0
    assert y == pytest.approx(math.sin(math.pi / 3))


def test_a_point_lands_where_it_does_by_hand():
    """From θ = π/3 on the +x side: right is +y, up is (-1/2, 0, √3/2) and back is (√3/2, 0, 1/2)."""
    camera = OrthographicCamera(math.pi / 3, 0, field_of_view=4.0)
    points = np.array([[1.0, 1.0, 1.0], [0.5, -0.25, 0.0], [0.0, 0.0, 0.0]])
    half, root = 0.5, math.sqrt(3) / 2
    expected = [[half, (root - half) / 2, -(root + half) / 2], [-0.125, -0.125, -root / 4], [0, 0, 0]]
    np.testing.assert_allclose(camera.project(points), expected, atol=2 * EPS)


@pytest.mark.parametrize(
    ("azimuth", "rightwards"),
    [(0, [0, 1, 0]), (math.pi / 2, [-1, 0, 0]), (math.pi, [0, -1, 0]), (-math.pi / 2, [1, 0, 0])],
)
def test_from_each_side_the_right_is_right(azimuth, rightwards):
    projected = OrthographicCamera(math.pi / 2, azimuth, 2.0).project(np.array([rightwards], dtype=float))
    np.testing.assert_allclose(projected, [[1, 0, 0]], atol=2 * EPS)


@pytest.mark.parametrize("camera", CAMERAS)
def test_depth_is_smaller_where_nearer_and_fits_every_normalised_mesh(camera):
    towards = camera.axes()[2]
    near, far = camera.project(np.stack([towards, -towards]))
    assert near[2] < 0 < far[2]
    np.testing.assert_allclose(near[:2], far[:2], atol=4 * EPS)
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    assert np.abs(camera.project(corners)[:, 2]).max() <= math.sqrt(3) / 2 + EPS


@pytest.mark.parametrize("width", [0.0, -2.0, math.nan])
def test_a_image_without_width_is_refused(width):
    with pytest.raises(InputError, match="field_of_view"):
        ring(3, width)


def test_a_place_moves_the_image_by_world_units_and_not_the_depth():
    points, plain = np.random.default_rng(0).normal(size=(20, 3)), OrthographicCamera(1.0, 0.4, 3.0)
    moved = OrthographicCamera(1.0, 0.4, 3.0, right=0.5, up=-0.2).project(points)
    np.testing.assert_allclose(moved - plain.project(points), [[1 / 3, -0.4 / 3, 0]] * 20, rtol=0, atol=4 * EPS)


@pytest.mark.parametrize("place", [{"right": math.nan}, {"up": math.inf}])
def test_a_place_that_is_not_finite_is_refused(place):
    with pytest.raises(InputError, match=r"camera place right=.*: give lengths of at most"):
        OrthographicCamera(1.0, 0.4, 3.0, **place)
