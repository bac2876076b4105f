import numpy as np
import pytest
import torch
from oracles import linear_of, srgb_of

from renderer.image import background_term, decode, encode, tonemap
from renderer.settings import ENCODINGS

EPS = torch.finfo(torch.float64).eps


def pixel(*rgb: float) -> torch.Tensor:
    return torch.tensor(rgb, dtype=torch.float64)[:, None]


def one(value: float) -> torch.Tensor:
    return torch.full((1, 1), value, dtype=torch.float64)


def test_the_surface_covers_the_background_in_linear_light_and_the_clamp_comes_last():
    image = tonemap(pixel(0.1, 0.2, 0.3), one(0.25), one(0.4))
    torch.testing.assert_close(image, pixel(0.4, 0.5, 0.6), rtol=4 * EPS, atol=0)
    image = tonemap(pixel(0.1, 0.2, 0.3), one(0.25), one(0.5), "srgb")
    expected = pixel(*srgb_of(np.array([0.1, 0.2, 0.3]) + 0.75 * linear_of(0.5)))
    torch.testing.assert_close(image, expected, rtol=8 * EPS, atol=0)
    # Half a pixel at radiance 1.5, -0.4 and 2.5: clamped before compositing, the first two would be 0.5 and 0.5.
    image = tonemap(pixel(0.75, -0.2, 1.25), one(0.5), pixel(0, 1, 1), "srgb")
    torch.testing.assert_close(image, pixel(*srgb_of([0.75, 0.3, 1.0])), rtol=8 * EPS, atol=0)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_background_comes_back_where_nothing_covers_it(encoding):
    grays = torch.linspace(0, 1, 256).view(256, 1, 1)
    images = tonemap(torch.zeros(1, 3, 1), torch.zeros(1, 1, 1), grays, encoding)
    # Exactly as it stands; through sRGB and back in float32, powers of some 4 ulps each, multiplied by up to 2.4.
    tolerance = 0 if encoding == "linear" else 16 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(images, grays.expand(-1, 3, 1), rtol=0, atol=tolerance)


def test_encoding_and_decoding_are_the_srgb_standards():
    values = [*np.linspace(0, 1, 1001), 0.0031308, 0.00313081, 0.04045, 0.04046]
    encoded, decoded = (function(torch.tensor(values, dtype=torch.float64), "srgb") for function in (encode, decode))
    np.testing.assert_allclose(encoded, srgb_of(values), rtol=4 * EPS, atol=EPS)
    np.testing.assert_allclose(decoded, linear_of(values), rtol=8 * EPS)
    assert encoded[500] == pytest.approx(0.735356983052449) and decoded[500] == pytest.approx(0.214041140482232)


@pytest.mark.parametrize("function", [encode, decode])
def test_the_gradient_of_an_srgb_curve_is_its_derivative_and_finite_at_black(function):
    inputs = torch.tensor([1e-4, 0.003, 0.0032, 0.04, 0.041, 0.5, 0.99], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda values: function(values, "srgb"), inputs)
    black = torch.zeros(1, requires_grad=True)
    (gradient,) = torch.autograd.grad(function(black, "srgb"), black)
    assert gradient.item() == pytest.approx({encode: 12.92, decode: 1 / 12.92}[function])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_gradients_by_radiance_coverage_and_background_are_central_differences(encoding):
    """Below, within and above the range, each at some distance from its ends, where the clamp has a kink."""
    draws = torch.Generator().manual_seed(0)
    radiance = torch.rand(2, 3, 20, generator=draws, dtype=torch.float64) * 3 - 1
    coverage = torch.rand(2, 1, 20, generator=draws, dtype=torch.float64)
    background = torch.rand(3, 1, generator=draws, dtype=torch.float64)
    composite = radiance + (1 - coverage) * decode(background, encoding)
    assert (composite < 0).any() and (composite > 1).any()
    assert min(composite.abs().min(), (composite - 1).abs().min(), (composite - 0.0031308).abs().min()) > 1e-4
    inputs = [tensor.requires_grad_(True) for tensor in (radiance, coverage, background)]
    assert torch.autograd.gradcheck(lambda *scene: tonemap(*scene, encoding), inputs)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_only_clamped_values_have_no_gradient(encoding):
    """Black and white themselves have one, so that a light of zero can grow."""
    radiance = pixel(-0.3, 0, 0.2, 1, 1.4).T.contiguous().requires_grad_(True)
    for coverage, background in ((1.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.5, 1.0)):
        scene = radiance, one(coverage), one(background)
        composite = radiance + background_term(*scene[1:], encoding)
        beyond = (composite < 0) | (composite > 1)
        (gradient,) = torch.autograd.grad(tonemap(*scene, encoding).sum(), radiance)
        assert gradient.isfinite().all() and torch.equal(beyond, gradient == 0)
        if background == 0:
            assert beyond.flatten().tolist() == [True, False, False, False, True]
