"""Gloss under environment maps equals an integral over all texels of glTF's formulas."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import Lobe, coat_albedo, fragments_of, operator_of

from augment.scene.build import build_scene
from renderer.light.environment import read_map, write_map
from renderer.light.files import mean_luminance, probe
from renderer.light.harmonics import equirectangular
from renderer.mesh import normalize
from renderer.operators.rays import Surface
from renderer.settings import ImageSettings
from renderer.solids import solid
from renderer.surface.gloss import Gloss

HDRI = Path(__file__).parents[4] / "shared" / "data" / "hdri"
SIZE = 32
SETTINGS = ImageSettings(SIZE, 2)
ALBEDO = 0.5
AT_ONCE = 32  # samples in the quadrature, which bounds the memory
ERRORS = {"city": 0.1, "forest": 0.1, "night": 0.1, "studio": 0.32}  # largest by map
BLACK = 0.005  # largest fraction of the channels of lit pixels that are black
METALLIC = {"varnish": 0.0, "metal": 1.0}

pytestmark = pytest.mark.filterwarnings("ignore:.*takes light of degree")


def brdf(normals, view, light, roughness, metallic) -> np.ndarray:
    """Return π times the BRDF (S, N) of a gray surface, after Kulla and Conty (2017)."""
    half = light + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    light_cosine = (normals @ light.T).clip(1e-9)
    view_cosine = (normals @ view[None].T).clip(1e-9)
    lobe = Lobe(roughness, ALBEDO if metallic else None)
    specular = lobe.of_cosines(light_cosine, view_cosine, normals @ half.T, half @ view)
    if metallic:
        return specular
    cosines = np.linspace(0, 1, 101) ** 2
    reflectance = np.array([coat_albedo(max(cosine, 1e-6), roughness) for cosine in cosines])
    mean = np.trapezoid(2 * reflectance * cosines, cosines)
    entering = 1 - np.interp(light_cosine, cosines, reflectance)
    leaving = 1 - np.interp(view_cosine, cosines, reflectance)
    diffuse = entering * leaving / (1 - mean)
    return specular + ALBEDO * diffuse


def texels(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions (N, 3) of a map's texels, and their power (N, 3) as in scenes."""
    radiance = read_map(path).double().clamp(min=0)
    directions, solid_angles = equirectangular(*radiance.shape[:2])
    power = radiance * solid_angles[..., None]
    mean = power.sum((0, 1))[None] / math.sqrt(4 * math.pi)
    scale = mean_luminance(probe("grace")) / mean_luminance(mean)
    return directions.flatten(0, 1).numpy(), power.flatten(0, 1).numpy() * scale


def integrated(path, mesh, camera, roughness, metallic) -> np.ndarray:
    """Return the radiance (P, 3) of the pear's pixels by quadrature over all texels."""
    view = fragments_of(mesh, camera, SETTINGS)
    surface = Surface(mesh, view, SETTINGS)
    normals = surface.normals.numpy()
    towards = surface.toward[0].numpy()
    light, power = texels(path)
    samples = []
    for part in np.array_split(normals, math.ceil(len(normals) / AT_ONCE)):
        cosine = (part @ light.T).clip(0)
        samples.append((brdf(part, towards, light, roughness, metallic) * cosine) @ power)
    pixels = np.zeros((len(view.pixels), 3))
    np.add.at(pixels, view.sample_to_pixel.numpy(), np.concatenate(samples) / 4)  # 2 × 2 samples
    return pixels


def require_close(path: Path, largest_error: float, roughness: float, metallic: float) -> None:
    pear = normalize(solid("pear"))
    gray = replace(pear, corner_colors=np.full_like(pear.corner_colors, ALBEDO))
    mesh = Gloss(roughness, metallic).on(gray)
    scene = build_scene([(mesh, "pear")], SIZE, light=str(path), rasterizer="numpy")
    camera = scene.cameras[0][0]
    operator = operator_of(mesh, camera, SETTINGS, basis=scene.basis)
    image = operator.radiance(scene.lights[0]).T.numpy()
    expected = integrated(path, mesh, camera, roughness, metallic)
    error = np.sqrt(np.square(image - expected).mean() / np.square(expected).mean())
    assert error <= largest_error
    assert (image <= 0)[expected > 0].mean() <= BLACK


@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.2, 0.25, 0.3, 0.335, 0.35, 0.4, 0.5])
@pytest.mark.parametrize("gloss", METALLIC)
@pytest.mark.parametrize("name", ERRORS)
def test_gloss_is_that_of_the_full_map_and_hardly_any_lit_pixel_is_black(name, roughness, gloss):
    if not HDRI.exists():
        pytest.skip("../shared/data is absent")
    require_close(HDRI / f"{name}.npy", ERRORS[name], roughness, METALLIC[gloss])


@pytest.fixture(scope="module")
def two_lamps(tmp_path_factory) -> Path:
    """Write a map of two lamps, 3,000 times as bright as the dim room around them."""
    directions = equirectangular(64, 128)[0]
    room = 1 + 0.5 * directions[..., 2:]
    radiance = room.expand(-1, -1, 3)
    color = torch.tensor([1.0, 0.8, 0.6])
    for axis, width in (((0.6, 0.0, 0.8), 0.02), ((-0.6, 0.64, 0.48), 0.01)):
        off_axis = 1 - directions @ torch.tensor(axis, dtype=torch.float64)
        radiance = radiance + 3000 * (-off_axis / width).exp()[..., None] * color
    path = tmp_path_factory.mktemp("map") / "lamps.npy"
    write_map(path, radiance)
    return path


@pytest.mark.parametrize("roughness", [pytest.param(0.2, marks=pytest.mark.slow), 0.5])
@pytest.mark.parametrize("gloss", METALLIC)
def test_gloss_is_that_of_a_generated_concentrated_map(two_lamps, roughness, gloss):
    require_close(two_lamps, 0.25, roughness, METALLIC[gloss])
