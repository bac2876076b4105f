"""Cameras, compared with points by hand, with rays in float64 and with homographies.

Comparisons with Mitsuba are in test_mitsuba.py.
"""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from oracles import fragments_of

from renderer.camera import (
    OrthographicCamera,
    PerspectiveCamera,
    depths_of_views,
    orbit_cameras,
    project_views,
)
from renderer.errors import InputError
from renderer.mesh import Mesh
from renderer.operators.rays import Surface
from renderer.pinhole import PinholeCamera
from renderer.settings import ImageSettings

EPS = np.finfo(np.float64).eps
ORTHOGRAPHIC = [OrthographicCamera(0, 0, 2.0), OrthographicCamera(180.0, 57.3, 3.0)]
ORTHOGRAPHIC += orbit_cameras(7, 2.0)
PERSPECTIVE = [
    PerspectiveCamera(60.0, 0, 4.0, distance=2.0),
    PerspectiveCamera(57.3, -114.6, 2.4, right=0.3, up=-0.2, distance=3.0),
    PerspectiveCamera(143.2, 40.1, 1.0, distance=1.8),
]
SHIFTED_PINHOLE = PinholeCamera(
    57.3, -114.6, 2.4, right=0.3, up=-0.2, distance=3.0, roll=20.0, center_x=0.4, center_z=0.1
)
CAMERA = PerspectiveCamera(51.6, 22.9, 2.4, right=0.2, up=-0.1, distance=1.9)
POSITION = CAMERA.pose()[:3, 3]


@pytest.mark.parametrize(
    ("camera", "points", "expected"),
    [
        # Right is +y, and up is (-1/2, 0, √3/2).
        (
            OrthographicCamera(60.0, 0, width=4.0),
            [[1.0, 1.0, 1.0], [0.5, -0.25, 0.0], [0.0, 0.0, 0.0]],
            [[0.5, (math.sqrt(3) - 1) / 4], [-0.125, -0.125], [0, 0]],
        ),
        (OrthographicCamera(90.0, 90.0, 2.0), [[-1, 0, 0]], [[1, 0]]),
        (
            OrthographicCamera(90.0, 0, 2, 0.5, -0.25),
            [[0, 0, 0], [9, 0.5, 1]],
            [[0.5, -0.25], [1, 0.75]],
        ),
        # What is 1 in front of the origin is twice as large, and 2 behind half as large.
        (
            PerspectiveCamera(90.0, 0, 4.0, right=0.5, distance=2.0),
            [[0.0, 1.0, 1.0], [1.0, 1.0, 1.0], [-2.0, 1.0, -1.0], [0.0, -0.5, 0.0]],
            [[0.75, 0.5], [1.5, 1], [0.375, -0.25], [0, 0]],
        ),
    ],
)
def test_points_are_projected_as_by_hand(camera, points, expected):
    projected = camera.project(np.array(points, dtype=float))
    np.testing.assert_allclose(projected[:, :2], expected, atol=2 * EPS)
    of_tensor = camera.project(torch.tensor(points, dtype=torch.float64))
    np.testing.assert_allclose(of_tensor, projected, rtol=0, atol=4 * EPS)


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy], ids=["array", "tensor"])
@pytest.mark.parametrize(
    "cameras",
    [ORTHOGRAPHIC, PERSPECTIVE, [SHIFTED_PINHOLE] * 2, [*ORTHOGRAPHIC, SHIFTED_PINHOLE]],
    ids=["orthographic", "perspective", "pinhole", "mixed"],
)
def test_views_that_are_projected_together_are_those_that_are_projected_alone(cameras, kind):
    points = kind(np.random.default_rng(0).uniform(-1, 1, (40, 3)))
    alone = np.stack([camera.project(points) for camera in cameras])
    np.testing.assert_allclose(project_views(cameras, points), alone, rtol=0, atol=4 * EPS)
    depths = depths_of_views(cameras, points)
    for index, camera in enumerate(cameras):
        of_camera = camera.depths(points)
        assert (of_camera is None) == (not camera.has_perspective)
        expected = np.ones(40) if of_camera is None else of_camera
        if depths is not None:
            np.testing.assert_allclose(depths[index], expected, rtol=0, atol=4 * EPS)
    assert (depths is None) == (cameras is ORTHOGRAPHIC)


def test_the_camera_that_the_mesh_reaches_is_named_among_several():
    near = replace(PERSPECTIVE[2], distance=0.5)
    with pytest.raises(InputError, match=re.escape(str(near.pose()[:3, 3].round(3).tolist()))):
        project_views([PERSPECTIVE[2], near], np.ones((1, 3)) * near.axes()[2])


@pytest.mark.parametrize("camera", [*ORTHOGRAPHIC[:2], *PERSPECTIVE])
def test_nearness_falls_with_the_distance_and_is_linear_in_the_image_of_a_plane(camera):
    steps_away = -np.linspace(-0.5, 0.5, 9)[:, None] * camera.axes()[2]
    assert (camera.homogeneous(torch.from_numpy(steps_away))[1].diff() < 0).all()
    corners = np.array([[0.5, 0.1, -0.3], [-0.4, 0.6, 0.2], [-0.1, -0.5, 0.4]])
    points = np.vstack([corners, np.array([0.2, 0.5, 0.3]) @ corners])
    image = camera.project(points)[:, :2]
    corners_of_image = np.column_stack([image[:3], np.ones(3)])
    weights = np.append(image[3], 1.0) @ np.linalg.inv(corners_of_image)
    nearness = camera.homogeneous(torch.from_numpy(points))[1].numpy()
    np.testing.assert_allclose(weights @ nearness[:3], nearness[3], rtol=0, atol=1e-8)


