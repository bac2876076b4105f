import math

import numpy as np
import pytest
import torch
from oracles import random_directions

from renderer.errors import InputError
from renderer.light.basis import HARMONICS
from renderer.light.environment import write_map
from renderer.light.harmonics import basis, equirectangular, nonzero_coefficients
from renderer.light.presets import PROBES, ambient, directional, load_light, perturb, probe

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)

# The probes to five and seven digits, as the OpenGL Shading Language book and many shaders after it have them.
MORE_DIGITS = {
    "grace": [
        [0.78908, 0.43710, 0.54161], [0.39499, 0.34989, 0.60488], [-0.33974, -0.18236, -0.26940],
        [-0.29213, -0.05562, 0.00944], [-0.11141, -0.05090, -0.12231], [-0.26240, -0.22401, -0.47479],
        [-0.15570, -0.09471, -0.14733], [0.56014, 0.21444, 0.13915], [0.21205, -0.05432, -0.30374],
    ],
    "eucalyptus": [
        [0.3783264, 0.4260425, 0.4504587], [0.2887813, 0.3586803, 0.4147053], [0.0379030, 0.0295216, 0.0098567],
        [-0.1033028, -0.1031690, -0.0884924], [-0.0621750, -0.0554432, -0.0396779], [0.0077820, -0.0148312, -0.0471301],
        [-0.0935561, -0.1254260, -0.1525629], [-0.0572703, -0.0502192, -0.0363410], [0.0203348, -0.0044201, -0.0452180],
    ],
    "st_peters": [
        [0.3623915, 0.2624130, 0.2326261], [0.1759131, 0.1436266, 0.1260569], [-0.0247311, -0.0101254, -0.0010745],
        [0.0346500, 0.0223184, 0.0101350], [0.0198140, 0.0144073, 0.0043987], [-0.0469596, -0.0254485, -0.0117786],
        [-0.0898667, -0.0760911, -0.0740964], [0.0050194, 0.0038841, 0.0001374], [-0.0818750, -0.0321501, 0.0033399],
    ],
}  # fmt: skip


