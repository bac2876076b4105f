import math

import numpy as np
import pytest
import torch

import renderer
from augment.scene import tabletop
from renderer.camera import OrthographicCamera, PerspectiveCamera
from renderer.geometry.mesh import Mesh, concatenate, normalize
from renderer.geometry.shapes import sphere
from renderer.light.basis import HARMONICS
from renderer.light.lamps import Lamps
from renderer.light.presets import ambient, probe
from renderer.settings import ImageSettings
from renderer.transport.rays import Rays

SIZE, FAR = 32, 1000.0
BALL = normalize(renderer.solid("ball"))
CAMERAS = (
    PerspectiveCamera(63.0, 22.9, 3.0, 0.1, -0.2, distance=7.0),
    OrthographicCamera(63.0, 22.9, 3.0, 0.1, -0.2),
)
LAMP = torch.nn.functional.normalize(torch.tensor([0.5, 0.1, 0.8]).double(), dim=0)
SKY, NONE = probe("grace").double() / 5, torch.zeros(3).double()


def square(middle: list[float], first: list[float], second: list[float]) -> Mesh:
    corners = [
        np.add(middle, 6 * (a * np.array(first) + b * np.array(second)))
        for a, b in [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    ]
    return Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("camera", CAMERAS, ids=["perspective", "parallel"])
@pytest.mark.parametrize("surface", ["table", "wall"])
def test_table_and_wall_are_lit_and_shadowed_as_meshes_are(camera, surface):
    towards = [math.cos(math.radians(camera.azimuth)), math.sin(math.radians(camera.azimuth)), 0.0]
    aside = [-towards[1], towards[0], 0.0]
    if surface == "table":
        height, wall, mesh = -1.0, 50.0, square([0, 0, -1], [1, 0, 0], [0, 1, 0])
    else:
        height, wall, mesh = -50.0, 1.5, square([-1.5 * x for x in towards], aside, [0, 0, 1])
    options = {
        "size": SIZE,
        "samples": 3,
        "normals": "flat",
        "shadows": True,
        "background": 0.0,
        "rasterizer": "numpy",
    }
    even, camera = ambient(torch.full((3,), 0.2)), camera.seeing(9.0)
    ball, flat = (renderer.render(part, camera, even, **options)[0, 0] for part in (BALL, mesh))
    compared = (ball == 0) & (flat > 0.999 * flat.max())
    lamp = [
        (Lamps((tuple((FAR * LAMP).tolist()),), 1e5), torch.full((1, 3), 0.1 * FAR**2).double())
    ]
    both, image = concatenate([BALL, mesh]), ImageSettings(SIZE, samples=3)
    around = tabletop.Room(Rays(BALL), 1.8, height, wall)
    for light, lights, ours in [(SKY, [], (SKY, NONE)), (None, lamp, (0 * SKY, LAMP))]:
        there = renderer.render(both, camera, light, lights=lights, **options)[0].double()
        seen = tabletop.irradiance(around, camera, image, *ours) * (0.1 if lights else 1)
        seen, expected = seen[:, compared], there[:, compared]
        most, errors = expected.max(), (seen - expected).abs()
        assert most < 1 and expected.min() < 0.6 * most  # a shadow is in sight
        mean, typical = (
            (0.01, 0.02) if lights else (0.02, 0.07)
        )  # an edge; 48 directions, at every second pixel
        assert errors.mean() < mean * most and errors.quantile(0.98) < typical * most


@pytest.mark.parametrize("camera", CAMERAS, ids=["perspective", "parallel"])
def test_light_from_above_meets_a_ball_and_its_table_at_their_own_x_and_y(camera):
    """In closed form: with the height of the unit sphere or of the table there, the camera sees the pixel's middle."""
    ball, image = Mesh.plain(*sphere(5)), ImageSettings(SIZE)
    around = tabletop.Room(Rays(ball), 1.0, -1.0, 50.0)
    placed = tabletop.project_along_light(
        around, ball, camera, image, torch.tensor([0.0, 0.0, 1.0]).double()
    )
    y, x = np.array([1, -1])[:, None, None] * placed.numpy() * camera.width / 2
    bulge = np.sqrt(np.clip(1 - x**2 - y**2, 0, None))
    on_ball = (
        renderer.render(ball, camera, ambient(torch.ones(3)), SIZE, 0.0, samples=1)[0, 0].numpy()
        > 0
    )
    middles = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    pixels, off = np.stack(np.meshgrid(middles, -middles), axis=-1), []
    for height in (bulge, -bulge, np.full_like(x, -1.0)):
        seen = camera.project(np.stack([x, y, height], axis=-1).reshape(-1, 3))[:, :2].reshape(
            SIZE, SIZE, 2
        )
        off.append(np.abs(seen - pixels).max(axis=-1))
    assert 0.2 < on_ball.mean() < 0.8 and off[2][~on_ball].max() < 1e-6
    assert (
        np.minimum(off[0], off[1])[on_ball].max() < 0.5 / SIZE
    )  # a quarter of a pixel: the sphere has faces


def test_an_even_sky_stays_even_on_a_white_table_and_loses_its_lower_half_on_a_black_one():
    """White reflects what it gets. In closed form, a surface tilted by an angle gets (1 + cos) / 2 of the sky."""
    light, tilts = ambient(torch.ones(3)).double(), torch.tensor([0.0, 0.5, 1.5, 2.5, 3.1]).double()
    normals = torch.stack([tilts.sin(), 0 * tilts, tilts.cos()], dim=1)
    white, black = tabletop.above_table(
        light.expand(2, -1, -1), torch.zeros(2, 3), torch.tensor([1.0, 0.0])[:, None].expand(2, 3)
    )
    for lights, expected in [
        (white, 0 * tilts + math.pi),
        (black, math.pi * (1 + tilts.cos()) / 2),
    ]:
        arriving = HARMONICS.irradiance(normals) @ lights[HARMONICS.nonzero]
        torch.testing.assert_close(arriving, expected[:, None].expand(-1, 3), rtol=0, atol=0.03)
    lit = tabletop.above_table(
        0 * light[None], torch.tensor([[0.6, 0.0, 0.8]]), torch.full((1, 3), 0.5)
    )[0]
    down = HARMONICS.irradiance(torch.tensor([[0.0, 0.0, -1.0]]).double()) @ lit[HARMONICS.nonzero]
    torch.testing.assert_close(down, torch.full((1, 3), 0.5 * 0.8).double(), rtol=0, atol=0.01)