@pytest.mark.parametrize("distance", [0.5, 1.731])
def test_a_camera_inside_or_in_front_of_the_mesh_is_refused(distance):
    """A normalized mesh ends at most √3 from the origin, at the point (1, 1, 1)."""
    corner = np.ones((1, 3))
    toward_corner = math.degrees(math.acos(1 / math.sqrt(3)))
    camera = PerspectiveCamera(toward_corner, 45.0, 2.0, distance=distance)
    with pytest.raises(InputError, match="distance"):
        camera.project(corner)
    assert np.isfinite(replace(camera, distance=1.8).project(corner)).all()


def open_torus() -> Mesh:
    """Return a torus without every third face, so that both sides of long thin faces are seen."""
    torus = trimesh.creation.torus(0.7, 0.3, major_sections=9, minor_sections=7)
    faces = np.delete(torus.faces, np.s_[::3], axis=0)
    return Mesh.plain(torus.vertices, faces, (0.9, 0.5, 0.2))


def rays(size: int) -> np.ndarray:
    centers = (2 * np.arange(size) + 1) / size - 1
    y, x = np.meshgrid(-centers, centers, indexing="ij")
    half_width = CAMERA.width / 2
    forward = np.full_like(x, -CAMERA.distance)
    in_camera = np.stack([half_width * x, half_width * y, forward], axis=-1).reshape(-1, 3)
    return in_camera @ CAMERA.axes()


def first_hits(mesh: Mesh, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the first face (N,) on each ray from CAMERA, or -1, and the points (N, 3) on them.

    A ray meets a face at a + u (b - a) + v (c - a) = POSITION + t direction.
    """
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    systems = np.empty((len(directions), len(a), 3, 3))
    systems[..., 0] = b - a
    systems[..., 1] = c - a
    systems[..., 2] = -directions[:, None]
    solutions = np.linalg.inv(systems) @ (POSITION - a)[..., None]
    u, v, t = solutions[..., 0].transpose(2, 0, 1)
    is_inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    t = np.where(is_inside, t, np.inf)
    length = t.min(axis=1)
    is_hit = np.isfinite(length)
    faces = np.where(is_hit, t.argmin(axis=1), -1)
    points = POSITION + directions * np.where(is_hit, length, 0)[:, None]
    return faces, points


def test_a_sample_shows_the_face_that_its_ray_meets_first_its_side_and_the_point_there():
    """A few samples near edges differ, because corners are rounded by up to 1/512 of a sample."""
    mesh = open_torus()
    settings = ImageSettings(64, 1)
    view = fragments_of(mesh, CAMERA, settings)
    ids = np.full(64 * 64, -1)
    ids[view.sample_numbers] = view.faces[view.sample_to_seen_face]
    expected, hits = first_hits(mesh, rays(64))
    assert (expected >= 0).sum() > 1000
    assert (ids != expected).sum() <= 4

    is_same = torch.from_numpy(ids == expected)[view.sample_numbers]
    points = Surface(mesh, view, settings).points
    np.testing.assert_allclose(
        points[is_same], hits[view.sample_numbers[is_same]], rtol=0, atol=1e-12
    )

    a, b, c = mesh.vertices[view.corners].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    sides = np.sign(((POSITION - a) * normals).sum(axis=1))
    np.testing.assert_array_equal(view.facing[:, 0], sides)
    # A camera without perspective would see other sides.
    assert (sides != np.sign(normals @ CAMERA.axes()[2])).sum() > 5


def homography_of(positions: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Solve the eight equations of Hartley and Zisserman 2004, section 4.1."""
    equations = []
    for (x, y), (u, v) in zip(positions, uvs, strict=True):
        equations.append([x, y, 1, 0, 0, 0, -u * x, -u * y])
        equations.append([0, 0, 0, x, y, 1, -v * x, -v * y])
    entries = np.linalg.solve(equations, uvs.ravel())
    return np.append(entries, 1).reshape(3, 3)


def test_a_texture_on_a_tilted_plane_follows_the_homography_of_its_corners():
    corners = np.array([[-0.9, -0.8, -0.7], [0.9, -0.6, 0.1], [0.8, 0.9, 0.9], [0, 0, 0]])
    corners[3] = corners[0] + corners[2] - corners[1]
    uvs = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    view = fragments_of(Mesh.plain(corners, faces), CAMERA, ImageSettings(32, 2))

    homography = homography_of(CAMERA.project(corners)[:, :2], uvs)
    homogeneous = np.column_stack([view.positions(), np.ones(len(view.sample_numbers))])
    u, v, w = homography @ homogeneous.T
    expected = torch.from_numpy(np.stack([u / w, v / w], axis=1))
    # Samples at the border of the plane are clipped into their face.
    is_inside = ((expected > 0.01) & (expected < 0.99)).all(1)
    assert is_inside.sum() > 500

    uvs_of_corners = torch.from_numpy(uvs)[torch.from_numpy(faces)[view.faces]]
    found = view.interpolate(uvs_of_corners)
    torch.testing.assert_close(found[is_inside], expected[is_inside], rtol=0, atol=1e-12)
    without_perspective = replace(view, depths=None).interpolate(uvs_of_corners)
    assert (without_perspective - expected)[is_inside].abs().max() > 0.05


@pytest.mark.parametrize("camera", [*ORTHOGRAPHIC, *PERSPECTIVE, SHIFTED_PINHOLE])
def test_the_differentiable_position_of_a_camera_is_its_position(camera):
    found = camera.differentiable_eye().numpy()
    np.testing.assert_allclose(found, camera.eye(), rtol=0, atol=1e-12)
