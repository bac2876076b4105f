"""Gloss: lobes against quadrature, images against Mitsuba, gradients against finite differences, energy."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from renderer.camera import Camera, OrthographicCamera, orbit_cameras
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh, concatenate, normalize, subdivide
from renderer.geometry.shapes import solid, sphere
from renderer.io.mitsuba import load, mitsuba, mitsuba_map, shape
from renderer.io.mitsuba_entries import environment, integrator, sensor_of
from renderer.light.basis import Harmonics, LightPaths, LocalBasis, SplitLight
from renderer.light.harmonics import bands, basis, lambertian_factors
from renderer.light.lamps import Lamps
from renderer.light.presets import load_light
from renderer.light.projector import Projector
from renderer.rendering import precompute_transfer, render
from renderer.settings import MIN_ROUGHNESS, ImageSettings
from renderer.shaded_view import ShadedView
from renderer.surface.gloss import Gloss, SampleGloss
from renderer.surface.microfacets import AMPLITUDE, degree_for, highlight_window, reflectance
from renderer.transport.lamp_paths import _reflectance
from renderer.transport.operators import build_operators
from renderer.transport.rays import Rays
from renderer.visibility.fragments import build_fragments
from renderer.visibility.rasterizers import choose

ROUGHNESS = [0.2, 0.3, 0.5, 0.8]
[CAMERA] = orbit_cameras(1, 2.2)
NEARBY = orbit_cameras(1, 2.2, fov=0.7)[0]
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
UP = torch.tensor([[0.0, 0, 1]], dtype=torch.float64)


def double(value: float) -> torch.Tensor:
    return torch.tensor([value], dtype=torch.float64)


def toward(cosine: float) -> torch.Tensor:
    return torch.tensor([[-math.sqrt(1 - cosine**2), 0, cosine]], dtype=torch.float64)


def gltf_reflectance(cosine: float, light: np.ndarray, roughness: float, f0: float, f90: float = 1.0) -> np.ndarray:
    """π f as in the appendix of glTF 2.0, of light from directions (N, 3); f0 of NaN: by Snell's and Fresnel's laws
    for a refractive index of 1.5 instead of Schlick's."""
    view, alpha = toward(cosine)[0].numpy(), roughness**2
    half = (light + view) / np.linalg.norm(light + view, axis=1, keepdims=True)
    nl, nv, nh, vh = light[:, 2], view[2], half[:, 2], np.clip(half @ view, 0, 1)
    distribution = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
    masking = [2 * x / (x + np.sqrt(alpha**2 + (1 - alpha**2) * x**2)) for x in (nl, nv)]
    inside = np.cos(np.arcsin(np.sqrt(1 - vh**2) / 1.5))
    amplitudes = (vh - 1.5 * inside) / (vh + 1.5 * inside), (1.5 * vh - inside) / (1.5 * vh + inside)
    fresnel = f0 + (f90 - f0) * (1 - vh) ** 5 if f0 == f0 else np.square(amplitudes).mean(0)
    return np.pi * fresnel * distribution * masking[0] * masking[1] / (4 * nl * nv)


def hemisphere(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) above z = 0 and their solid angles: Gauss and Legendre's in z."""
    node, weight = np.polynomial.legendre.leggauss(rings)
    z, azimuth = (node[:, None] + 1) / 2, 2 * np.pi * (np.arange(2 * rings) + 0.5) / (2 * rings)
    radius = np.sqrt(1 - z**2)
    directions = np.stack(np.broadcast_arrays(radius * np.cos(azimuth), radius * np.sin(azimuth), z), axis=-1)
    return directions.reshape(-1, 3), np.repeat(weight / 2 * 2 * np.pi / len(azimuth), len(azimuth))


