import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre, sph_harm_y

from renderer.albedo import surface_albedo
from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.fragments import build_fragments
from renderer.image import ImageSettings
from renderer.light.basis import Harmonics
from renderer.light.harmonics import MAX_DEGREE, lambertian_factors, nonzero_coefficients
from renderer.light.presets import directional
from renderer.mesh import Mesh, concatenate
from renderer.rasterizer import choose
from renderer.shading import radiance as shade
from renderer.transfer import TransferOperator, build_operators

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
RASTERIZER = choose("numpy")
LAMBERTIAN = [math.pi, 2 * math.pi / 3, math.pi / 4, 0, -math.pi / 24, 0, math.pi / 64]
ABOVE = OrthographicCamera(0, 0, 2.0)  # right is +y, up is -x
CUBE = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)


def radiance(operator: TransferOperator, light: torch.Tensor) -> np.ndarray:
    """(3, P) float64."""
    nonzero = light[nonzero_coefficients(6)].double()
    return torch.einsum("kc,ckp->cp", nonzero, (operator.transfer * operator.albedo[:, None]).double()).numpy()


def image_of(operator: TransferOperator, light: torch.Tensor, size: int) -> np.ndarray:
    """(size, size, 3), black where nothing covers."""
    canvas = np.zeros((size * size, 3))
    canvas[operator.pixels] = radiance(operator, light).T
    return canvas.reshape(size, size, 3)


def coverage_map(operator: TransferOperator, size: int) -> np.ndarray:
    canvas = np.zeros(size * size)
    canvas[operator.pixels] = operator.coverage
    return canvas.reshape(size, size)


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def random_light(seed: int) -> torch.Tensor:
    """All 49 coefficients, the dead ones too."""
    return draw(49, 3, seed=seed).float()


def square(half: float, turn: float = 0.0, color=(1.0, 1.0, 1.0)) -> Mesh:
    """Level, facing up, turned about z."""
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Mesh.plain(Rotation.from_euler("z", turn).apply(corners), [[0, 1, 2], [0, 2, 3]], color)


def sphere(subdivisions: int, color=(1.0, 1.0, 1.0)) -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh.plain(shape.vertices, shape.faces, color)


def patchwork() -> Mesh:
    """A dented sphere: two textures and bare faces, vertex colors on all, UVs that wrap round."""
    rng = np.random.default_rng(0)
    mesh = sphere(2)
    mesh = replace(mesh, vertices=mesh.vertices * rng.uniform(0.7, 1.0, (len(mesh.vertices), 1)))
    count = len(mesh.faces)
    return replace(
        mesh,
        corner_colors=rng.uniform(0.1, 1, (count, 3, 3)).astype(np.float32),
        corner_uvs=rng.uniform(-1, 2, (count, 3, 2)).astype(np.float32),
        texture_ids=rng.integers(-1, 2, count).astype(np.int32),
        textures=tuple(rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for height, width in [(5, 7), (4, 3)]),
    )


# ---------------------------------------------------------------------------- a slow, independent renderer


