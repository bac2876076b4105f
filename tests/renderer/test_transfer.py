import math
import re

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw, patchwork, scipy_irradiance
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre

from renderer.camera import OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.image import ImageSettings
from renderer.light.harmonics import nonzero_coefficients
from renderer.light.presets import directional
from renderer.mesh import Mesh, concatenate
from renderer.rasterizer import choose
from renderer.transfer import TransferOperator, build_operators

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
RASTERIZER = choose("numpy")
LAMBERTIAN = [math.pi, 2 * math.pi / 3, math.pi / 4, 0, -math.pi / 24, 0, math.pi / 64]
ABOVE = OrthographicCamera(0, 0, 2.0)  # right is +y, up is -x


def image_of(operator: TransferOperator, light: torch.Tensor) -> np.ndarray:
    """(size, size, 3) linear radiance, black where nothing covers."""
    size = operator.settings.size
    canvas = np.zeros((size * size, 3))
    canvas[operator.pixels] = operator.radiance(light).double().T
    return canvas.reshape(size, size, 3)


def coverage_map(operator: TransferOperator) -> np.ndarray:
    size = operator.settings.size
    canvas = np.zeros(size * size)
    canvas[operator.pixels] = operator.coverage
    return canvas.reshape(size, size)


def square(half: float, color=(1.0, 1.0, 1.0), center=(0.0, 0.0, 0.0), tilt: float = 0.0) -> Mesh:
    """Facing up, or tilted about x."""
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = Rotation.from_euler("x", tilt).apply(corners) + center
    return Mesh.plain(vertices, [[0, 1, 2], [0, 2, 3]], color)


def sphere(subdivisions: int, color=(1.0, 1.0, 1.0)) -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh.plain(shape.vertices, shape.faces, color)


def dented() -> Mesh:
    shape = sphere(2)
    return patchwork(shape.vertices, shape.faces)


def linear(color: np.ndarray, encoding: str) -> np.ndarray:
    """A color as authored to linear albedo (IEC 61966-2-1)."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4) if encoding == "srgb" else color


def texel(texture: np.ndarray, u: float, v: float, encoding: str) -> np.ndarray:
    height, width = texture.shape[:2]
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    total = np.zeros(3)
    for column in (math.floor(x), math.floor(x) + 1):
        for row in (math.floor(y), math.floor(y) + 1):
            weight = (1 - abs(x - column)) * (1 - abs(y - row))
            total += weight * linear(texture[row % height, column % width] / 255, encoding)
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
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    shades = scipy_irradiance(normals * np.sign(normals @ camera.axes()[2])[:, None], light)
    for row, column in np.argwhere(ids >= 0):
        face = ids[row, column]
        at = [(2 * column + 1) / resolution - 1, 1 - (2 * row + 1) / resolution, 1]
        weights = np.linalg.solve(np.vstack([projected[mesh.faces[face], :2].T, np.ones(3)]), at)
        weights = weights.clip(0, 1) / weights.clip(0, 1).sum()  # corners are snapped to 1/256 sample
        pixel = (row // settings.samples, column // settings.samples)
        image[pixel] += shades[face] * albedo_at(mesh, face, weights, settings.encoding) / settings.samples**2
        coverage[pixel] += 1 / settings.samples**2
    return image, coverage


@pytest.mark.parametrize("camera", [OrthographicCamera(0.4, 5.0, 1.7), OrthographicCamera(math.pi / 3, 0.0, 2.0)])
@pytest.mark.parametrize(("encoding", "scale"), [("linear", 1.0), ("srgb", 2.5)])
def test_operators_shade_as_a_loop_over_the_samples_does(camera, encoding, scale):
    mesh, light, settings = dented(), draw(49, 3).float(), ImageSettings(size=9, samples=3, encoding=encoding)
    [operator] = build_operators(mesh, [camera], settings, RASTERIZER, scale)
    expected, coverage = shade_slowly(mesh, camera, light, settings)
    # The transfer is stored in float32, and 31 terms are summed.
    tolerance = 8 * EPS32 * np.abs(scale * expected).max()
    np.testing.assert_allclose(image_of(operator, light), scale * expected, rtol=0, atol=tolerance)
    np.testing.assert_allclose(coverage_map(operator), coverage, rtol=EPS32)


@pytest.mark.parametrize("light_from", [(0.0, 0.0, 1.0), (0.8, 0.0, 0.6), (-0.48, 0.6, -0.64)])
def test_a_sphere_under_directional_light_has_the_truncated_cosines_shading(light_from):
    """Facets reach an angle ρ from their center, so normals are off by at most ρ + ρ²; the series' slope is 1.02."""
    camera, size, samples = OrthographicCamera(1.1, 0.7, 2.0), 16, 4
    mesh = sphere(5)
    (operator,) = build_operators(mesh, [camera], ImageSettings(size, samples), RASTERIZER)
    lit = image_of(operator, directional(torch.tensor(light_from), torch.ones(3)))

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
    assert difference.mean() < 0.2 * reach  # errors of facets average out within a pixel


