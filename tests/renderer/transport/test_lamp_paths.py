"""Lamps and projectors against Mitsuba 3's projector, point and area emitters, on convex and concave meshes."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from oracles import mesh_of

from renderer.camera import OrthographicCamera
from renderer.geometry.mesh import Mesh, concatenate
from renderer.io import mitsuba
from renderer.io.mitsuba import SCENE, render_mitsuba_scene, write_mitsuba_scene
from renderer.light.basis import HARMONICS, LocalBasis, SumBasis
from renderer.light.environment import write_map
from renderer.light.lamps import Lamps
from renderer.light.projector import Projector
from renderer.settings import ImageSettings
from renderer.surface.albedo import surface_albedo
from renderer.transport import lamp_paths as sparse
from renderer.transport.lamp_paths import local_radiance, unoccluded
from renderer.transport.operators import TransferOperator, build_operators
from renderer.transport.rays import Rays, Surface
from renderer.visibility.fragments import build_fragments
from renderer.visibility.rasterizers import choose

CAMERA = OrthographicCamera(51.6, 22.9, 2.2)
PROJECTOR = Projector(pixels=7, polar=28.6, azimuth=91.7, distance=3.0, fov=35.0)
LAMPS = Lamps(((1.5, 1.0, 1.0), (-0.5, -1.5, 1.6), (0.0, 1.5, -1.2)))
DISCS = replace(LAMPS, radius=0.3)
SIZE, SAMPLES = 24, 16


def ball(subdivisions: int = 2) -> Mesh:
    return mesh_of(trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.9), (0.9, 0.5, 0.2))


def ball_on_a_table() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.45)
    plate = Mesh.plain([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]], (0.3, 0.6, 0.9))
    return concatenate([Mesh.plain(sphere.vertices + np.array([0, 0, 0.45]), sphere.faces, (0.9, 0.5, 0.2)), plate])


def operator(mesh: Mesh, basis: LocalBasis, size: int = SIZE, samples: int = SAMPLES, **settings) -> TransferOperator:
    images = ImageSettings(size, samples, **settings)
    return build_operators(mesh, [CAMERA], images, choose("numpy"), basis=basis, dtype=torch.float64)[0]


def canvas(built: TransferOperator, light: torch.Tensor) -> np.ndarray:
    """(size, size, 3) linear radiance."""
    whole = torch.zeros(3, built.settings.size**2, dtype=torch.float64)
    whole[:, built.pixels] = built.radiance(light)
    return whole.view(3, built.settings.size, -1).permute(1, 2, 0).numpy()


def mitsuba_image(folder: Path, mesh: Mesh, basis: LocalBasis, light: torch.Tensor) -> np.ndarray:
    """(SIZE, SIZE, 3) of files, in each of several lamps by itself, of which Mitsuba would draw one."""
    pytest.importorskip("mitsuba")
    write_map(folder / "light.exr", torch.zeros(8, 16, 3))
    lights = [(basis, light)]
    if isinstance(basis, Lamps):
        lights = [(replace(basis, positions=(at,)), row[None]) for at, row in zip(basis.positions, light, strict=True)]
    images = []
    for placed in lights:
        write_mitsuba_scene(folder, mesh, 1.0, [CAMERA], ImageSettings(SIZE), "light.exr", [placed])
        images.append(render_mitsuba_scene(folder / SCENE, 1)[0, :3])
    return sum(images).permute(1, 2, 0).double().numpy()


@pytest.mark.parametrize(
    ("basis", "solid"),
    [(PROJECTOR, ball), (LAMPS, ball_on_a_table), (replace(DISCS, positions=LAMPS.positions[:2]), ball_on_a_table)],
    ids=lambda value: getattr(value, "name", None),
)
def test_images_are_mitsubas_and_gradients_their_adjoint(solid, basis, tmp_path, monkeypatch):
    """Direct light of a point has no noise but where edges of pattern, shadow and outline cross a pixel: most pixels
    are equal to float32's digits of the rays, and the others on average. That of discs has little at 1,024 rays.

    The image is linear in the light: the gradient of its sum, weighted at random, gives the sum of any light's image.
    """
    draws = torch.Generator().manual_seed(1)
    light = 2 * torch.rand(basis.size, 3, generator=draws, dtype=torch.float64)
    built = operator(solid(), basis)
    monkeypatch.setattr(mitsuba, "SAMPLES", 1024 if getattr(basis, "radius", 0) else 256)
    ours, theirs = canvas(built, light), mitsuba_image(tmp_path, solid(), basis, light)
    error = np.abs(ours - theirs)
    assert theirs.max() > 0.1 and (theirs.max(axis=2) == 0).mean() > 0.1
    assert np.median(error[theirs > 0]) < 1e-3 * theirs.max()
    assert np.sqrt((error**2).mean()) < 0.01 * theirs.max()
    assert abs((ours - theirs).mean()) < 2e-3 * theirs.mean()

    weights = torch.rand(3, len(built.pixels), generator=draws, dtype=torch.float64)
    expected = torch.from_numpy(theirs).flatten(0, 1)[built.pixels].T
    sums = (built.light_gradient(weights) * light).sum(), (weights * built.radiance(light)).sum()
    torch.testing.assert_close(*sums, rtol=1e-12, atol=0)
    torch.testing.assert_close(sums[0], (weights * expected).sum(), rtol=5e-3, atol=0)


def test_a_screen_at_the_origin_shows_the_pattern_upright_and_as_bright():
    """Thrown along the camera's view, each pixel of a white screen is one of the pattern's."""
    straight = Projector(4, CAMERA.polar, CAMERA.azimuth, 3.0, 2 * math.degrees(math.atan(CAMERA.width / 2 / 3.0)))
    right, up, _ = CAMERA.axes()
    corners = 3 * np.array([-right - up, right - up, right + up, up - right])
    screen = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])
    pattern = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    shown = canvas(operator(screen, straight, size=4, samples=3), pattern.flatten(0, 1))
    np.testing.assert_allclose(shown, pattern.numpy(), rtol=1e-12)


def moved_image(
    mesh: Mesh,
    positions: torch.Tensor,
    powers: torch.Tensor,
    size: int = SIZE,
    samples: int = SAMPLES,
    basis: Lamps = LAMPS,
) -> tuple[TransferOperator, torch.Tensor]:
    """The operator of the lamps, and (3, P) of its pixels under these at other positions."""
    settings = ImageSettings(size, samples)
    (view,) = build_fragments(mesh.vertices, mesh.faces, [CAMERA], settings, choose("numpy"), closed=mesh.closed)
    surface, albedo = Surface(mesh, view, settings), surface_albedo(mesh, view, settings.encoding)
    paths = unoccluded(Rays(mesh), basis, surface.points, surface.normals, surface.planes, positions)
    return operator(mesh, basis, size, samples), local_radiance(surface, albedo, paths, powers)


@pytest.mark.parametrize("basis", [LAMPS, DISCS], ids=["lamps", "discs"])
def test_moved_lamps_shine_and_cast_shadows_as_lamps_that_stand_there(basis):
    there = torch.tensor([[2.0, -1.0, 1.5], [-0.4, 1.7, 2.5]], dtype=torch.float64)
    powers = torch.rand(2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    shown = partial(moved_image, ball_on_a_table(), samples=4, basis=basis)
    _, image = shown(there, powers)
    standing = operator(ball_on_a_table(), basis.moved(there), samples=4)
    torch.testing.assert_close(image, standing.radiance(powers), rtol=1e-12, atol=1e-14)
    _, alone = shown(there[:1], powers[:1])
    assert (alone == 0).any() and alone.max() > 0.02


@pytest.mark.parametrize("basis", [LAMPS, DISCS], ids=["lamps", "discs"])
def test_derivatives_by_positions_and_powers_are_finite_differences_where_no_shadow_moves(basis):
    positions = torch.tensor(LAMPS.positions, dtype=torch.float64, requires_grad=True)
    powers = torch.rand(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True)
    small = partial(moved_image, ball(), size=6, samples=2, basis=basis)
    assert torch.autograd.gradcheck(lambda *inputs: small(*inputs)[1], (positions, powers), eps=1e-7)


@pytest.mark.parametrize(("basis", "normals"), [(PROJECTOR, "flat"), (LAMPS, "smooth"), (DISCS, "flat")])
def test_derivatives_by_vertices_and_albedo_are_finite_differences_at_fixed_visibility(basis, normals):
    mesh, settings = ball(0), ImageSettings(4, 2, normals=normals)
    (view,) = build_fragments(mesh.vertices, mesh.faces, [CAMERA], settings, choose("numpy"), closed=True)
    powers = torch.rand(basis.size, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rays = Rays(mesh)

    def image(vertices: torch.Tensor, albedo: torch.Tensor) -> torch.Tensor:
        surface = Surface(mesh, view, settings, vertices)
        return local_radiance(
            surface, albedo, unoccluded(rays, basis, surface.points, surface.normals, surface.planes), powers
        )

    vertices = torch.from_numpy(mesh.vertices).requires_grad_()
    albedo = surface_albedo(mesh, view, settings.encoding).contiguous().requires_grad_()
    assert torch.autograd.gradcheck(image, (vertices, albedo), eps=1e-7)
    (gradient,) = torch.autograd.grad(image(vertices, albedo).sum(), vertices)
    assert gradient.abs().max() > 1e-3


def test_a_small_disc_is_a_point_but_for_the_cosine_off_its_axis_and_dark_behind():
    draws = torch.Generator().manual_seed(0)
    points, normals = torch.randn(2, 500, 3, generator=draws, dtype=torch.float64)
    normals /= normals.norm(dim=1, keepdim=True)
    position = torch.tensor([0.5, -0.3, 0.8], dtype=torch.float64)
    received = []
    for radius in (0.0, 1e-7):
        paths = Lamps((tuple(position.tolist()),), radius=radius).connect(points, normals)
        received.append(torch.zeros(500, dtype=torch.float64).index_add(0, paths.point, paths.irradiance))
    toward = position - points
    cosine = (toward @ position / position.norm() / toward.norm(dim=1)).clamp(min=0)
    assert 50 < (cosine == 0).sum() < 450
    torch.testing.assert_close(received[1], received[0] * cosine, rtol=1e-5, atol=1e-6)


def test_a_surface_behind_a_lamp_casts_no_shadow():
    """Halfway between two screens, of which the camera sees the lower one through a gap."""
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([square, square * [0.2, 0.2, 0] + [0, 0, 1.0]])
    screens = Mesh.plain(vertices, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    lamp = Lamps(((0.0, 0.0, 0.5),))
    shown = canvas(operator(screens, lamp, size=5, samples=1), torch.ones(1, 3, dtype=torch.float64))
    assert shown.max() == pytest.approx(4.0, rel=0.2)  # 1 / 0.5², and less away from below the lamp


@pytest.mark.parametrize("batch", [(), (2, 3)], ids=str)
@pytest.mark.parametrize("solid", [ball, ball_on_a_table])
def test_sparse_and_dense_transfer_give_the_same_radiance_and_gradient(monkeypatch, batch, solid):
    """In harmonics and a projector at once, of one color and of two."""
    both, mesh = SumBasis((HARMONICS, Projector(16, 28.6, 91.7, 3.0, 45.8))), solid()
    monkeypatch.setattr(sparse, "SMALL", 0)
    few = operator(mesh, both, samples=2)
    monkeypatch.setattr(sparse, "SPARSE", 0)
    whole = operator(mesh, both, samples=2)
    assert few.sparse is not None and whole.sparse is None and len(few.nonzero) == len(HARMONICS.nonzero)
    assert 50 * len(few.sparse.function) < whole.transfer[0, len(few.nonzero) :].numel()
    draws = torch.Generator().manual_seed(0)
    lights = torch.rand(*batch, both.size, 3, generator=draws, dtype=torch.float64)
    torch.testing.assert_close(few.radiance(lights), whole.radiance(lights), rtol=1e-13, atol=1e-13)
    upstream = torch.randn(*batch, 3, len(few.pixels), generator=draws, dtype=torch.float64)
    torch.testing.assert_close(few.light_gradient(upstream), whole.light_gradient(upstream), rtol=1e-12, atol=1e-12)
