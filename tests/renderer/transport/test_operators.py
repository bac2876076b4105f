import math
import re

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw, mesh_of, patchwork

from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.image import decode, encode
from renderer.light.harmonics import nonzero_coefficients
from renderer.settings import ENCODINGS, ImageSettings
from renderer.transport.operators import build_operators
from renderer.visibility.rasterizers import choose

EPS = torch.finfo(torch.float64).eps
RASTERIZER = choose("numpy")
ABOVE = OrthographicCamera(0, 0, 2.0)  # right is +y, up is -x


def square(half: float, center=(0.0, 0.0, 0.0)) -> Mesh:
    """Facing up."""
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Mesh.plain(corners + center, [[0, 1, 2], [0, 2, 3]])


def test_coverage_of_a_square_on_sample_borders_is_its_area_in_each_pixel():
    """Half-width 5/8 at 8 pixels of 1/4: two pixels' worth and a half on either side of the center."""
    (operator,) = build_operators(square(0.625), [ABOVE], ImageSettings(size=8, samples=4), RASTERIZER)
    along = [0, 0.5, 1, 1, 1, 1, 0.5, 0]
    coverage = torch.zeros(64).index_copy(0, operator.pixels, operator.coverage)
    np.testing.assert_array_equal(coverage.view(8, 8), np.outer(along, along))


def test_the_image_is_upright():
    """From θ = π/2 on the +x side, up is up and right is +y."""
    corners = [[0, 0.5, 0.5], [0, 1, 0.5], [0, 1, 1], [0, 0.5, 1]]
    mesh = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])
    (operator,) = build_operators(mesh, [OrthographicCamera(math.pi / 2, 0, 2.0)], ImageSettings(4, 2), RASTERIZER)
    assert operator.pixels.tolist() == [3]


BALL, FINE = (trimesh.creation.icosphere(subdivisions=count) for count in (1, 2))
DENTED = patchwork(FINE.vertices, FINE.faces)
LAYOUTS = {  # mesh, samples, channels of the transfer
    "one color": (mesh_of(BALL, (0.8, 0.4, 0.1)), 3, 1),
    "one sample per pixel": (DENTED, 1, 1),
    "mixed albedos": (DENTED, 3, 3),
    "empty": (square(0.1, center=(20, 0, 0)), 2, 1),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_radiance_is_linear_in_the_light_with_the_gradient_of_central_differences(layout):
    """In batches of any shape; bands 3 and 5, 18 coefficients, have a gradient of exactly zero."""
    mesh, samples, channels = LAYOUTS[layout]
    settings = ImageSettings(6, samples)
    [operator] = build_operators(mesh, orbit_cameras(1, 2.2), settings, RASTERIZER, dtype=torch.float64)
    assert operator.transfer.shape == (channels, 31, len(operator.pixels)) and operator.transfer.dtype == torch.float64
    for batch in ((0,), (1,), (2, 3)):
        lights = draw(*batch, 49, 3)
        expected = [operator.radiance(light) for light in lights.flatten(0, -3)]
        found = operator.radiance(lights)
        assert found.shape == (*batch, 3, len(operator.pixels))
        for single, values in zip(expected, found.flatten(0, -3), strict=True):
            torch.testing.assert_close(values, single, rtol=0, atol=64 * EPS)

    light, step = draw(49, 3).requires_grad_(True), draw(49, 3, seed=2)
    upstream = draw(3, len(operator.pixels), seed=1)
    (gradient,) = torch.autograd.grad(operator.radiance(light), light, upstream)
    assert torch.equal(operator.light_gradient(upstream), gradient)
    # A step of any length gives the derivative, to the rounding of 31 terms of some 1.
    change = (operator.radiance(light + step) - operator.radiance(light - step)) / 2
    assert (gradient * step).sum().item() == pytest.approx((change * upstream).sum().item(), abs=1e-11)
    unlit = torch.ones(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), False)
    assert unlit.sum() == 18 and not gradient[unlit].any()
    assert gradient[~unlit].all() == (len(operator.pixels) > 0)


@pytest.mark.parametrize("shape", [(36, 3), (49, 1), (49,), (2, 31, 3), (0, 3)])
def test_lights_of_another_degree_are_refused(shape):
    [operator] = build_operators(square(0.5), [ABOVE], ImageSettings(4, 1), RASTERIZER)
    with pytest.raises(InputError, match=rf"lights of shape {re.escape(str(shape))} .* degree 6"):
        operator.radiance(torch.zeros(shape))


def backgrounds_of(kind: str, *lights: int) -> float | torch.Tensor:
    images = draw(*lights, 3, 6, 6, seed=3).abs().clamp(max=1)
    return {"gray": 0.3, "color": torch.tensor([0.1, 0.5, 0.9]), "image": images[(0,) * len(lights)], "images": images}[
        kind
    ]


