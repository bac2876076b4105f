"""Gloss against glTF's formulas, and Kulla and Conty's diffuse layer (2017), and Mitsuba.

A reflectance is always π f, the reflected radiance per irradiance.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre
from oracles import (
    Lobe,
    coat_albedo,
    directions_of,
    draw,
    draw_uniform,
    fragments_of,
    image_of,
    operator_of,
    relative_error,
    square,
    textured,
    toward,
)
from scipy import optimize
from scipy.special import roots_sh_legendre
from torch import Tensor

from renderer.camera import Camera, OrthographicCamera, orbit_cameras
from renderer.io.mitsuba_entries import environment, integrator, sensor_of
from renderer.light.basis import Harmonics, LocalBasis, SplitLight
from renderer.light.files import load_light
from renderer.light.harmonics import bands, basis, lambertian_factors
from renderer.light.lamps import Lamps, Projector
from renderer.light.ringing import AMPLITUDE, highlight_window, required_degree
from renderer.mesh import Mesh, concatenate, normalize, subdivide
from renderer.microfacets import reflectance
from renderer.mitsuba_scene import load, mitsuba, mitsuba_map, shape
from renderer.operators.apply import TransferOperator
from renderer.operators.rays import LocalLightView, Rays, Surface
from renderer.rendering import precompute_transfer, render
from renderer.settings import MIN_ROUGHNESS, ImageSettings
from renderer.shaded_view import ShadedView
from renderer.solids import solid, sphere
from renderer.surface.gloss import Gloss, SampleGloss, smallest_roughness

[CAMERA] = orbit_cameras(1, 2.2)
[NEARBY] = orbit_cameras(1, 2.2, fov=40.0)
DOUBLE = torch.float64
UP = torch.tensor([[0.0, 0, 1]], dtype=DOUBLE)


def double(value: float) -> Tensor:
    return torch.tensor([value], dtype=DOUBLE)


def unit_vector(polar: float, azimuth: float = 0.0) -> np.ndarray:
    x = math.sin(polar) * math.cos(azimuth)
    y = math.sin(polar) * math.sin(azimuth)
    return np.array([x, y, math.cos(polar)])


def hemisphere(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (N, 3) above z = 0 at `rings` nodes of z, and their solid angles (N,)."""
    z, weight = roots_sh_legendre(rings)
    azimuth_count = 2 * rings
    azimuth = 2 * np.pi * (np.arange(azimuth_count) + 0.5) / azimuth_count
    solid_angles = np.repeat(weight * 2 * np.pi / azimuth_count, azimuth_count)
    return directions_of(z[:, None], azimuth), solid_angles


COSINES = [1e-3, 0.02, 0.07, 0.2, 0.37, 0.6, 0.9, 0.99, 1 - 1e-5]


def quadrature_of_narrow_lobes(degree: int) -> Iterator[tuple[np.ndarray, Tensor]]:
    """Yield blocks of directions (N, 3) with y > 0, and twice their weighted harmonics.

    The nodes are closest together near the horizon and towards +x. The harmonics (N, K) of order
    m < 0 are odd in y and count as 0.
    """
    node, weight = roots_sh_legendre(240)
    fraction, step = roots_sh_legendre(120)
    azimuth = math.pi * fraction**2
    order = torch.arange((degree + 1) ** 2) - bands(degree) * (bands(degree) + 1)
    for root, ring in zip(np.split(node, 24), np.split(weight, 24), strict=True):
        directions = directions_of(root[:, None] ** 2, azimuth)
        solid_angles = (ring * root)[:, None] * 8 * math.pi * fraction * step
        values = basis(torch.from_numpy(directions), degree)
        yield directions, values * torch.from_numpy(solid_angles).reshape(-1, 1) * (order >= 0)


