"""Images of convex meshes against Mitsuba 3, which traces rays from the surface into a map of the same light.

A diffuse face reflects albedo / π of its irradiance and our radiance leaves the 1/π out, so an image of Mitsuba's
times π is one of ours. It draws directions by the cosine: its noise is then the light's variation alone.
"""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import hard_meshes as hard
import numpy as np
import pytest
import torch
import trimesh
from oracles import mesh_of

from renderer.camera import Camera, OrthographicCamera, PerspectiveCamera
from renderer.geometry.mesh import Mesh, normalize
from renderer.geometry.shapes import solid
from renderer.light.environment import write_map
from renderer.mitsuba_scene import SCENE, mitsuba, mitsuba_map, write_mitsuba_scene
from renderer.settings import ImageSettings
from renderer.transport import rays
from renderer.transport.operators import build_operators
from renderer.visibility.rasterizers import choose

pytest.importorskip("mitsuba")

SEEDS = 32  # independent images of Mitsuba's, from which its noise is estimated
SIGMAS = 5  # a right image fails a bound once in a million times
FEW = 0.02  # of a pixel: less surface is hit too seldom for a normal distribution
MAP_ROWS = 192  # linear interpolation dims band l by l(l + 1) (π / 191)² / 12: 5e-5 of band 1, 1e-3 of the faint band 6
BAND_WEIGHTS = [
    0,
    1,
    1,
    0.3,
    1,
    0.3,
    1,
]  # bands 3 and 5 reach no diffuse surface and only add noise

VIEWS = {
    "near the pole": OrthographicCamera(1.72, 22.9, 2.5),
    "from above": OrthographicCamera(57.3, 126.1, 2.3),
    "from below": OrthographicCamera(131.8, 292.2, 2.7),
    "from close by": PerspectiveCamera(63.0, 40.1, 2.7, right=0.1, up=-0.2, distance=2.0),
}


def positive_light(seed: int) -> np.ndarray:
    """(49, 3): every coefficient at random, over just enough ambient light to be positive everywhere."""
    weights = np.repeat(BAND_WEIGHTS, 2 * np.arange(7) + 1)
    light = weights[:, None] * np.random.default_rng(seed).normal(size=(49, 3))
    light[0] = (
        0.1 - mitsuba_map(torch.from_numpy(light), MAP_ROWS).numpy().min(axis=(0, 1))
    ) * math.sqrt(4 * math.pi)
    return light / light[0]


LIGHT = positive_light(1)


def ball() -> Mesh:
    return mesh_of(trimesh.creation.icosphere(subdivisions=1), (0.9, 0.5, 0.2))


def colored_cube() -> Mesh:
    return mesh_of(
        trimesh.creation.box((1.1, 1.1, 1.1)), np.random.default_rng(1).uniform(0.1, 1, (8, 3))
    )


def textured_hull() -> Mesh:
    """Twelve points on an ellipsoid; the texture repeats and each face has its own piece of it."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(12, 3))
    hull = trimesh.convex.convex_hull(
        points / np.linalg.norm(points, axis=1, keepdims=True) * [1.0, 0.8, 0.9]
    )
    count = len(hull.faces)
    return replace(
        Mesh.plain(hull.vertices, hull.faces),
        corner_uvs=rng.uniform(-0.5, 1.5, (count, 3, 2)).astype(np.float32),
        texture_ids=np.zeros(count, dtype=np.int32),
        textures=(rng.integers(0, 256, (5, 7, 3), dtype=np.uint8),),
    )


def bowl() -> Mesh:
    """The lower half of a ball, seen from within."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.9)
    lower = ball.vertices[ball.faces].mean(axis=1)[:, 2] < 0
    return Mesh.plain(ball.vertices, ball.faces[lower], (0.8, 0.8, 0.3))


def cup() -> Mesh:
    return normalize(solid("cup"))


def our_image(mesh: Mesh, camera: Camera, size: int, samples: int, **settings) -> np.ndarray:
    """(size, size, 4): radiance and coverage."""
    settings = ImageSettings(size, samples, **settings)
    [operator] = build_operators(mesh, [camera], settings, choose("numpy"))
    canvas = np.zeros((size * size, 4))
    canvas[operator.pixels, :3] = operator.radiance(torch.from_numpy(LIGHT)).T
    canvas[operator.pixels, 3] = operator.coverage
    return canvas.reshape(size, size, 4)


