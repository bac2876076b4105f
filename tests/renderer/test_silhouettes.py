"""Gradients that see outlines move: in closed form, and against differences of images rendered anew."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import renderer
from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.light.local import Lamps
from renderer.light.presets import ambient, load_light
from renderer.mesh import concatenate
from renderer.shapes import SOLIDS

SIZE = 64
FAR, NEAR = OrthographicCamera(1.1, 0.4, 2.8), PerspectiveCamera(1.1, 0.4, 2.8, 0.1, -0.05, distance=4.0)
LIGHT = 0.4 * load_light("grace").double()
SCANS = Path(__file__).parents[3] / "shared" / "data" / "meshes"


def smooth_weights(size: int) -> Tensor:
    """(3, 3, size, size): projections of an image, its sum and two smooth ones."""
    y, x = torch.meshgrid(*[torch.linspace(-1, 1, size, dtype=torch.float64)] * 2, indexing="ij")
    waves = [torch.stack([torch.sin(a * x + b * y + c) for a in (1.0, 2.0, 3.0)]) for b, c in ((2.0, 0.5), (-1.0, 2.0))]
    return torch.stack([torch.ones(3, size, size, dtype=torch.float64), *waves])


def displacements(points: Tensor) -> Tensor:
    """(7, V, 3): inflation, three turns, a shear and two smooth fields."""
    turns = [torch.linalg.cross(axis.expand_as(points), points) for axis in torch.eye(3, dtype=torch.float64)]
    shear = torch.stack([points[:, 2], 0 * points[:, 0], points[:, 0]], dim=1)
    return torch.stack([points, *turns, shear, *(torch.sin(points[:, [1, 2, 0]] * k + k) for k in (2.0, 3.0))])


def error(image: Callable[[Tensor, int], Tensor], directions: Tensor, size: int = SIZE, step: float = 0.02) -> float:
    """Of the derivatives of projections along directions (D, ...), at 8² samples, relative to central differences at
    20²: norms over all of them. image: of an offset and samples."""
    weights, offset = smooth_weights(size), torch.zeros_like(directions[0]).requires_grad_()
    values = (weights * image(offset, 8)).sum((1, 2, 3))
    gradients = [torch.autograd.grad(value, offset, retain_graph=True)[0] for value in values]
    found = torch.stack([(directions * gradient).flatten(1).sum(1) for gradient in gradients], dim=1)
    sides = [[(weights * image(sign * step * by, 20)).sum((1, 2, 3)) for by in directions] for sign in (1, -1)]
    expected = (torch.stack(sides[0]) - torch.stack(sides[1])).detach() / (2 * step)
    return float((found - expected).norm() / expected.norm())


def rendered(mesh: renderer.Mesh, camera: Camera, samples: int, size: int = SIZE, **options) -> Tensor:
    choices = {"light": LIGHT, "background": 0.3, "albedo_scale": 0.8, "silhouettes": True} | options
    return renderer.render(mesh, camera, size=size, samples=samples, **choices)[0]


def named(name: str) -> renderer.Mesh:
    if name in SOLIDS:
        return renderer.normalize(renderer.solid(name))
    if not (SCANS / name).exists():
        pytest.skip(f"{name} is not there")
    return renderer.normalize(renderer.load_mesh(SCANS / name))


@pytest.mark.parametrize(
    ("name", "normals", "camera", "size"),
    [
        ("mushroom", "flat", NEAR, 32),
        *(pytest.param(name, "smooth", FAR, SIZE, marks=pytest.mark.slow) for name in SOLIDS),
        *(pytest.param(name, "flat", NEAR, SIZE, marks=pytest.mark.slow) for name in SOLIDS),
        *(
            pytest.param(name, "smooth", NEAR, SIZE, marks=pytest.mark.slow)
            for name in ("banana.glb", "apple_scan.glb")
        ),
    ],
)
def test_gradients_by_vertices_are_differences_of_images_rendered_anew(name, normals, camera, size):
    mesh = named(name)
    points = torch.from_numpy(mesh.vertices)

    def image(offset: Tensor, samples: int) -> Tensor:
        return rendered(mesh, camera, samples, size, vertices=points + offset, normals=normals)

    directions = displacements(points)
    bound = {"cup": 0.03, "plate": 0.04}.get(name, 0.02)  # whose walls are of a few samples
    assert error(image, directions if size == SIZE else directions[::3], size) < bound


@pytest.mark.parametrize("camera", [FAR, NEAR], ids=["orthographic", "perspective"])
def test_gradients_by_the_camera_are_differences_of_images_rendered_anew(camera):
    mesh = named("pear")
    names = ["polar", "azimuth", "width", "right", "up"] + ["distance"] * (camera is NEAR)
    fields = torch.tensor([getattr(camera, name) for name in names], dtype=torch.float64)

    def image(offset: Tensor, samples: int) -> Tensor:
        moved = replace(camera, **dict(zip(names, fields + offset, strict=True)))
        return rendered(mesh, moved, samples, 48)

    assert error(image, torch.eye(len(names), dtype=torch.float64), 48) < 0.02


def square(half: float, height: float) -> renderer.Mesh:
    corners = [[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]]
    return renderer.Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("meshes", "expected"),
    [
        ([square(0.5, 0.0)], 0.6 - 0.1),
        ([square(0.5, 0.5), square(0.9, 0.0)], 0.0),  # as bright as what is behind
        ([square(0.5, 0.5), square(0.503, 0.0)], 0.0),  # which ends before the next sample
        ([square(0.5, -0.5), square(0.9, 0.0)], 0.0),  # hidden
        ([square(0.5, 0.5), square(0.3, 0.0)], 0.6 - 0.1),
    ],
)
def test_a_growing_square_gains_its_perimeter_times_the_jump(meshes, expected):
    """In even light; its corners move outwards by one each, and its area grows by its perimeter of 8 · 0.5."""
    mesh, light = concatenate(meshes), ambient(torch.full((3,), 0.6 / math.pi).double())
    vertices = torch.from_numpy(mesh.vertices).requires_grad_()
    camera = OrthographicCamera(0.0, 0.3, 2.0)
    image = rendered(mesh, camera, 8, 32, light=light, vertices=vertices, background=0.1, albedo_scale=1.0)
    (gradient,) = torch.autograd.grad(image[0].sum(), vertices)
    growth = (gradient[:4] * torch.from_numpy(mesh.vertices[:4]).sign())[:, :2].sum()
    assert float(growth) / (32 / 2) ** 2 == pytest.approx(4 * expected, abs=0.02 * 4 * 0.5)


def test_the_image_is_the_same_and_local_light_and_shadows_move_with_the_outline():
    """Under a lamp and shadowed environment light; a shift in the image's plane moves nothing else."""
    mesh, lamps = named("apple"), Lamps(((2.0, 1.0, 2.5),), radius=0.0)
    points, right = torch.from_numpy(mesh.vertices), torch.from_numpy(FAR.axes()[0])
    options = {"lights": [(lamps, torch.full((1, 3), 2.0))], "shadows": True}
    images = [rendered(mesh, FAR, 3, 24, silhouettes=moves, **options) for moves in (False, True)]
    torch.testing.assert_close(images[1], images[0], rtol=0, atol=1e-12)
    vertices = points.clone().requires_grad_()
    image = rendered(mesh, FAR, 8, 32, vertices=vertices, **options)
    (gradient,) = torch.autograd.grad((image * smooth_weights(32)[1]).sum(), vertices)
    found = float((gradient @ right).sum())
    sides = [rendered(mesh, replace(FAR, right=0.03 * sign), 20, 32, **options) for sign in (1, -1)]
    expected = float(((sides[0] - sides[1]) * smooth_weights(32)[1]).sum()) / 0.06
    assert found == pytest.approx(expected, rel=0.1)  # the distance to the lamp changes, too
