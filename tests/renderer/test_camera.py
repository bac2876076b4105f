"""Cameras by hand, and perspective in images against rays in float64 and homographies. Mitsuba is in test_mitsuba."""

import math
from ctypes.util import find_library
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch
import trimesh

from renderer.camera import OrthographicCamera, PerspectiveCamera, orbit_cameras
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.settings import ImageSettings
from renderer.transport.rays import Surface
from renderer.visibility.fragments import build_fragments
from renderer.visibility.rasterizers import choose

EPS = np.finfo(np.float64).eps
CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
ORTHOGRAPHIC = [*orbit_cameras(7, 2.0), OrthographicCamera(0, 0, 2.0), OrthographicCamera(math.pi, 1, 3.0)]
PERSPECTIVE = [
    PerspectiveCamera(math.pi / 3, 0, 4.0, distance=2.0),
    PerspectiveCamera(1.0, -2.0, 2.4, right=0.3, up=-0.2, distance=3.0),
    PerspectiveCamera(2.5, 0.7, 1.0, distance=1.8),
]
CAMERA = PerspectiveCamera(0.9, 0.4, 2.4, right=0.2, up=-0.1, distance=1.9)
POSITION = CAMERA.pose()[:3, 3]
RASTERIZERS = [
    "numpy",
    pytest.param("numba", marks=pytest.mark.skipif(find_spec("numba") is None, reason="numba is not installed")),
    pytest.param("opengl", marks=pytest.mark.skipif(find_library("EGL") is None, reason="no EGL on this machine")),
]


@pytest.mark.parametrize("camera", ORTHOGRAPHIC)
def test_axes_are_right_handed_with_z_upward_and_depth_grows_with_distance(camera):
    axes = camera.axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=4 * EPS)
    np.testing.assert_allclose(np.cross(axes[0], axes[1]), axes[2], atol=4 * EPS)
    x, y, _ = camera.project(np.array([[0.0, 0.0, 1.0]]))[0]
    assert abs(x) < EPS and y == pytest.approx(2 * math.sin(camera.polar) / camera.width, abs=EPS)
    near, far = camera.project(np.stack([axes[2], -axes[2]]))
    assert near[2] < 0 < far[2]
    np.testing.assert_allclose(near[:2], far[:2], atol=4 * EPS)
    assert np.abs(camera.project(CORNERS)[:, 2]).max() <= math.sqrt(3) / 2 + EPS


@pytest.mark.parametrize(
    ("camera", "points", "expected"),
    [
        # From θ = π/3 on the +x side, right is +y, up is (-1/2, 0, √3/2).
        (
            OrthographicCamera(math.pi / 3, 0, width=4.0),
            [[1.0, 1.0, 1.0], [0.5, -0.25, 0.0], [0.0, 0.0, 0.0]],
            [[0.5, (math.sqrt(3) - 1) / 4], [-0.125, -0.125], [0, 0]],
        ),
        *(
            (OrthographicCamera(math.pi / 2, azimuth, 2.0), [rightward], [[1, 0]])
            for azimuth, rightward in [
                (0, [0, 1, 0]), (math.pi / 2, [-1, 0, 0]), (math.pi, [0, -1, 0]), (-math.pi / 2, [1, 0, 0])
            ]
        ),
        (OrthographicCamera(math.pi / 2, 0, 2, 0.5, -0.25), [[0, 0, 0], [9, 0.5, 1]], [[0.5, -0.25], [1, 0.75]]),
        # From 2 away on +x, the frame 4 wide: what is 1 before the origin is twice as large as there, 2 behind half.
        (
            PerspectiveCamera(math.pi / 2, 0, 4.0, right=0.5, distance=2.0),
            [[0.0, 1.0, 1.0], [1.0, 1.0, 1.0], [-2.0, 1.0, -1.0], [0.0, -0.5, 0.0]],
            [[0.75, 0.5], [1.5, 1], [0.375, -0.25], [0, 0]],
        ),
    ],
)  # fmt: skip
def test_points_are_projected_as_by_hand(camera, points, expected):
    np.testing.assert_allclose(camera.project(np.array(points, dtype=float))[:, :2], expected, atol=2 * EPS)


@pytest.mark.parametrize("camera", PERSPECTIVE)
def test_perspective_depth_grows_from_the_near_plane_to_the_far_one(camera):
    along = np.linspace(camera.near, camera.far, 9)
    depths = camera.project((camera.distance - along)[:, None] * camera.axes()[2])[:, 2]
    np.testing.assert_allclose(depths[[0, -1]], [-1, 1], atol=64 * EPS)
    assert (np.diff(depths) > 0).all()
    assert np.abs(camera.project(CORNERS)[:, 2]).max() < 1