@pytest.mark.parametrize(("roughness", "most"), [(0.2, 0.004), (0.5, 0.004), (1.0, 0.003)])
@pytest.mark.parametrize("apart", [True, False], ids=["orthographic", "perspective"])
def test_lobes_are_those_of_the_reflectance_by_quadrature(roughness, most, apart):
    """To degree 6, in the L2 norm, of a normal that looks anywhere, seen from one side or from three at once."""
    directions, solid_angles = hemisphere(int(45 / roughness))
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))[0]
    harmonics, views = basis(torch.from_numpy(directions) @ turn.T, 6), [0.95, 0.6, 0.25]
    for metallic, f0, f90 in ((1.0, 1.0, 0.0), (1.0, 0.0, 1.0), (0.0, math.nan, 1.0)):
        gloss, ours = SampleGloss(double(roughness), double(metallic), double(1.0)), []
        for seen in torch.cat([toward(cosine) for cosine in views]).split(1 if apart else 3):
            colored, white, frame = gloss.transfer((UP @ turn.T).expand_as(seen), seen @ turn.T, 6)
            ours.append(frame.to_world(colored if f0 == 1 else white).T)
        for cosine, row in zip(views, torch.cat(ours), strict=True):
            lobe = gltf_reflectance(cosine, directions, roughness, f0, f90) * directions[:, 2] * solid_angles
            exact = torch.from_numpy(lobe) @ harmonics
            whole = gltf_reflectance(cosine, directions, roughness, f0 or 0.04) * directions[:, 2] * solid_angles
            assert (row - exact).norm() <= most * (torch.from_numpy(whole) @ harmonics).norm()


def test_reflectance_is_that_of_gltf_and_of_fresnel():
    directions, _ = hemisphere(5)
    for cosine, roughness in ((0.9, 0.2), (0.3, 0.7), (1.0, 1.0)):
        ours = reflectance(UP, toward(cosine), torch.from_numpy(directions), double(roughness))
        for value, fresnel in zip(ours, ((1, 0), (0, 1), (math.nan, 1)), strict=True):
            expected = gltf_reflectance(cosine, directions, roughness, *fresnel)
            np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-14)


def test_degree_for_is_the_least_above_which_no_band_has_the_amplitude():
    directions, solid_angles = hemisphere(120)
    for roughness in (MIN_ROUGHNESS, 0.3, 0.6):
        lobe = gltf_reflectance(1.0, directions, roughness, 1, 0) * directions[:, 2] * solid_angles
        amplitudes = lobe @ np.polynomial.legendre.legvander(directions[:, 2], 45)
        degree = degree_for(roughness)
        assert degree <= 40 and (amplitudes[degree + 1 :] <= AMPLITUDE * amplitudes[0]).all()
        assert amplitudes[degree] > AMPLITUDE * amplitudes[0]


def test_a_highlight_under_its_window_is_nowhere_negative():
    """Of lobes seen head-on, at the design's roughness and above, by Legendre series at 2,000 angles."""
    angles = np.cos(np.linspace(0, math.pi, 2000))
    directions, solid_angles = hemisphere(160)
    for roughness in (MIN_ROUGHNESS, 0.25, 0.5):
        degree = degree_for(roughness)
        window = highlight_window(degree, roughness, 0.7)[torch.arange(degree + 1) ** 2].numpy()
        lobe = gltf_reflectance(1.0, directions, roughness * math.sqrt(0.7), 1, 0) * directions[:, 2] * solid_angles
        amplitudes = lobe @ np.polynomial.legendre.legvander(directions[:, 2], degree)
        radiance = np.polynomial.legendre.legval(angles, (2 * np.arange(degree + 1) + 1) * amplitudes * window)
        assert window[0] == 1 and radiance.min() >= -1e-3 * radiance.max()


def test_an_even_sky_is_never_exceeded():
    """A white furnace: white surfaces of any gloss, from every side. Dielectrics meet it."""
    steps = [torch.linspace(0, 1, count, dtype=torch.float64) for count in (41, 17, 3, 2)]
    cosine, rough, metallic, strength = (values.flatten() for values in torch.meshgrid(*steps, indexing="ij"))
    gloss = SampleGloss(MIN_ROUGHNESS + (1 - MIN_ROUGHNESS) * rough, metallic, strength)
    views = torch.stack([-((1 - cosine**2).sqrt()), 0 * cosine, cosine], dim=1)
    colored, white, _ = gloss.transfer(UP.expand_as(views), views, 0)
    diffuse = gloss.diffuse(UP.expand_as(views), views) * gloss.entering_bands(0)[0] / math.pi
    reflected = diffuse + (colored + white)[0] * math.sqrt(4 * math.pi) / math.pi
    assert diffuse.min() >= 0 and reflected.max() <= 1 + 1e-12
    dielectric = metallic == 0
    torch.testing.assert_close(reflected[dielectric], torch.ones_like(reflected[dielectric]))


