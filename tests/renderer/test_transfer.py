import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from scipy.special import eval_legendre, sph_harm_y

from renderer.camera import OrthographicCamera, ring
from renderer.errors import InputError
from renderer.harmonics import live_coefficients
from renderer.lights import ambient, directional
from renderer.mesh import Mesh, concatenate
from renderer.transfer import Operator, PictureSettings, build_operators
from renderer.visibility import choose

EPS32 = torch.finfo(torch.float32).eps
BACKEND = choose("software")
LAMBERTIAN = [math.pi, 2 * math.pi / 3, math.pi / 4, 0, -math.pi / 24, 0, math.pi / 64]
ABOVE = OrthographicCamera(0, 0, 2.0)  # right is +y, up is -x
CUBE = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)


def radiance(operator: Operator, light: torch.Tensor) -> np.ndarray:
    """(3, P) float64."""
    live = light[live_coefficients(6)].double()
    return torch.einsum("kc,kcp->cp", live, operator.transfer.double()).numpy()


def picture(operator: Operator, light: torch.Tensor, size: int) -> np.ndarray:
    """(size, size, 3), black where nothing covers."""
    canvas = np.zeros((size * size, 3))
    canvas[operator.pixels] = radiance(operator, light).T
    return canvas.reshape(size, size, 3)


def coverage_map(operator: Operator, size: int) -> np.ndarray:
    canvas = np.zeros(size * size)
    canvas[operator.pixels] = operator.coverage
    return canvas.reshape(size, size)


def random_light(seed: int) -> torch.Tensor:
    """All 49 coefficients, the dead ones too."""
    return torch.randn(49, 3, generator=torch.Generator().manual_seed(seed))


def square(half: float, turn: float = 0.0, color=(1.0, 1.0, 1.0)) -> Mesh:
    """Level, facing up, turned about z."""
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Mesh.plain(Rotation.from_euler("z", turn).apply(corners), [[0, 1, 2], [0, 2, 3]], color)


def sphere(subdivisions: int, color=(1.0, 1.0, 1.0)) -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh.plain(shape.vertices, shape.faces, color)


def patchwork() -> Mesh:
    """A dented sphere: two textures and bare faces, vertex colours on all, UVs that wrap round."""
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
    """Σ A_l U_lm Y_lm(n), RGB, with scipy's complex harmonics."""
    polar, azimuth = math.atan2(math.hypot(normal[0], normal[1]), normal[2]), math.atan2(normal[1], normal[0])
    total = np.zeros(3)
    for l in range(7):
        for m in range(-l, l + 1):
            value = complex(sph_harm_y(l, abs(m), polar, azimuth))
            real = value.real if m == 0 else math.sqrt(2) * (-1) ** m * (value.real if m > 0 else value.imag)
            total += LAMBERTIAN[l] * light[l * l + l + m] * real
    return total


def texel(texture: np.ndarray, u: float, v: float) -> np.ndarray:
    height, width = texture.shape[:2]
    x, y = u * width - 0.5, (1 - v) * height - 0.5
    total = np.zeros(3)
    for column in (math.floor(x), math.floor(x) + 1):
        for row in (math.floor(y), math.floor(y) + 1):
            share = (1 - abs(x - column)) * (1 - abs(y - row))
            total += share * texture[row % height, column % width] / 255
    return total


def albedo_at(mesh: Mesh, face: int, weights: np.ndarray, encoding: str) -> np.ndarray:
    color = weights @ mesh.corner_colors[face].astype(float)
    if mesh.texture_ids[face] >= 0:
        color *= texel(mesh.textures[mesh.texture_ids[face]], *(weights @ mesh.corner_uvs[face].astype(float)))
    if encoding == "srgb":
        return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return color


