"""Operators of single views, compared with plain operations and central differences."""

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw, mesh_of, operator_of, patchwork, square
from torch import Tensor

from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.image import decode, encode
from renderer.operators.apply import TransferOperator
from renderer.settings import ImageSettings

DOUBLE = torch.float64
EPS = torch.finfo(DOUBLE).eps
# The image of this camera has +y to the right and -x up, from -1 to 1.
ABOVE = OrthographicCamera(0, 0, 2.0)
[IN_FRONT] = orbit_cameras(1, 2.2)
SIZE = 6


def test_the_coverage_of_a_square_on_sample_borders_is_its_area_in_each_pixel():
    """The half-width of 5/8 is that of two pixels and a half."""
    operator = operator_of(square(5 / 8), ABOVE, ImageSettings(size=8, samples=4))
    along = [0, 0.5, 1, 1, 1, 1, 0.5, 0]
    coverage = torch.zeros(64)
    coverage[operator.pixels] = operator.coverage
    np.testing.assert_array_equal(coverage.view(8, 8), np.outer(along, along))


COARSE_BALL = trimesh.creation.icosphere(subdivisions=1)
FINE_BALL = trimesh.creation.icosphere(subdivisions=2)
DENTED = patchwork(FINE_BALL.vertices, FINE_BALL.faces)
# Meshes, and samples in each row of a pixel.
LAYOUTS = {
    "one color": (mesh_of(COARSE_BALL, (0.8, 0.4, 0.1)), 3),
    "one sample per pixel": (DENTED, 1),
    "mixed albedos": (DENTED, 3),
    "outside of the image": (square(0.1, center=(20, 0, 0)), 2),
}


def background_of(kind: str, batch: tuple[int, ...]) -> float | Tensor:
    if kind == "gray":
        return 0.3
    if kind == "color":
        return torch.tensor([0.1, 0.5, 0.9])
    shape = batch if kind == "images" else ()
    return draw(*shape, 3, SIZE, SIZE, seed=3).abs().clamp(max=1)


def compose(operator: TransferOperator, lights: Tensor, background: float | Tensor) -> Tensor:
    """Compute images (..., 3, size, size) by plain operations that autograd differentiates."""
    size = operator.settings.size
    encoding = operator.settings.encoding
    behind = torch.as_tensor(background).to(lights)
    if behind.ndim < 2:
        behind = behind.view(-1, 1, 1)
    behind = behind.expand(*lights.shape[:-2], 3, size, size).flatten(-2)
    uncovered = 1 - operator.coverage.to(lights)
    background_radiance = uncovered * decode(behind[..., operator.pixels], encoding)
    reaching = lights[..., operator.nonzero, :].to(operator.transfer.dtype)
    radiance = torch.einsum("...kc,ckp->...cp", reaching, operator.by_channel)
    values = radiance + background_radiance
    images = behind.clone()
    images[..., operator.pixels] = encode(values.clamp(0, 1), encoding)
    return images.unflatten(-1, (size, size))


@pytest.mark.parametrize(
    ("batch", "kind", "encoding"),
    [
        ((), "gray", "linear"),
        ((2, 3), "color", "srgb"),
        ((), "image", "srgb"),
        ((0,), "images", "linear"),
        ((2, 3), "images", "srgb"),
    ],
    ids=str,
)
@pytest.mark.parametrize(("mesh", "samples"), LAYOUTS.values(), ids=LAYOUTS)
def test_image_and_gradient_are_those_of_plain_operations(mesh, samples, batch, kind, encoding):
    """At least a tenth of the values of visible meshes is clamped."""
    operator = operator_of(mesh, IN_FRONT, ImageSettings(SIZE, samples, encoding), dtype=DOUBLE)
    lights = draw(*batch, 49, 3).requires_grad_()
    upstream = draw(*batch, 3, SIZE, SIZE, seed=1)
    background = background_of(kind, batch)
    expected = compose(operator, lights, background)
    is_clamped = (expected == 0) | (expected == 1)
    assert 0 in batch or is_clamped.float().mean() > 0.1 or not len(operator.pixels)
    image = operator.image(lights, background)
    torch.testing.assert_close(image, expected, rtol=0, atol=64 * EPS)
    [expected_gradient] = torch.autograd.grad(expected, lights, upstream)
    [gradient] = torch.autograd.grad(image, lights, upstream)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-12, atol=1e-12)
    without_autograd = operator.image_and_gradient(lights, lambda _: upstream, background)
    assert torch.equal(without_autograd[0], image)
    assert torch.equal(without_autograd[1], gradient)


DARK = torch.zeros(49, 3)


@pytest.mark.parametrize("gray", [0.2, 0.7])
def test_an_image_shows_the_current_values_of_a_background(gray):
    """The memory of the tensor holds other values than in the call before."""
    operator = operator_of(square(0.5), ABOVE, ImageSettings(SIZE, 2))
    memory = np.full((3, SIZE, SIZE), 0.5, dtype=np.float32)
    background = torch.from_numpy(memory)
    operator.image(DARK, background)
    memory[...] = gray
    assert operator.image(DARK, background)[0, 0, 0] == np.float32(gray)


def test_a_change_of_an_image_does_not_change_the_next_one():
    operator = operator_of(square(0.5), ABOVE, ImageSettings(SIZE, 2))
    operator.image(DARK, 0.25).zero_()
    assert operator.image(DARK, 0.25)[0, 0, 0] == 0.25


@pytest.mark.parametrize(
    ("loss_gradient", "argument"),
    [
        (lambda image: image[0], "the result of loss_gradient"),
        (lambda image: image.numpy(), "the result of loss_gradient"),
        (lambda image: image * torch.nan, "image_gradient"),
        (lambda image: torch.full_like(image, torch.inf), "image_gradient"),
    ],
    ids=["another shape", "an array", "NaN", "infinity"],
)
def test_an_invalid_gradient_of_a_loss_is_refused(loss_gradient, argument):
    operator = operator_of(square(0.5), ABOVE, ImageSettings(4, 2))
    with pytest.raises(InputError, match=f"^{argument}"):
        operator.image_and_gradient(0.1 * draw(49, 3).float(), loss_gradient)
