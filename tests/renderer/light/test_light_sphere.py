"""The image of a light: closed forms, and the renderer's image of a ball."""

import math

import pytest
import torch
import trimesh

from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.image import encode
from renderer.light.basis import HARMONICS, SumBasis
from renderer.light.light_sphere import light_sphere
from renderer.light.local import Lamps
from renderer.light.presets import ambient, probe
from renderer.mesh import Mesh
from renderer.rendering import render

EPS32 = torch.finfo(torch.float32).eps


def disc(size: int) -> torch.Tensor:
    """The pixels (size, size) that lie in the ball's outline whole, by their corner farthest from the middle."""
    farthest = ((torch.arange(size) + 0.5) * 2 / size - 1).abs() + 1 / size
    return farthest[:, None] ** 2 + farthest**2 < 1


def test_even_light_gives_an_even_disc_on_white():
    color = torch.tensor([0.1, 0.4, 0.9])
    image = light_sphere(ambient(color), 64)
    assert image.shape == (3, 64, 64) and image.dtype == torch.float32
    expected = encode(color.double(), "srgb").float()
    torch.testing.assert_close(
        image[:, disc(64)], expected[:, None].expand(3, int(disc(64).sum())), rtol=0, atol=8 * EPS32
    )
    assert (image[:, ::63, ::63] == 1).all()


@pytest.mark.parametrize("name", ["grace", "eucalyptus"])
def test_the_image_is_that_of_a_rendered_white_ball(name):
    """At the same samples. Edges of 0.018 leave the faces 0.018² / 8 inside the ball, at cosines above 0.28: normals
    are off by 1.5e-4. Irradiance / π grows by less than 1 in a radian, and sRGB's slope is 2.5 at 0.02."""
    ball = trimesh.creation.icosphere(subdivisions=6)
    camera, light, inside = orbit_cameras(3, 2.0)[1], probe(name).double(), disc(48)
    mesh = Mesh.plain(ball.vertices, ball.faces)
    [image] = render(mesh, camera, light, 48, albedo_scale=1 / math.pi, encoding="srgb", rasterizer="numpy")
    expected = image[:, inside].float()
    assert expected.min() > encode(torch.tensor(0.02), "srgb")
    torch.testing.assert_close(light_sphere(light, 48, camera)[:, inside], expected, rtol=0, atol=2.5 * 1.5e-4)


def test_lamps_add_their_inverse_squares_to_the_environment_light():
    """c · cos / d² at each of a pixel's four samples, which are averaged before the encoding."""
    position, power, size = torch.tensor([0.3, -0.4, 2.5]).double(), torch.tensor([0.5, 1.0, 2.0]).double(), 32
    light = torch.cat([ambient(torch.full((3,), 0.1)), power[None].float()])
    basis = SumBasis((HARMONICS, Lamps((tuple(position.tolist()),))))
    image = light_sphere(light, size, OrthographicCamera(0.0, 0.0, 2.0), basis)
    at = (torch.arange(2 * size).double() + 0.5) / size - 1
    right, up = at.expand(2 * size, -1), -at[:, None].expand(-1, 2 * size)
    back = (1 - right**2 - up**2).clamp(min=0).sqrt()
    normal = torch.stack([-up, right, back])  # from above, +y is to the right and -x is up
    toward = position[:, None, None] - normal
    arriving = ((toward * normal).sum(0) / toward.norm(dim=0) ** 3).clamp(min=0)
    expected = 0.1 + power[:, None, None] * torch.nn.functional.avg_pool2d(arriving[None, None], 2)[0]
    inside = disc(size)
    assert expected[:, inside].std() > 0.05
    torch.testing.assert_close(
        image[:, inside], encode(expected.clamp(max=1), "srgb").float()[:, inside], rtol=0, atol=1e-6
    )