# A floor that fills the image from every side above it
FLOOR = Mesh.plain(
    np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]]), np.array([[0, 1, 2], [0, 2, 3]]), np.ones(3)
)
GLOSSES = [(0.0, 1.0), (0.0, 0.4), (1.0, 1.0), (0.5, 0.7)]  # metallic and strength


def half_hemisphere() -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) with y > 0 and twice their solid angles, closest together towards +x and the horizon, where
    lobes of grazing light are narrow."""
    (node, weight), (around, step) = (np.polynomial.legendre.leggauss(count) for count in (100, 50))
    root, fraction = (node[:, None] + 1) / 2, (around + 1) / 2
    z, azimuth = root**2, math.pi * fraction**3
    radius = np.sqrt(1 - z**2)
    directions = np.stack(np.broadcast_arrays(radius * np.cos(azimuth), radius * np.sin(azimuth), z), axis=-1)
    solid_angles = weight[:, None] * root * 3 * math.pi * fraction**2 * step
    return directions.reshape(-1, 3), solid_angles.ravel()


@cache
def coat_albedo_by_quadrature(cosine: float, roughness: float) -> float:
    """The fraction of a beam that a dielectric reflects, from glTF's formulas."""
    directions, solid_angles = half_hemisphere()
    return float(gltf_reflectance(cosine, directions, roughness, math.nan) * directions[:, 2] @ solid_angles) / math.pi


def expected_reflectance(light: np.ndarray, cosine: float, roughness: float, metallic: float, strength: float):
    """π f of a white surface for light from directions (N, 3), after Kulla and Conty (2017)."""
    node, weight = np.polynomial.legendre.leggauss(12)
    of_nodes = [coat_albedo_by_quadrature((x + 1) / 2, roughness) for x in node]
    mean = 1 - strength * float((weight / 2) @ (of_nodes * (node + 1)))
    leaving = 1 - strength * coat_albedo_by_quadrature(cosine, roughness)
    heights, ring = np.unique(light[:, 2], return_inverse=True)
    entering = 1 - strength * np.array([coat_albedo_by_quadrature(z, roughness) for z in heights])[ring]
    coat = strength * gltf_reflectance(cosine, light, roughness, math.nan)
    metal = gltf_reflectance(cosine, light, roughness, 1.0)
    return metallic * metal + (1 - metallic) * (coat + leaving * entering / mean)


def from_aside(polar: float, azimuth: float = 0.0) -> np.ndarray:
    return np.array([math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)])


def local_reflectance(basis: LocalBasis, coefficient: float, irradiance: float, camera: Camera, gloss: Gloss) -> float:
    """π f of the floor at the origin, in the light of a basis with one coefficient for all functions."""
    settings = ImageSettings(1, 1)
    [operator] = build_operators(FLOOR, [camera], settings, choose("numpy"), basis=basis, dtype=UP.dtype, gloss=gloss)
    return float(operator.radiance(UP.new_full((basis.size, 3), coefficient))[0, 0]) / irradiance


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
@pytest.mark.parametrize(("metallic", "strength"), GLOSSES)
def test_lamps_and_projectors_are_reflected_as_by_kulla_and_conty_and_reciprocally(roughness, metallic, strength):
    """A floor, at two pairs of directions, of which one is grazing; each pair also the other way round."""
    gloss = Gloss(roughness, metallic, strength)
    for polar, other, azimuth in ((0.4, 1.0, 2.0), (1.45, 0.6, 2.8)):
        for seen, lit in ((polar, other), (other, polar)):
            light, camera = from_aside(lit, azimuth), OrthographicCamera(seen, 0.0, 1e-3)
            flat = np.array([from_aside(lit, azimuth + math.pi)])  # `toward` looks from -x
            expected = expected_reflectance(flat, math.cos(seen), roughness, metallic, strength)[0]
            lamp, projector = Lamps((tuple(4 * light),)), Projector(1, lit, azimuth, 4.0)
            of_lamp = local_reflectance(lamp, 16.0, math.cos(lit), camera, gloss)
            of_projector = local_reflectance(projector, 1.0, math.cos(lit), camera, gloss)
            assert of_lamp == pytest.approx(expected, rel=2e-3) and of_projector == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("roughness", [0.2, 0.3, 0.5, 0.75, 1.0])
