"""Lights by name and from maps, and lights in closed form."""

import math
from io import StringIO

import numpy as np
import pytest
import torch
from oracles import random_directions, scipy_basis

from renderer.errors import InputError
from renderer.light.basis import HARMONICS
from renderer.light.environment import write_map
from renderer.light.files import PROBES, ambient, directional, load_light, perturb, probe
from renderer.light.harmonics import basis, equirectangular, nonzero_coefficients

EPS = torch.finfo(torch.float64).eps
EPS32 = torch.finfo(torch.float32).eps
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
# The first nine coefficients of the probes to five and seven digits, as in the
# OpenGL Shading Language book and in many shaders after it: one row for each coefficient,
# red, green and blue of grace, eucalyptus and st_peters.
PUBLISHED = """
0.78908 0.43710 0.54161  0.3783264 0.4260425 0.4504587  0.3623915 0.2624130 0.2326261
0.39499 0.34989 0.60488  0.2887813 0.3586803 0.4147053  0.1759131 0.1436266 0.1260569
-0.33974 -0.18236 -0.26940  0.0379030 0.0295216 0.0098567  -0.0247311 -0.0101254 -0.0010745
-0.29213 -0.05562 0.00944  -0.1033028 -0.1031690 -0.0884924  0.0346500 0.0223184 0.0101350
-0.11141 -0.05090 -0.12231  -0.0621750 -0.0554432 -0.0396779  0.0198140 0.0144073 0.0043987
-0.26240 -0.22401 -0.47479  0.0077820 -0.0148312 -0.0471301  -0.0469596 -0.0254485 -0.0117786
-0.15570 -0.09471 -0.14733  -0.0935561 -0.1254260 -0.1525629  -0.0898667 -0.0760911 -0.0740964
0.56014 0.21444 0.13915  -0.0572703 -0.0502192 -0.0363410  0.0050194 0.0038841 0.0001374
0.21205 -0.05432 -0.30374  0.0203348 -0.0044201 -0.0452180  -0.0818750 -0.0321501 0.0033399
"""


