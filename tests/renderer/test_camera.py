import math
from dataclasses import replace

import numpy as np
import pytest

from renderer.cache import content_key
from renderer.camera import OrthographicCamera, PerspectiveCamera, orbit_cameras
from renderer.errors import InputError

EPS = np.finfo(np.float64).eps
CAMERAS = [*orbit_cameras(7, 2.0), OrthographicCamera(0, 0, 2.0), OrthographicCamera(math.pi, 1, 3.0)]


def test_a_ring_has_equal_azimuths_from_0_at_the_papers_polar_angle():
    cameras = orbit_cameras(10, 2.5)
    assert [camera.polar for camera in cameras] == [math.pi / 3] * 10
    assert {camera.width for camera in cameras} == {2.5}
    azimuths = np.unwrap([math.atan2(*camera.axes()[2, 1::-1]) for camera in cameras])
    np.testing.assert_allclose(azimuths, np.arange(10) * math.pi / 5, rtol=0, atol=8 * EPS)
    np.testing.assert_allclose([camera.axes()[2, 2] for camera in cameras], 0.5, rtol=2 * EPS)


@pytest.mark.parametrize("camera", CAMERAS)
def test_right_up_and_back_are_right_handed_and_orthonormal(camera):
    axes = camera.axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=4 * EPS)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=4 * EPS)


@pytest.mark.parametrize("camera", orbit_cameras(7, 2.0))
def test_world_z_points_straight_up_in_the_image(camera):
    (x, y, _) = camera.project(np.array([[0.0, 0.0, 1.0]]))[0]
    assert x == 0
    assert y == pytest.approx(math.sin(math.pi / 3))


def test_a_point_lands_where_it_does_by_hand():
    """From θ = π/3 on the +x side: right is +y, up is (-1/2, 0, √3/2) and back is (√3/2, 0, 1/2)."""
    camera = OrthographicCamera(math.pi / 3, 0, width=4.0)
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
def test_depth_is_smaller_where_nearer_and_fits_every_normalized_mesh(camera):
    towards = camera.axes()[2]
    near, far = camera.project(np.stack([towards, -towards]))
    assert near[2] < 0 < far[2]
    np.testing.assert_allclose(near[:2], far[:2], atol=4 * EPS)
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    assert np.abs(camera.project(corners)[:, 2]).max() <= math.sqrt(3) / 2 + EPS


def test_a_place_moves_the_image_by_world_units_and_not_the_depth():
    points, plain = np.random.default_rng(0).normal(size=(20, 3)), OrthographicCamera(1.0, 0.4, 3.0)
    moved = OrthographicCamera(1.0, 0.4, 3.0, right=0.5, up=-0.2).project(points)
    np.testing.assert_allclose(moved - plain.project(points), [[1 / 3, -0.4 / 3, 0]] * 20, rtol=0, atol=4 * EPS)


# ---------------------------------------------------------------------------- perspective

CLOSE = [
    PerspectiveCamera(math.pi / 3, 0, 4.0, distance=2.0),
    PerspectiveCamera(1.0, -2.0, 2.4, right=0.3, up=-0.2, distance=3.0),
    PerspectiveCamera(2.5, 0.7, 1.0, distance=1.8),
]


def test_in_perspective_a_point_lands_where_it_does_by_hand():
    """From 2 away on +x, the frame 4 wide: what is 1 before the origin is twice as large as there, 2 behind half."""
    camera = PerspectiveCamera(math.pi / 2, 0, 4.0, right=0.5, distance=2.0)
    points = np.array([[0.0, 1.0, 1.0], [1.0, 1.0, 1.0], [-2.0, 1.0, -1.0], [0.0, -0.5, 0.0]])
    np.testing.assert_allclose(
        camera.project(points)[:, :2], [[0.75, 0.5], [1.5, 1], [0.375, -0.25], [0, 0]], atol=2 * EPS
    )


@pytest.mark.parametrize("camera", CLOSE)
def test_in_perspective_depth_is_smaller_where_nearer_from_the_near_plane_to_the_far_one(camera):
    along = np.linspace(camera.near, camera.far, 9)
    depths = camera.project((camera.distance - along)[:, None] * camera.axes()[2])[:, 2]
    np.testing.assert_allclose(depths[[0, -1]], [-1, 1], atol=64 * EPS)
    assert (np.diff(depths) > 0).all()
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    assert np.abs(camera.project(corners)[:, 2]).max() < 1


@pytest.mark.parametrize("camera", CLOSE)
def test_in_perspective_planes_stay_planes_in_depth_and_lines_lines_in_the_image(camera):
    """As rasterizers, which interpolate depth across the image, need it."""
    a, b, c = np.random.default_rng(0).uniform(-1, 1, (3, 3))
    shares = np.random.default_rng(1).dirichlet(np.ones(3), 8)
    plane = camera.project(np.vstack([a, b, c, shares @ [a, b, c]]))
    assert np.linalg.svd(plane - plane.mean(axis=0))[1][2] < 64 * EPS
    line = camera.project(np.vstack([a + share * (b - a) for share in np.linspace(0, 1, 5)]))
    assert np.linalg.svd(line - line.mean(axis=0))[1][1] < 64 * EPS


@pytest.mark.parametrize("distance", [0.5, 1.0, 1.731])
def test_a_camera_within_or_before_the_mesh_is_refused_in_one_sentence(distance):
    """A normalized mesh ends √3 from the origin."""
    camera = PerspectiveCamera(math.acos(1 / math.sqrt(3)), math.pi / 4, 2.0, distance=distance)
    corner = np.ones((1, 3))
    with pytest.raises(InputError, match=r"distance .*fov.*normalize the mesh$") as refused:
        camera.project(corner)
    assert "\n" not in str(refused.value)
    assert np.isfinite(replace(camera, distance=1.8).project(corner)).all()


@pytest.mark.parametrize("distance", [0.0, -1.0, math.nan, math.inf])
def test_a_distance_that_is_none_is_refused(distance):
    with pytest.raises(InputError, match=r"distance=.* must be at least"):
        PerspectiveCamera(1.0, 0.4, 2.0, distance=distance)


@pytest.mark.parametrize("angle", [0.0, -0.5, math.pi, math.nan])
def test_an_angle_that_is_none_is_refused(angle):
    with pytest.raises(InputError, match=r"fov=.* must be at least"):
        orbit_cameras(1, 2.0, fov=angle)


def test_cameras_of_two_kinds_or_distances_are_never_taken_for_one():
    """They are keys of what is kept of a view, here and on disk."""
    place = {"polar": 1.0, "azimuth": 0.4, "width": 2.0}
    cameras = [OrthographicCamera(**place), *(PerspectiveCamera(**place, distance=each) for each in (4.0, 5.0))]
    assert len(set(cameras)) == len({content_key(camera) for camera in cameras}) == 3