def shade_slowly(mesh: Mesh, camera: OrthographicCamera, light: torch.Tensor, settings: PictureSettings) -> tuple:
    """(size, size, 3) radiance and (size, size) coverage, sample by sample."""
    projected = camera.project(mesh.vertices)
    resolution = settings.size * settings.samples
    ids = BACKEND.rasterise(projected[None], mesh.faces, resolution)[0]
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
    mesh, settings = patchwork(), PictureSettings(size=9, samples=3, encoding=encoding)
    cameras = [OrthographicCamera(0.4, 5.0, 1.7), OrthographicCamera(math.pi / 3, 0.0, 2.0)]
    for camera, operator in zip(cameras, build_operators(mesh, cameras, settings, BACKEND), strict=True):
        for light in (random_light(0), random_light(1)):
            image, coverage = shade_slowly(mesh, camera, light, settings)
            # Colours and texel positions are interpolated in float32, and transfer is stored in it.
            tolerance = 8 * EPS32 * np.abs(image).max()
            np.testing.assert_allclose(picture(operator, light, settings.size), image, rtol=0, atol=tolerance)
            np.testing.assert_allclose(coverage_map(operator, settings.size), coverage, rtol=EPS32)


def test_pixels_are_in_order_and_coverage_is_positive_up_to_1():
    (operator,) = build_operators(sphere(2), ring(1, 1.5), PictureSettings(size=8, samples=3), BACKEND)
    assert operator.transfer.shape == (31, 3, len(operator.pixels))
    assert (operator.transfer.dtype, operator.coverage.dtype) == (torch.float32, torch.float32)
    assert (operator.pixels.diff() > 0).all()
    assert operator.coverage.min() > 0 and operator.coverage.max() == 1


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_white_under_white_ambient_light_is_pi_times_coverage(encoding):
    settings = PictureSettings(size=12, samples=4, encoding=encoding)
    for operator in build_operators(sphere(2), ring(3, 2.0), settings, BACKEND):
        expected = math.pi * operator.coverage.double().numpy() * np.array([[0.5], [1.0], [2.0]])
        lit = radiance(operator, ambient(torch.tensor([0.5, 1.0, 2.0])))
        np.testing.assert_allclose(lit, expected, rtol=4 * EPS32)


@pytest.mark.parametrize("light_from", [(0.0, 0.0, 1.0), (0.8, 0.0, 0.6), (-0.48, 0.6, -0.64)])
def test_a_sphere_under_directional_light_has_the_truncated_cosines_shading(light_from):
    """Facets reach an angle ρ from their centre, so normals are off by at most ρ + ρ²; the series' slope is 1.02."""
    camera, size, samples = OrthographicCamera(1.1, 0.7, 2.0), 16, 4
    mesh = sphere(5)
    (operator,) = build_operators(mesh, [camera], PictureSettings(size, samples), BACKEND)
    lit = picture(operator, directional(torch.tensor(light_from), torch.ones(3)), size)

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
    """Half-width 5/8 at 8 pixels of 1/4: two pixels' worth and a half on either side of the centre."""
    (operator,) = build_operators(square(0.625), [ABOVE], PictureSettings(size=8, samples=4), BACKEND)
    along = [0, 0.5, 1, 1, 1, 1, 0.5, 0]
    np.testing.assert_array_equal(coverage_map(operator, 8), np.outer(along, along))


@pytest.mark.parametrize("turn", [0.1, 0.5, 1.2])
def test_coverage_of_a_turned_square_adds_up_to_its_area(turn):
    """Each side, of length 1, is off by at most half a sample's width, 1/128, along its length."""
    (operator,) = build_operators(square(0.5, turn), [ABOVE], PictureSettings(size=16, samples=8), BACKEND)
    area = float(operator.coverage.sum()) * (2 / 16) ** 2
    assert area == pytest.approx(1.0, abs=4 / 128)


def test_the_picture_is_upright():
    """From θ = π/2 on the +x side, up is up and right is +y."""
    corners = [[0, 0.5, 0.5], [0, 1, 0.5], [0, 1, 1], [0, 0.5, 1]]
    mesh = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])
    (operator,) = build_operators(mesh, [OrthographicCamera(math.pi / 2, 0, 2.0)], PictureSettings(4, 2), BACKEND)
    assert operator.pixels.tolist() == [3]


