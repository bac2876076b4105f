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
from renderer.geometry.mesh import concatenate
from renderer.geometry.shapes import SOLIDS
from renderer.light.lamps import Lamps
from renderer.light.presets import ambient, load_light

SIZE = 64
FAR, NEAR = OrthographicCamera(63.0, 22.9, 2.8), PerspectiveCamera(63.0, 22.9, 2.8, 0.1, -0.05, distance=4.0)
LIGHT = 0.4 * load_light("grace").double()
SCANS = Path(__file__).parents[4] / "shared" / "data" / "meshes"


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


def derivatives(image: Callable[[Tensor, int], Tensor], directions: Tensor, size: int, samples: int) -> Tensor:
    """(D, 3) of projections of an image, by gradients along directions (D, ...). image: of an offset and samples."""
    weights, offset = smooth_weights(size), torch.zeros_like(directions[0]).requires_grad_()
    values = (weights * image(offset, samples)).sum((1, 2, 3))
    gradients = [torch.autograd.grad(value, offset, retain_graph=True)[0] for value in values]
    return torch.stack([(directions * gradient).flatten(1).sum(1) for gradient in gradients], dim=1)


def differences(
    image: Callable[[Tensor, int], Tensor], directions: Tensor, size: int, samples: int, step: float
) -> Tensor:
    """(D, 3) central differences in place of `derivatives`."""
    weights = smooth_weights(size)
    with torch.no_grad():
        sides = [[(weights * image(sign * step * by, samples)).sum((1, 2, 3)) for by in directions] for sign in (1, -1)]
    return (torch.stack(sides[0]) - torch.stack(sides[1])) / (2 * step)


def error(image: Callable[[Tensor, int], Tensor], directions: Tensor, size: int = SIZE, step: float = 0.02) -> float:
    """Of the derivatives of projections along directions (D, ...), at 8² samples, relative to central differences at
    20²: norms over all of them. image: of an offset and samples."""
    found, expected = derivatives(image, directions, size, 8), differences(image, directions, size, 20, step)
    return float((found - expected).norm() / expected.norm())


def rendered(mesh: renderer.Mesh, camera: Camera, samples: int | None, size: int = SIZE, **options) -> Tensor:
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
    camera = OrthographicCamera(0.0, 17.2, 2.0)
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


def colored_plane(cells: int) -> tuple[renderer.Mesh, Tensor]:
    """A square of cells of two triangles each, whose corners are displaced at random, and the triangles' albedos."""
    generator = torch.Generator().manual_seed(4)
    along = torch.linspace(-0.8, 0.8, cells + 1, dtype=torch.float64)
    plane = torch.stack(torch.meshgrid(along, along, indexing="ij"), dim=2)
    plane += (torch.rand(plane.shape, generator=generator, dtype=torch.float64) - 0.5) * 0.8 / cells
    points = torch.nn.functional.pad(plane.flatten(0, 1), (0, 1))
    first = (torch.arange(cells)[:, None] * (cells + 1) + torch.arange(cells)).flatten()
    lower = torch.stack([first, first + cells + 1, first + cells + 2], dim=1)
    upper = torch.stack([first, first + cells + 2, first + 1], dim=1)
    faces = torch.cat([lower, upper])
    albedo = torch.rand(len(faces), 3, generator=generator, dtype=torch.float64)
    return renderer.Mesh.plain(points.numpy(), faces.numpy()), albedo


def triangle_areas(points: Tensor, faces: Tensor) -> Tensor:
    a, b, c = points[faces].unbind(1)
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


@pytest.mark.parametrize(
    ("size", "bounds"),
    [
        (32, {8: 0.06, 24: 0.03}),
        pytest.param(32, {2: 0.25, 8: 0.06, 32: 0.02}, marks=pytest.mark.slow),
        pytest.param(64, {2: 0.13, 8: 0.033, 32: 0.01}, marks=pytest.mark.slow),
        pytest.param(224, {2: 0.05, 8: 0.015}, marks=pytest.mark.slow),
    ],
)
def test_gradients_by_single_vertices_converge_to_those_of_areas_as_samples_grow(size, bounds):
    """In even light an image's sum is that of the triangles' colors times their areas; most of the edges are inner."""
    mesh, albedo = colored_plane(9)
    points, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
    camera, light = OrthographicCamera(0.0, 17.2, 2.0), ambient(torch.full((3,), 1 / math.pi).double())
    moved = points.clone().requires_grad_()
    total = ((albedo.sum(1) - 3 * 0.3) * triangle_areas(moved, faces)).sum() * (size / camera.width) ** 2
    (expected,) = torch.autograd.grad(total, moved)
    for samples, bound in bounds.items():
        vertices = points.clone().requires_grad_()
        image = rendered(mesh, camera, samples, size, light=light, vertices=vertices, albedo=albedo, albedo_scale=1.0)
        (found,) = torch.autograd.grad(image.sum(), vertices)
        assert float((found - expected)[:, :2].norm() / expected.norm()) < bound


