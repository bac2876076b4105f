import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.special import eval_legendre

from renderer.camera import OrthographicCamera
from renderer.errors import InputError
from renderer.io.lights import save_light
from renderer.light.environment import SUFFIXES, to_map, write_map
from renderer.light.harmonics import basis, irradiance_basis, nonzero_coefficients, project
from renderer.light.presets import (
    PROBES,
    ambient,
    directional,
    load_light,
    perturb,
    probe,
)
from renderer.mesh import Mesh
from renderer.rendering import render
from renderer.transfer import DEGREE

HDRI = Path(__file__).parents[4] / "shared" / "data" / "hdri"
EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
UP, DOWN = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)

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


def random_directions(count: int) -> torch.Tensor:
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return torch.from_numpy(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def irradiance(light: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    return irradiance_basis(normals, 6) @ light.double()[nonzero_coefficients(6)]


def save(path: Path, array: np.ndarray) -> str:
    np.save(path, array)
    return str(path)


@pytest.mark.parametrize("name", PROBES)
def test_turned_back_to_y_up_probes_are_as_published(name):
    """Radiance at world (x, y, z) is the published polynomial at (x, z, -y), to the two digits printed."""
    x, up, back = random_directions(100).T
    y, z = up, back
    c0, c1, c2, c3, c4 = 0.5, math.sqrt(3) / 2, math.sqrt(15) / 2, math.sqrt(5) / 4, math.sqrt(15) / 4
    rows = [
        c0 + 0 * x,
        c1 * y,
        c1 * z,
        c1 * x,
        c2 * x * y,
        c2 * y * z,
        c3 * (3 * z * z - 1),
        c2 * x * z,
        c4 * (x * x - y * y),
    ]
    published = torch.stack(rows, dim=1) / math.sqrt(math.pi)
    world = basis(torch.stack([x, -back, up], dim=1), 6) @ probe(name).double()
    # Least squares recovers the nine coefficients; half a unit of the second digit, and float32.
    recovered = torch.linalg.lstsq(published, world).solution
    torch.testing.assert_close(recovered, torch.tensor(MORE_DIGITS[name]).double(), rtol=0, atol=0.005 + 4 * EPS32)
    torch.testing.assert_close(published @ recovered, world, rtol=0, atol=16 * EPS32)


@pytest.mark.parametrize("name", PROBES)
def test_probes_are_float32_and_end_at_band_2(name):
    light = load_light(name)
    assert light.shape == (49, 3) and light.dtype == torch.float32
    assert not light[9:].any()


def test_a_surface_shows_its_albedo_in_uniform_light():
    ball, albedo = trimesh.creation.icosphere(), (0.8, 0.4, 0.1)
    mesh = Mesh.plain(ball.vertices, ball.faces, albedo)
    (image,) = render(mesh, [OrthographicCamera(1.0, 2.0, 1.0)], load_light("uniform"), 8)
    torch.testing.assert_close(image.flatten(1).T, torch.tensor(albedo).expand(64, 3), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", PROBES)
def test_probes_are_upright(name):
    above, below = irradiance(probe(name), torch.stack([UP, DOWN])) @ LUMINANCE
    assert above > 2 * below > 0


def test_grace_is_lit_from_one_side():
    azimuth = torch.arange(36, dtype=torch.float64) * math.pi / 18
    around = torch.stack([azimuth.cos(), azimuth.sin(), 0 * azimuth], dim=1)
    luminance = irradiance(probe("grace"), around) @ LUMINANCE
    assert luminance.max() > 2 * luminance.min()


def test_a_constant_map_has_only_its_mean():
    """The sum over a row is exact in azimuth; along z it is the midpoint rule, off by Σ Δz³/24 · max |Y''| · 2π."""
    height, color = 64, torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    light = project(color.expand(height, 32, 3), DEGREE)
    torch.testing.assert_close(light[0], math.sqrt(4 * math.pi) * color, rtol=200 * EPS, atol=0)  # 2,048 terms
    zonal = torch.tensor([l * l + l for l in range(7)])
    rest = torch.ones(49, dtype=torch.bool).index_fill(0, zonal, False)
    torch.testing.assert_close(light[rest], torch.zeros(42, 3, dtype=torch.float64), rtol=0, atol=200 * EPS)
    steps = -np.diff(np.cos(np.pi * np.arange(height + 1) / height))
    for l in range(1, 7):
        curvature = np.polynomial.Legendre.basis(l).deriv(2)(1.0)  # the largest, at the pole
        bound = (steps**3).sum() / 24 * curvature * math.sqrt((2 * l + 1) / (4 * math.pi)) * 2 * math.pi
        assert light[l * l + l].abs().max() <= color.max() * bound + 200 * EPS


def test_a_map_bright_in_its_top_row_lights_from_straight_above():
    radiance = torch.zeros(32, 48, 3)
    radiance[0] = torch.tensor([3.0, 2.0, 1.0])
    light = project(radiance, DEGREE)
    solid_angle = 2 * math.pi * (1 - math.cos(math.pi / 32))
    z = (1 + math.cos(math.pi / 32)) / 2
    expected = torch.zeros(49, 3, dtype=torch.float64)
    for l in range(7):
        zonal = math.sqrt((2 * l + 1) / (4 * math.pi)) * eval_legendre(l, z)
        expected[l * l + l] = solid_angle * zonal * torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(light, expected, rtol=64 * EPS, atol=64 * EPS)
    lit = irradiance(light, torch.cat([UP[None], random_directions(50)])) @ LUMINANCE
    assert lit.argmax() == 0


@pytest.mark.parametrize(
    ("column", "direction"),
    [(24, [1, 0, 0]), (12, [0, 1, 0]), (36, [0, -1, 0]), (0, [-1, 0, 0])],
    ids=["middle", "left", "right", "seam"],
)
def test_the_middle_column_faces_x_and_azimuth_grows_to_the_left(column, direction):
    """Texels on both sides of a column's left edge and of the horizon."""
    radiance = torch.zeros(24, 48, 3)
    radiance[11:13, [column - 1, column]] = 1.0
    y, z, x = project(radiance, DEGREE)[1:4, 0]
    found = torch.stack([x, y, z])
    torch.testing.assert_close(found / found.norm(), torch.tensor(direction).double(), rtol=0, atol=64 * EPS)


def smooth_map(height: int = 128, width: int = 256) -> np.ndarray:
    """1 + 0.5 z + 0.3 y, tinted; azimuth π at the left edge, falling."""
    polar = np.pi * (np.arange(height) + 0.5)[:, None] / height
    azimuth = np.pi - 2 * np.pi * (np.arange(width) + 0.5) / width
    radiance = 1 + 0.5 * np.cos(polar) + 0.3 * np.sin(polar) * np.sin(azimuth)
    return radiance[..., None] * [0.7, 1.0, 1.3]


def test_a_saved_map_comes_back_at_graces_luminance(tmp_path):
    light = load_light(save(tmp_path / "map.npy", smooth_map()))
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


@pytest.mark.parametrize("change", [lambda m: 1e4 * m, lambda m: m.astype(">f8"), lambda m: np.asfortranarray(m)])
def test_a_maps_unit_and_layout_do_not_matter(tmp_path, change):
    plain, changed = (load_light(save(tmp_path / "map.npy", array)) for array in (smooth_map(), change(smooth_map())))
    # Texels are rounded to float32 in the file's unit: EPS32 / 2 of the flux, times |Y| of at most √13 times Y₀.
    torch.testing.assert_close(changed, plain, rtol=0, atol=4 * EPS32 * float(plain[0].max()))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_map_gives_the_same_light_in_every_format(tmp_path, suffix):
    radiance = torch.from_numpy(smooth_map())
    write_map(tmp_path / f"map{suffix}", radiance)
    light = load_light(str(tmp_path / f"map{suffix}"))
    plain = load_light(save(tmp_path / "plain.npy", smooth_map()))
    # .hdr is off by 2⁻⁸ of the largest channel, up to twice the others, of both the light and its luminance.
    tolerance = 4 * 2**-8 if suffix == ".hdr" else 4 * EPS32
    torch.testing.assert_close(light, plain, rtol=0, atol=tolerance * float(plain.max()))


def with_value(value: float) -> np.ndarray:
    radiance = smooth_map(8, 16)
    radiance[2, 3, 1] = value
    return radiance


@pytest.mark.parametrize(
    ("radiance", "message"),
    [
        pytest.param(with_value(np.nan), "holds NaN or infinity", id="NaN"),
        pytest.param(with_value(np.inf), "holds NaN or infinity", id="infinite"),
        pytest.param(-smooth_map(8, 16), "has a mean luminance of -", id="negative"),
        pytest.param(np.zeros((8, 16, 3)), "has a mean luminance of 0", id="black"),
    ],
)
@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_a_map_without_physical_light_is_refused_by_name(tmp_path, radiance, message, suffix):
    path = tmp_path / f"map{suffix}"
    write_map(path, torch.from_numpy(radiance))
    with pytest.raises(InputError, match=message) as caught:
        load_light(str(path))
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("suffix", [".npy", ".exr"])
def test_a_probe_written_as_a_map_loads_as_the_probe(tmp_path, suffix):
    """Negative in places, as it is. The midpoint rule along z is off by 22.2 / height² of the norm."""
    write_map(tmp_path / f"grace{suffix}", to_map(probe("grace"), 128))
    light = load_light(str(tmp_path / f"grace{suffix}"))
    assert float((light - probe("grace")).norm() / probe("grace").norm()) < 2 * 22.2 / 128**2


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".json"])
def test_a_missing_light_is_refused_by_name(tmp_path, suffix):
    with pytest.raises(InputError, match=re.escape(f"{tmp_path / f'light{suffix}'} does not exist: give the path")):
        load_light(str(tmp_path / f"light{suffix}"))


@pytest.mark.parametrize("name", ["graze", "", "sky.jpg", "grace/"])
def test_an_unknown_light_is_refused_with_what_is_known(name):
    known = "choose grace, eucalyptus, st_peters, uniform or the path of an environment map (.npy, .hdr, .exr) or of"
    with pytest.raises(InputError, match=re.escape(known)):
        load_light(name)


def test_saved_coefficients_come_back_to_the_bit_and_unscaled(tmp_path):
    light = 100 * torch.randn(49, 3, generator=draws())
    save_light(tmp_path / "light.json", light)
    torch.testing.assert_close(load_light(str(tmp_path / "light.json")), light, rtol=0, atol=0)
    written = json.loads((tmp_path / "light.json").read_text())
    assert written["basis"] == "harmonics" and len(written["coefficients"]) == 49
    (tmp_path / "rows.json").write_text(json.dumps(written["coefficients"]))
    torch.testing.assert_close(load_light(str(tmp_path / "rows.json")), light, rtol=0, atol=0)


def test_coefficients_that_are_not_finite_are_not_saved(tmp_path):
    with pytest.raises(InputError, match="coefficients holds NaN"):
        save_light(tmp_path / "light.json", torch.full((49, 3), math.nan))
    assert not list(tmp_path.iterdir())


ROWS = [[1, 0.5, -2]] * 49
DEGREE_1 = json.dumps({"basis": "harmonics", "degree": 1, "coefficients": ROWS[:4]})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        pytest.param("", "does not describe a light", id="empty"),
        pytest.param(json.dumps(ROWS)[:-1], "does not describe a light", id="truncated"),
        pytest.param(json.dumps({"basis": "harmonics"}), "does not describe a light", id="no coefficients"),
        pytest.param(
            json.dumps({"basis": "lamps", "coefficients": ROWS}),
            "its basis is 'lamps', give one of harmonics",
            id="another basis",
        ),
        pytest.param("\udcff", "does not describe a light", id="bytes"),
        pytest.param('{"light": 1}', "does not describe a light", id="object"),
        pytest.param('"grace"', "does not describe a light", id="text"),
        pytest.param("null", "does not describe a light", id="null"),
        pytest.param(json.dumps([*ROWS[:48], [1, 2]]), "does not describe a light", id="ragged"),
        pytest.param(json.dumps([*ROWS[:48], [1, 2, 10**400]]), "does not describe a light", id="beyond float"),
        pytest.param(json.dumps(ROWS[:9]), "has coefficients (9, 3): give 49 rows [r, g, b]", id="9 rows"),
        pytest.param("[]", "has coefficients (0,)", id="no rows"),
        pytest.param("1.5", "has coefficients ()", id="number"),
        pytest.param(json.dumps([*ROWS[:48], [1, 2, math.nan]]), "of finite numbers", id="NaN"),
        pytest.param(DEGREE_1, "is of harmonics of degree 1: give one of harmonics of degree 6", id="degree"),
        pytest.param(
            '{"basis": "harmonics", "degree": 21, "coefficients": []}', "harmonics=21 must be", id="degree 21"
        ),
    ],
)
def test_a_file_that_holds_no_coefficients_is_refused_by_name(tmp_path, content, message):
    path = tmp_path / "light.json"
    path.write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_light(str(path))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


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


