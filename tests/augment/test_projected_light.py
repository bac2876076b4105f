"""Light of a projector on photographs, against hand computations."""

import math

import numpy as np
import torch

from augment.projected_light import (
    ProjectedLight,
    draw_projected_light,
    draw_shading,
    relight_photographs,
)
from augment.random_streams import generator
from augment.scene.patterns import draw_cells
from renderer.image import LUMINANCE, encode

SIZE = 12


def srgb_to_linear(values):
    """Decode sRGB with NumPy, by the formula of IEC 61966-2-1."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def random_photographs(count=3, size=SIZE):
    """Draw photographs of random pixels."""
    draws = torch.Generator().manual_seed(7)
    return torch.randint(0, 256, (count, 3, size, size), dtype=torch.uint8, generator=draws)


def plain_light(count=1):
    """Return white light on a flat surface, without ambient light."""
    shape = (count, 1, SIZE, SIZE)
    zero = torch.zeros(count, 1, 1, 1)
    return ProjectedLight(torch.ones(count, 3, SIZE, SIZE), torch.ones(shape), zero, zero)


def test_white_light_leaves_a_photograph_as_it_is():
    photographs = random_photographs().float() / 255
    relit = plain_light(3).apply(photographs)
    torch.testing.assert_close(relit, photographs, atol=1e-6, rtol=0)


def test_a_camera_sees_albedo_times_light_at_its_exposure():
    photographs = random_photographs(2).float() / 255
    light = draw_projected_light(2, SIZE, generator(0))
    log_gain = torch.linspace(-1, 1, 2 * 3).view(2, 3, 1, 1)
    relit = light.apply(photographs, log_gain)

    albedo = srgb_to_linear(photographs.double().numpy())
    gain = np.exp(log_gain.double().numpy())
    slide = light.slide.double().numpy() * gain * light.shading.double().numpy()
    radiance = albedo * (slide + light.ambient.double().numpy())
    weights = np.array(LUMINANCE)[:, None, None]
    wanted = (albedo * weights).sum(1).mean((1, 2)) * 2 ** light.stops.double().numpy().ravel()
    given = (radiance * weights).sum(1).mean((1, 2))
    exposed = radiance * (wanted / given)[:, None, None, None]
    expected = encode(torch.from_numpy(exposed.clip(0, 1)), "srgb")
    torch.testing.assert_close(relit.double(), expected, atol=1e-5, rtol=0)


def test_light_is_linear_in_the_slide():
    first = draw_projected_light(1, SIZE, generator(1))
    second = draw_projected_light(1, SIZE, generator(2))
    shading = first.shading
    zero = torch.zeros(1, 1, 1, 1)
    lights = []
    for slide in (first.slide, second.slide, 0.3 * first.slide + 2 * second.slide):
        lights.append(ProjectedLight(slide, shading, zero, zero).light())
    torch.testing.assert_close(lights[2], 0.3 * lights[0] + 2 * lights[1])


def test_gains_between_the_cells_stay_within_the_bound():
    radius = math.log(3)
    draws = torch.Generator().manual_seed(0)
    log_gain = radius * (2 * torch.randint(0, 2, (1, 3, 6, 6), generator=draws) - 1.0)
    gain = plain_light().light(log_gain)
    assert gain.max() <= 3 + 1e-5
    assert gain.min() >= 1 / 3 - 1e-5
    # The bound is reached.
    torch.testing.assert_close(gain.max(), torch.tensor(3.0))


def test_the_gradient_of_the_gain_agrees_with_finite_differences():
    light = draw_projected_light(1, SIZE, generator(3))
    light = ProjectedLight(*(getattr(light, name).double() for name in vars(light)))
    # Dim photographs, none of whose values is clamped.
    photographs = 0.1 + 0.2 * random_photographs(1).double() / 255
    light = ProjectedLight(light.slide, light.shading, light.ambient + 0.5, light.stops - 3)
    log_gain = torch.linspace(-0.5, 0.5, 12, dtype=torch.float64).view(1, 3, 2, 2)
    log_gain.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda value: light.apply(photographs, value), log_gain)


def test_shading_is_the_cosine_between_normal_and_light():
    shading = draw_shading(20, 64, generator(5))
    assert shading.min() >= 0
    assert shading.max() <= 1
    # A flat surface reflects at least the cosine of the largest angle, on average over the draws.
    assert math.cos(math.radians(60)) < float(shading.mean()) < 1


def test_each_pixel_of_a_slide_of_cells_has_the_color_of_the_nearest_point():
    from scipy.spatial import cKDTree

    slide = draw_cells(1, 16, generator(4))[0]
    draws = generator(4)
    count = int(torch.randint(3, 25, (1,), generator=draws))
    points = (2 * torch.rand(1, 24, 2, generator=draws) - 1)[0, :count].numpy()
    centers = (np.arange(16) + 0.5) / 8 - 1
    grid = np.stack(np.meshgrid(centers, centers), axis=-1).reshape(-1, 2)
    nearest = cKDTree(points).query(grid)[1]
    colors = slide.flatten(1).T.numpy()
    for cell in np.unique(nearest):
        assert np.ptp(colors[nearest == cell], axis=0).max() == 0
    assert len(np.unique(colors, axis=0)) == len(np.unique(nearest))


def test_relit_photographs_repeat_with_their_seed():
    photographs = random_photographs()
    first = relight_photographs(photographs, seed=1, slides=photographs)
    again = relight_photographs(photographs, seed=1, slides=photographs)
    other = relight_photographs(photographs, seed=2, slides=photographs)
    assert first.dtype == torch.uint8
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