def irradiance(light: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    return HARMONICS.irradiance(normals) @ light.double()[nonzero_coefficients(6)]


@pytest.mark.parametrize("name", PROBES)
def test_probes_are_as_published_after_a_rotation_back_to_y_up(name):
    """The probe's radiance at (x, -z, y) is the published polynomial at (x, y, z)."""
    y_up = random_directions(100)
    x, y, z = y_up.T
    z_up = torch.stack([x, -z, y], dim=1)
    radiance = basis(z_up, 6) @ probe(name).double()
    published = torch.from_numpy(scipy_basis(y_up, 2))
    recovered = torch.linalg.lstsq(published, radiance).solution
    published_probes = np.loadtxt(StringIO(PUBLISHED)).reshape(9, 3, 3)
    expected = torch.from_numpy(published_probes[:, PROBES.index(name)])
    torch.testing.assert_close(recovered, expected, rtol=0, atol=0.005 + 4 * EPS32)
    torch.testing.assert_close(published @ recovered, radiance, rtol=0, atol=16 * EPS32)


def smooth_map(height: int = 128, width: int = 256) -> np.ndarray:
    """Return a map of the radiance 1 + 0.5 z + 0.3 y with a tint; the azimuth falls from π."""
    polar = np.pi * (np.arange(height) + 0.5)[:, None] / height
    azimuth = np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width
    z = np.cos(polar)
    y = np.sin(polar) * np.sin(azimuth)
    return (1 + 0.5 * z + 0.3 * y)[..., None] * [0.7, 1.0, 1.3]


def test_the_coefficients_of_a_map_are_those_of_its_formula_as_bright_as_grace(tmp_path):
    """A row misses (π/128)²/24 of the curvature, which is at most 6 · 7 at degree 6."""
    np.save(tmp_path / "map.npy", smooth_map())
    light = load_light(str(tmp_path / "map.npy"))
    assert light.shape == (49, 3)
    assert light.dtype == torch.float32
    expected = torch.zeros(49, 3, dtype=torch.float64)
    tint = torch.tensor([0.7, 1.0, 1.3], dtype=torch.float64)
    expected[0] = tint * 2
    expected[1] = tint * 0.3 * 2 / math.sqrt(3)
    expected[2] = tint * 0.5 * 2 / math.sqrt(3)
    grace_luminance = probe("grace")[0].double() @ LUMINANCE
    luminance = light[0].double() @ LUMINANCE
    torch.testing.assert_close(luminance, grace_luminance, rtol=4 * EPS32, atol=0)
    found = light.double() / light[0, 1]
    tolerance = 3 * 42 * (math.pi / 128) ** 2 / 24
    torch.testing.assert_close(found, expected / expected[0, 1], rtol=0, atol=tolerance)


@pytest.mark.parametrize(
    ("factor", "texel"),
    [(1.0, math.inf), (1.0, math.nan), (1.0, 1e30), (1.0, -3.0), (0.0, 0.0)],
    ids=["infinite", "NaN", "beyond the limit", "negative", "black"],
)
def test_a_map_without_physical_light_is_refused_by_name(tmp_path, factor, texel):
    path = tmp_path / "map.exr"
    radiance = factor * torch.from_numpy(smooth_map(8, 16))
    radiance[3, 5] = texel
    write_map(path, radiance)
    with pytest.raises(InputError, match=r"map\.exr"):
        load_light(str(path))


def test_a_map_with_one_texel_of_a_million_times_the_others_is_light_from_there(tmp_path):
    radiance = torch.full((64, 128, 3), 1e-3)
    radiance[20, 30] = 1e3
    # Relative to the brightest texel, this value counts as zero.
    radiance[40, 50] = -1e-2
    write_map(tmp_path / "map.exr", radiance)
    light = load_light(str(tmp_path / "map.exr"))
    directions, _ = equirectangular(64, 128)
    beam = basis(directions[20, 30], 6)
    expected = (beam / beam[0]).float()[:, None].expand(-1, 3)
    torch.testing.assert_close(light / light[0], expected, rtol=0, atol=0.02)


def test_ambient_light_gives_every_normal_pi_times_its_color():
    color = torch.tensor([0.2, 0.5, 1.5], dtype=torch.float64)
    found = irradiance(ambient(color), random_directions(50))
    expected = (math.pi * color).expand(50, 3)
    torch.testing.assert_close(found, expected, rtol=8 * EPS, atol=0)


def test_directional_light_is_the_clamped_cosine_within_the_error_of_degree_6():
    """The largest error is 0.043, and the irradiance behind the terminator falls to -0.016."""
    [direction] = random_directions(1)
    color = torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)
    across = torch.linalg.svd(direction[None]).Vh[1]
    angle = torch.linspace(0, math.pi, 2001, dtype=torch.float64)[:, None]
    normals = angle.cos() * direction + angle.sin() * across
    relative = irradiance(directional(direction, color), normals) / color
    error = (relative - angle.cos().clamp(min=0)).abs()
    assert 0.0425 < error.max() < 0.0435
    assert -0.0165 < relative.min() < -0.0155
    torch.testing.assert_close(relative[:, 0], relative[:, 2], rtol=0, atol=8 * EPS)


@pytest.mark.parametrize("amplitude", [0.01, 100.0])
def test_perturbations_with_a_radius_have_this_norm_on_the_nonzero_coefficients(amplitude):
    offsets = perturb(torch.zeros(49, 3), 50, amplitude, 1.5, torch.Generator().manual_seed(0))
    expected_norms = torch.full((50,), 1.5)
    norms = offsets.flatten(1).norm(dim=1)
    torch.testing.assert_close(norms, expected_norms, rtol=4 * EPS32, atol=0)
    changed = (offsets != 0).any(dim=2).any(dim=0).nonzero().flatten()
    assert changed.tolist() == nonzero_coefficients(6).tolist()


def test_perturbations_without_a_radius_are_uniform_in_all_coefficients():
    """A thousand uniform draws leave 1% at one end without a value with a chance of e^-10."""
    grace = probe("grace")
    offsets = perturb(grace, 1000, 0.5, None, torch.Generator().manual_seed(0)) - grace
    assert offsets.abs().max() <= 0.5 + EPS32
    assert (offsets.amin(0) < -0.49).all()
    assert (offsets.amax(0) > 0.49).all()


@pytest.mark.parametrize("degree", [6, 12, 20])
def test_a_small_uniform_map_is_nearly_uniform_light_at_every_degree(tmp_path, degree):
    """At degree 20, it had 1.8 times the norm of the mean in other harmonics."""
    write_map(tmp_path / "map.npy", torch.ones(8, 16, 3))
    light = load_light(tmp_path / "map.npy", degree)
    assert light[1:].norm() < 0.08 * light[0].norm()