def draws(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_perturbations_are_uniform_within_the_amplitude_on_every_coefficient():
    light = probe("eucalyptus")
    offsets = perturb(light, 1000, 0.5, None, draws()) - light
    assert offsets.shape == (1000, 49, 3)
    assert offsets.abs().max() <= 0.5 + EPS32
    # 1,000 uniform draws leave 1 % at either end untouched with a chance of e^-10 per coefficient and end.
    assert (offsets.amin(0) < -0.49).all() and (offsets.amax(0) > 0.49).all()
    # Five standard errors of the mean and, on the whole, the paper's norm of 3.5.
    assert offsets.mean(0).abs().max() < 5 * 0.5 / math.sqrt(3 * 1000)
    assert offsets.flatten(1).norm(dim=1).mean() == pytest.approx(math.sqrt(147 / 12), rel=0.01)


@pytest.mark.parametrize("amplitude", [0.01, 0.5, 100.0])
def test_with_a_radius_perturbations_have_that_norm_on_the_live_coefficients_alone(amplitude):
    offsets = perturb(torch.zeros(49, 3), 50, amplitude, 1.5, draws())
    torch.testing.assert_close(offsets.flatten(1).norm(dim=1), torch.full((50,), 1.5), rtol=4 * EPS32, atol=0)
    moved = torch.zeros(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), True)
    np.testing.assert_array_equal((offsets != 0).any(2).any(0), moved)


def test_the_generator_alone_decides_the_draw():
    light = probe("grace")
    first, again, other = (perturb(light, 4, 0.5, None, draws(seed)) for seed in (1, 1, 2))
    torch.testing.assert_close(first, again, rtol=0, atol=0)
    assert (first != other).any()
    assert first.flatten(1).unique(dim=0).shape == (4, 147)


@pytest.mark.realdata
@pytest.mark.skipif(not HDRI.is_dir(), reason="needs ../shared/data")
@pytest.mark.parametrize("name", ["city", "forest", "night", "studio"])
def test_the_shared_maps_load_bright_above_and_at_graces_luminance(name):
    light = load_light(str(HDRI / f"{name}.npy"))
    assert light.isfinite().all()
    assert float(light[0].double() @ LUMINANCE) == pytest.approx(
        float(probe("grace")[0].double() @ LUMINANCE), rel=1e-6
    )
    above, below = irradiance(light, torch.stack([UP, DOWN])) @ LUMINANCE
    assert above > below