def projected(lobes: list[tuple[Lobe, float]], degree: int) -> Tensor:
    """Project lobes, each with its cosine n·v, times the cosine of the light: (lobes, K)."""
    total = torch.zeros(len(lobes), (degree + 1) ** 2, dtype=DOUBLE)
    for directions, harmonics in quadrature_of_narrow_lobes(degree):
        values = [lobe.reflectance(cosine, directions) for lobe, cosine in lobes]
        total += torch.from_numpy(np.stack(values) * directions[:, 2]) @ harmonics
    return total


# Metallic and Fresnel terms of the two parts of a metal's lobe, and of a varnish.
PARTS = {"colored": (1.0, (1, 0)), "white": (1.0, (0, 1)), "varnish": (0.0, (None, 1))}


ROUGHNESSES = [0.2, 0.22, 0.3, 0.37, 0.6, 0.85, 1.0]
SLOW = [pytest.param(degree, ROUGHNESSES, marks=pytest.mark.slow) for degree in (5, 20, 39, 40)]


@pytest.mark.parametrize(("degree", "roughnesses"), [(10, [0.2]), *SLOW])
def test_lobes_and_roughness_gradients_are_those_of_quadrature_in_float32(degree, roughnesses):
    """The errors are L2 norms over all harmonics, relative to those of the whole lobe."""
    step = 1e-4
    shape = (3, len(PARTS), len(roughnesses) * len(COSINES), -1)
    cases = itertools.product((0, step, -step), PARTS.values(), roughnesses, COSINES)
    lobes = [(Lobe(rough + move, *part[1]), cosine) for move, part, rough, cosine in cases]
    expected, above, below = projected(lobes, degree).view(shape)
    slope = (above - below) / (2 * step)

    def coefficients(part: str, roughness: Tensor, cosine: float) -> Tensor:
        """Evaluate the library's lobe (K,) in axes whose z-axis is the normal."""
        metallic, _ = PARTS[part]
        gloss = SampleGloss(roughness, double(metallic).float(), double(1.0).float())
        colored, white, frame = gloss.specular_transfer(UP.float(), toward(cosine).float(), degree)
        return frame.to_world(colored if part == "colored" else white)[:, 0]

    def require_close(found: Tensor, expected: Tensor, tolerance: float) -> None:
        whole = torch.stack([expected[0] + expected[1]] * 2 + [expected[2]])
        assert ((found - expected).norm(dim=1) <= tolerance * whole.norm(dim=1)).all()

    for row, (roughness, cosine) in enumerate(itertools.product(roughnesses, COSINES)):
        given = torch.tensor([roughness], dtype=torch.float32), torch.ones(1)
        functions = (partial(coefficients, part, cosine=cosine) for part in PARTS)
        pairs = [torch.autograd.functional.jvp(function, *given) for function in functions]
        values, tangents = (torch.stack(parts).double() for parts in zip(*pairs, strict=True))
        require_close(values, expected[:, row], 0.001)
        require_close(tangents, slope[:, row], 0.02)


def test_an_image_does_not_depend_on_whether_the_roughness_is_differentiable():
    """A number and a tensor give equal images. One roughness per face differs by rounding."""
    mesh = normalize(solid("pear"))
    light = positive_light(12)
    plain = render(mesh, CAMERA, light, 8, gloss=Gloss(0.2, 1.0))
    tensor = torch.tensor(0.2, dtype=DOUBLE, requires_grad=True)
    attacked = render(mesh, CAMERA, light, 8, gloss=Gloss(tensor, 1.0))
    torch.testing.assert_close(attacked.detach(), plain, rtol=0, atol=1e-14)
    by_face = torch.full((len(mesh.faces),), 0.2, dtype=DOUBLE)
    faces = render(mesh, CAMERA, light, 8, gloss=Gloss(by_face, 1.0))
    torch.testing.assert_close(faces, plain, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("cosine", "roughness"), [(0.9, 0.2), (0.3, 0.7), (1.0, 1.0)])
