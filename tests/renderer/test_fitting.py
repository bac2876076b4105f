"""Cameras and lights that photographs were made with are found again: of path-traced images, and of our own."""

import math
from pathlib import Path

import pytest
import torch

import renderer
from renderer.camera import OrthographicCamera, PerspectiveCamera
from renderer.errors import InputError
from renderer.fitting import FINAL_GRID, LEAST_RADIANCE, _nonnegative_light, fit_scene
from renderer.light.environment import to_map, write_map
from renderer.light.harmonics import basis
from renderer.light.presets import load_light
from renderer.mitsuba_scene import SCENE, mitsuba_map, render_mitsuba_scene, write_mitsuba_scene
from renderer.settings import ImageSettings

FAR = OrthographicCamera(51.6, 114.6, 3.0, 0.2, -0.1)
NEAR = PerspectiveCamera(63.0, 57.3, 3.0, 0.2, -0.1, distance=6.0)


def positive_light(name: str) -> torch.Tensor:
    """(49, 3) with no negative radiance, dim enough for an image without clipped values."""
    light = 0.2 * load_light(name).double()
    light[0] -= mitsuba_map(light, 96).amin((0, 1)).clamp(max=0) * math.sqrt(4 * math.pi)
    return light


def check(found, mesh: renderer.Mesh, camera, light: torch.Tensor, irradiance: float) -> None:
    """Camera within 1° and 1 % of the image; light by the irradiance of the visible surface."""
    turned = (found.camera.axes() * camera.axes()).sum(1)  # cosines
    assert min(turned) > math.cos(math.radians(1))
    assert found.camera.width == pytest.approx(camera.width, rel=0.01)
    assert (found.camera.right, found.camera.up) == pytest.approx((camera.right, camera.up), abs=0.01 * camera.width)
    white = renderer.Mesh.plain(mesh.vertices, mesh.faces)
    [operator] = renderer.precompute_transfer(white, camera, 64)
    found, expected = operator.radiance(found.light), operator.radiance(light)
    assert float((found - expected).norm() / expected.norm()) < irradiance


@pytest.mark.slow
def test_a_renders_camera_and_light_are_found_before_any_background():
    mesh, light = renderer.normalize(renderer.solid("mushroom")), positive_light("eucalyptus")
    behind = torch.rand(3, 48, 48, generator=torch.Generator().manual_seed(0)).double()
    image = renderer.render(mesh, FAR, light, 48, behind, samples=8)[0]
    mask = 1 - renderer.render(mesh, FAR, 0 * light, 48, 1.0, samples=8)[0, 0]
    check(fit_scene(image, mask, mesh), mesh, FAR, light, 0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "camera", "light"),
    [
        ("mushroom", FAR, "eucalyptus"),
        pytest.param(
            "cup", FAR, "st_peters", marks=pytest.mark.xfail(reason="irradiance is 7.4 % off", raises=AssertionError)
        ),
        ("apple_scan.glb", NEAR, "grace"),
        ("banana.glb", NEAR, "grace"),
    ],
)
def test_a_path_traced_images_camera_and_light_are_found(tmp_path, name, camera, light):
    pytest.importorskip("mitsuba")
    file = Path(__file__).parents[3] / "shared" / "data" / "meshes" / name
    if file.suffix and not file.exists():
        pytest.skip(f"{name} is not there")
    mesh = renderer.normalize(renderer.load_mesh(file) if file.suffix else renderer.solid(name))
    light = positive_light(light)
    write_map(tmp_path / "light.exr", mitsuba_map(light, 192))
    write_mitsuba_scene(tmp_path, mesh, 1.0, [camera], ImageSettings(64, bounces=3), "light.exr")
    image = render_mitsuba_scene(tmp_path / SCENE, 1)[0].double()
    fov = camera.angle if camera is NEAR else None
    found = fit_scene(image[:3].clamp(0, 1), image[3].clamp(0, 1), mesh, fov=fov, bounces=3)
    check(found, mesh, camera, light, 0.07 if name == "cup" else 0.05)  # inside which light bounces


@pytest.mark.slow
def test_how_high_the_camera_stands_is_found_of_a_round_object():
    """All azimuths fit it alike, so that all of the best cameras of the first search may share a wrong polar angle."""
    mesh, light = renderer.normalize(renderer.solid("bottle", 3)), positive_light("st_peters")
    camera = PerspectiveCamera(31.5, 286.5, 2.6, 0.1, 0.1, distance=4.0)
    image = renderer.render(mesh, camera, light, 64, 0.0, samples=8)[0]
    mask = 1 - renderer.render(mesh, camera, 0 * light, 64, 1.0, samples=8)[0, 0]
    found = fit_scene(image.clamp(0, 1), mask, mesh, fov=camera.angle)
    assert found.camera.polar == pytest.approx(camera.polar, abs=1)


def test_the_light_of_a_quadratic_program_is_nowhere_negative_and_no_other_such_light_is_better():
    """At the minimum of a convex function, its derivative toward any other light of the set is not negative. The other
    lights are the squares of lights of degree 3 and a constant light, and zero."""
    generator = torch.Generator().manual_seed(0)
    factors = torch.randn(3, 49, 60, generator=generator, dtype=torch.float64)
    squares = factors @ factors.mT
    wanted = (squares @ torch.randn(3, 49, 1, generator=generator, dtype=torch.float64))[..., 0]
    light = _nonnegative_light(squares, wanted, FINAL_GRID)
    radiance = to_map(light, 256)
    assert radiance.min() >= 0
    free = torch.linalg.solve(squares, wanted[..., None])[..., 0].T
    assert to_map(free, 64).amin((0, 1)).max() < -0.1  # The constraint matters in all channels.
    directions = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator, dtype=torch.float64), dim=1)
    harmonics = basis(directions, 6)
    roots = basis(directions, 3) @ torch.randn(16, 200, generator=generator, dtype=torch.float64)
    others = torch.linalg.lstsq(harmonics, roots.square()).solution
    others[0] += 2 * LEAST_RADIANCE * others[0]
    others = torch.cat([others, 0 * others[:, :1]], dim=1)
    slope = (squares @ light.T[..., None])[..., 0] - wanted  # (3, 49)
    toward = slope @ others - (slope * light.T).sum(1, keepdim=True)
    assert toward.min() > -1e-6 * toward.abs().max()


def test_a_mask_of_nothing_is_refused():
    mesh = renderer.normalize(renderer.solid("apple"))
    with pytest.raises(InputError, match="the mask covers 0 pixels"):
        fit_scene(torch.zeros(3, 32, 32), torch.zeros(32, 32), mesh)
