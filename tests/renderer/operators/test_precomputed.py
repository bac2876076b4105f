"""Shadows that a mesh casts on itself, in closed form; see test_accuracy.py and test_mitsuba.py."""

import math
import sys
from dataclasses import replace

import hard_meshes as hard
import numpy as np
import pytest
import torch
import torch.nn.functional as F
import trimesh
from oracles import mesh_of, operator_of, scipy_basis, square
from torch import Tensor

from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.light.files import ambient, load_light
from renderer.light.harmonics import nonzero_coefficients, quadrature
from renderer.mesh import Mesh, normalize
from renderer.operators import rays
from renderer.operators import shadows as precomputed
from renderer.operators.apply import TransferOperator
from renderer.rendering import precompute_transfer, render
from renderer.settings import ImageSettings
from renderer.solids import solid

ABOVE = OrthographicCamera(0, 0, 2.0)
EPS32 = torch.finfo(torch.float32).eps
# Root mean square error of a shadowed pixel with 512 directions, relative to
# the brightest pixel.
QUADRATURE_ERROR = 0.015


def shaded(mesh, camera=ABOVE, size=6, samples=1, shadows=True, bounces=0, normals="flat"):
    settings = ImageSettings(size, samples, normals=normals, shadows=shadows, bounces=bounces)
    return operator_of(mesh, camera, settings, dtype=torch.float64)


def all_rows(operator: TransferOperator) -> Tensor:
    """Return the radiance per unit of each coefficient, shape (3, 49, P)."""
    nonzero_rows = operator.transfer * operator.albedo[:, None]
    rows = nonzero_rows.new_zeros(3, 49, nonzero_rows.shape[2])
    rows[:, operator.nonzero] = nonzero_rows.expand(3, -1, -1)
    return rows


def sky_fraction(operator: TransferOperator) -> Tensor:
    """Return the radiance of a white mesh under a uniform sky, relative to an open sky, (3, P)."""
    sky = ambient(torch.ones(3, dtype=torch.float64))
    return operator.radiance(sky) / operator.coverage / math.pi


def dented(seed: int = 0) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertex_count = len(ball.vertices)
    radii = np.random.default_rng(seed).uniform(0.5, 1.0, (vertex_count, 1))
    colors = np.random.default_rng(seed).uniform(0.1, 1, (vertex_count, 3))
    return Mesh.plain(ball.vertices * radii, ball.faces, colors)


def pit(depth: float) -> Mesh:
    floor, rim = square(0.5), square(0.5, center=(0, 0, depth))
    faces = floor.faces.tolist()
    for a, b in [(0, 1), (1, 2), (2, 3), (3, 0)]:
        faces += [[a, 4 + a, b], [b, 4 + a, 4 + b]]
    return Mesh.plain(np.concatenate([floor.vertices, rim.vertices]), faces)


CONVEX = {
    "a ball": mesh_of(trimesh.creation.icosphere(subdivisions=2)),
    "a cube": mesh_of(trimesh.creation.box()),
    "an open square": square(1),
}


@pytest.mark.parametrize(("name", "bounces"), [*zip(CONVEX, (0, 2, 0), strict=True)])
def test_a_convex_mesh_has_the_operator_of_direct_light_to_the_bit(name, bounces):
    camera = OrthographicCamera(57.3, 17.2, 2.2)
    direct = shaded(CONVEX[name], camera, shadows=False)
    shadowed = shaded(CONVEX[name], camera, bounces=bounces)
    assert torch.equal(shadowed.transfer, direct.transfer)
    assert torch.equal(shadowed.nonzero, nonzero_coefficients(6))


def points_on_octahedron(operator: TransferOperator, camera: OrthographicCamera) -> np.ndarray:
    size = operator.settings.size
    row, column = np.divmod(operator.pixels.numpy(), size)
    x = (column + 0.5) / size - 0.5
    y = 0.5 - (row + 0.5) / size
    right, up, back = camera.axes()
    in_plane = camera.width * (x[:, None] * right + y[:, None] * up)
    heights = 1 - abs(in_plane).sum(axis=1, keepdims=True)
    return in_plane + heights * back


def test_a_face_blocks_the_light_from_below_it_that_smooth_normals_would_receive(monkeypatch):
    """The normal at a point p is p / |p|. Of a uniform sky, the face leaves (1 + cos) / 2."""
    monkeypatch.setattr(rays, "DIRECTIONS", 2**14)
    camera = OrthographicCamera(0, 0, 2.1)
    hull = trimesh.convex.convex_hull(np.concatenate([np.eye(3), -np.eye(3)]))
    octahedron = Mesh.plain(hull.vertices, hull.faces, crease=180)
    operator = shaded(octahedron, camera, size=8, normals="smooth", bounces=2)
    points = points_on_octahedron(operator, camera)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    face_normals = np.sign(points) / math.sqrt(3)
    fractions = (1 + (normals * face_normals).sum(axis=1)) / 2
    assert fractions.min() < 0.9
    np.testing.assert_allclose(sky_fraction(operator)[0], fractions, atol=1e-3)

    directions, solid_angles = (values.numpy() for values in quadrature(255))
    is_above_face = face_normals @ directions.T > 0
    received = (normals @ directions.T).clip(0) * is_above_face * solid_angles
    expected = received @ scipy_basis(directions, 6)
    np.testing.assert_allclose(all_rows(operator)[0].T, expected, atol=4e-3)