def test_no_beam_of_a_lamp_is_reflected_with_more_than_its_energy(roughness):
    """Into all directions, from nearly grazing angles on, by a white surface. Varnish reflects all of it."""
    directions, solid_angles = half_hemisphere()
    views = torch.from_numpy(directions)
    measure = torch.from_numpy(directions[:, 2] * solid_angles) / math.pi
    for polar in (0.0, 0.8, 1.2, 1.4, 1.5, 1.55):
        beam = torch.from_numpy(from_aside(polar, math.pi)).expand_as(views)
        for metallic, strength in GLOSSES:
            gloss = SampleGloss(double(roughness), double(metallic), double(strength))
            surface = SimpleNamespace(gloss=gloss, normals=UP.expand_as(views), toward=views, points=0 * views)
            nothing = torch.zeros(len(views), dtype=torch.int64)
            paths = LightPaths(torch.arange(len(views)), nothing, beam, beam[:, 2])
            reflected = float(_reflectance(surface, views.new_ones(len(views), 1), paths)[:, 0] @ measure)
            assert reflected <= 1 + 1e-4
            if metallic == 0:
                assert reflected >= 1 - 2e-3


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
@pytest.mark.parametrize(("metallic", "strength"), GLOSSES)
def test_environment_light_is_reflected_reciprocally_and_with_no_more_than_its_energy(roughness, metallic, strength):
    """By a white floor. All beams reflect the energy Σ e_l Y_l0: of varnish the irradiance, A_l Y_l0, in closed form.
    The operators of all views, projected on harmonics, are a symmetric matrix."""
    node, weight = np.polynomial.legendre.leggauss(40)
    cosines, zonal = (node + 1) / 2, [l * (l + 1) for l in range(7)]
    cameras = [OrthographicCamera(math.acos(cosine), 0.3, 1.0) for cosine in cosines]
    gloss, settings = Gloss(roughness, metallic, strength), ImageSettings(1, 1)
    given = {"basis": Harmonics(6), "dtype": UP.dtype, "gloss": gloss}
    operators = build_operators(FLOOR, cameras, settings, choose("numpy"), **given)
    seen = torch.stack([operator.by_channel[0, zonal, 0] for operator in operators])  # (views, 7)
    above = torch.tensor([[0.0, 0.0, 1.0]], dtype=UP.dtype)
    measure = torch.from_numpy(weight * cosines)  # 2 cosine dcosine: the mean over the hemisphere's irradiance
    reflected, irradiance = measure @ seen, (basis(above, 6) * lambertian_factors(6))[0, zonal]
    views = torch.stack([0 * measure, (1 - torch.from_numpy(cosines) ** 2).sqrt(), torch.from_numpy(cosines)], dim=1)
    matrix = (basis(views, 6)[:, zonal] * measure[:, None]).T @ seen
    torch.testing.assert_close(matrix, matrix.T, rtol=0, atol=4e-3)
    if metallic == 0:
        torch.testing.assert_close(reflected, irradiance, rtol=0, atol=2e-3)
    assert reflected[0] <= irradiance[0] * (1 + 1e-4)


