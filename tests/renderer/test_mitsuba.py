"""Images compared with Mitsuba 3, which traces rays from the surface into a map of the light."""

import math
from dataclasses import replace
from typing import NamedTuple

import hard_meshes as hard
import numpy as np
import pytest
import torch
import trimesh
from oracles import image_of, mesh_of, operator_of, textured

from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.light.environment import write_map
from renderer.mesh import Mesh, normalize
from renderer.mitsuba_scene import SCENE, mitsuba, mitsuba_map, write_mitsuba_scene
from renderer.operators import rays
from renderer.settings import ImageSettings
from renderer.solids import solid

# Number of independent images of Mitsuba, from which its noise is estimated.
SEED_COUNT = 32
# A correct image exceeds a bound of so many standard errors once in a million times.
SIGMAS = 5
# Rays hit a smaller part of a pixel too seldom for a normal distribution.
LEAST_COVERAGE = 0.02
# Rows of the environment map. Linear interpolation dims band l by
# l (l + 1) (π / 191)² / 12, which is 5e-5 for band 1 and 1e-3 for the faint band 6.
MAP_ROWS = 192
# Bands 3 and 5 reach no diffuse surface. They only add noise.
BAND_WEIGHTS = [0, 1, 1, 0.3, 1, 0.3, 1]

VIEWS = {
    "near the pole": OrthographicCamera(1.72, 22.9, 2.5),
    "from above": OrthographicCamera(57.3, 126.1, 2.3),
    "from below": OrthographicCamera(131.8, 292.2, 2.7),
    "from close by": PerspectiveCamera(63.0, 40.1, 2.7, right=0.1, up=-0.2, distance=2.0),
}


def positive_light(seed: int) -> np.ndarray:
    """Draw coefficients (49, 3), and add ambient light until the radiance is positive."""
    weights = np.repeat(BAND_WEIGHTS, 2 * np.arange(7) + 1)
    light = weights[:, None] * np.random.default_rng(seed).normal(size=(49, 3))
    radiance = mitsuba_map(torch.from_numpy(light), MAP_ROWS).numpy()
    missing_radiance = 0.1 - radiance.min(axis=(0, 1))
    light[0] = missing_radiance * math.sqrt(4 * math.pi)
    return light / light[0]


LIGHT = torch.from_numpy(positive_light(1))


def colored_cube() -> Mesh:
    colors = np.random.default_rng(1).uniform(0.1, 1, (8, 3))
    return mesh_of(trimesh.creation.box((1.1, 1.1, 1.1)), colors)