def test_a_mesh_with_too_many_faces_to_compare_is_found_convex_by_its_rays(monkeypatch):
    monkeypatch.setattr(rays, "MAX_COMPARISONS", 0)
    assert torch.equal(shaded(CONVEX["a ball"]).nonzero, nonzero_coefficients(6))
    assert len(shaded(dented()).nonzero) == 49


CONCAVE = {
    "a dented ball": dented(),
    "inside out": Mesh.plain(dented(1).vertices, dented(1).faces[:, ::-1]),
    "many small faces": solid("orange"),
    "a handle": solid("cup"),
    "many parts": hard.heap(),
}


@pytest.mark.parametrize("normals", ["flat", "smooth"])
@pytest.mark.parametrize("name", CONCAVE)
def test_no_ray_above_the_horizon_of_its_face_hits_another_face(name, normals, monkeypatch):
    mesh, cast = CONCAVE[name], []
    first_hit = rays.Rays.first_hit

    def count(self, origins, *rest):
        cast[-1] += len(origins)
        return first_hit(self, origins, *rest)

    monkeypatch.setattr(rays.Rays, "first_hit", count)
    found = []
    for comparisons in (0, 2**30):
        monkeypatch.setattr(rays, "COMPARISONS_PER_RAY", comparisons)
        cast.append(0)
        camera = OrthographicCamera(57.3, 17.2, 2.2)
        found.append(shaded(normalize(mesh), camera, size=24, normals=normals).transfer)
    assert torch.equal(*found)
    assert cast[1] < cast[0]


@pytest.mark.parametrize("bounces", [0, 1])
def test_a_face_without_area_leaves_the_transfer_finite(bounces, monkeypatch):
    monkeypatch.setattr(precomputed, "PATCHES", 2**7)
    heap = hard.heap()
    faces = np.concatenate([heap.faces[:-1], [[0, 0, 1]]])
    operator = shaded(replace(heap, faces=faces), bounces=bounces)
    assert operator.transfer.isfinite().all()


@pytest.mark.parametrize("depth", [0.25, 0.5, 1.0])
def test_the_sky_over_the_center_of_a_pit_has_the_configuration_factor_of_a_square(depth):
    """Howell's catalog, B-3, has a square that is parallel to a surface, over its center."""
    half_side = 0.5 / depth
    hypotenuse = math.hypot(1, half_side)
    expected = 4 * half_side / (math.pi * hypotenuse) * math.atan(half_side / hypotenuse)
    camera = OrthographicCamera(0, 0, 0.01)
    [found] = sky_fraction(shaded(pit(depth), camera, size=1))[0].tolist()
    assert found == pytest.approx(expected, abs=QUADRATURE_ERROR)


def test_the_walls_of_a_pit_that_is_small_beside_the_mesh_hide_the_sky():
    """The pit has a five hundredth of the mesh's size. The rest of the mesh is below it."""
    scale = 1 / 500
    whole = shaded(pit(1.0), OrthographicCamera(0, 0, 0.01), size=1)
    small = pit(1.0)
    far_below = np.array([[0.0, 0.0, -1.0], [0.1, 0.0, -1.0], [0.0, 0.1, -1.0]])
    vertices = np.concatenate([scale * small.vertices, far_below])
    far_face = len(small.vertices) + np.arange(3)
    mesh = Mesh.plain(vertices, np.concatenate([small.faces, far_face[None]]))
    scaled = shaded(mesh, OrthographicCamera(0, 0, 0.01 * scale), size=1)
    torch.testing.assert_close(sky_fraction(scaled), sky_fraction(whole), rtol=0, atol=0.01)


def test_the_second_bounce_in_a_sphere_with_a_hole_has_its_closed_form(monkeypatch):
    """Each bounce has the albedo times the wall's share of the area of the bounce before."""
    monkeypatch.setattr(precomputed, "PATCHES", 2**9)
    ball = trimesh.creation.icosphere(subdivisions=2)
    heights = ball.vertices[ball.faces].mean(axis=1)[:, 2]
    inside_out = ball.faces[heights < 0.6][:, ::-1]
    mesh = Mesh.plain(ball.vertices, inside_out, (0.8, 0.8, 0.8))
    direct, one_bounce, two_bounces = (
        float(sky_fraction(shaded(mesh, bounces=bounces)).mean()) for bounces in range(3)
    )
    # The hole z > 0.6 has 20% of the area, and the albedo is 0.8.
    expected = 0.8 * 0.8 * (one_bounce - direct)
    assert two_bounces - one_bounce == pytest.approx(expected, rel=0.05)