def mitsuba_image(
    folder: Path, mesh: Mesh, camera: Camera, size: int, spp: int, **settings
) -> tuple[np.ndarray, ...]:
    """The mean (size, size, 4) of SEEDS images of files, of so many rays per pixel, and its standard error."""
    write_map(folder / "light.exr", mitsuba_map(torch.from_numpy(LIGHT), MAP_ROWS))
    write_mitsuba_scene(folder, mesh, 1.0, [camera], ImageSettings(size, **settings), "light.exr")
    file = folder / SCENE
    file.write_text(file.read_text().replace("multijitter", "independent"))
    with mitsuba() as mi:
        scene = mi.load_file(str(file))
        images = np.stack(
            [np.array(mi.render(scene, spp=spp, seed=seed)) for seed in range(SEEDS)]
        ).astype(float)
    return images.mean(axis=0), images.std(axis=0, ddof=1) / math.sqrt(SEEDS)


@pytest.mark.parametrize(
    ("solid", "view"),
    [
        (ball, "near the pole"),
        (colored_cube, "from below"),
        (textured_hull, "from close by"),
    ],
)
@pytest.mark.parametrize(
    ("size", "samples", "rays"), [(24, 32, 128), pytest.param(64, 64, 512, marks=pytest.mark.slow)]
)
def test_a_convex_mesh_looks_as_mitsuba_renders_it_within_its_noise(
    tmp_path, solid, view, size, samples, rays
):
    """Our error, in Mitsuba's standard errors: its root mean square is one and its mean is zero.

    A standard error from n images makes a Student's t of n - 1 degrees of freedom: the mean and the variance of its
    square follow. The three channels share their rays, so a pixel counts once.

    s² samples misjudge the coverage at the outline by 1 / √(12 s³), as each of s rows rounds to its samples: 0.2 % of
    a pixel, against Mitsuba's noise of up to 0.8 % there (0.06 and 0.4 % in the slow runs), too little to show.
    """
    ours = our_image(solid(), VIEWS[view], size, samples)
    theirs, noise = mitsuba_image(tmp_path, solid(), VIEWS[view], size, rays)
    covered = np.maximum(ours, theirs)[..., 3] > FEW
    errors = (ours - theirs)[covered, :3] / noise[covered, :3]
    freedom = SEEDS - 1
    mean = freedom / (freedom - 2)
    variance = 3 * freedom**2 / ((freedom - 2) * (freedom - 4)) - mean**2
    assert (errors**2).mean() == pytest.approx(mean, abs=SIGMAS * math.sqrt(variance / len(errors)))

    inside = np.minimum(ours, theirs)[..., 3] == 1
    total_noise = np.sqrt((noise[inside, :3] ** 2).sum(axis=0))
    np.testing.assert_array_less(
        np.abs((ours - theirs)[inside, :3].sum(axis=0)), SIGMAS * total_noise
    )


@pytest.mark.parametrize(
    ("solid", "view", "bounces", "normals"),
    [
        (bowl, "near the pole", 0, "flat"),
        (cup, "near the pole", 0, "smooth"),
        (hard.heap, "from above", 3, "flat"),
        *(
            pytest.param(solid, view, bounces, normals, marks=pytest.mark.slow)
            for solid, view, normals in [
                (bowl, "near the pole", "flat"),
                (partial(hard.sphere, 2, 0.5), "from above", "flat"),
                (cup, "near the pole", "smooth"),
            ]
            for bounces in (1, 3)
        ),
    ],
)
def test_shadows_and_bounces_are_mitsubas_within_its_noise(
    tmp_path, solid, view, bounces, normals, monkeypatch
):
    """With rays enough for a quadrature of 0.5 % of the brightest, root mean square, and 0.1 % on average. Of a closed
    mesh that shows no smooth normal turned away from the camera: Mitsuba takes the normal's other side there."""
    monkeypatch.setattr(rays, "DIRECTIONS", 2**12)
    theirs, noise = mitsuba_image(
        tmp_path, solid(), VIEWS[view], 32, 128, bounces=bounces, normals=normals
    )
    inside, brightest = theirs[..., 3] == 1, theirs[..., :3].max()
    ours, less = (
        our_image(solid(), VIEWS[view], 32, 8, normals=normals, **options)
        for options in (
            ({"bounces": bounces}, {"shadows": True}) if bounces else ({"shadows": True}, {})
        )
    )
    error, without, noise = (
        values[inside, :3] / brightest for values in (ours - theirs, less - theirs, noise)
    )
    assert (error**2).mean() < 0.005**2 + (noise**2).mean()
    assert abs(error.mean()) < 0.001
    assert (without**2).mean() > 0.02**2