def scipy_irradiance(light: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Σ A_l U_lm Y_lm(n), RGB, with scipy's complex harmonics; A_l is proven in test_harmonics."""
    polar, azimuth = math.atan2(math.hypot(normal[0], normal[1]), normal[2]), math.atan2(normal[1], normal[0])
    total = np.zeros(3)
    degree = math.isqrt(len(light)) - 1
    for l, factor in enumerate(lambertian_factors(degree).tolist()):
        for m in range(-l, l + 1):
            value = complex(sph_harm_y(l, abs(m), polar, azimuth))
            real = value.real if m == 0 else math.sqrt(2) * (-1) ** m * (value.real if m > 0 else value.imag)
            total += factor * light[l * l + l + m] * real
    return total


def linear(color: np.ndarray, encoding: str) -> np.ndarray:
    """A color as authored to linear albedo (IEC 61966-2-1)."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4) if encoding == "srgb" else color


def texel(texture: np.ndarray, u: float, v: float, encoding: str) -> np.ndarray:
    height, width = texture.shape[:2]
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    total = np.zeros(3)
    for column in (math.floor(x), math.floor(x) + 1):
        for row in (math.floor(y), math.floor(y) + 1):
            share = (1 - abs(x - column)) * (1 - abs(y - row))
            total += share * linear(texture[row % height, column % width] / 255, encoding)
    return total


def albedo_at(mesh: Mesh, face: int, weights: np.ndarray, encoding: str) -> np.ndarray:
    color = weights @ linear(mesh.corner_colors[face].astype(float), encoding)
    if mesh.texture_ids[face] >= 0:
        uv = weights @ mesh.corner_uvs[face].astype(float)
        color *= texel(mesh.textures[mesh.texture_ids[face]], *uv, encoding)
    return color


def shade_slowly(mesh: Mesh, camera: OrthographicCamera, light: torch.Tensor, settings: ImageSettings) -> tuple:
    """(size, size, 3) radiance and (size, size) coverage, sample by sample."""
    projected = camera.project(mesh.vertices)
    resolution = settings.size * settings.samples
    ids = RASTERIZER.rasterize(projected[None], mesh.faces, resolution)[0]
    image, coverage = np.zeros((settings.size, settings.size, 3)), np.zeros((settings.size, settings.size))
    shades = {}
    for row, column in np.argwhere(ids >= 0):
        face = ids[row, column]
        if face not in shades:
            a, b, c = mesh.vertices[mesh.faces[face]]
            normal = np.cross(b - a, c - a)
            normal *= np.sign(normal @ camera.axes()[2]) / np.linalg.norm(normal)
            shades[face] = scipy_irradiance(light.double().numpy(), normal)
        at = [(2 * column + 1) / resolution - 1, 1 - (2 * row + 1) / resolution, 1]
        weights = np.linalg.solve(np.vstack([projected[mesh.faces[face], :2].T, np.ones(3)]), at)
        weights = weights.clip(0, 1) / weights.clip(0, 1).sum()  # corners are snapped to 1/256 sample
        pixel = (row // settings.samples, column // settings.samples)
        image[pixel] += shades[face] * albedo_at(mesh, face, weights, settings.encoding) / settings.samples**2
        coverage[pixel] += 1 / settings.samples**2
    return image, coverage


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_operators_are_what_shading_every_sample_gives(encoding):
    mesh, settings = patchwork(), ImageSettings(size=9, samples=3, encoding=encoding)
    cameras = [OrthographicCamera(0.4, 5.0, 1.7), OrthographicCamera(math.pi / 3, 0.0, 2.0)]
    for camera, operator in zip(cameras, build_operators(mesh, cameras, settings, RASTERIZER), strict=True):
        for light in (random_light(0), random_light(1)):
            expected, coverage = shade_slowly(mesh, camera, light, settings)
            # The transfer is stored in float32, and 31 terms are summed.
            tolerance = 8 * EPS32 * np.abs(expected).max()
            np.testing.assert_allclose(image_of(operator, light, settings.size), expected, rtol=0, atol=tolerance)
            np.testing.assert_allclose(coverage_map(operator, settings.size), coverage, rtol=EPS32)


@pytest.mark.parametrize("light_from", [(0.0, 0.0, 1.0), (0.8, 0.0, 0.6), (-0.48, 0.6, -0.64)])
def test_a_sphere_under_directional_light_has_the_truncated_cosines_shading(light_from):
    """Facets reach an angle ρ from their center, so normals are off by at most ρ + ρ²; the series' slope is 1.02."""
    camera, size, samples = OrthographicCamera(1.1, 0.7, 2.0), 16, 4
    mesh = sphere(5)
    (operator,) = build_operators(mesh, [camera], ImageSettings(size, samples), RASTERIZER)
    lit = image_of(operator, directional(torch.tensor(light_from), torch.ones(3)), size)

    steps = (np.arange(size * samples) + 0.5) / (size * samples) * 2 - 1
    x, y = np.meshgrid(steps, -steps)
    depth = np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))
    cosine = np.stack([x, y, depth], axis=-1) @ camera.axes() @ light_from
    series = sum(a * (2 * l + 1) / (4 * math.pi) * eval_legendre(l, cosine) for l, a in enumerate(LAMBERTIAN))
    expected = series.reshape(size, samples, size, samples).mean(axis=(1, 3))

    corners = mesh.vertices[mesh.faces]
    reach = np.arccos((corners[:, 0] * mesh.face_normals()).sum(axis=1).min())
    inside = np.hypot(x, y).reshape(size, samples, size, samples).max(axis=(1, 3)) < 0.8
    assert inside.sum() > 100
    difference = np.abs(lit - expected[..., None])[inside]
    assert difference.max() < 1.03 * (reach + reach**2)
    assert difference.mean() < 0.2 * reach  # facets' errors average out within a pixel


def test_coverage_of_a_square_on_sample_borders_is_its_area_in_each_pixel():
    """Half-width 5/8 at 8 pixels of 1/4: two pixels' worth and a half on either side of the center."""
    (operator,) = build_operators(square(0.625), [ABOVE], ImageSettings(size=8, samples=4), RASTERIZER)
    along = [0, 0.5, 1, 1, 1, 1, 0.5, 0]
    np.testing.assert_array_equal(coverage_map(operator, 8), np.outer(along, along))


