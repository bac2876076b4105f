"""Gradients through moving outlines, in closed form and against differences of images."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw_uniform, mesh_of, named_mesh, relative_error, square
from torch import Tensor
from torch.autograd.functional import jacobian

import renderer
from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.light.files import ambient, load_light
from renderer.light.lamps import Lamps, Projector
from renderer.mesh import Mesh, concatenate
from renderer.pinhole import PinholeCamera
from renderer.solids import SOLIDS

FAR = OrthographicCamera(63.0, 22.9, 2.8)
NEAR = PerspectiveCamera(63.0, 22.9, 2.8, 0.1, -0.05, distance=4.0)
ASIDE = {"roll": 30.0, "center_x": 0.1, "principal_right": 0.2, "principal_up": -0.1}
TURNED = PinholeCamera(63.0, 22.9, 2.8, distance=4.0, pixel_aspect=1.1, **ASIDE)
FROM_ABOVE = OrthographicCamera(0.0, 17.2, 2.0)
LIGHT = 0.4 * load_light("grace").double()

# Image (3, size, size) after a change of the scene. The arguments are the change
# and the samples per row of a pixel.
ChangedImage = Callable[[Tensor, int], Tensor]


def rendered(mesh, camera, size, samples, **options) -> Tensor:
    choices = {"light": LIGHT, "background": 0.3, "albedo_scale": 0.8, "silhouettes": True}
    return renderer.render(mesh, camera, size=size, samples=samples, **choices | options)


def soft_front_light(radiance: float) -> Tensor:
    return ambient(torch.full((3,), radiance / math.pi).double())


def smooth_weights(size: int) -> Tensor:
    """Return the weights of three sums over an image: ones, and two waves."""
    along = torch.linspace(-1, 1, size, dtype=torch.float64)
    y, x = torch.meshgrid(along, along, indexing="ij")
    slow_wave = [torch.sin(frequency * x + 2 * y + 0.5) for frequency in (1, 2, 3)]
    tilted_wave = [torch.sin(frequency * x - y + 2) for frequency in (1, 2, 3)]
    ones = torch.ones(3, size, size, dtype=torch.float64)
    return torch.stack([ones, torch.stack(slow_wave), torch.stack(tilted_wave)])


def smooth_sums(image: Tensor) -> Tensor:
    return (smooth_weights(image.shape[-1]) * image).sum((1, 2, 3))


def derivatives(image: ChangedImage, directions: Tensor, samples: int) -> Tensor:
    start = torch.zeros_like(directions[0])
    gradients = jacobian(lambda change: smooth_sums(image(change, samples)), start)
    return directions.flatten(1) @ gradients.flatten(1).T


@torch.no_grad()
def differences(image: ChangedImage, directions: Tensor, samples: int, step: float) -> Tensor:
    rows = []
    for direction in directions:
        forward = smooth_sums(image(step * direction, samples))
        backward = smooth_sums(image(-step * direction, samples))
        rows.append((forward - backward) / (2 * step))
    return torch.stack(rows)


def require_differences(image, directions, samples, finer_samples, step, bound) -> None:
    """Compare derivatives with differences of new images that have more samples."""
    found = derivatives(image, directions, samples)
    expected = differences(image, directions, finer_samples, step)
    assert relative_error(found, expected) < bound


def moved_vertices(mesh: renderer.Mesh, camera: Camera, size: int, normals: str) -> ChangedImage:
    def image(change: Tensor, samples: int) -> Tensor:
        vertices = torch.from_numpy(mesh.vertices) + change
        options = {"vertices": vertices, "normals": normals, "silhouettes": change.requires_grad}
        return rendered(mesh, camera, size, samples, **options)

    return image


def moved_camera(mesh, camera, names, size, gloss=None, **options) -> ChangedImage:
    def image(change: Tensor, samples: int) -> Tensor:
        values = {
            name: getattr(camera, name) + amount for name, amount in zip(names, change, strict=True)
        }
        options["silhouettes"] = change.requires_grad
        return rendered(mesh, replace(camera, **values), size, samples, gloss=gloss, **options)

    return image


def displacements(points: Tensor) -> Tensor:
    """Return changes of vertices (V, 3): inflation, turns, a shear, and waves, shape (7, V, 3)."""
    axes = torch.eye(3, dtype=torch.float64)
    turns = [torch.linalg.cross(axis.expand_as(points), points) for axis in axes]
    shear = torch.stack([points[:, 2], torch.zeros_like(points[:, 0]), points[:, 0]], dim=1)
    waves = [torch.sin(points[:, [1, 2, 0]] * k + k) for k in (2.0, 3.0)]
    return torch.stack([points, *turns, shear, *waves])


@pytest.mark.parametrize("camera", [FAR, TURNED])
def test_the_pattern_of_a_projector_stays_in_place_while_an_object_moves_through_it(camera):
    """The ramp of 64 pixels is wider than the ball."""
    ramp = torch.linspace(0.2, 0.8, 64).double().expand(3, 64, 64)
    beamer = Projector(pixels=64, polar=50.0, azimuth=60.0, distance=3.0, fov=50.0)
    mesh = named_mesh("orange")
    points = torch.from_numpy(mesh.vertices)

    def image(change: Tensor, samples: int) -> Tensor:
        options = {"lights": [(beamer, ramp.flatten(1).T)], "light": None}
        options["silhouettes"] = change.requires_grad
        return rendered(mesh, camera, 32, samples, vertices=points + change, **options)

    directions = displacements(points)
    require_differences(image, directions, 6, 16, step=0.02, bound=0.03)


@pytest.mark.parametrize("pixels", [2, 3, 8])
def test_a_plane_that_slides_in_itself_under_a_projector_shows_the_same_pattern(pixels):
    """The pattern rises from row to row, and is as wide as the image."""
    corners = np.array([[-3.0, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]])
    plane = Mesh.plain(corners, np.array([[0, 1, 2], [0, 2, 3]]), (0.8,) * 3)
    beamer = Projector(pixels=pixels, polar=0.0, azimuth=0.0, fov=22.63)
    ramp = torch.linspace(0.2, 0.8, pixels).double()[:, None, None].expand(-1, pixels, 3)
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    options = {"lights": [(beamer, ramp.flatten(0, 1))], "silhouettes": True}
    vertices = torch.from_numpy(corners) + shift
    camera = OrthographicCamera(0, 0, 1.6)
    image = renderer.render(plane, camera, None, 32, 0.0, vertices=vertices, samples=8, **options)
    weights = torch.linspace(0, 2, 32).double()[:, None]
    (gradient,) = torch.autograd.grad((image * weights).mean(), shift)
    assert gradient[:2].abs().max() < 1e-3


# Walls of the cup and of the plate are a few samples thick.
BOUNDS = {"cup": 0.03, "plate": 0.04}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:ignored in .glb files")
@pytest.mark.parametrize(
    ("name", "normals", "camera"),
    [
        *((name, "smooth", FAR) for name in SOLIDS),
        *((name, "flat", NEAR) for name in SOLIDS),
        *((name, "smooth", NEAR) for name in ("banana.glb", "apple_scan.glb")),
    ],
)
def test_gradients_by_vertices_are_differences_of_new_images(name, normals, camera):
    mesh = named_mesh(name)
    image = moved_vertices(mesh, camera, 64, normals)
    directions = displacements(torch.from_numpy(mesh.vertices))
    require_differences(image, directions, 8, 20, step=0.02, bound=BOUNDS.get(name, 0.02))


def test_gradients_by_vertices_are_differences_of_new_images_of_a_few_pixels():
    mesh = named_mesh("mushroom")
    image = moved_vertices(mesh, NEAR, 32, "flat")
    directions = displacements(torch.from_numpy(mesh.vertices))[::3]
    require_differences(image, directions, 8, 14, step=0.02, bound=0.02)


@pytest.mark.parametrize("camera", [FAR, TURNED], ids=["orthographic", "pinhole"])
def test_gradients_by_the_camera_are_differences_of_new_images(camera):
    names = ["polar", "azimuth", "width", "right", "up"]
    if isinstance(camera, PinholeCamera):
        names += ["distance", "roll", "center_x", "center_y", "center_z"]
        names += ["principal_right", "principal_up", "pixel_aspect"]
    image = moved_camera(named_mesh("pear"), camera, names, 32)
    directions = torch.eye(len(names), dtype=torch.float64)
    require_differences(image, directions, 8, 14, step=0.02, bound=0.02)


@pytest.mark.slow
def test_gradients_by_the_camera_include_the_movement_of_highlights():
    metal = renderer.Gloss(0.5, 1.0)
    image = moved_camera(named_mesh("pear"), NEAR, ["polar", "azimuth"], 48, metal)
    # A smaller turn moves outlines across too few samples.
    require_differences(image, torch.eye(2, dtype=torch.float64), 8, 14, step=0.5, bound=0.1)


def test_the_highlight_of_a_lamp_on_a_large_mirror_moves_with_the_camera():
    lights = [(Lamps(((0.4, 0.3, 1.5),)), torch.full((1, 3), 2.0))]
    names = ["polar", "azimuth"]
    metal = renderer.Gloss(0.5, 1.0)
    camera = replace(NEAR, polar=20.0)
    image = moved_camera(square(2.5), camera, names, 16, metal, light=None, lights=lights)
    require_differences(image, torch.eye(2, dtype=torch.float64), 4, 4, step=0.1, bound=0.03)


def pyramid_on_the_ground() -> list[renderer.Mesh]:
    """Create a pyramid, and ground that hides its base by rounding and has the radiance 0.12."""
    base = square(0.5).vertices - np.array([0, 0, 1e-12])
    sides = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    gray_ground = square(0.9, color=(0.2, 0.2, 0.2))
    return [renderer.Mesh.plain([*base, [0, 0, 0.5]], sides), gray_ground]


ABOVE, BELOW = (0, 0, 0.5), (0, 0, -0.5)
GROWING = {
    "before the background": ([square(0.5)], 0.5),
    "hiding a square": ([square(0.5, ABOVE), square(0.3)], 0.5),
    "before an equal square": ([square(0.5, ABOVE), square(0.9)], 0.0),
    "before a square that ends less than a sample further": (
        [square(0.5, ABOVE), square(0.503)],
        0.0,
    ),
    "hidden": ([square(0.5, BELOW), square(0.9)], 0.0),
    "a pyramid on the ground": (pyramid_on_the_ground(), 0.6 - 0.12),
}


@pytest.mark.parametrize(("meshes", "jump"), GROWING.values(), ids=GROWING)
def test_a_growing_square_gains_its_perimeter_times_the_jump_of_radiance(meshes, jump):
    """The radiance is 0.6 on the squares and 0.1 on the background. Each side moves by one."""
    mesh = concatenate(meshes)
    vertices = torch.from_numpy(mesh.vertices).requires_grad_()
    options = {"light": soft_front_light(0.6), "background": 0.1, "albedo_scale": 1.0}
    image = rendered(mesh, FROM_ABOVE, 32, 8, vertices=vertices, **options)
    (gradient,) = torch.autograd.grad(image[0].sum(), vertices)
    growth = float((gradient[:4, :2] * vertices.detach()[:4, :2].sign()).sum())
    pixels_per_area = (32 / FROM_ABOVE.width) ** 2
    perimeter = 8 * 0.5
    assert growth / pixels_per_area == pytest.approx(perimeter * jump, abs=0.04)


def colored_plane(cells: int) -> tuple[renderer.Mesh, Tensor]:
    """Create cells² displaced squares, and the albedo (2 cells², 3) of their triangles."""
    # The turned square fits into the image of `FROM_ABOVE`.
    along = torch.linspace(-0.7, 0.7, cells + 1, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(along, along, indexing="ij"), dim=2)
    grid += (draw_uniform(*grid.shape, seed=4) - 0.5) * 0.7 / cells
    points = torch.nn.functional.pad(grid.flatten(0, 1), (0, 1))
    # Vertices of a row have successive indices.
    row = cells + 1
    corner = (torch.arange(cells)[:, None] * row + torch.arange(cells)).flatten()
    lower = torch.stack([corner, corner + row, corner + row + 1], dim=1)
    upper = torch.stack([corner, corner + row + 1, corner + 1], dim=1)
    faces = torch.cat([lower, upper])
    albedo = draw_uniform(len(faces), 3, seed=5)
    return renderer.Mesh.plain(points.numpy(), faces.numpy()), albedo


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
    """In even light, the sum of an image is that of the triangles' colors times their areas."""
    mesh, albedo = colored_plane(9)
    vertices = torch.from_numpy(mesh.vertices).requires_grad_()
    corners = vertices[torch.from_numpy(mesh.faces), :2]
    areas = torch.linalg.det(corners[:, 1:] - corners[:, :1]) / 2
    pixels_per_area = (size / FROM_ABOVE.width) ** 2
    # The background has a radiance of 0.3 in three channels.
    total = ((albedo.sum(1) - 3 * 0.3) * areas).sum() * pixels_per_area
    (expected,) = torch.autograd.grad(total, vertices)
    options = {"light": soft_front_light(1.0), "albedo": albedo, "albedo_scale": 1.0}
    for samples, bound in bounds.items():
        image = rendered(mesh, FROM_ABOVE, size, samples, vertices=vertices, **options)
        (found,) = torch.autograd.grad(image.sum(), vertices)
        assert relative_error(found[:, :2], expected[:, :2]) < bound