def test_the_reflectance_has_gltfs_terms_and_fresnels(cosine, roughness):
    directions, _ = hemisphere(5)
    found = reflectance(UP, toward(cosine), torch.from_numpy(directions), double(roughness))
    lobes = [Lobe(roughness, 1, 0), Lobe(roughness, 0, 1), Lobe(roughness)]
    expected = [lobe.reflectance(cosine, directions) for lobe in lobes]
    np.testing.assert_allclose(found, np.stack(expected), rtol=1e-9, atol=1e-14)


def zonal_amplitudes(roughness: float, degree: int, rings: int) -> np.ndarray:
    directions, solid_angles = hemisphere(rings)
    lobe = Lobe(roughness, 1, 0).reflectance(1.0, directions)
    polynomials = legendre.legvander(directions[:, 2], degree)
    return (lobe * directions[:, 2] * solid_angles) @ polynomials


def test_a_direction_below_the_surface_passes_the_coat_like_one_at_its_horizon():
    varnish = SampleGloss(double(0.4), double(0.0), double(1.0))
    below = torch.tensor([-0.01, -0.5, -0.99], dtype=DOUBLE)
    level = torch.zeros(3, dtype=DOUBLE)
    torch.testing.assert_close(varnish.coat_transmittance(below), varnish.coat_transmittance(level))


@pytest.mark.parametrize("roughness", [MIN_ROUGHNESS, 0.6])
def test_the_degree_for_a_roughness_is_the_last_band_with_the_amplitude(roughness):
    amplitudes = zonal_amplitudes(roughness, 45, rings=120)
    relative = amplitudes / amplitudes[0]
    degree = required_degree(roughness)
    assert degree <= 40
    assert relative[degree] > AMPLITUDE
    assert (relative[degree + 1 :] <= AMPLITUDE).all()


@pytest.mark.parametrize("roughness", [MIN_ROUGHNESS, 0.5])
def test_a_highlight_under_its_window_is_nowhere_negative(roughness):
    """The lobe is seen head-on, and has 0.7 of the squared roughness of the window's design."""
    degree = required_degree(roughness)
    first_of_band = torch.arange(degree + 1) ** 2
    window = highlight_window(degree, roughness, 0.7)[first_of_band].numpy()
    amplitudes = zonal_amplitudes(roughness * math.sqrt(0.7), degree, rings=120)
    cosines = np.cos(np.linspace(0, math.pi, 2000))
    radiance = legendre.legval(cosines, (2 * np.arange(degree + 1) + 1) * amplitudes * window)
    assert window[0] == 1
    assert radiance.min() >= -1e-3 * radiance.max()


def test_the_window_of_a_highlight_keeps_the_irradiance_with_ten_times_the_weight():
    """SciPy minimizes the squared errors, for a highlight that is not negative on a grid."""
    highlight = zonal_amplitudes(0.3, 4, rings=120)
    energies = 2 * np.arange(5) + 1
    # The clamped cosine has the coefficients π, 2π/3, π/4, 0 and -π/24.
    irradiance = np.array([1, 2 / 3, 1 / 4, 0, -1 / 24])
    weights = energies * ((highlight / highlight[0]) ** 2 + (10 * irradiance) ** 2)
    lobe = legendre.legvander(np.cos(np.linspace(0, math.pi, 300)), 4) * energies * highlight
    limits = [
        {"type": "ineq", "fun": lambda w: lobe @ w},
        {"type": "eq", "fun": lambda w: w[0] - 1},
    ]
    best = optimize.minimize(lambda w: weights @ (w - 1) ** 2, np.eye(5)[0], constraints=limits)
    found = highlight_window(4, 0.3, 1.0)[torch.arange(5) ** 2]
    np.testing.assert_allclose(found, best.x, atol=1e-3)