@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_the_part_of_the_sky_that_a_wall_leaves_is_reflected_as_by_kulla_and_conty(strength):
    """At the foot of a wall without end, which hides half of an even sky."""
    wall = np.array([[0.05, -99.0, 0], [0.05, 99, 0], [0.05, 99, 99], [0.05, -99, 99]])
    corner = Mesh.plain(np.concatenate([FLOOR.vertices, wall]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))
    white = replace(corner, corner_colors=np.ones_like(corner.corner_colors))
    camera, sky = OrthographicCamera(0.7, math.pi, 1e-3), load_light("uniform", 6).double() * math.pi
    settings, given = ImageSettings(1, 1, shadows=True), {"basis": Harmonics(6), "dtype": UP.dtype}
    [operator] = build_operators(white, [camera], settings, choose("numpy"), gloss=Gloss(1.0, 0.0, strength), **given)
    light, solid_angles = hemisphere(24)
    free = light[:, 0] < 0  # on the camera's side, as `toward` looks
    reflectance = expected_reflectance(light, math.cos(0.7), 1.0, 0.0, strength)
    expected = float((reflectance * light[:, 2] * solid_angles)[free].sum())
    assert float(operator.radiance(sky)[0, 0]) == pytest.approx(expected, rel=0.02)


def positive_light(degree: int) -> torch.Tensor:
    """Random coefficients whose radiance is nowhere negative, of less power in higher bands, as in nature."""
    random = torch.randn((degree + 1) ** 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(degree))
    light = random / (1 + bands(degree)[:, None])
    light[0] = 0
    return light / (-1.1 * mitsuba_map(light, 64).min()) + torch.eye(len(light), 3)[:, :1] * math.sqrt(4 * math.pi)


def mitsuba_radiance(mesh: Mesh, light: torch.Tensor, surface: dict, spp: int, size: int = 16) -> torch.Tensor:
    """(3, size, size) in our units, of one with interpolated normals."""
    with mitsuba() as module:
        bitmap = module.Bitmap(mitsuba_map(light, 256).float().numpy())
        even = {"sampler": {"type": "multijitter", "sample_count": spp}}
        mesh_of = shape(module, surface, mesh.vertices, mesh.faces, mesh.vertex_normals)
        entries = {"integrator": integrator(0), "sky": environment({"bitmap": bitmap}), "shape": mesh_of}
        scene = load(module, {"type": "scene", **entries, "sensor": sensor_of(CAMERA, size) | even})
        image = np.array(module.render(scene, spp=spp, seed=1))
    return math.pi * torch.from_numpy(image[..., :3]).double().permute(2, 0, 1)


def our_radiance(mesh: Mesh, light: torch.Tensor, gloss: Gloss, size: int = 16, **given: bool) -> torch.Tensor:
    settings, degree = ImageSettings(size, 8, normals="smooth", **given), math.isqrt(len(light)) - 1
    basis = Harmonics(degree)
    [operator] = build_operators(mesh, [CAMERA], settings, choose("numpy"), basis=basis, dtype=light.dtype, gloss=gloss)
    canvas = light.new_zeros(3, size * size).index_copy(1, operator.pixels, operator.radiance(light))
    return canvas.unflatten(1, (size, size))


def difference(ours: torch.Tensor, theirs: torch.Tensor) -> float:
    return float((ours - theirs).norm() / theirs.norm())


BALL = Mesh.plain(*sphere(4))
EGG = normalize(replace(BALL, vertices=BALL.vertices * [1.0, 0.7, 0.8]))


@pytest.mark.parametrize(
    ("mesh", "roughness", "model", "cut"),
    [
        (EGG, 0.3, 0.016, 0.032),
        pytest.param(BALL, 0.8, 0.02, 0.04, marks=pytest.mark.slow),
        pytest.param(BALL, 0.2, 0.016, 0.018, marks=pytest.mark.slow),
        pytest.param(BALL, 0.3, 0.016, 0.035, marks=pytest.mark.slow),
        pytest.param(EGG, 0.5, 0.019, 0.05, marks=pytest.mark.slow),
    ],
)
def test_conductors_look_as_mitsubas(mesh, roughness, model, cut):
    """A mirror's, without Fresnel's term. `model`: the root mean square error of the lobes, in light of degree 6, with
    Mitsuba's noise. `cut`: that in light of degree 20, of which `degree_for` is left."""
    mirror = {"type": "roughconductor", "distribution": "ggx", "alpha": roughness**2, "material": "none"}
    gloss, light, wide = Gloss(roughness, metallic=1.0), positive_light(6), positive_light(20)
    assert difference(our_radiance(mesh, light, gloss), mitsuba_radiance(mesh, light, mirror, 144)) < model
    few, theirs = wide[: (degree_for(roughness) + 1) ** 2], mitsuba_radiance(mesh, wide, mirror, 144)
    assert difference(our_radiance(mesh, few, gloss), theirs) < cut
    assert difference(our_radiance(mesh, wide, gloss), theirs) < 1.25 * model