def test_the_image_is_upright():
    """From θ = π/2 on the +x side, up is up and right is +y."""
    corners = [[0, 0.5, 0.5], [0, 1, 0.5], [0, 1, 1], [0, 0.5, 1]]
    mesh = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])
    (operator,) = build_operators(mesh, [OrthographicCamera(math.pi / 2, 0, 2.0)], ImageSettings(4, 2), RASTERIZER)
    assert operator.pixels.tolist() == [3]


def test_gain_multiplies_the_radiance_and_leaves_the_coverage():
    mesh, settings = patchwork(), ImageSettings(size=6, samples=2, encoding="srgb")
    (plain,), (bright,) = (
        build_operators(mesh, orbit_cameras(1, 2.0), settings, RASTERIZER, albedo_scale) for albedo_scale in (1.0, 2.5)
    )
    torch.testing.assert_close(bright.transfer, 2.5 * plain.transfer, rtol=2 * EPS32, atol=0)
    torch.testing.assert_close(bright.coverage, plain.coverage, rtol=0, atol=0)


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
@pytest.mark.parametrize("shape", [patchwork, lambda: sphere(2, (0.8, 0.4, 0.1))], ids=["patchwork", "one color"])
def test_smooth_operators_are_what_shading_with_vertex_normals_gives(shape, encoding):
    mesh, light, cameras = shape(), draw(49, 3), orbit_cameras(2, 2.2)
    settings = ImageSettings(12, samples=3, encoding=encoding, normals="smooth")
    operators = build_operators(mesh, cameras, settings, RASTERIZER, dtype=torch.float64)
    views = build_fragments(mesh.vertices, mesh.faces, cameras, settings, RASTERIZER, closed=mesh.closed)
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
    flat = build_operators(mesh, cameras, replace(settings, normals="flat"), RASTERIZER, dtype=torch.float64)
    for operator, view, faceted in zip(operators, views, flat, strict=True):
        expected = shade(view, vertices, light, surface_albedo(mesh, view, encoding), smooth_faces=faces)
        # 31 coefficients of some 1, whose terms are added in another order.
        torch.testing.assert_close(operator.radiance(light), expected, rtol=0, atol=256 * EPS)
        assert torch.equal(operator.pixels, view.pixels) and torch.equal(operator.coverage, view.coverage.double())
        assert (operator.radiance(light) - faceted.radiance(light)).abs().max() > 1e-3


# ---------------------------------------------------------------------------- light to pixels and back

LAYOUTS = {  # mesh, samples, channels of the transfer
    "one color": (sphere(1, (0.8, 0.4, 0.1)), 3, 1),
    "one sample per pixel": (patchwork(), 1, 1),
    "mixed albedos": (patchwork(), 3, 3),
}


def operator_of(layout: str, dtype=torch.float64) -> TransferOperator:
    mesh, samples, channels = LAYOUTS[layout]
    [operator] = build_operators(mesh, orbit_cameras(1, 2.2), ImageSettings(6, samples), RASTERIZER, dtype=dtype)
    assert operator.transfer.shape == (channels, 31, len(operator.pixels)) and operator.transfer.dtype == dtype
    return operator


def empty_operator() -> TransferOperator:
    mesh = replace(square(0.1), vertices=square(0.1).vertices + np.array([0.8, 0, 0]))
    [operator] = build_operators(mesh, [OrthographicCamera(0, 0, 0.5)], ImageSettings(size=4, samples=2), RASTERIZER)
    return operator


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 6, 13, MAX_DEGREE])
def test_operators_of_any_degree_are_scipys_harmonics(degree):
    box = trimesh.convex.convex_hull(CUBE)
    mesh = Mesh.plain(Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).apply(box.vertices), box.faces, (0.5, 1.0, 0.25))
    settings, camera = ImageSettings(size=4, samples=1), OrthographicCamera(1.0, 0.4, 1.5)
    [operator] = build_operators(mesh, [camera], settings, RASTERIZER, basis=Harmonics(degree), dtype=torch.float64)
    light = draw((degree + 1) ** 2, 3)
    image, coverage = shade_slowly(mesh, camera, light, settings)
    found = np.zeros((16, 3))
    found[operator.pixels] = operator.radiance(light).T
    assert operator.basis == Harmonics(degree) and coverage.sum() > 8
    # The harmonics are scipy's to 1e-13 and reach 2.6 in band 20; the factors are π at most.
    np.testing.assert_allclose(found.reshape(4, 4, 3), image, rtol=0, atol=1e-13 * math.pi * (degree + 1))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("batch", [(), (1,), (4,), (2, 3), (0,)])