def test_white_surfaces_reflect_no_more_than_an_even_sky_and_dielectrics_all_of_it():
    """This is a white furnace for all roughness, metallic and specular_factor, from all sides."""
    ranges = [(0, 1, 21), (MIN_ROUGHNESS, 1, 9), (0, 1, 3), (0, 1, 2)]
    grid = torch.meshgrid(*(torch.linspace(*ends, dtype=DOUBLE) for ends in ranges), indexing="ij")
    cosine, roughness, metallic, specular_factor = (values.flatten() for values in grid)
    gloss = SampleGloss(roughness, metallic, specular_factor)
    views = torch.stack([-((1 - cosine**2).sqrt()), 0 * cosine, cosine], dim=1)
    normals = UP.expand_as(views)
    colored, white, _ = gloss.specular_transfer(normals, views, 0)
    diffuse = gloss.diffuse_factor(cosine) * gloss.factors_below_coat(0)[0] / math.pi
    specular = (colored + white)[0] * math.sqrt(4 * math.pi) / math.pi
    reflected = diffuse + specular
    assert diffuse.min() >= 0
    assert reflected.max() <= 1 + 1e-12
    of_dielectrics = reflected[metallic == 0]
    torch.testing.assert_close(of_dielectrics, torch.ones_like(of_dielectrics))


@dataclass(frozen=True)
class GraySurface:
    """Reference for a gray or white surface with gloss, after Kulla and Conty (2017)."""

    roughness: float
    metallic: float
    specular_factor: float
    albedo: float = 1.0

    def transmitted(self, cosine: float) -> float:
        return 1 - self.specular_factor * coat_albedo(cosine, self.roughness)

    def mean_transmitted(self) -> float:
        cosines, weight = roots_sh_legendre(12)
        fractions = np.array([self.transmitted(cosine) for cosine in cosines])
        return float(weight @ (2 * cosines * fractions))

    def reflectance(self, cosine: float, light: np.ndarray) -> np.ndarray:
        heights, ring_of_light = np.unique(light[:, 2], return_inverse=True)
        entering = np.array([self.transmitted(height) for height in heights])[ring_of_light]
        passed = self.transmitted(cosine) * entering / self.mean_transmitted()
        coat = self.specular_factor * Lobe(self.roughness).reflectance(cosine, light)
        metal = Lobe(self.roughness, self.albedo).reflectance(cosine, light)
        return self.metallic * metal + (1 - self.metallic) * (coat + self.albedo * passed)


# A white floor that fills the image from every side above it.
FLOOR = square(9)


def double_operator(mesh, camera, settings, light_basis, gloss) -> TransferOperator:
    return operator_of(mesh, camera, settings, basis=light_basis, dtype=DOUBLE, gloss=gloss)


@dataclass(frozen=True)
class FloorView:
    """The center of the floor, seen from a polar angle and lit from another one."""

    seen: float
    lit: float
    azimuth: float

    def reflectance(
        self, light: LocalBasis, coefficient: float, gloss: Gloss, floor: Mesh
    ) -> float:
        camera = OrthographicCamera(math.degrees(self.seen), 0.0, 1e-3)
        operator = double_operator(floor, camera, ImageSettings(1, 1), light, gloss)
        coefficients = UP.new_full((light.size, 3), coefficient)
        return float(operator.radiance(coefficients)[0, 0]) / math.cos(self.lit)


# Each pair of directions is also used the other way round, which tests reciprocity.
FLOOR_VIEWS = [FloorView(0.4, 1.0, 2.0), FloorView(1.45, 0.6, 2.8)]
FLOOR_VIEWS += [FloorView(view.lit, view.seen, view.azimuth) for view in FLOOR_VIEWS]


@pytest.mark.parametrize(
    "material", [(0.2, 0.0, 1.0), (1.0, 0.0, 0.4), (0.2, 1.0, 1.0), (1.0, 0.5, 0.7)], ids=str
)
@pytest.mark.parametrize("albedo", [0.0, 0.4, 1.0])
def test_local_lights_are_reflected_as_by_kulla_and_conty(material, albedo):
    gloss = Gloss(*material)
    surface = GraySurface(*material, albedo)
    floor = Mesh.plain(FLOOR.vertices, FLOOR.faces, np.full(3, albedo))
    for view in FLOOR_VIEWS:
        # The reference looks from -x, and the camera from +x.
        light = unit_vector(view.lit, view.azimuth + math.pi)
        [expected] = surface.reflectance(math.cos(view.seen), light[None])
        lamp = Lamps((tuple(4 * unit_vector(view.lit, view.azimuth)),))
        projector = Projector(1, math.degrees(view.lit), math.degrees(view.azimuth), 4.0)
        # A lamp of power 16 has the irradiance 1 at a distance of 4.
        assert view.reflectance(lamp, 16.0, gloss, floor) == pytest.approx(expected, rel=2e-3)
        assert view.reflectance(projector, 1.0, gloss, floor) == pytest.approx(expected, rel=2e-3)