def test_a_growing_square_in_shadow_gains_its_perimeter_times_its_dark_radiance():
    """High walls around the square, outside of the image, hide most of the sky."""
    floor = square(0.5)
    rim = 3.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    low = np.column_stack([rim, np.full(4, -1.0)])
    high = np.column_stack([rim, np.full(4, 9.0)])
    walls = []
    for here, there in [(0, 1), (1, 2), (2, 3), (3, 0)]:
        walls += [[here, there, 4 + here], [there, 4 + there, 4 + here]]
    mesh = concatenate([floor, renderer.Mesh.plain(np.concatenate([low, high]), walls)])
    vertices = torch.from_numpy(mesh.vertices).requires_grad_()
    options = {"light": soft_front_light(1.0), "background": 0.0, "albedo_scale": 1.0}
    image = rendered(mesh, FROM_ABOVE, 16, 8, vertices=vertices, shadows=True, **options)
    (gradient,) = torch.autograd.grad(image[0].sum(), vertices)
    outward = torch.from_numpy(2 * floor.vertices[:, :2])
    gained = float((gradient[:4, :2] * outward).sum())
    pixels_per_area = (16 / FROM_ABOVE.width) ** 2
    radiance = float(image.detach()[0].sum()) / pixels_per_area  # The area of the square is 1.
    assert 0.05 < radiance < 0.5
    assert gained == pytest.approx(4 * radiance * pixels_per_area, rel=0.05)