def test_coverage_of_a_square_on_sample_borders_is_its_area_in_each_pixel():
    """Half-width 5/8 at 8 pixels of 1/4: two pixels' worth and a half on either side of the center."""
    (operator,) = build_operators(square(0.625), [ABOVE], ImageSettings(size=8, samples=4), RASTERIZER)
    along = [0, 0.5, 1, 1, 1, 1, 0.5, 0]
    np.testing.assert_array_equal(coverage_map(operator), np.outer(along, along))


def test_the_image_is_upright():
    """From θ = π/2 on the +x side, up is up and right is +y."""
    corners = [[0, 0.5, 0.5], [0, 1, 0.5], [0, 1, 1], [0, 0.5, 1]]
    mesh = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])
    (operator,) = build_operators(mesh, [OrthographicCamera(math.pi / 2, 0, 2.0)], ImageSettings(4, 2), RASTERIZER)
    assert operator.pixels.tolist() == [3]


LAYOUTS = {  # mesh, samples, channels of the transfer
    "one color": (sphere(1, (0.8, 0.4, 0.1)), 3, 1),
    "one sample per pixel": (dented(), 1, 1),
    "mixed albedos": (dented(), 3, 3),
    "empty": (square(0.1, center=(20, 0, 0)), 2, 1),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_radiance_is_linear_in_the_light_with_the_gradient_of_central_differences(layout):
    """In batches of any shape; bands 3 and 5, 18 coefficients, have a gradient of exactly zero."""
    mesh, samples, channels = LAYOUTS[layout]
    settings = ImageSettings(6, samples)
    [operator] = build_operators(mesh, orbit_cameras(1, 2.2), settings, RASTERIZER, dtype=torch.float64)
    assert operator.transfer.shape == (channels, 31, len(operator.pixels)) and operator.transfer.dtype == torch.float64
    for batch in ((0,), (1,), (2, 3)):
        lights = draw(*batch, 49, 3)
        expected = [operator.radiance(light) for light in lights.flatten(0, -3)]
        found = operator.radiance(lights)
        assert found.shape == (*batch, 3, len(operator.pixels))
        for single, values in zip(expected, found.flatten(0, -3), strict=True):
            torch.testing.assert_close(values, single, rtol=0, atol=64 * EPS)

    light, step = draw(49, 3).requires_grad_(True), draw(49, 3, seed=2)
    upstream = draw(3, len(operator.pixels), seed=1)
    (gradient,) = torch.autograd.grad(operator.radiance(light), light, upstream)
    assert torch.equal(operator.light_gradient(upstream), gradient)
    # A step of any length gives the derivative, to the rounding of 31 terms of some 1.
    change = (operator.radiance(light + step) - operator.radiance(light - step)) / 2
    assert (gradient * step).sum().item() == pytest.approx((change * upstream).sum().item(), abs=1e-11)
    unlit = torch.ones(49, dtype=torch.bool).index_fill(0, nonzero_coefficients(6), False)
    assert unlit.sum() == 18 and not gradient[unlit].any()
    assert gradient[~unlit].all() == (len(operator.pixels) > 0)


def test_one_and_three_channels_give_the_same_radiance():
    """A red and a green square far apart; a third that is white and blue within a pixel makes three channels needed."""
    plain = concatenate(
        [square(0.2, (1, 0.2, 0.1), (0.6, 0.6, 0), 0.3), square(0.2, (0.1, 1, 0.3), (-0.6, -0.6, 0), 0.3)]
    )
    mixed = square(0.2, center=(0.6, -0.6, 0), tilt=0.3)
    mixed.corner_colors[0] = (0, 0, 1)
    [one], [three] = (
        build_operators(mesh, [ABOVE], ImageSettings(8, 4), RASTERIZER, dtype=torch.float64)
        for mesh in (plain, concatenate([plain, mixed]))
    )
    assert (len(one.transfer), len(three.transfer)) == (1, 3)
    shared = torch.isin(three.pixels, one.pixels)
    assert torch.equal(three.pixels[shared], one.pixels) and not shared.all()
    light, upstream = draw(49, 3), draw(3, len(three.pixels), seed=1) * shared
    torch.testing.assert_close(three.radiance(light)[:, shared], one.radiance(light), rtol=0, atol=64 * EPS)
    expected = one.light_gradient(upstream[:, shared])
    torch.testing.assert_close(three.light_gradient(upstream), expected, rtol=0, atol=64 * EPS)


@pytest.mark.parametrize("shape", [(36, 3), (49, 1), (49,), (2, 31, 3), (0, 3)])
def test_lights_of_another_degree_are_refused(shape):
    [operator] = build_operators(square(0.5), [ABOVE], ImageSettings(4, 1), RASTERIZER)
    with pytest.raises(InputError, match=rf"lights of shape {re.escape(str(shape))} .* degree 6"):
        operator.radiance(torch.zeros(shape))