class FloorUnderSky:
    """Zonal transfer (views, 7) of the floor, and the share of each view in a quadrature."""

    ZONAL = tuple(l * (l + 1) for l in range(7))

    def __init__(self, gloss: Gloss) -> None:
        cosines, weight = map(torch.from_numpy, roots_sh_legendre(24))
        polar_angles = [math.degrees(math.acos(cosine)) for cosine in cosines]
        rows = []
        for polar in polar_angles:
            camera = OrthographicCamera(polar, 17.2, 1.0)
            operator = double_operator(FLOOR, camera, ImageSettings(1, 1), Harmonics(6), gloss)
            rows.append(operator.by_channel[0, self.ZONAL, 0])
        self.transfer = torch.stack(rows)
        # 2 cosine d(cosine) over [0, 1].
        self.measure = 2 * weight * cosines
        directions = torch.stack([0 * cosines, (1 - cosines**2).sqrt(), cosines], dim=1)
        self.harmonics = basis(directions, 6)[:, self.ZONAL]


@pytest.mark.parametrize(
    "roughness, metallic, specular_factor", [(0.2, 0.0, 1.0), (0.2, 1.0, 1.0), (1.0, 0.5, 0.7)]
)
def test_a_sky_is_reflected_reciprocally_without_gain(roughness, metallic, specular_factor):
    """The transfer onto harmonics is symmetric. Varnish reflects all, A_l Y_l0 in closed form."""
    floor = FloorUnderSky(Gloss(roughness, metallic, specular_factor))
    matrix = (floor.harmonics * floor.measure[:, None]).T @ floor.transfer
    torch.testing.assert_close(matrix, matrix.T, rtol=0, atol=4e-3)
    reflected = floor.measure @ floor.transfer
    irradiance = (basis(UP, 6) * lambertian_factors(6))[0, floor.ZONAL]
    assert reflected[0] <= irradiance[0] * (1 + 1e-4)
    if metallic == 0:
        torch.testing.assert_close(reflected, irradiance, rtol=0, atol=2e-3)


@pytest.mark.parametrize(("polar", "lean"), [(40.1, 90.0), (70.0, 30.0)])
def test_the_part_of_the_sky_beside_a_wall_is_reflected_as_by_kulla_and_conty(polar, lean):
    """At the foot of a very high wall, half of an even sky is hidden, or more if it leans over."""
    specular_factor = 0.5
    along, up = -math.cos(math.radians(lean)), math.sin(math.radians(lean))
    top = 0.05 + 99 * along
    corners = [[0.05, -99.0, 0], [0.05, 99, 0], [top, 99, 99 * up], [top, -99, 99 * up]]
    wall = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]], np.ones(3))
    corner = concatenate([FLOOR, wall])
    camera = OrthographicCamera(polar, 180.0, 1e-3)
    settings = ImageSettings(1, 8, shadows=True)
    gloss = Gloss(1.0, 0.0, specular_factor)
    operator = double_operator(corner, camera, settings, Harmonics(6), gloss)
    even_sky = load_light("uniform", 6).double() * math.pi
    found = float(operator.radiance(even_sky)[0, 0])

    light, solid_angles = hemisphere(48)
    surface = GraySurface(1.0, 0.0, specular_factor)
    reflected = surface.reflectance(math.cos(math.radians(polar)), light)
    radiance = reflected * light[:, 2] * solid_angles
    is_visible = light[:, 0] * up < light[:, 2] * along
    assert found == pytest.approx(radiance[is_visible].sum(), rel=0.02)