def test_local_light_and_shadows_move_with_the_outline():
    """A shift in the image's plane changes the distance to the lamp, too, by less than a tenth."""
    lamps = Lamps(((2.0, 1.0, 2.5),), radius=0.0)
    lights = [(lamps, torch.full((1, 3), 2.0))]
    lit_by_a_lamp = partial(rendered, named_mesh("apple"), lights=lights, shadows=True)
    vertices = torch.from_numpy(named_mesh("apple").vertices).requires_grad_()
    image = lit_by_a_lamp(FAR, 24, 8, vertices=vertices)
    without = lit_by_a_lamp(FAR, 24, 8, silhouettes=False)
    torch.testing.assert_close(image.detach(), without, rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(smooth_sums(image)[1], vertices)
    right = torch.from_numpy(FAR.axes()[0])
    found = float((gradient @ right).sum())

    shifted_right = smooth_sums(lit_by_a_lamp(replace(FAR, right=0.03), 24, 12))[1]
    shifted_left = smooth_sums(lit_by_a_lamp(replace(FAR, right=-0.03), 24, 12))[1]
    expected = float(shifted_right - shifted_left) / 0.06
    assert found == pytest.approx(expected, rel=0.1)


def box(low: list[float], high: list[float]) -> renderer.Mesh:
    return mesh_of(trimesh.creation.box(bounds=[low, high]))


def table() -> list[renderer.Mesh]:
    parts = [box([-0.9, -0.9, 0.3], [0.9, 0.9, 0.45])]
    for x in (-0.7, 0.7):
        for y in (-0.7, 0.7):
            parts.append(box([x - 0.1, y - 0.1, -0.8], [x + 0.1, y + 0.1, 0.3]))
    return parts


PARTS = {
    "ring": [mesh_of(trimesh.creation.annulus(0.4, 0.8, 1.4, sections=7))],
    "boxes": [box([-0.8, -0.7, -0.6], [0.2, 0.1, 0.3]), box([-0.3, 0.15, -0.5], [0.5, 0.9, 0.6])],
    "table": table(),
}
# Samples per row of a pixel, and the largest relative error.
ERROR_BY_SAMPLES = {2: 0.2, 8: 0.05, 32: 0.015}
# Most samples in a row of an image.
FINEST = 2048


def moves_of_nearest_vertices(mesh: renderer.Mesh) -> Tensor:
    """Return changes that move one of three vertices close to the camera, shape (3, V, 3)."""
    nearest = NEAR.depths(mesh.vertices).argsort()[:12:4]
    moves = torch.zeros(3, *mesh.vertices.shape, dtype=torch.float64)
    for move, vertex in zip(moves, nearest, strict=True):
        move[vertex] = torch.tensor([0.5, 0.7, -0.5])
    return moves


@pytest.mark.slow
@pytest.mark.parametrize("size", [32, 64, 224])
@pytest.mark.parametrize("name", PARTS)
def test_gradients_by_single_vertices_are_differences_if_a_part_hides_another(name, size):
    mesh = concatenate(PARTS[name])
    image = moved_vertices(mesh, NEAR, size, "flat")
    directions = moves_of_nearest_vertices(mesh)
    # The error of differences falls with the square of the step.
    step = min(NEAR.width / size / 2, 0.04)
    coarse = differences(image, directions, FINEST // size, step)
    fine = differences(image, directions, FINEST // size, step / 2)
    expected = (4 * fine - coarse) / 3
    for samples, bound in ERROR_BY_SAMPLES.items():
        if samples * size <= FINEST:
            assert relative_error(derivatives(image, directions, samples), expected) < bound