def test_each_view_is_what_it_is_alone():
    mesh, cameras, settings = patchwork(), ring(3, 2.0), PictureSettings(size=6, samples=2)
    together = build_operators(mesh, cameras, settings, BACKEND)
    for camera, operator in zip(cameras, together, strict=True):
        (alone,) = build_operators(mesh, [camera], settings, BACKEND)
        for name in ("transfer", "coverage", "pixels"):
            torch.testing.assert_close(getattr(operator, name), getattr(alone, name), rtol=0, atol=0)


def test_winding_does_not_matter():
    mesh, settings = patchwork(), PictureSettings(size=8, samples=3)
    flipped = replace(
        mesh,
        faces=mesh.faces[:, ::-1],
        corner_colors=mesh.corner_colors[:, ::-1],
        corner_uvs=mesh.corner_uvs[:, ::-1],
    )
    for plain, turned in zip(
        *(build_operators(m, ring(2, 2.0), settings, BACKEND) for m in (mesh, flipped)), strict=True
    ):
        torch.testing.assert_close(turned.pixels, plain.pixels)
        torch.testing.assert_close(turned.coverage, plain.coverage, rtol=0, atol=0)
        # Corners are summed in another order, in float32.
        torch.testing.assert_close(
            turned.transfer, plain.transfer, rtol=0, atol=8 * EPS32 * float(plain.transfer.max())
        )


def test_faces_turned_away_do_not_shade():
    box = trimesh.convex.convex_hull(CUBE)
    camera, settings = OrthographicCamera(math.pi / 3, 0.4, 2.0), PictureSettings(size=8, samples=4)
    white = Mesh.plain(box.vertices, box.faces)
    away = white.face_normals() @ camera.axes()[2] < 0
    assert 0 < away.sum() < len(away)
    painted = replace(white, corner_colors=np.where(away[:, None, None], 0.0, white.corner_colors).astype(np.float32))
    (seen,), (same,) = (build_operators(mesh, [camera], settings, BACKEND) for mesh in (white, painted))
    torch.testing.assert_close(same.transfer, seen.transfer, rtol=0, atol=0)


def test_hidden_faces_do_not_shade():
    """A red square just below a white one, listed first."""
    below = replace(square(0.5, color=(1.0, 0.0, 0.0)), vertices=square(0.5).vertices - [0, 0, 0.1])
    settings = PictureSettings(size=8, samples=2)
    (both,) = build_operators(concatenate([below, square(0.5)]), [ABOVE], settings, BACKEND)
    (alone,) = build_operators(square(0.5), [ABOVE], settings, BACKEND)
    torch.testing.assert_close(both.transfer, alone.transfer, rtol=0, atol=0)


def test_gain_multiplies_the_radiance_and_leaves_the_coverage():
    mesh, settings = patchwork(), PictureSettings(size=6, samples=2, encoding="srgb")
    (plain,), (bright,) = (build_operators(mesh, ring(1, 2.0), settings, BACKEND, gain) for gain in (1.0, 2.5))
    torch.testing.assert_close(bright.transfer, 2.5 * plain.transfer, rtol=2 * EPS32, atol=0)
    torch.testing.assert_close(bright.coverage, plain.coverage, rtol=0, atol=0)


def test_a_mesh_outside_the_picture_leaves_an_empty_operator():
    mesh = replace(square(0.1), vertices=square(0.1).vertices + np.array([0.8, 0, 0]))
    (operator,) = build_operators(mesh, [OrthographicCamera(0, 0, 0.5)], PictureSettings(size=4, samples=2), BACKEND)
    assert operator.transfer.shape == (31, 3, 0)
    assert len(operator.coverage) == len(operator.pixels) == 0


def test_settings_that_make_no_picture_are_refused():
    with pytest.raises(InputError, match=r"renderer\.samples=0"):
        PictureSettings(samples=0)
    with pytest.raises(InputError, match=r"renderer\.encoding=gamma"):
        build_operators(square(0.5), [ABOVE], PictureSettings(size=4, samples=1, encoding="gamma"), BACKEND)
