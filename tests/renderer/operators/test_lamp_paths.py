"""Lamps and projectors on convex and concave meshes, against Mitsuba and in closed form."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from oracles import (
    draw,
    draw_uniform,
    fragments_of,
    image_of,
    mesh_of,
    operator_of,
    path_traced,
    square,
)
from torch import Tensor

from renderer import mitsuba_scene
from renderer.camera import OrthographicCamera
from renderer.light.basis import HARMONICS, LocalBasis, SumBasis
from renderer.light.lamps import Lamps, Projector
from renderer.mesh import Mesh, concatenate
from renderer.operators.apply import TransferOperator
from renderer.operators.rays import LocalLightView, Rays, Surface
from renderer.rendering import render
from renderer.settings import ImageSettings
from renderer.surface.albedo import surface_albedo
from renderer.surface.gloss import Gloss

CAMERA = OrthographicCamera(51.6, 22.9, 2.2)
PROJECTOR = Projector(pixels=7, polar=28.6, azimuth=91.7, distance=3.0, fov=35.0)
LAMPS = Lamps(((1.5, 1.0, 1.0), (-0.5, -1.5, 1.6), (0.0, 1.5, -1.2)))
DISCS = replace(LAMPS, radius=0.3)
TWO_DISCS = replace(DISCS, positions=LAMPS.positions[:2])
ORANGE = (0.9, 0.5, 0.2)
BLUE = (0.3, 0.6, 0.9)
SIZE = 16
SAMPLES = 16
lamps_and_discs = pytest.mark.parametrize("basis", [LAMPS, DISCS], ids=["lamps", "discs"])


def ball(subdivisions: int = 2) -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.9)
    return mesh_of(shape, ORANGE)


def ball_on_a_table() -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=2, radius=0.45)
    shape.apply_translation([0, 0, 0.45])
    return concatenate([mesh_of(shape, ORANGE), square(1, color=BLUE)])


def operator_under(basis, mesh, size=SIZE, samples=SAMPLES) -> TransferOperator:
    settings = ImageSettings(size, samples)
    return operator_of(mesh, CAMERA, settings, basis=basis, dtype=torch.float64)


def canvas(operator: TransferOperator, light: Tensor) -> np.ndarray:
    return image_of(operator, light)[:3].permute(1, 2, 0).numpy()


def mitsuba_image(folder: Path, mesh: Mesh, basis: LocalBasis, light: Tensor) -> np.ndarray:
    """Render each local light alone, since Mitsuba would choose one of several at random."""
    no_sky, settings = torch.zeros(49, 3), ImageSettings(SIZE)
    lights = [(basis, light)]
    if isinstance(basis, Lamps):
        lights = [
            (replace(basis, positions=(position,)), power[None])
            for position, power in zip(basis.positions, light, strict=True)
        ]
    total = torch.zeros(3, SIZE, SIZE, dtype=torch.float64)
    for placed in lights:
        total += path_traced(folder, mesh, [CAMERA], no_sky, settings, lights=[placed])[0, :3]
    return total.permute(1, 2, 0).numpy()


@pytest.mark.parametrize(
    ("make_mesh", "basis", "sample_count"),
    [(ball, PROJECTOR, 256), (ball_on_a_table, LAMPS, 256), (ball_on_a_table, TWO_DISCS, 1024)],
    ids=["projector", "lamps", "discs"],
)
def test_images_are_mitsubas(make_mesh, basis, sample_count, tmp_path, monkeypatch):
    """The direct light of a point has noise only at edges of patterns, shadows and silhouettes."""
    monkeypatch.setattr(mitsuba_scene, "SAMPLES", sample_count)
    light = 2 * draw_uniform(basis.size, 3, seed=1)
    found = canvas(operator_under(basis, make_mesh()), light)
    expected = mitsuba_image(tmp_path, make_mesh(), basis, light)
    error = np.abs(found - expected)
    brightest = expected.max()
    is_dark = expected.max(axis=2) == 0
    assert brightest > 0.1
    assert is_dark.mean() > 0.1
    assert np.median(error[expected > 0]) < 1e-3 * brightest
    assert np.sqrt((error**2).mean()) < 0.01 * brightest
    assert abs((found - expected).mean()) < 2e-3 * expected.mean()


def test_a_screen_at_the_origin_shows_the_pattern_upright_and_with_its_brightness():
    """The projector is at the camera, so each pixel of the white screen is one of the pattern."""
    distance = 3.0
    fov = 2 * math.degrees(math.atan(CAMERA.width / 2 / distance))
    projector = Projector(4, CAMERA.polar, CAMERA.azimuth, distance, fov)
    right, up, _ = CAMERA.axes()
    corners = 3 * np.array([-right - up, right - up, right + up, up - right])
    screen = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])
    pattern = draw_uniform(4, 4, 3)
    shown = canvas(operator_under(projector, screen, size=4, samples=3), pattern.flatten(0, 1))
    np.testing.assert_allclose(shown, pattern, rtol=1e-12)


class LitView:
    """Radiance of a view under local light, at fixed visibility."""

    def __init__(self, mesh, basis, size, samples, normals="flat") -> None:
        self.mesh = mesh
        self.basis = basis
        self.settings = ImageSettings(size, samples, normals=normals)
        self.view = fragments_of(mesh, CAMERA, self.settings, mesh.closed)
        self.albedo = surface_albedo(mesh, self.view, self.settings.encoding)

    def moved_lamps(self, positions: Tensor, powers: Tensor) -> Tensor:
        """Return the radiance (3, P) under lamps at positions (L, 3) with powers (L, 3)."""
        lit = LocalLightView(Rays(self.mesh), Surface(self.mesh, self.view, self.settings))
        return lit.radiance(self.basis, self.albedo, powers, positions)

    def changed_surface(self, vertices: Tensor, albedo: Tensor) -> Tensor:
        surface = Surface(self.mesh, self.view, self.settings, vertices)
        lit = LocalLightView(Rays(self.mesh), surface)
        return lit.radiance(self.basis, albedo, draw_uniform(self.basis.size, 3))


@lamps_and_discs
def test_moved_lamps_give_the_radiance_and_shadows_of_lamps_at_these_positions(basis):
    positions = torch.tensor([[2.0, -1.0, 1.5], [-0.4, 1.7, 2.5]], dtype=torch.float64)
    powers = draw_uniform(2, 3)
    moved = LitView(ball_on_a_table(), basis, SIZE, 4).moved_lamps
    operator = operator_under(basis.moved(positions), ball_on_a_table(), samples=4)
    found = moved(positions, powers)
    torch.testing.assert_close(found, operator.radiance(powers), rtol=1e-12, atol=1e-14)
    one_lamp = moved(positions[:1], powers[:1])
    assert (one_lamp == 0).any()
    assert one_lamp.max() > 0.02


@lamps_and_discs
def test_derivatives_by_positions_and_powers_are_finite_differences_without_shadows(basis):
    positions = torch.tensor(LAMPS.positions, dtype=torch.float64, requires_grad=True)
    powers = draw_uniform(3, 3).requires_grad_()
    image = LitView(ball(1), basis, 6, 2).moved_lamps
    assert torch.autograd.gradcheck(image, (positions, powers), eps=1e-7, fast_mode=True)


@pytest.mark.parametrize(
    ("basis", "normals"),
    [(PROJECTOR, "flat"), (LAMPS, "smooth"), (DISCS, "flat")],
    ids=["projector", "lamps", "discs"],
)
def test_derivatives_by_vertices_and_albedo_are_finite_differences(basis, normals):
    lit = LitView(ball(0), basis, 4, 2, normals)
    vertices = torch.from_numpy(lit.mesh.vertices).requires_grad_()
    albedo = lit.albedo.contiguous().requires_grad_()
    image = lit.changed_surface
    assert torch.autograd.gradcheck(image, (vertices, albedo), eps=1e-7, fast_mode=True)
    [gradient] = torch.autograd.grad(image(vertices, albedo).sum(), vertices)
    assert gradient.abs().max() > 1e-3


def irradiance_of_lamp(position, radius, points, normals) -> Tensor:
    paths = Lamps((tuple(position),), radius=radius).connect(points, normals, None, math.inf)
    total = torch.zeros(len(points), dtype=torch.float64)
    return total.index_add(0, paths.point, paths.irradiance)


POSITION = [0.5, -0.3, 0.8]


def test_a_small_disc_is_a_point_times_the_cosine_to_its_axis_and_dark_behind():
    """A disc faces the origin."""
    points, normals = draw(500, 3), torch.nn.functional.normalize(draw(500, 3, seed=1))
    position = torch.tensor(POSITION, dtype=torch.float64)
    to_lamp = position - points
    axis = position / position.norm()
    cosine = (to_lamp @ axis / to_lamp.norm(dim=1)).clamp(min=0)
    assert 50 < (cosine == 0).sum() < 450
    expected = irradiance_of_lamp(POSITION, 0.0, points, normals) * cosine
    found = irradiance_of_lamp(POSITION, 1e-7, points, normals)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("roughness", [0.2, 0.4])
def test_the_highlight_of_a_disc_is_that_of_many_small_discs(roughness):
    """200 small discs on a spiral have equal areas, and axes of almost the same direction."""
    center = np.array([1.3, 0.9, 1.1])
    across = np.linalg.svd(center[None])[2][1:]
    steps = np.arange(200) + 0.5
    turns = steps * math.pi * (3 - math.sqrt(5))
    offsets = 0.5 * np.sqrt(steps / 200) * np.stack([np.cos(turns), np.sin(turns)])
    places = center + offsets.T @ across
    gloss = Gloss(roughness, 1.0)
    images = []
    for lamps in (
        Lamps((tuple(center),), radius=0.5),
        Lamps(tuple(map(tuple, places)), radius=1e-6),
    ):
        power = torch.full((lamps.size, 3), 0.2 / lamps.size, dtype=torch.float64)
        lights = [(lamps, power)]
        options = {"lights": lights, "gloss": gloss, "samples": 2}
        images.append(render(ball(3), CAMERA, None, 16, 0.0, **options))
    error = (images[0] - images[1]).square().mean().sqrt()
    assert error < 0.05 * images[1].square().mean().sqrt()


def path_count(rows: list) -> int:
    """Return the number of paths from a disc to a ball whose nearest face has the last gloss."""
    mesh = ball(3)
    gloss = np.resize(np.float32(rows[:1]), (len(mesh.faces), 3))
    gloss[np.argmax(mesh.vertices[mesh.faces].mean(1) @ CAMERA.axes()[2])] = rows[-1]
    view = LitView(replace(mesh, gloss=gloss), DISCS, SIZE, 2)
    lit = LocalLightView(Rays(view.mesh), Surface(view.mesh, view.view, view.settings))
    lit.radiance(DISCS, view.albedo, draw_uniform(3, 3))
    return len(lit.fixed_paths[DISCS].point)


def test_rays_to_discs_are_more_only_if_many_samples_have_narrow_highlights():
    matte = path_count([[1, 0, 0]])
    assert path_count([[0.2, 0, 0]]) == matte
    assert path_count([[1, 0, 1], [0.2, 0, 1]]) == matte
    assert path_count([[0.2, 0, 1]]) > 2 * matte


def test_a_surface_behind_a_lamp_casts_no_shadow():
    """The lamp is between two screens. The camera sees the lower one past the upper one."""
    screens = concatenate([square(1), square(0.2, center=(0, 0, 1))])
    lamp = Lamps(((0.0, 0.0, 0.5),))
    power = torch.ones(1, 3, dtype=torch.float64)
    shown = canvas(operator_under(lamp, screens, size=5, samples=1), power)
    # Directly below the lamp, the irradiance is 1 / 0.5². It is less elsewhere.
    assert shown.max() == pytest.approx(4.0, rel=0.2)


@pytest.mark.parametrize(("batch", "make_mesh"), [((), ball), ((2, 3), ball_on_a_table)])
def test_sparse_and_dense_transfer_give_equal_radiance_and_gradient(monkeypatch, batch, make_mesh):
    basis = SumBasis((HARMONICS, Projector(16, 28.6, 91.7, 3.0, 45.8)))
    mesh = make_mesh()
    monkeypatch.setattr("renderer.operators.build.SMALL_MATRIX_SIZE", 0)
    sparse = operator_under(basis, mesh, samples=2)
    monkeypatch.setattr("renderer.operators.build.SPARSE_FRACTION", 0)
    dense = operator_under(basis, mesh, samples=2)
    assert dense.sparse is None
    # Only the lit entries of the projector are sparse.
    assert len(sparse.nonzero) == len(HARMONICS.nonzero)
    assert 50 * len(sparse.sparse.function) < Projector(16).size * len(sparse.pixels)

    lights = draw_uniform(*batch, basis.size, 3)
    found = sparse.radiance(lights)
    torch.testing.assert_close(found, dense.radiance(lights), rtol=1e-13, atol=1e-13)
    upstream = draw(*batch, 3, len(sparse.pixels))
    gradient = sparse.light_gradient(upstream)
    expected = dense.light_gradient(upstream)
    torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=1e-12)