def textured_hull() -> Mesh:
    """Create the hull of twelve points on an ellipsoid, whose texture repeats."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(12, 3))
    on_sphere = points / np.linalg.norm(points, axis=1, keepdims=True)
    hull = trimesh.convex.convex_hull(on_sphere * [1.0, 0.8, 0.9])
    uvs = rng.uniform(-0.5, 1.5, (len(hull.faces), 3, 2))
    texture = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    return textured(Mesh.plain(hull.vertices, hull.faces), uvs, texture)


def bowl(subdivisions: int = 3) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions, radius=0.9)
    heights = ball.vertices[ball.faces].mean(axis=1)[:, 2]
    return Mesh.plain(ball.vertices, ball.faces[heights < 0], (0.8, 0.8, 0.3))


def coarse_bowl() -> Mesh:
    return bowl(subdivisions=1)


def cup() -> Mesh:
    return normalize(solid("cup"))


def vessel() -> Mesh:
    """Make a closed bowl, so fine that its faces are close to its smooth normals."""
    around = np.linspace(0, np.pi / 2, 13)
    over = np.linspace(0, np.pi, 9)[1:-1]
    quarter = np.stack([np.sin(around), -np.cos(around)], axis=1)
    rim = np.stack([0.825 + 0.075 * np.cos(over), 0.075 * np.sin(over)], axis=1)
    profile = np.concatenate([0.9 * quarter, rim, 0.75 * quarter[::-1]])
    revolved = trimesh.creation.revolve(profile, sections=48)
    return Mesh.plain(revolved.vertices, revolved.faces, (0.8, 0.8, 0.3))


def our_image(mesh: Mesh, camera: Camera, settings: ImageSettings) -> np.ndarray:
    return image_of(operator_of(mesh, camera, settings), LIGHT).permute(1, 2, 0).numpy()


class NoisyImage(NamedTuple):
    mean: np.ndarray
    noise: np.ndarray


def mitsuba_image(folder, mesh, camera, settings, ray_count) -> NoisyImage:
    """Render the files of a scene with Mitsuba, several times with `ray_count` rays per pixel."""
    write_map(folder / "light.exr", mitsuba_map(LIGHT, MAP_ROWS))
    write_mitsuba_scene(folder, mesh, 1.0, [camera], settings, "light.exr")
    scene_path = folder / SCENE
    scene_path.write_text(scene_path.read_text().replace("multijitter", "independent"))
    images = []
    with mitsuba() as mi:
        scene = mi.load_file(str(scene_path))
        for seed in range(SEED_COUNT):
            images.append(np.array(mi.render(scene, spp=ray_count, seed=seed)))
    stack = np.stack(images).astype(float)
    noise = stack.std(axis=0, ddof=1) / math.sqrt(SEED_COUNT)
    return NoisyImage(stack.mean(axis=0), noise)


def mean_square(values: np.ndarray) -> float:
    return float((values**2).mean())


@pytest.mark.parametrize(
    ("make_mesh", "view"), [(colored_cube, "from below"), (textured_hull, "from close by")]
)
@pytest.mark.parametrize(
    ("size", "samples", "ray_count"),
    [(16, 32, 128), pytest.param(64, 64, 512, marks=pytest.mark.slow)],
)
def test_a_convex_mesh_looks_as_in_mitsuba(tmp_path, make_mesh, view, size, samples, ray_count):
    """Errors in units of the standard errors of n images follow Student's t distribution.

    The three channels share their rays, so a pixel counts once. At the outline, s rows of samples
    leave an error of the coverage of 1 / √(12 s³), a quarter of Mitsuba's noise or less.
    """
    settings = ImageSettings(size, samples)
    ours = our_image(make_mesh(), VIEWS[view], settings)
    theirs = mitsuba_image(tmp_path, make_mesh(), VIEWS[view], settings, ray_count)
    difference = (ours - theirs.mean)[..., :3]
    noise = theirs.noise[..., :3]

    is_covered = np.maximum(ours, theirs.mean)[..., 3] > LEAST_COVERAGE
    errors = difference[is_covered] / noise[is_covered]
    freedom = SEED_COUNT - 1
    mean = freedom / (freedom - 2)
    variance = 3 * freedom**2 / ((freedom - 2) * (freedom - 4)) - mean**2
    tolerance = SIGMAS * math.sqrt(variance / len(errors))
    assert mean_square(errors) == pytest.approx(mean, abs=tolerance)

    is_inside = np.minimum(ours, theirs.mean)[..., 3] == 1
    sum_of_errors = difference[is_inside].sum(axis=0)
    noise_of_sum = np.sqrt((noise[is_inside] ** 2).sum(axis=0))
    np.testing.assert_array_less(np.abs(sum_of_errors), SIGMAS * noise_of_sum)


def lumpy_sphere() -> Mesh:
    return hard.sphere(2, lowest=0.5)


SLOW_BOUNCES = [
    *((bowl, "near the pole", bounces, "flat") for bounces in (0, 3)),
    *((lumpy_sphere, "from above", bounces, "flat") for bounces in (1, 3)),
    *((vessel, "near the pole", bounces, "smooth") for bounces in (1, 3)),
    (hard.heap, "from above", 3, "flat"),
]


@pytest.mark.parametrize(
    ("make_mesh", "view", "bounces", "normals"),
    [
        (cup, "near the pole", 0, "smooth"),
        (coarse_bowl, "near the pole", 1, "flat"),
        *(pytest.param(*scene, marks=pytest.mark.slow) for scene in SLOW_BOUNCES),
    ],
)
def test_shadows_and_bounces_are_mitsubas(tmp_path, make_mesh, view, bounces, normals, monkeypatch):
    """The rays are enough for errors of 0.5 % of the brightest value, and 0.1 % on average.

    Light bounces off flat faces here, and off smooth normals in Mitsuba, so that both have to be
    close where light bounces. If a normal turns away from the camera, Mitsuba takes its other side.
    """
    monkeypatch.setattr(rays, "DIRECTIONS", 2**12)
    # Fewer pixels and rays take less time.
    size, ray_count = (20, 64) if make_mesh is coarse_bowl else (32, 128)
    plain = ImageSettings(size, 8, normals=normals)
    bounced = replace(plain, bounces=bounces)
    shadowed = replace(plain, shadows=True)
    settings, without = (bounced, shadowed) if bounces else (shadowed, plain)
    mesh = make_mesh()
    theirs = mitsuba_image(tmp_path, mesh, VIEWS[view], bounced, ray_count)
    ours = our_image(mesh, VIEWS[view], settings)
    less = our_image(mesh, VIEWS[view], without)

    is_inside = theirs.mean[..., 3] == 1
    brightest = theirs.mean[..., :3].max()
    error = (ours - theirs.mean)[is_inside, :3] / brightest
    noise = theirs.noise[is_inside, :3] / brightest
    assert mean_square(error) < 0.005**2 + mean_square(noise)
    assert abs(error.mean()) < 0.001
    # An image without the bounces, or without shadows, differs clearly.
    error_of_less = (less - theirs.mean)[is_inside, :3] / brightest
    assert mean_square(error_of_less) > 0.02**2
