"""Tables and walls that have no triangles are lit and shadowed as meshes are."""

import math

import numpy as np
import pytest
import torch

import renderer
from augment.scene import tabletop
from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.light.basis import HARMONICS
from renderer.light.files import ambient, probe
from renderer.light.lamps import Lamps
from renderer.mesh import Mesh, concatenate, normalize
from renderer.operators.rays import Rays
from renderer.settings import ImageSettings
from renderer.solids import sphere

SIZE = 24
FAR = 1000.0
BALL = normalize(renderer.solid("ball"))
CAMERAS = {
    "perspective": PerspectiveCamera(63.0, 22.9, 3.0, 0.1, -0.2, distance=7.0),
    "parallel": OrthographicCamera(63.0, 22.9, 3.0, 0.1, -0.2),
}
each_camera = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
each_surface = pytest.mark.parametrize(
    ("surface", "camera"), [*zip(("table", "wall"), CAMERAS.values(), strict=True)]
)


def square(middle: list[float], first: list[float], second: list[float]) -> Mesh:
    x = 6 * np.array(first)
    y = 6 * np.array(second)
    corners = np.add(middle, [-x - y, x - y, x + y, y - x])
    return Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])


def place(surface: str, camera: Camera, height: float) -> tuple[float, float, Mesh]:
    """Return the height of a table, the distance of a wall, and a mesh of the one in sight."""
    azimuth = math.radians(camera.azimuth)
    towards = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    aside = [-towards[1], towards[0], 0.0]
    if surface == "table":
        return height, 50.0, square([0, 0, height], [1, 0, 0], [0, 1, 0])
    return -50.0, 1.5, square(list(-1.5 * towards), aside, [0, 0, 1])


RENDERED = {"size": SIZE, "samples": 3, "normals": "flat", "shadows": True, "background": 0.0}
RENDERED["rasterizer"] = "numpy"


def require_close(
    surface, camera, mean, typical, sky=None, lamps=(), light=(), scale=1.0, mesh=BALL, height=-1.0
) -> None:
    """Compare the irradiance of a table or a wall with that of a mesh, at the pixels that show it.

    Errors, in the mean and of 98 % of the pixels, are below fractions of the largest irradiance.
    """
    table_height, wall, flat_mesh = place(surface, camera, height)
    camera = camera.with_clip_range(9.0)
    even = ambient(torch.full((3,), 0.2))
    ball = renderer.render(mesh, camera, even, **RENDERED)[0]
    flat = renderer.render(flat_mesh, camera, even, **RENDERED)[0]
    is_surface = (ball == 0) & (flat > 0.999 * flat.max())
    both = concatenate([mesh, flat_mesh])
    expected = renderer.render(both, camera, sky, lights=list(lamps), **RENDERED).double()
    around = tabletop.Room(Rays(mesh), 1.8, table_height, wall)
    image = ImageSettings(SIZE, samples=3)
    found = scale * tabletop.irradiance(around, camera, image, *light)
    largest = expected[:, is_surface].max()
    assert largest < 1
    assert expected[:, is_surface].min() < 0.6 * largest  # A shadow is in sight.
    errors = (found - expected)[:, is_surface].abs()
    assert errors.mean() < mean * largest
    assert errors.quantile(0.98) < typical * largest


@each_surface
def test_table_and_wall_are_lit_by_a_sky_as_meshes_are(surface, camera):
    """The room has 48 directions of the sky, at every second pixel."""
    sky = probe("grace").double() / 5
    light = sky, torch.zeros(3).double()
    require_close(surface, camera, mean=0.02, typical=0.07, sky=sky, light=light)


# A square plate with a side of 1.6, which hovers above a table.
PLATE = square([0, 0, 0], [2 / 15, 0, 0], [0, 2 / 15, 0])
SHADED = [
    (surface, camera, BALL, -1.0)
    for surface, camera in zip(("table", "wall"), CAMERAS.values(), strict=True)
]
LOW = OrthographicCamera(80.0, 22.9, 3.0)