def positive_light(degree: int) -> Tensor:
    """Draw a light whose radiance is nowhere negative, with less power in higher bands."""
    count = (degree + 1) ** 2
    light = draw(count, 3, seed=degree) / (1 + bands(degree)[:, None])
    light[0] = 0
    lowest = mitsuba_map(light, 64).min()
    mean = torch.zeros(count, 3, dtype=DOUBLE)
    mean[0] = math.sqrt(4 * math.pi)
    return light / (-1.1 * lowest) + mean


def mitsuba_radiance(mesh, light, surface, sample_count) -> Tensor:
    """Render a mesh with interpolated normals in an environment or by an emitter, (3, 16, 16)."""
    with mitsuba() as module:
        sampler = {"type": "multijitter", "sample_count": sample_count}
        sensor = sensor_of(CAMERA, 16) | {"sampler": sampler}
        corners = mesh.vertices[mesh.faces].reshape(-1, 3)
        triangles = np.arange(len(corners)).reshape(-1, 3)
        normals = mesh.corner_normals.reshape(-1, 3)
        mitsuba_mesh = shape(module, surface, corners, triangles, normals)
        emitter_samples = int(isinstance(light, dict))
        if isinstance(light, Tensor):
            light = environment({"bitmap": module.Bitmap(mitsuba_map(light, 256).float().numpy())})
        parts = {"sensor": sensor, "mesh": mitsuba_mesh, "light": light}
        parts |= {"type": "scene", "integrator": integrator(0, emitter_samples)}
        scene = load(module, parts)
        image = np.array(module.render(scene, spp=sample_count, seed=1))
    return math.pi * torch.from_numpy(image[..., :3]).double().permute(2, 0, 1)


def our_radiance(mesh: Mesh, light: Tensor, gloss: Gloss, shadows: bool = False) -> Tensor:
    settings = ImageSettings(16, 8, normals="smooth", shadows=shadows)
    light_basis = Harmonics(math.isqrt(len(light)) - 1)
    operator = double_operator(mesh, CAMERA, settings, light_basis, gloss)
    return image_of(operator, light)[:3]


def rough_mirror(roughness: float) -> dict[str, Any]:
    """Describe a metal without a Fresnel term for Mitsuba."""
    microfacets = {"distribution": "ggx", "alpha": roughness**2}
    return {"type": "roughconductor", "material": "none", **microfacets}


BALL = Mesh.plain(*sphere(4))
EGG = normalize(replace(BALL, vertices=BALL.vertices * [1.0, 0.7, 0.8]))


def test_metals_look_as_mitsubas_in_light_of_degree_6():
    """The error is that of the lobes, with Mitsuba's noise."""
    light = positive_light(6)
    found = our_radiance(EGG, light, Gloss(0.3, metallic=1.0))
    assert relative_error(found, mitsuba_radiance(EGG, light, rough_mirror(0.3), 144)) < 0.016


def test_the_highlight_of_a_lamp_is_mitsubas():
    """A point light has no noise except at the edges of pixels. The ball has few faces."""
    coarse_ball = Mesh.plain(*sphere(2))
    lamp = Lamps(((2.0, 1.0, 2.5),), power=1.0)
    settings = ImageSettings(16, 4, normals="smooth")
    operator = double_operator(coarse_ball, CAMERA, settings, lamp, Gloss(0.4, metallic=1.0))
    found = image_of(operator, UP.new_ones(1, 3))[:3]
    intensity = {"type": "rgb", "value": [1.0] * 3}
    emitter = {"type": "point", "position": list(lamp.positions[0]), "intensity": intensity}
    expected = mitsuba_radiance(coarse_ball, emitter, rough_mirror(0.4), 64)
    assert relative_error(found, expected) < 0.02