def test_a_hidden_sheet_just_below_a_floor_reflects_no_light():
    def rectangle(corner, first, second) -> np.ndarray:
        return np.array([np.zeros(3), first, np.add(first, second), second]) + corner

    floor = rectangle([-1, -1, 0.03], [2, 0, 0], [0, 2, 0])
    wall = rectangle([-1, -1, 0.03], [0, 2, 0], [0, 0, 2])
    images = []
    for squares, colors in (
        ((floor, wall), (0.8, 0.8)),
        ((floor, wall, floor - [0, 0, 0.01]), (0.8, 0.8, 0)),
    ):
        faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(squares))[:, None, None]
        corner_colors = np.repeat(colors, 4)[:, None].repeat(3, axis=1)
        mesh = Mesh.plain(np.vstack(squares), faces.reshape(-1, 3), corner_colors)
        camera = OrthographicCamera(60.0, 0.0, 3.0)
        options = {"normals": "flat", "bounces": 2, "rasterizer": "numpy"}
        images.append(render(mesh, camera, 0.6 * load_light("uniform"), 16, **options))
    torch.testing.assert_close(*images, rtol=0, atol=0.002)


def test_bounces_reflect_the_scaled_albedo():
    """Half of an albedo is the same surface as half of the scale."""
    bright = pit(1.0)
    dark = replace(bright, corner_colors=0.5 * bright.corner_colors)
    light = load_light("grace").double()
    scaled = render(bright, ABOVE, light, 6, albedo_scale=0.5, bounces=2, rasterizer="numpy")
    expected = render(dark, ABOVE, light, 6, bounces=2, rasterizer="numpy")
    torch.testing.assert_close(scaled, expected, rtol=0, atol=1e-6)


WHITE_MESHES = {"heap": (hard.heap(), 2, 1e-6), "pit": (pit(3.0), 2, 0.5)}


@pytest.mark.parametrize("name", WHITE_MESHES)
def test_a_white_mesh_in_a_white_furnace_brightens_with_bounces_to_the_sky(name, monkeypatch):
    """A white mesh absorbs no light, so it becomes as bright as the sky, in a deep pit slowly."""
    monkeypatch.setattr(precomputed, "PATCHES", 2**7)
    mesh, samples, tolerance = WHITE_MESHES[name]
    white = replace(mesh, corner_colors=np.ones_like(mesh.corner_colors))
    fraction = sky_fraction(shaded(white, size=8, samples=samples))
    assert -QUADRATURE_ERROR <= fraction.min() < 0.96
    for bounces in (1, 2, 100):
        operator = shaded(white, size=8, samples=samples, bounces=bounces)
        brighter_fraction = sky_fraction(operator)
        assert (brighter_fraction >= fraction - 1e-9).all()
        assert brighter_fraction.max() <= 1 + 1e-9
        fraction = brighter_fraction
    torch.testing.assert_close(fraction, torch.ones_like(fraction), rtol=0, atol=tolerance)


def test_shadows_without_embree_are_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(InputError, match="embreex"):
        shaded(dented())


@pytest.mark.parametrize("degree", [2, 6])
def test_render_shows_the_shadows_of_the_operators_of_moved_vertices(degree):
    cameras = orbit_cameras(2, 2.2)
    light = load_light("grace").double()[: (degree + 1) ** 2]
    options = {"size": 12, "normals": "flat", "shadows": True, "rasterizer": "numpy"}
    stretched = replace(dented(), vertices=dented().vertices * [1.0, 0.5, 1.0])
    vertices = torch.from_numpy(stretched.vertices)
    images = render(dented(), cameras, light, vertices=vertices, **options)
    padded_light = F.pad(light, (0, 0, 0, 49 - len(light)))
    operators = precompute_transfer(stretched, cameras, **options)
    expected = torch.stack([operator.image(padded_light) for operator in operators])
    torch.testing.assert_close(images, expected, rtol=0, atol=10 * EPS32)


def render_gradients(normals: str, shadows: bool) -> tuple[Tensor, ...]:
    light = ambient(torch.full((3,), 0.1).double()).requires_grad_()
    vertices = torch.from_numpy(dented().vertices).requires_grad_()
    options = {"size": 6, "normals": normals, "shadows": shadows, "rasterizer": "numpy"}
    image = render(dented(), ABOVE, light, vertices=vertices, **options)
    return torch.autograd.grad(image.sum(), (light, vertices))


@pytest.mark.parametrize("normals", ["flat", "smooth"])
def test_the_gradient_by_the_light_contains_shadows_and_that_by_the_vertices_does_not(normals):
    by_light, by_vertices = render_gradients(normals, shadows=True)
    operator = shaded(dented(), samples=2, normals=normals)
    torch.testing.assert_close(by_light, all_rows(operator).sum(2).T)
    _, expected = render_gradients(normals, shadows=False)
    assert torch.equal(by_vertices, expected)
