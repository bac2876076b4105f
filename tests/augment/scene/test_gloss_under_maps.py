"""Gloss under environment maps: images of a scene against the full map, integrated by quadrature of glTF's formulas."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from augment.scene.build import build_scene
from renderer.camera import Camera
from renderer.geometry.mesh import Mesh, normalize
from renderer.geometry.shapes import solid
from renderer.light.environment import read_map, write_map
from renderer.light.harmonics import equirectangular
from renderer.light.presets import mean_luminance, probe
from renderer.settings import ImageSettings
from renderer.shading.gloss import Gloss
from renderer.transport.operators import build_operators
from renderer.transport.rays import Surface
from renderer.visibility.fragments import build_fragments
from renderer.visibility.rasterizers import choose

HDRI = Path(__file__).parents[4] / "shared" / "data" / "hdri"
SIZE, ALBEDO = 32, 0.5
AT_ONCE = 32  # samples in the quadrature: bounds the memory
MAPS = {"city": 0.1, "forest": 0.1, "night": 0.1, "studio": 0.25}
GLOSSES = {"varnish": 0.0, "metal": 1.0}  # metallic


def brdf(
    normals: np.ndarray, view: np.ndarray, light: np.ndarray, roughness: float, metallic: float
) -> np.ndarray:
    """π f (S, N) of glTF for a gray surface; the diffuse part below a varnish is that of Kulla and Conty (2017)."""
    alpha = roughness**2
    half = light + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    nl, nv, nh = (normals @ vectors.T for vectors in (light, view[None], half))
    nl, nv, vh = nl.clip(1e-9), nv.clip(1e-9), half @ view
    value = alpha**2 / (nh**2 * (alpha**2 - 1) + 1) ** 2 / (4 * nl * nv)
    for cosine in (nl, nv):
        value *= 2 * cosine / (cosine + np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2))
    if metallic:
        return value * (ALBEDO + (1 - ALBEDO) * (1 - vh) ** 5)
    inside = np.sqrt(1 - (1 - vh**2) / 2.25)
    amplitudes = (
        (vh - 1.5 * inside) / (vh + 1.5 * inside),
        (1.5 * vh - inside) / (1.5 * vh + inside),
    )
    cosines, reflected = coat(roughness)
    mean = np.trapezoid(2 * reflected * cosines, cosines)
    diffuse = (
        (1 - np.interp(nl, cosines, reflected))
        * (1 - np.interp(nv, cosines, reflected))
        / (1 - mean)
    )
    return value * np.square(amplitudes).mean(0) + ALBEDO * diffuse


@cache
def coat(roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """Cosines, and the fraction of beams that a varnish reflects: Monte Carlo over half vectors, stratified."""
    cosines, alpha, count = np.linspace(0, 1, 101) ** 2, roughness**2, 200
    cosines[0] = 1e-6
    fraction, azimuth = np.meshgrid(
        (np.arange(count) + 0.5) / count, 2 * np.pi * (np.arange(count) + 0.5) / count
    )
    height = np.sqrt((1 - fraction) / (1 + (alpha**2 - 1) * fraction))
    reflected = []
    for cosine in cosines:
        facing = cosine * height + np.sqrt(1 - cosine**2) * np.sqrt(1 - height**2) * np.cos(azimuth)
        light = 2 * facing * height - cosine
        inside = np.sqrt(1 - (1 - np.clip(facing, 0, 1) ** 2) / 2.25)
        first, second = (
            (facing - 1.5 * inside) / (facing + 1.5 * inside),
            (1.5 * facing - inside) / (1.5 * facing + inside),
        )
        weight = (first**2 + second**2) / 2 * facing / (cosine * height)
        for each in (cosine, light.clip(1e-9)):
            weight = weight * 2 * each / (each + np.sqrt(alpha**2 + (1 - alpha**2) * each**2))
        reflected.append(np.where((light > 0) & (facing > 0), weight, 0).mean())
    return cosines, np.array(reflected)


def mesh_of(roughness: float, metallic: float) -> Mesh:
    """The pear, gray and with gloss."""
    pear = normalize(solid("pear"))
    gray = replace(pear, corner_colors=np.full_like(pear.corner_colors, ALBEDO))
    return Gloss(roughness, metallic).on(gray)


def ours(path: Path, mesh: Mesh) -> tuple[np.ndarray, Camera]:
    """Radiance (P, 3) of the pear's pixels in a scene, and the scene's camera."""
    scene = build_scene([(mesh, "pear")], SIZE, light=str(path), rasterizer="numpy")
    camera, settings = scene.cameras[0][0], ImageSettings(SIZE, 2)
    [operator] = build_operators(mesh, [camera], settings, choose("numpy"), basis=scene.basis)
    return operator.radiance(scene.lights[0]).T.numpy(), camera


def of_full_maps(
    paths: Sequence[Path], mesh: Mesh, camera: Camera, roughness: float, metallic: float
) -> list[np.ndarray]:
    """Radiance (P, 3) of the pear's pixels, by quadrature over all texels of each map; maps are of one size."""
    [view] = build_fragments(
        mesh.vertices, mesh.faces, [camera], ImageSettings(SIZE, 2), choose("numpy")
    )
    surface = Surface(mesh, view, ImageSettings(SIZE, 2))
    normals, toward = surface.normals.numpy(), surface.toward[0].numpy()
    arriving = []
    for path in paths:
        radiance = read_map(path).double().clamp(min=0)
        directions, solid_angles = equirectangular(*radiance.shape[:2])
        power = radiance * solid_angles[..., None]
        mean = power.sum((0, 1))[None] / math.sqrt(4 * math.pi)
        arriving.append(
            power.flatten(0, 1).numpy() * mean_luminance(probe("grace")) / mean_luminance(mean)
        )
    light, seen = directions.flatten(0, 1).numpy(), []
    for some in np.array_split(normals, -(-len(normals) // AT_ONCE)):
        cosine = (some @ light.T).clip(0)
        seen.append(
            (brdf(some, toward, light, roughness, metallic) * cosine)
            @ np.concatenate(arriving, axis=1)
        )
    pixels = np.zeros((len(view.pixels), 3 * len(paths)))
    np.add.at(pixels, view.pixel.numpy(), np.concatenate(seen) / 4)
    return np.split(pixels, len(paths), axis=1)


def require_close(
    paths: Sequence[Path], most: Sequence[float], roughness: float, metallic: float
) -> None:
    mesh = mesh_of(roughness, metallic)
    shown = [ours(path, mesh) for path in paths]
    expected = of_full_maps(paths, mesh, shown[0][1], roughness, metallic)
    for path, limit, (image, _), theirs in zip(paths, most, shown, expected, strict=True):
        error = float(np.sqrt(np.square(image - theirs).mean() / np.square(theirs).mean()))
        print(
            f"{path.stem} {roughness} {metallic}: {error:.3f}, least {(image / theirs).min():.2f}"
        )
        assert error <= limit and (image > 0)[theirs > 0].all()


@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*takes light of degree")
@pytest.mark.parametrize("roughness", [0.2, 0.25, 0.5])
@pytest.mark.parametrize("gloss", GLOSSES)
def test_gloss_is_that_of_the_full_map_and_no_lit_pixel_is_black(roughness, gloss):
    if not HDRI.exists():
        pytest.skip("../shared/data is absent")
    paths = [HDRI / f"{name}.npy" for name in MAPS]
    require_close(paths, list(MAPS.values()), roughness, GLOSSES[gloss])


@pytest.mark.filterwarnings("ignore:.*takes light of degree")
@pytest.mark.parametrize("roughness", [pytest.param(0.2, marks=pytest.mark.slow), 0.5])
@pytest.mark.parametrize("gloss", GLOSSES)
def test_gloss_is_that_of_a_generated_concentrated_map(tmp_path, roughness, gloss):
    """Two lamps, 3,000 times as bright as the dim room around them."""
    directions = equirectangular(64, 128)[0]
    radiance = 1 + 0.5 * directions[..., 2:].expand(-1, -1, 3)
    for axis, width in (((0.6, 0.0, 0.8), 0.02), ((-0.6, 0.64, 0.48), 0.01)):
        off = 1 - directions @ torch.tensor(axis, dtype=torch.float64)
        radiance = radiance + 3000 * (-off / width).exp()[..., None] * torch.tensor([1.0, 0.8, 0.6])
    write_map(tmp_path / "lamps.npy", radiance)
    require_close([tmp_path / "lamps.npy"], [0.25], roughness, GLOSSES[gloss])