@pytest.mark.parametrize("roughness", [0.4, pytest.param(0.2, marks=pytest.mark.slow)])
def test_the_highlight_of_varnish_over_black_looks_as_mitsubas(roughness):
    black = {"type": "rgb", "value": [0.0, 0.0, 0.0]}
    varnish = rough_mirror(roughness) | {"type": "roughplastic", "int_ior": 1.5}
    varnish |= {"diffuse_reflectance": black}
    del varnish["material"]
    light = positive_light(6)
    black_ball = replace(BALL, corner_colors=0 * BALL.corner_colors)
    found = our_radiance(black_ball, light, Gloss(roughness))
    assert relative_error(found, mitsuba_radiance(BALL, light, varnish, 256)) < 0.04


def test_no_highlight_shines_through_the_wall_of_a_cup():
    """Neither image contains the reflection of the cup in itself."""
    cup = normalize(solid("cup"))
    white_cup = replace(cup, corner_colors=np.ones_like(cup.corner_colors))
    light = positive_light(6)
    gloss = Gloss(0.5, metallic=1.0)
    surface = {"type": "twosided", "material": rough_mirror(0.5)}
    expected = mitsuba_radiance(white_cup, light, surface, 64)
    shadowed = our_radiance(white_cup, light, gloss, shadows=True)
    assert relative_error(shadowed, expected) < 0.1
    unshadowed = our_radiance(white_cup, light, gloss)
    assert relative_error(unshadowed, expected) > 0.2


class GlossyView:
    """Weighted sum of the radiance of a glossy apple, as a function of all parameters."""

    LAMP = Lamps(((1.5, 0.4, 1.2),), radius=0.0)

    def __init__(self, normals: str, camera: Camera) -> None:
        self.mesh, self.camera = normalize(solid("apple")), camera
        self.settings = ImageSettings(12, 2, normals=normals)
        self.rays = Rays(self.mesh)
        self.view = fragments_of(self.mesh, camera, self.settings)
        self.upstream = 0.3 + 0.5 * draw_uniform(3, len(self.view.pixels), seed=9)

    def start(self) -> dict[str, Tensor]:
        face_count = len(self.mesh.faces)
        sample_count = len(self.view.sample_to_seen_face)
        shapes = {"lamp": (1, 3), "albedo": (sample_count, 3)}
        shapes |= dict.fromkeys(("roughness", "metallic", "specular_factor"), (face_count,))
        uniform = {}
        for seed, (name, size) in enumerate(shapes.items()):
            uniform[name] = 0.3 + 0.5 * draw_uniform(*size, seed=seed)
        vertices = torch.from_numpy(self.mesh.vertices)
        return {"environment": positive_light(6), "vertices": vertices, **uniform}

    def total(self, values: dict[str, Tensor]) -> Tensor:
        gloss = Gloss(values["roughness"], values["metallic"], values["specular_factor"])
        seen = (self.mesh, self.view, self.settings, values["vertices"])
        light = SplitLight(values["environment"], [(self.LAMP, values["lamp"])])
        lamp_view = LocalLightView(self.rays, Surface(*seen, gloss))
        view = ShadedView(*seen, values["albedo"], light, lamp_view, gloss=gloss)
        shown = view.pixel_radiance(self.camera, torch.zeros(3, self.settings.pixel_count))
        return (shown.radiance * self.upstream).sum()


@pytest.mark.parametrize(
    ("normals", "camera"),
    [("flat", CAMERA), ("smooth", NEARBY)],
    ids=["flat, orthographic", "smooth, perspective"],
)
def test_derivatives_by_all_parameters_are_finite_differences(normals, camera):
    """Each parameter is moved along a random direction."""
    view = GlossyView(normals, camera)
    start = view.start()
    variables = {name: value.clone().requires_grad_() for name, value in start.items()}
    gradients = torch.autograd.grad(view.total(variables), list(variables.values()))
    for seed, (name, gradient) in enumerate(zip(start, gradients, strict=True)):
        direction = draw(*gradient.shape, seed=seed)
        step = 2e-6 * direction / direction.abs().max()
        above = view.total({**start, name: start[name] + step})
        below = view.total({**start, name: start[name] - step})
        expected = float(above - below) / 2
        found = float((gradient * step).sum())
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-13), name