@pytest.mark.parametrize("distance", [0.5, 1.731])
def test_a_camera_within_or_before_the_mesh_is_refused(distance):
    """A normalized mesh ends √3 from the origin."""
    camera = PerspectiveCamera(math.acos(1 / math.sqrt(3)), math.pi / 4, 2.0, distance=distance)
    with pytest.raises(InputError, match=r"distance .*fov.*normalize the mesh$"):
        camera.project(np.ones((1, 3)))
    assert np.isfinite(replace(camera, distance=1.8).project(np.ones((1, 3)))).all()


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_distances_and_angles_out_of_range_are_refused(value):
    with pytest.raises(InputError, match=r"distance=.* must be at least"):
        PerspectiveCamera(1.0, 0.4, 2.0, distance=value)
    with pytest.raises(InputError, match=r"fov=.* must be at least"):
        orbit_cameras(1, 2.0, fov=value)


def open_torus() -> Mesh:
    """Long thin faces before others, visible from both sides: a torus without every third face."""
    torus = trimesh.creation.torus(0.7, 0.3, major_sections=9, minor_sections=7)
    return Mesh.plain(torus.vertices, np.delete(torus.faces, np.s_[::3], axis=0), (0.9, 0.5, 0.2))


def rays(size: int) -> np.ndarray:
    """(size², 3) from CAMERA through the middles of pixels, as far as the plane through the origin."""
    middles = (2 * np.arange(size) + 1) / size - 1
    y, x = np.meshgrid(-middles, middles, indexing="ij")
    half = CAMERA.width / 2
    return np.stack([half * x, half * y, np.full_like(x, -CAMERA.distance)], axis=-1).reshape(-1, 3) @ CAMERA.axes()


def first_hits(mesh: Mesh, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(the face that a ray from CAMERA meets first, or -1, and where (N, 3)): a + u (b - a) + v (c - a) on both."""
    corners = mesh.vertices[mesh.faces]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)
    systems = np.empty((len(directions), len(edges), 3, 3))
    systems[..., :2], systems[..., 2] = edges, -directions[:, None]
    u, v, t = (np.linalg.inv(systems) @ (POSITION - corners[:, 0])[..., None])[..., 0].transpose(2, 0, 1)
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    first, length = t.argmin(axis=1), t.min(axis=1)
    hit = np.isfinite(length)
    return np.where(hit, first, -1), POSITION + directions * np.where(hit, length, 0)[:, None]


@pytest.mark.parametrize("name", RASTERIZERS)
def test_a_sample_shows_the_face_that_its_ray_meets_first_and_the_point_there(name):
    """But for the few samples within the snapping of an edge: corners move by up to 1/512 of a sample. Which side of a
    face is visible depends on the face's position, too."""
    mesh, settings = open_torus(), ImageSettings(64, 1)
    [view] = build_fragments(mesh.vertices, mesh.faces, [CAMERA], settings, choose(name))
    ids = np.full(64 * 64, -1)
    ids[view.sample] = view.faces[view.face]
    expected, hits = first_hits(mesh, rays(64))
    assert (expected >= 0).sum() > 1000 and (ids != expected).sum() <= 4
    same = torch.from_numpy(ids == expected)[view.sample]
    points = Surface(mesh, view, settings).points
    np.testing.assert_allclose(points[same], hits[view.sample[same]], rtol=0, atol=1e-12)

    a, b, c = mesh.vertices[view.corners].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    towards = np.sign(((POSITION - a) * normals).sum(axis=1))
    np.testing.assert_array_equal(view.facing[:, 0], towards)
    assert (towards != np.sign(normals @ CAMERA.axes()[2])).sum() > 5


def test_a_texture_on_a_tilted_plane_follows_the_homography_of_its_corners():
    """Of four corners, by the eight equations of Hartley and Zisserman 2004, 4.1; without perspective it is far off."""
    corners = np.array([[-0.9, -0.8, -0.7], [0.9, -0.6, 0.1], [0.8, 0.9, 0.9], [-1.0, 0.7, 0.1]])
    corners[3] = corners[0] + corners[2] - corners[1]  # in one plane
    uvs, faces = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    [view] = build_fragments(corners, faces, [CAMERA], ImageSettings(32, 2), choose("numpy"))
    equations = []
    for (x, y, _), (u, v) in zip(CAMERA.project(corners), uvs, strict=True):
        equations += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    homography = np.append(np.linalg.solve(equations, uvs.ravel()), 1).reshape(3, 3)
    u, v, w = homography @ np.column_stack([view.positions(), np.ones(len(view.sample))]).T
    expected = torch.from_numpy(np.stack([u / w, v / w], axis=1))
    inside = ((expected > 0.01) & (expected < 0.99)).all(1)
    assert inside.sum() > 500
    at_corners = torch.from_numpy(uvs)[torch.from_numpy(faces)[view.faces]]
    torch.testing.assert_close(view.interpolate(at_corners)[inside], expected[inside], rtol=0, atol=1e-12)
    assert (replace(view, depths=None).interpolate(at_corners) - expected)[inside].abs().max() > 0.05
