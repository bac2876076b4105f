"""How pixels divide the directions of rays among their samples."""

from dataclasses import replace

import pytest
import torch
from oracles import fragments_of, square
from torch import Tensor

from renderer.camera import OrthographicCamera
from renderer.light.files import load_light
from renderer.mesh import concatenate, normalize
from renderer.operators.rays import DIRECTIONS, Rays, Surface, ray_directions
from renderer.rendering import render
from renderer.settings import ImageSettings
from renderer.solids import solid

ABOVE = OrthographicCamera(0, 0, 2.0)
SIZE = 4
SAMPLES = 8


def starts_of_rays(sample_count: int) -> Tensor:
    """Return the sample of its pixel (pixels, DIRECTIONS) from which each ray of a floor starts."""
    mesh = concatenate([square(1), square(1, center=(3, 0, 1))])
    settings = ImageSettings(SIZE, SAMPLES)
    fragments = fragments_of(mesh, ABOVE, settings)
    in_pixel = torch.arange(SAMPLES**2).repeat(SIZE**2)
    names = ("sample_to_pixel", "sample_to_seen_face", "sample_numbers")
    kept = {name: getattr(fragments, name)[in_pixel < sample_count] for name in names}
    surface = Surface(mesh, replace(fragments, **kept), settings)
    pixels = torch.arange(SIZE**2)
    starts = surface.samples_of_rays(pixels, DIRECTIONS)
    [blocked] = Rays(mesh).blocked(surface, ray_directions(DIRECTIONS))
    assert len(blocked.row) > 0
    assert torch.equal(starts[blocked.pixels[blocked.row], blocked.direction], blocked.sample)
    return starts - sample_count * pixels[:, None]


@pytest.mark.parametrize("sample_count", [9, 16])
def test_neighboring_pixels_cast_a_direction_from_all_of_their_samples(sample_count):
    """As many pixels as a pixel has samples cast it once from each sample."""
    starts = starts_of_rays(sample_count)[:sample_count]
    expected = torch.arange(sample_count)[:, None].expand(-1, DIRECTIONS)
    assert torch.equal(starts.sort(dim=0).values, expected)


def test_each_sample_casts_rays_in_directions_all_over_the_sphere():
    """The mean of every 55th direction of the lattice has a length of 0.75."""
    is_from_sample = starts_of_rays(55)[..., None] == torch.arange(55)
    sums = torch.einsum("pds,di->psi", is_from_sample.double(), ray_directions(DIRECTIONS))
    means = sums / is_from_sample.sum(1)[..., None]
    assert means.norm(dim=-1).mean() < 0.4


@pytest.mark.parametrize("normals", ["flat", pytest.param("smooth", marks=pytest.mark.slow)])
def test_shadows_converge_with_the_number_of_samples(normals):
    """An image of 8 times as many pixels per side, averaged, is the reference."""
    cup = normalize(solid("cup"))
    camera = OrthographicCamera(50.0, 30.0, 2.4)
    light = 0.2 * load_light("grace")  # No pixel of the image is clamped.

    def image(size: int, samples: int) -> Tensor:
        options = {"normals": normals, "shadows": True, "encoding": "linear", "background": 0.0}
        return render(cup, camera, light, size, samples=samples, **options)

    expected = image(12 * 8, 4).view(3, 12, 8, 12, 8).mean((2, 4))
    differences = [image(12, samples) - expected for samples in (4, 8, 16)]
    errors = [float(difference.square().mean().sqrt()) for difference in differences]
    brightness = float(expected.square().mean().sqrt())
    assert errors[1] < 0.7 * errors[0]
    assert errors[2] < 0.7 * errors[1]
    assert errors[2] < 0.01 * brightness