def test_the_radiance_is_the_light_times_the_transfer_times_the_albedo(layout, batch):
    operator = operator_of(layout)
    lights = draw(*batch, 49, 3)
    expected = torch.einsum(
        "...kc,ckp,cp->...cp",
        lights[..., nonzero_coefficients(6), :],
        operator.transfer.expand(3, -1, -1),
        operator.albedo,
    )
    torch.testing.assert_close(operator.radiance(lights), expected, rtol=0, atol=64 * EPS)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_light_gradient_is_autograds_and_that_of_central_differences(layout):
    operator = operator_of(layout)
    light = draw(49, 3).requires_grad_(True)
    assert torch.autograd.gradcheck(operator.radiance, light)
    upstream = draw(3, len(operator.pixels), seed=1)
    (gradient,) = torch.autograd.grad(operator.radiance(light), light, upstream)
    assert torch.equal(operator.light_gradient(upstream), gradient)
    # The radiance is linear: a step of any length gives the derivative, to the rounding of 31 terms of some 1.
    step = draw(49, 3, seed=2)
    change = (operator.radiance(light + step) - operator.radiance(light - step)) / 2
    assert (gradient * step).sum().item() == pytest.approx((change * upstream).sum().item(), abs=1e-11)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_18_dead_coefficients_have_a_gradient_of_exactly_zero(layout):
    gradient = operator_of(layout).light_gradient(draw(5, 3, len(operator_of(layout).pixels)))
    dead = torch.ones(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), False)
    assert dead.sum() == 18
    assert not gradient[:, dead].any() and gradient[:, ~dead].all()


def test_both_layouts_give_the_same_radiance():
    """A red and a green square far apart; a third that is white and blue within a pixel makes three channels needed."""
    tilted = replace(square(0.2), vertices=Rotation.from_euler("x", 0.3).apply(square(0.2).vertices))

    def at(x: float, y: float, color) -> Mesh:
        return replace(Mesh.plain(tilted.vertices, tilted.faces, color), vertices=np.array([x, y, 0]) + tilted.vertices)

    plain = concatenate([at(0.6, 0.6, (1, 0.2, 0.1)), at(-0.6, -0.6, (0.1, 1, 0.3))])
    mixed = at(0.6, -0.6, (1, 1, 1))
    mixed.corner_colors[0] = (0, 0, 1)
    settings = ImageSettings(8, 4)
    [one], [three] = (
        build_operators(mesh, [ABOVE], settings, RASTERIZER, dtype=torch.float64)
        for mesh in (plain, concatenate([plain, mixed]))
    )
    assert (len(one.transfer), len(three.transfer)) == (1, 3)
    shared = torch.isin(three.pixels, one.pixels)
    assert torch.equal(three.pixels[shared], one.pixels) and not shared.all()
    light = draw(49, 3)
    torch.testing.assert_close(three.radiance(light)[:, shared], one.radiance(light), rtol=0, atol=64 * EPS)
    upstream = draw(3, len(three.pixels), seed=1) * shared
    torch.testing.assert_close(
        three.light_gradient(upstream), one.light_gradient(upstream[:, shared]), rtol=0, atol=64 * EPS
    )


@pytest.mark.parametrize(("step", "channels"), [(0, 1), (1, 1), (16, 3)])
def test_one_channel_is_taken_for_albedos_that_are_the_same_to_float32s_rounding(step, channels):
    """Two halves of a square, apart by some of float32's steps."""
    colors = np.full((2, 3, 3), 0.75, dtype=np.float32)
    colors[1] += step * np.spacing(colors[1])
    mesh = replace(square(0.5), corner_colors=colors)
    [operator] = build_operators(mesh, [ABOVE], ImageSettings(4, 4), RASTERIZER)
    assert len(operator.transfer) == channels
    [exact] = build_operators(mesh, [ABOVE], ImageSettings(4, 4), RASTERIZER, dtype=torch.float64)
    light = random_light(0)
    torch.testing.assert_close(operator.radiance(light), exact.radiance(light), rtol=0, atol=16 * EPS32)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3), (0,)])
def test_an_empty_view_has_no_radiance_and_a_gradient_of_zero(batch):
    operator = empty_operator()
    lights = torch.ones(*batch, 49, 3, requires_grad=True)
    radiance = operator.radiance(lights)
    assert radiance.shape == (*batch, 3, 0)
    (gradient,) = torch.autograd.grad(radiance.sum(), lights)
    assert torch.equal(gradient, torch.zeros(*batch, 49, 3))


@pytest.mark.parametrize("shape", [(36, 3), (64, 3), (49, 1), (49,), (3, 49), (2, 31, 3), (0, 3)])
def test_lights_of_another_degree_are_refused(shape):
    with pytest.raises(InputError, match=rf"lights of shape {re.escape(str(shape))} .* degree 6"):
        operator_of("one color").radiance(torch.zeros(shape))