@pytest.mark.parametrize("roughness", [0.4, pytest.param(0.2, marks=pytest.mark.slow)])
def test_varnish_looks_as_mitsubas(roughness):
    """Its highlight, over black."""
    varnish = {"type": "roughplastic", "distribution": "ggx", "alpha": roughness**2, "int_ior": 1.5}
    varnish["diffuse_reflectance"] = {"type": "rgb", "value": [0.0, 0.0, 0.0]}
    black, light = replace(BALL, corner_colors=0 * BALL.corner_colors), positive_light(6)
    ours, theirs = our_radiance(black, light, Gloss(roughness)), mitsuba_radiance(BALL, light, varnish, 256)
    assert difference(ours, theirs) < 0.04


LAMP = Lamps(((1.5, 0.4, 1.2),), radius=0.0)
PARAMETERS = ("environment", "lamp", "vertices", "albedo", "roughness", "metallic", "strength")


@pytest.mark.parametrize("normals", ["smooth", "flat"])
@pytest.mark.parametrize("camera", [CAMERA, NEARBY], ids=["orthographic", "perspective"])
def test_derivatives_by_all_parameters_are_those_of_finite_differences(normals, camera):
    """Of a view with fixed visibility, along a random direction of each parameter."""
    mesh, settings = normalize(solid("apple")), ImageSettings(12, 2, normals=normals)
    [view] = build_fragments(mesh.vertices, mesh.faces, [camera], settings, choose("numpy"))
    random, rays = torch.Generator().manual_seed(0), Rays(mesh)

    def uniform(*shape: int) -> torch.Tensor:
        return 0.3 + 0.5 * torch.rand(shape, dtype=torch.float64, generator=random)

    count = len(mesh.faces)
    start = [positive_light(6), uniform(1, 3), torch.from_numpy(mesh.vertices), uniform(len(view.face), 3)]
    start += [uniform(count), uniform(count), uniform(count)]
    upstream = uniform(3, len(view.pixels))

    def total(values: list[torch.Tensor]) -> torch.Tensor:
        environment, lamp, vertices, albedo, *gloss = values
        light = SplitLight(environment, [(LAMP, lamp)])
        shown = ShadedView(mesh, view, settings, vertices, albedo, light, rays, gloss=Gloss(*gloss))
        return (shown.radiance() * upstream).sum()

    variables = [value.clone().requires_grad_() for value in start]
    gradients = torch.autograd.grad(total(variables), variables)
    for index, (name, gradient) in enumerate(zip(PARAMETERS, gradients, strict=True)):
        direction = torch.randn(gradient.shape, dtype=torch.float64, generator=random)
        step = 1e-5 * direction / direction.abs().max()
        ends = [total([*start[:index], start[index] + sign * step, *start[index + 1 :]]) for sign in (1, -1)]
        expected = float(ends[0] - ends[1]) / 2
        assert abs(float((gradient * step).sum()) - expected) <= 1e-6 * abs(expected), name


@pytest.mark.parametrize("given", [{}, {"normals": "flat"}, {"shadows": True}, {"bounces": 2}])
def test_an_operator_gives_the_images_of_render(given):
    mesh, light = normalize(solid("cup")), positive_light(6).float()
    gloss = Gloss(torch.rand(len(mesh.faces)), 0.3, torch.rand(len(mesh.faces)))
    with pytest.warns(UserWarning, match="roughness"):
        images = render(mesh, [CAMERA, NEARBY], light, 24, gloss=gloss, **given)
        operators = precompute_transfer(gloss.on(mesh), [CAMERA, NEARBY], 24, **given)
    torch.testing.assert_close(torch.stack([each.image(light) for each in operators]), images, rtol=0, atol=2e-6)


