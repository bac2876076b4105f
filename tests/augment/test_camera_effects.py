import math

import pytest
import torch
from scipy.ndimage import gaussian_filter

from augment.camera_effects import CameraEffects, CameraEffectSettings, draw_camera_effects, draw_patterns
from augment.utils import generator
from renderer.errors import InputError
from renderer.image import ImageSettings, decode, encode

SIZE, COUNT = 12, 40
IMAGES = torch.rand(COUNT, 2, 3, SIZE, SIZE, generator=generator(0), dtype=torch.float64)
EVERY = torch.arange(COUNT)


def photographed(images=IMAGES, examples=EVERY, encoding="srgb", **settings) -> torch.Tensor:
    image = ImageSettings(SIZE, encoding=encoding)
    return draw_camera_effects(CameraEffectSettings(**settings), COUNT, image, generator(1))(images, examples)


def test_without_effects_the_render_is_unchanged():
    torch.testing.assert_close(photographed(), IMAGES, rtol=0, atol=1e-6)  # the draws are single precision


def test_a_pattern_multiplies_the_light_of_object_and_background():
    ratio = decode(photographed(pattern_fraction=1.0, pattern_fill=[0.2, 0.2]), "srgb") / decode(IMAGES, "srgb")
    torch.testing.assert_close(ratio[:, 0], ratio[:, 1], rtol=1e-5, atol=0)
    assert 0.2 - 1e-5 <= ratio.min() < 0.25 and 0.99 < ratio.max() <= 1 + 1e-5
    untouched = (photographed(pattern_fraction=0.5) == photographed()).flatten(1).all(1).double().mean()
    assert 0.3 < untouched < 0.7


def test_white_balance_is_a_gain_of_each_channel_in_stops():
    dark = encode(decode(IMAGES, "srgb") / 4, "srgb")
    stops = (decode(photographed(dark, white_balance=1.0), "srgb") / decode(dark, "srgb")).log2().flatten(3)
    torch.testing.assert_close(stops, stops[..., :1].expand_as(stops), rtol=0, atol=1e-4)
    assert -1.001 < stops.min() < -0.8 and 0.8 < stops.max() < 1.001


def test_a_blur_is_scipys_gaussian_of_the_linear_light():
    blur = torch.linspace(0.3, 1.2, COUNT)
    effects = CameraEffects(torch.ones(COUNT, 3, 1, 1), blur, torch.zeros(COUNT, 3, SIZE, SIZE), "srgb")
    light = decode(effects(IMAGES, EVERY), "srgb")
    for index in range(0, COUNT, 13):
        sharp, sigma = decode(IMAGES[index], "srgb").numpy(), (0, 0, float(blur[index]), float(blur[index]))
        expected = gaussian_filter(sharp, sigma, mode="nearest", radius=(0, 0, 3, 3))
        torch.testing.assert_close(light[index], torch.from_numpy(expected), rtol=0, atol=1e-5)


def test_noise_differs_in_deviation_from_image_to_image():
    gray = torch.full_like(IMAGES, 0.5)
    deviations = (photographed(gray, noise=0.1) - gray).flatten(1).std(1)
    assert deviations.max() < 0.12 and deviations.min() < 0.03 and 0.035 < deviations.mean() < 0.065


def test_examples_in_any_order_have_the_same_effects():
    settings = {"pattern_fraction": 1.0, "white_balance": 0.5, "blur": 1.0, "noise": 0.05}
    some = torch.tensor([7, 3])
    expected = photographed(**settings)[some]
    torch.testing.assert_close(photographed(IMAGES[some], some, **settings), expected, rtol=0, atol=1e-12)
    image = IMAGES[:1, :1].clone().requires_grad_(True)
    assert torch.autograd.grad(photographed(image, EVERY[:1], **settings).sum(), image)[0].abs().max() > 0.01


@pytest.mark.parametrize(
    ("name", "value"), [("pattern_fraction", 1.5), ("blur", -1.0), ("noise", math.nan), ("pattern_fill", [0.5, 0.2])]
)
def test_settings_beyond_their_range_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        CameraEffectSettings(**{name: value})


def test_a_pattern_has_at_most_two_colors_and_its_brighter_one_is_full():
    patterns = draw_patterns(200, 24, generator(0))
    assert patterns.shape == (200, 3, 24, 24) and patterns.min() >= 0 and patterns.max() <= 1
    assert {len(pattern.flatten(1).unique(dim=1).T) for pattern in patterns} == {1, 2}
    assert (patterns.amax((1, 2, 3)) == 1).double().mean() > 0.9  # a half may leave the bright side out
