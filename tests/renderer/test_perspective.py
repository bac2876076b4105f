"""Perspective in images, against rays in float64, homographies and orthographic images. Mitsuba is in test_mitsuba."""

from ctypes.util import find_library
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch
import trimesh

from renderer.camera import PerspectiveCamera
from renderer.fragments import build_fragments
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.rasterizer import choose
from renderer.transport.surface import Surface

SOFTWARE = choose("numpy")
CAMERA = PerspectiveCamera(0.9, 0.4, 2.4, right=0.2, up=-0.1, distance=1.9)
POSITION = CAMERA.pose()[:3, 3]
BACKENDS = [
    "numpy",
    pytest.param("numba", marks=pytest.mark.skipif(find_spec("numba") is None, reason="numba is not installed")),
    pytest.param("opengl", marks=pytest.mark.skipif(find_library("EGL") is None, reason="no EGL on this machine")),
]


def knot() -> Mesh:
    """Long thin faces before others, seen from both sides: a torus with every third face taken out."""
    torus = trimesh.creation.torus(0.7, 0.3, major_sections=9, minor_sections=7)
    return Mesh.plain(torus.vertices, np.delete(torus.faces, np.s_[::3], axis=0), (0.9, 0.5, 0.2))


def rays(size: int) -> np.ndarray:
    """(size², 3) from CAMERA through the middles of pixels, as far as the plane through the origin."""
    middles = (2 * np.arange(size) + 1) / size - 1
    y, x = np.meshgrid(-middles, middles, indexing="ij")
    half = CAMERA.width / 2
    return np.stack([half * x, half * y, np.full_like(x, -CAMERA.distance)], axis=-1).reshape(-1, 3) @ CAMERA.axes()


def nearest(mesh: Mesh, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(the face that each ray from CAMERA meets first, or -1, and where (N, 3)): a + u (b - a) + v (c - a) on both."""
    corners = mesh.vertices[mesh.faces]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1)
    systems = np.empty((len(directions), len(edges), 3, 3))
    systems[..., :2], systems[..., 2] = edges, -directions[:, None]
    u, v, t = (np.linalg.inv(systems) @ (POSITION - corners[:, 0])[..., None])[..., 0].transpose(2, 0, 1)
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    first = t.argmin(axis=1)
    length = t[np.arange(len(t)), first]
    hit = np.isfinite(length)
    return np.where(hit, first, -1), POSITION + directions * np.where(hit, length, 0)[:, None]


@pytest.mark.parametrize("name", BACKENDS)
def test_each_sample_shows_the_face_that_its_ray_meets_first_and_where_it_does(name):
    """But for the few samples within the snapping of an edge: corners move by up to 1/512 of a sample."""
    mesh, settings = knot(), ImageSettings(64, 1)
    [seen] = build_fragments(mesh.vertices, mesh.faces, [CAMERA], settings, choose(name))
    ids = np.full(64 * 64, -1)
    ids[seen.sample] = seen.faces[seen.face]
    expected, places = nearest(mesh, rays(64))
    assert (expected >= 0).sum() > 1000 and (ids != expected).sum() <= 4
    same = torch.from_numpy(ids == expected)[seen.sample]
    points = Surface.of(mesh, seen, settings).points
    np.testing.assert_allclose(points[same], places[seen.sample[same]], rtol=0, atol=1e-12)


def test_which_side_of_a_face_is_seen_depends_on_where_the_face_is():
    mesh = knot()
    [seen] = build_fragments(mesh.vertices, mesh.faces, [CAMERA], ImageSettings(64, 1), SOFTWARE)
    corners = mesh.vertices[seen.corners]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    towards = np.sign(((POSITION - corners[:, 0]) * normals).sum(axis=1))
    np.testing.assert_array_equal(seen.facing[:, 0], towards)
    assert (towards != np.sign(normals @ CAMERA.axes()[2])).sum() > 5


def test_a_texture_on_a_tilted_plane_follows_the_homography_of_its_corners():
    """Of four corners, by the eight equations of Hartley and Zisserman 2004, 4.1; without perspective it is far off."""
    corners = np.array([[-0.9, -0.8, -0.7], [0.9, -0.6, 0.1], [0.8, 0.9, 0.9], [-1.0, 0.7, 0.1]])
    corners[3] = corners[0] + corners[2] - corners[1]  # in one plane
    uvs = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    [seen] = build_fragments(corners, faces, [CAMERA], ImageSettings(32, 2), SOFTWARE)
    equations, values = [], []
    for (x, y, _), (u, v) in zip(CAMERA.project(corners), uvs, strict=True):
        equations += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        values += [u, v]
    homography = np.append(np.linalg.solve(equations, values), 1).reshape(3, 3)
    u, v, w = homography @ np.column_stack([seen.positions(), np.ones(len(seen.sample))]).T
    expected = torch.from_numpy(np.stack([u / w, v / w], axis=1))
    inside = ((expected > 0.01) & (expected < 0.99)).all(1)
    assert inside.sum() > 500
    at_corners = torch.from_numpy(uvs)[torch.from_numpy(faces)[seen.faces]]
    torch.testing.assert_close(seen.interpolate(at_corners)[inside], expected[inside], rtol=0, atol=1e-12)
    assert (replace(seen, depths=None).interpolate(at_corners) - expected)[inside].abs().max() > 0.05