def irradiance(light: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    return HARMONICS.irradiance(normals) @ light.double()[nonzero_coefficients(6)]


@pytest.mark.parametrize("name", PROBES)
def test_rotated_back_to_y_up_probes_are_as_published(name):
    """Radiance at world (x, y, z) is the published polynomial at (x, z, -y), to the two digits printed."""
    x, y, z = random_directions(100).T
    c1, c2, c3 = math.sqrt(3) / 2, math.sqrt(15) / 2, math.sqrt(5) / 4
    rows = [0.5 + 0 * x, c1 * y, c1 * z, c1 * x, c2 * x * y, c2 * y * z, c3 * (3 * z * z - 1), c2 * x * z]
    published = torch.stack([*rows, c2 / 2 * (x * x - y * y)], dim=1) / math.sqrt(math.pi)
    world = basis(torch.stack([x, -z, y], dim=1), 6) @ probe(name).double()
    # Least squares recovers the nine coefficients; half a unit of the second digit, and float32.
    recovered = torch.linalg.lstsq(published, world).solution
    torch.testing.assert_close(recovered, torch.tensor(MORE_DIGITS[name]).double(), rtol=0, atol=0.005 + 4 * EPS32)
    torch.testing.assert_close(published @ recovered, world, rtol=0, atol=16 * EPS32)


def smooth_map(height: int = 128, width: int = 256) -> np.ndarray:
    """1 + 0.5 z + 0.3 y, tinted; azimuth π at the left edge, falling."""
    polar = np.pi * (np.arange(height) + 0.5)[:, None] / height
    azimuth = np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width
    radiance = 1 + 0.5 * np.cos(polar) + 0.3 * np.sin(polar) * np.sin(azimuth)
    return radiance[..., None] * [0.7, 1.0, 1.3]


def test_a_saved_map_comes_back_at_graces_luminance(tmp_path):
    np.save(tmp_path / "map.npy", smooth_map())
    light = load_light(str(tmp_path / "map.npy"))
    assert light.shape == (49, 3) and light.dtype == torch.float32
    grace = probe("grace")[0].double() @ LUMINANCE
    assert float(light[0].double() @ LUMINANCE) == pytest.approx(float(grace), rel=4 * EPS32)
    expected = torch.zeros(49, 3, dtype=torch.float64)
    tint = torch.tensor([0.7, 1.0, 1.3], dtype=torch.float64)
    expected[0], expected[1], expected[2] = (tint * c for c in (2.0, 0.3 * 2 / math.sqrt(3), 0.5 * 2 / math.sqrt(3)))
    # Row by row: radiance and harmonics off by (π/128)²/24 of their curvature, at most 6·7 at degree 6.
    torch.testing.assert_close(
        light.double() / light[0, 1], expected / expected[0, 1], rtol=0, atol=42 * (math.pi / 128) ** 2 / 8
    )


@pytest.mark.parametrize(
    ("factor", "texel", "message"),
    [
        *((1.0, texel, "holds NaN, infinity or radiance beyond 1e") for texel in (math.inf, math.nan, 1e30)),
        (1.0, -3.0, "has negative radiance, down to -3: "),
        (0.0, 0.0, "is black: "),
    ],
)
def test_a_map_without_physical_light_is_refused_by_name(tmp_path, factor, texel, message):
    path, radiance = tmp_path / "map.exr", factor * torch.from_numpy(smooth_map(8, 16))
    radiance[3, 5] = texel
    write_map(path, radiance)
    with pytest.raises(InputError, match=message) as refused:
        load_light(str(path))
    assert str(path) in str(refused.value)


def test_a_map_whose_brightest_texel_is_a_million_times_the_others_is_light_from_there(tmp_path):
    radiance = torch.full((64, 128, 3), 1e-3)
    radiance[20, 30], radiance[40, 50] = 1e3, -1e-2  # so little below zero counts as zero
    write_map(tmp_path / "map.exr", radiance)
    light = load_light(str(tmp_path / "map.exr"))
    there = basis(equirectangular(64, 128)[0][20, 30], 6)
    torch.testing.assert_close(light / light[0], (there / there[0]).float()[:, None].expand(-1, 3), rtol=0, atol=0.02)


def test_ambient_light_gives_every_normal_pi_times_its_color():
    color = torch.tensor([0.2, 0.5, 1.5], dtype=torch.float64)
    lit = irradiance(ambient(color), random_directions(50))
    torch.testing.assert_close(lit, (math.pi * color).expand(50, 3), rtol=8 * EPS, atol=0)


def test_directional_light_is_the_clamped_cosine_within_its_truncation():
    """Off by 0.043 at most and down to -0.016 behind the terminator, both of which it reaches."""
    direction, color = random_directions(1)[0], torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)
    across = torch.linalg.svd(direction[None]).Vh[1]
    angle = torch.linspace(0, math.pi, 2001, dtype=torch.float64)[:, None]
    lit = irradiance(directional(direction, color), angle.cos() * direction + angle.sin() * across) / color
    error = (lit - angle.cos().clamp(min=0)).abs()
    assert 0.0425 < error.max() < 0.0435
    assert -0.0165 < lit.min() < -0.0155
    torch.testing.assert_close(lit[:, 0], lit[:, 2], rtol=0, atol=8 * EPS)


@pytest.mark.parametrize("amplitude", [0.01, 100.0])
def test_with_a_radius_perturbations_have_that_norm_on_the_nonzero_coefficients_alone(amplitude):
    offsets = perturb(torch.zeros(49, 3), 50, amplitude, 1.5, torch.Generator().manual_seed(0))
    torch.testing.assert_close(offsets.flatten(1).norm(dim=1), torch.full((50,), 1.5), rtol=4 * EPS32, atol=0)
    moved = torch.zeros(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), True)
    np.testing.assert_array_equal((offsets != 0).any(2).any(0), moved)
    everywhere = perturb(probe("grace"), 1000, 0.5, None, torch.Generator().manual_seed(0)) - probe("grace")
    assert everywhere.abs().max() <= 0.5 + EPS32
    # 1,000 uniform draws leave 1 % at either end untouched with a chance of e^-10 per coefficient and end.
    assert (everywhere.amin(0) < -0.49).all() and (everywhere.amax(0) > 0.49).all()