def box(low: list[float], high: list[float]) -> renderer.Mesh:
    low_corner, high_corner = torch.tensor(low), torch.tensor(high)
    unit = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return renderer.Mesh.plain((low_corner + unit * (high_corner - low_corner)).numpy(), faces)


def angular_cup(segments: int = 7) -> renderer.Mesh:
    """A cup with a thick wall and no handle: rings of vertices outside, on the rim and inside."""
    angle = torch.arange(segments, dtype=torch.float64) * (2 * math.pi / segments)
    radius, height = torch.tensor([0.6, 0.8, 0.6, 0.4]), torch.tensor([-0.7, 0.7, 0.7, -0.4])
    rings = torch.stack([angle.cos() * radius[:, None], angle.sin() * radius[:, None]], dim=2)
    rings = torch.cat([rings, height[:, None, None].expand(-1, segments, 1)], dim=2)
    points = torch.cat([rings.flatten(0, 1), torch.tensor([[0.0, 0.0, -0.7], [0.0, 0.0, -0.4]])])
    after = (torch.arange(segments) + 1) % segments
    faces = [torch.stack([torch.full_like(after, 4 * segments), after, torch.arange(segments)], dim=1)]
    for ring in range(3):
        low, next_low = ring * segments + torch.arange(segments), ring * segments + after
        faces += [
            torch.stack([low, next_low, next_low + segments], 1),
            torch.stack([low, next_low + segments, low + segments], 1),
        ]
    inside = 3 * segments
    faces += [
        torch.stack([torch.full_like(after, 4 * segments + 1), inside + torch.arange(segments), inside + after], dim=1)
    ]
    return renderer.Mesh.plain(points.numpy(), torch.cat(faces).numpy())


ERROR_BY_SAMPLES = {2: 0.2, 8: 0.05, 32: 0.015}
PARTS = {
    "cup": [angular_cup()],
    "boxes": [box([-0.8, -0.7, -0.6], [0.2, 0.1, 0.3]), box([-0.3, 0.15, -0.5], [0.5, 0.9, 0.6])],
    "table": [box([-0.9, -0.9, 0.3], [0.9, 0.9, 0.45])]
    + [box([x - 0.1, y - 0.1, -0.8], [x + 0.1, y + 0.1, 0.3]) for x in (-0.7, 0.7) for y in (-0.7, 0.7)],
}


@pytest.mark.slow
@pytest.mark.parametrize("size", [32, 64, 224])
@pytest.mark.parametrize("name", PARTS)
def test_gradients_by_single_vertices_are_differences_where_a_part_hides_another(name, size):
    """Each nearest vertex alone: the error at 2² samples is larger than at 8², and at 32² it is small."""
    mesh = concatenate(PARTS[name])
    points, direction = torch.from_numpy(mesh.vertices), torch.tensor([0.5, 0.7, -0.5], dtype=torch.float64)
    nearest = NEAR.depths(mesh.vertices).argsort()[:12:4].copy()
    directions = points.new_zeros(len(nearest), *points.shape)
    directions[range(len(nearest)), nearest] = direction

    def image(offset: Tensor, samples: int) -> Tensor:
        vertices, moves = points + offset, offset.requires_grad
        return rendered(mesh, NEAR, samples, size, vertices=vertices, normals="flat", silhouettes=moves)

    step, finest = min(NEAR.width / size / 2, 0.04), 2048 // size
    coarse, fine = (differences(image, directions, size, finest, by) for by in (step, step / 2))
    expected = (4 * fine - coarse) / 3  # the error of differences falls with the square of the step
    for samples, bound in ERROR_BY_SAMPLES.items():
        if samples * size <= 2048:
            found = derivatives(image, directions, size, samples)
            assert float((found - expected).norm() / expected.norm()) < bound


def test_outlines_take_the_samples_of_their_documented_accuracy_unless_a_number_is_given():
    mesh = named("pear")
    images = [rendered(mesh, FAR, samples, 16, silhouettes=moves) for samples, moves in [(None, True), (8, False)]]
    assert torch.equal(*images)
    images = [rendered(mesh, FAR, samples, 16, silhouettes=moves) for samples, moves in [(2, True), (None, False)]]
    assert torch.equal(*images)