@pytest.mark.parametrize(("roughness", "most"), [(0.25, 0.2), (0.5, 0.1)])
def test_no_highlight_shines_through_the_object(roughness, most):
    """A metal cup, of whose own reflection in itself Mitsuba's direct light has nothing, either. Rays in 512 directions
    leave an error; without them, light comes through the wall."""
    cup, light, gloss = normalize(solid("cup")), positive_light(6), Gloss(roughness, metallic=1.0)
    mirror = {"type": "roughconductor", "distribution": "ggx", "alpha": roughness**2, "material": "none"}
    white = replace(cup, corner_colors=np.ones_like(cup.corner_colors))
    theirs = mitsuba_radiance(white, light, {"type": "twosided", "material": mirror}, 64)
    shadowed, open_sky = (difference(our_radiance(white, light, gloss, shadows=on), theirs) for on in (True, False))
    assert shadowed < most < 2 * most < open_sky


def test_a_lamps_highlight_is_mitsubas():
    """A rough conductor and a point light, which has no noise but the pixels' edges."""
    gloss, lamp = Gloss(0.4, metallic=1.0), Lamps(((2.0, 1.0, 2.5),), power=1.0)
    settings = ImageSettings(24, 4, normals="smooth")
    [operator] = build_operators(EGG, [CAMERA], settings, choose("numpy"), basis=lamp, dtype=UP.dtype, gloss=gloss)
    ours = UP.new_zeros(3, 24**2).index_copy(1, operator.pixels, operator.radiance(UP.new_ones(1, 3)))
    with mitsuba() as module:
        surface = {"type": "roughconductor", "distribution": "ggx", "alpha": 0.16, "material": "none"}
        point = {
            "type": "point",
            "position": list(lamp.positions[0]),
            "intensity": {"type": "rgb", "value": [math.pi] * 3},
        }
        mesh_of = shape(module, surface, EGG.vertices, EGG.faces, EGG.vertex_normals)
        film = sensor_of(CAMERA, 24) | {"sampler": {"type": "multijitter", "sample_count": 64}}
        scene = load(
            module, {"type": "scene", "integrator": integrator(0, 1), "lamp": point, "shape": mesh_of, "sensor": film}
        )
        theirs = torch.from_numpy(np.array(module.render(scene, seed=0))[..., :3]).double().permute(2, 0, 1)
    assert difference(ours.unflatten(1, (24, 24)), theirs) < 0.02


def test_roughness_that_no_light_shows_is_said_and_values_out_of_range_are_refused():
    mesh, light = solid("pear"), positive_light(6)
    with pytest.warns(UserWarning, match="0.2"):
        mirror = render(mesh, CAMERA, light, 8, gloss=Gloss(0.0))
    assert torch.equal(mirror, render(mesh, CAMERA, light, 8, gloss=Gloss(MIN_ROUGHNESS)))
    for gloss in (Gloss(1.5), Gloss(0.5, -0.1), Gloss(0.5, strength=torch.ones(3)), Gloss(float("nan"))):
        with pytest.raises(InputError, match=r"roughness|metallic|strength"):
            render(mesh, CAMERA, light, 8, gloss=gloss)


def test_parts_and_subdivisions_keep_their_gloss():
    """A matte part of a mesh of several is rendered as it was alone."""
    pear, light = Gloss(0.3).on(solid("pear")), positive_light(6)
    whole = concatenate([pear, solid("table")])
    assert whole.gloss[0].tolist() == pytest.approx([0.3, 0, 1]) and whole.gloss[-1].tolist() == [1, 0, 0]
    assert (subdivide(whole, 10**4).gloss == np.repeat(whole.gloss, 4, axis=0)[:1]).any()
    matte, table = replace(whole, gloss=whole.gloss * [[1, 0, 0]]), concatenate([solid("pear"), solid("table")])
    torch.testing.assert_close(*(render(mesh, CAMERA, light, 16) for mesh in (matte, table)), rtol=0, atol=1e-12)