@pytest.mark.parametrize(
    ("surface", "camera", "mesh", "height"), [*SHADED, ("table", LOW, PLATE, -0.15)]
)
def test_table_and_wall_are_lit_by_a_far_lamp_as_meshes_are(surface, camera, mesh, height):
    """Only the edge of the shadow differs. The plate shades points that are within its radius."""
    direction = torch.nn.functional.normalize(torch.tensor([0.5, 0.1, 0.8]).double(), dim=0)
    position = tuple((FAR * direction).tolist())
    power = torch.full((1, 3), 0.1 * FAR**2).double()
    lamps = [(Lamps((position,), 1e5), power)]
    light = (torch.zeros(49, 3).double(), direction)
    require_close(surface, camera, 0.01, 0.02, None, lamps, light, 0.1, mesh, height)


def distance_to_pixel(camera: Camera, points: np.ndarray) -> np.ndarray:
    middles = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    pixels = np.stack(np.meshgrid(middles, -middles), axis=-1)
    projected = camera.project(points.reshape(3, -1).T)[:, :2]
    return np.abs(projected.reshape(SIZE, SIZE, 2) - pixels).max(axis=-1)


@each_camera
def test_light_from_above_meets_a_ball_and_its_table_at_their_own_x_and_y(camera):
    """The camera sees the middle of the pixel at the height of the unit sphere or the table."""
    ball = Mesh.plain(*sphere(5))
    around = tabletop.Room(Rays(ball), 1.0, -1.0, 50.0)
    down = torch.tensor([0.0, 0.0, 1.0]).double()
    placed = tabletop.project_along_light(around, ball, camera, ImageSettings(SIZE), down).numpy()
    y = placed[0] * camera.width / 2
    # Seen along the light with y to the right, x points down, as in `pixel_centers`.
    x = placed[1] * camera.width / 2

    even = ambient(torch.ones(3))
    shown = renderer.render(ball, camera, even, SIZE, 0.0, samples=1)[0].numpy()
    is_ball = shown > 0
    assert 0.2 < is_ball.mean() < 0.8
    table = np.stack([x, y, np.full_like(x, -1.0)])
    assert distance_to_pixel(camera, table)[~is_ball].max() < 1e-6
    bulge = np.sqrt(np.clip(1 - x**2 - y**2, 0, None))
    upper_half = np.stack([x, y, bulge])
    lower_half = np.stack([x, y, -bulge])
    on_upper_half = distance_to_pixel(camera, upper_half)
    on_lower_half = distance_to_pixel(camera, lower_half)
    on_ball = np.minimum(on_upper_half, on_lower_half)
    # The sphere has faces, so that points are off by up to a quarter of a pixel.
    assert on_ball[is_ball].max() < 0.5 / SIZE


TILTS = torch.tensor([0.0, 0.5, 1.5, 2.5, 3.1]).double()


@pytest.mark.parametrize(
    ("albedo", "expected"),
    [(1.0, math.pi * torch.ones_like(TILTS)), (0.0, math.pi * (1 + TILTS.cos()) / 2)],
    ids=["white", "black"],
)
def test_an_even_sky_above_a_table_lights_tilted_surfaces_as_in_closed_form(albedo, expected):
    """A surface tilted by an angle sees (1 + cos) / 2 of the sky. White reflects all it gets."""
    sky = ambient(torch.ones(3)).double()[None]
    light = tabletop.above_table(sky, torch.zeros(1, 3), torch.full((1, 3), albedo))[0]
    normals = torch.stack([TILTS.sin(), torch.zeros_like(TILTS), TILTS.cos()], dim=1)
    irradiance = HARMONICS.irradiance(normals) @ light[HARMONICS.nonzero]
    torch.testing.assert_close(irradiance, expected[:, None].expand(-1, 3), rtol=0, atol=0.03)


def test_a_table_reflects_directional_light_by_its_albedo_and_the_cosine():
    no_sky = torch.zeros(1, 49, 3).double()
    direction = torch.tensor([[0.6, 0.0, 0.8]])
    light = tabletop.above_table(no_sky, direction, torch.full((1, 3), 0.5))[0]
    down = torch.tensor([[0.0, 0.0, -1.0]]).double()
    irradiance = HARMONICS.irradiance(down) @ light[HARMONICS.nonzero]
    expected = torch.full((1, 3), 0.5 * 0.8).double()
    torch.testing.assert_close(irradiance, expected, rtol=0, atol=0.01)