def composed(operator, lights, background):
    """The image by plain operations, which autograd differentiates."""
    size, encoding = operator.settings.size, operator.settings.encoding
    behind = torch.as_tensor(background).to(lights)
    behind = behind if behind.ndim > 1 else behind.view(-1, 1, 1)
    behind = behind.expand(*lights.shape[:-2], 3, size, size).flatten(-2)
    added = (1 - operator.coverage.to(lights)) * decode(behind[..., operator.pixels], encoding)
    values = (operator.radiance(lights) + added).clamp(0, 1)
    images = behind.clone()
    images[..., operator.pixels] = encode(values, encoding)
    return images.unflatten(-1, (size, size))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("background", ["gray", "color", "image", "images"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_image_and_its_gradients_are_those_of_plain_operations(layout, background, encoding):
    """Of one light and of batches, with and without autograd. A tenth of the values or more is clamped."""
    mesh, samples, _ = LAYOUTS[layout]
    settings = ImageSettings(6, samples, encoding)
    [operator] = build_operators(mesh, orbit_cameras(1, 2.2), settings, RASTERIZER, dtype=torch.float64)
    for batch in ((), (2, 3)):
        lights = draw(*batch, 49, 3).requires_grad_()
        upstream = draw(*batch, 3, 6, 6, seed=1)
        behind = backgrounds_of(background, *batch)
        expected = composed(operator, lights, behind)
        image = operator.image(lights, behind)
        assert ((expected == 0) | (expected == 1)).float().mean() > 0.1 or not len(operator.pixels)
        torch.testing.assert_close(image, expected, rtol=0, atol=8 * EPS)
        [by_plain_operations] = torch.autograd.grad(expected, lights, upstream)
        [gradient] = torch.autograd.grad(image, lights, upstream)
        torch.testing.assert_close(gradient, by_plain_operations, rtol=1e-12, atol=1e-12)
        direct = operator.image_and_gradient(lights, lambda shown, upstream=upstream: upstream, behind)
        assert torch.equal(direct[0], image) and torch.equal(direct[1], gradient)


def test_an_image_is_differentiable_in_its_background():
    [operator] = build_operators(DENTED, orbit_cameras(1, 2.2), ImageSettings(6, 3, "srgb"), RASTERIZER)
    light, behind = draw(49, 3).requires_grad_(), backgrounds_of("image").requires_grad_()
    found, expected = operator.image(light, behind), composed(operator, light, behind)
    for value, other in zip(
        (found, *torch.autograd.grad(found.sum(), (light, behind))),
        (expected, *torch.autograd.grad(expected.sum(), (light, behind))),
        strict=True,
    ):
        torch.testing.assert_close(value, other, rtol=1e-6, atol=1e-6)


def test_an_image_shows_the_background_as_it_is_now():
    """Also where the same tensor, or the memory behind it, holds other values than in the call before."""
    [operator] = build_operators(square(0.5), [ABOVE], ImageSettings(6, 2), RASTERIZER)
    memory = np.full((3, 6, 6), 0.2, dtype=np.float32)
    behind, light = torch.from_numpy(memory), torch.zeros(49, 3)
    for gray in (0.2, 0.7):
        memory[...] = gray
        assert operator.image(light, behind)[0, 0, 0] == memory[0, 0, 0]
        assert operator.image(light, gray)[0, 0, 0] == memory[0, 0, 0]
    assert operator.image(light.double(), 0.75)[0, 0, 0] == 0.75
    before = operator.image(light, 0.2)
    before.zero_()
    assert operator.image(light, 0.2)[0, 0, 0] == np.float32(0.2)


def test_a_step_without_autograd_takes_any_loss_and_refuses_a_gradient_of_another_shape_or_nan():
    [operator] = build_operators(square(0.5), [ABOVE], ImageSettings(4, 2), RASTERIZER)
    light, target = 0.1 * draw(49, 3).float(), torch.full((3, 4, 4), 0.4)

    def loss(image):
        return (image - target).square().sum()

    variable = light.clone().requires_grad_()
    image = operator.image(variable)
    [expected] = torch.autograd.grad(loss(image), variable)
    shown, gradient = operator.image_and_gradient(variable, lambda image: 2 * (image - target))
    assert torch.equal(shown, image) and torch.equal(gradient, expected) and not gradient.requires_grad
    with pytest.raises(InputError, match=r"loss_gradient returned \(4, 4\): .* \(3, 4, 4\)"):
        operator.image_and_gradient(light, lambda image: image[0])
    with pytest.raises(InputError, match="image_gradient holds NaN"):
        operator.image_and_gradient(light, lambda image: image * torch.nan)
    with pytest.raises(InputError, match="image_gradient holds NaN"):
        torch.autograd.grad(operator.image(variable), variable, torch.full_like(image, torch.inf))


def test_the_gradient_of_an_image_is_differentiated_once():
    [operator] = build_operators(square(0.5), [ABOVE], ImageSettings(4, 2), RASTERIZER)
    light = (0.1 * draw(49, 3)).requires_grad_()
    [gradient] = torch.autograd.grad(operator.image(light).square().sum(), light, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()
