"""Conversion of radiance to image values."""

import numpy as np
import pytest
import torch
from oracles import linear_of, srgb_of
from torch import Tensor

from renderer.image import background_term, decode, encode, tonemap
from renderer.settings import ENCODINGS

EPS = torch.finfo(torch.float64).eps
# Linear value at which the sRGB curve changes from a line to a power.
KNEE = 0.0031308


def pixel(*rgb: float) -> Tensor:
    return torch.tensor(rgb, dtype=torch.float64)[:, None]


def test_the_surface_covers_the_background_in_linear_light():
    image = tonemap(pixel(0.1, 0.2, 0.3), pixel(0.25), pixel(0.4))
    torch.testing.assert_close(image, pixel(0.4, 0.5, 0.6), rtol=4 * EPS, atol=0)

    image = tonemap(pixel(0.1, 0.2, 0.3), pixel(0.25), pixel(0.5), "srgb")
    linear = np.array([0.1, 0.2, 0.3]) + 0.75 * linear_of(0.5)
    torch.testing.assert_close(image, pixel(*srgb_of(linear)), rtol=8 * EPS, atol=0)


def test_the_clamp_comes_after_the_sum_with_the_background():
    """If the radiance were clamped before the sum, the first two channels would be 0.5."""
    image = tonemap(pixel(0.75, -0.2, 1.25), pixel(0.5), pixel(0, 1, 1), "srgb")
    expected = pixel(*srgb_of([0.75, 0.3, 1.0]))
    torch.testing.assert_close(image, expected, rtol=8 * EPS, atol=0)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_background_is_unchanged_if_nothing_covers_it(encoding):
    grays = torch.linspace(0, 1, 256).view(256, 1, 1)
    images = tonemap(torch.zeros(1, 3, 1), torch.zeros(1, 1, 1), grays, encoding)
    # Powers have errors of about 4 eps, which the curve multiplies by up to 2.4.
    tolerance = 0 if encoding == "linear" else 16 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(images, grays.expand(-1, 3, 1), rtol=0, atol=tolerance)


def test_encoding_and_decoding_are_the_srgb_standards():
    values = [*np.linspace(0, 1, 1001), 0.0031308, 0.00313081, 0.04045, 0.04046]
    inputs = torch.tensor(values, dtype=torch.float64)
    encoded = encode(inputs, "srgb")
    decoded = decode(inputs, "srgb")
    np.testing.assert_allclose(encoded, srgb_of(values), rtol=4 * EPS, atol=EPS)
    np.testing.assert_allclose(decoded, linear_of(values), rtol=8 * EPS)
    # These are the published values for 0.5.
    assert encoded[500] == pytest.approx(0.735356983052449)
    assert decoded[500] == pytest.approx(0.214041140482232)


@pytest.mark.parametrize(("function", "slope_at_black"), [(encode, 12.92), (decode, 1 / 12.92)])
def test_the_gradient_of_an_srgb_curve_is_finite_at_black(function, slope_at_black):
    black = torch.zeros(1, requires_grad=True)
    (gradient,) = torch.autograd.grad(function(black, "srgb"), black)
    assert gradient.item() == pytest.approx(slope_at_black)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_gradients_by_radiance_coverage_and_background_are_central_differences(encoding):
    """Values lie below, within and above [0, 1], and not near the kinks of clamp and curve."""
    draws = torch.Generator().manual_seed(0)
    radiance = torch.rand(2, 3, 20, generator=draws, dtype=torch.float64) * 3 - 1
    coverage = torch.rand(2, 1, 20, generator=draws, dtype=torch.float64)
    background = torch.rand(3, 1, generator=draws, dtype=torch.float64)
    linear = radiance + (1 - coverage) * decode(background, encoding)
    assert (linear < 0).any()
    assert (linear > 1).any()
    for kink in (0, KNEE, 1):
        assert (linear - kink).abs().min() > 1e-4
    inputs = [tensor.requires_grad_(True) for tensor in (radiance, coverage, background)]
    assert torch.autograd.gradcheck(lambda *scene: tonemap(*scene, encoding), inputs)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("coverage, background", [(1.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.5, 1.0)])
def test_only_values_outside_the_range_have_no_gradient(encoding, coverage, background):
    """Black and white themselves have a gradient, so that a light of zero can grow."""
    radiance = torch.tensor([[-0.3, 0, 0.2, 1, 1.4]], dtype=torch.float64, requires_grad=True)
    linear = radiance + background_term(pixel(coverage), pixel(background), encoding)
    is_outside = (linear < 0) | (linear > 1)
    image = tonemap(radiance, pixel(coverage), pixel(background), encoding)
    (gradient,) = torch.autograd.grad(image.sum(), radiance)
    assert gradient.isfinite().all()
    assert torch.equal(is_outside, gradient == 0)
    if background == 0:
        assert is_outside.tolist() == [[True, False, False, False, True]]