@pytest.mark.parametrize("options", [{"normals": "flat", "shadows": True}, {"bounces": 2}], ids=str)
def test_an_operator_gives_the_images_of_render(options):
    mesh = normalize(solid("cup"))
    light = positive_light(6).float()
    face_count = len(mesh.faces)
    roughness = MIN_ROUGHNESS + 0.8 * draw_uniform(face_count).float()
    gloss = Gloss(roughness, 0.3, draw_uniform(face_count, seed=1).float())
    cameras = [CAMERA, NEARBY]
    images = render(mesh, cameras, light, 8, gloss=gloss, **options)
    operators = precompute_transfer(gloss.on(mesh), cameras, 8, **options)
    found = torch.stack([operator.image(light) for operator in operators])
    torch.testing.assert_close(found, images, rtol=0, atol=2e-6)


def test_a_roughness_below_the_minimum_is_raised_to_it_with_a_warning():
    mesh = solid("pear")
    light = positive_light(6)
    with pytest.warns(UserWarning):
        mirror = render(mesh, CAMERA, light, 8, gloss=Gloss(0.0))
    assert torch.equal(mirror, render(mesh, CAMERA, light, 8, gloss=Gloss(MIN_ROUGHNESS)))


def test_the_parts_of_a_joined_mesh_and_subdivided_faces_keep_their_gloss():
    """A mesh without gloss is rough, without metal and without a specular layer."""
    pear = solid("pear")
    glossy = Gloss(torch.linspace(0.3, 1, len(pear.faces))).on(pear)
    table = solid("table")
    joined = concatenate([glossy, table]).gloss
    expected = np.concatenate([glossy.gloss, np.tile([1, 0, 0], (len(table.faces), 1))])
    np.testing.assert_array_equal(joined, expected)
    finer = subdivide(glossy, len(pear.vertices))
    np.testing.assert_array_equal(finer.gloss, glossy.gloss.repeat(4, axis=0))


def test_a_matte_part_of_a_glossy_mesh_is_rendered_as_a_matte_mesh():
    light = positive_light(6)
    mesh = concatenate([solid("pear"), solid("table")])
    matte = np.tile(np.float32([1, 0, 0]), (len(mesh.faces), 1))
    found = render(replace(mesh, gloss=matte), CAMERA, light, 16)
    torch.testing.assert_close(found, render(mesh, CAMERA, light, 16), rtol=0, atol=1e-12)


def with_gloss_texture(mesh: Mesh, texels: np.ndarray) -> Mesh:
    white = np.full((1, 1, 3), 255, dtype=np.uint8)
    covered = textured(mesh, np.zeros((len(mesh.faces), 3, 2)), white)
    return replace(covered, gloss_textures=(np.uint8(texels),))


def test_only_a_textured_gloss_is_multiplied_by_the_gloss_textures():
    mesh = with_gloss_texture(FLOOR, np.full((2, 2, 2), [102, 51]))
    light = positive_light(2)
    plain, given = Gloss(0.9 * 0.4, 0.2, 0.6), Gloss(0.9, 1.0, 0.6)
    pairs = [(replace(given, textured=True), plain), (given, given)]
    for gloss, expected in pairs:
        found = render(mesh, CAMERA, light, 2, gloss=gloss)
        without_texture = render(FLOOR, CAMERA, light, 2, gloss=expected)
        torch.testing.assert_close(found, without_texture, rtol=0, atol=1e-6)


def test_the_smoothest_hundredth_of_a_texture_does_not_count():
    """Of 201 texels with all roughnesses from 0 to 200, the two smallest do not count."""
    roughness = np.random.default_rng(0).permutation(201)
    texels = np.stack([roughness, roughness], axis=1)[None]
    mesh = with_gloss_texture(Gloss(0.5).on(solid("pear")), texels)
    assert smallest_roughness(mesh) == pytest.approx(0.5 * 2 / 255)
