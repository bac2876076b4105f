"""A scene's files, rendered by Mitsuba, against our image of the same."""

import faulthandler
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from renderer.camera import OrthographicCamera, PerspectiveCamera
from renderer.geometry.mesh import Mesh, normalize
from renderer.io.mitsuba import SCENE, mitsuba, mitsuba_map, render_mitsuba_scene, write_mitsuba_scene
from renderer.light.environment import write_map
from renderer.light.harmonics import basis
from renderer.light.presets import load_light
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss
from renderer.transport.operators import build_operators
from renderer.vectors import unit_vectors
from renderer.visibility.rasterizers import choose

pytest.importorskip("mitsuba")
drjit = pytest.importorskip("drjit")
CAMERAS = [
    OrthographicCamera(1.0, 2.2, 2.3),
    OrthographicCamera(2.3, 5.1, 2.7, right=0.2, up=-0.1),
    PerspectiveCamera(1.4, 0.3, 2.7, right=0.2, up=-0.1, distance=2.2),
]


def ball() -> Mesh:
    """Smooth, with a texture on the upper half under colors of its own, and colors at the corners below."""
    sphere, draws = trimesh.creation.icosphere(subdivisions=3), np.random.default_rng(0)
    mesh = Mesh.plain(sphere.vertices, sphere.faces, draws.uniform(0.2, 1, sphere.vertices.shape))
    above = sphere.vertices[sphere.faces].mean(axis=1)[:, 2] > 0
    uvs = (sphere.vertices[:, :2] / 2 + 0.5)[sphere.faces].astype(np.float32)
    return replace(
        mesh,
        corner_uvs=uvs,
        corner_colors=np.where(above[:, None, None], [0.9, 0.8, 0.6], mesh.corner_colors).astype(np.float32),
        texture_ids=np.where(above, 0, -1).astype(np.int32),
        textures=(draws.integers(0, 256, (9, 6, 3), dtype=np.uint8),),
    )


def test_a_mitsuba_map_equals_the_light_in_every_direction(tmp_path):
    """But for the interpolation between texels."""
    light, settings = load_light("grace").double(), ImageSettings(8)
    write_mitsuba_scene(tmp_path, normalize(ball()), 1.0, CAMERAS, settings, "light.exr")
    write_map(tmp_path / "light.exr", mitsuba_map(light, 128))
    directions = unit_vectors(torch.randn(3, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))[0].T
    with mitsuba() as mi:
        sky, seen = mi.load_file(str(tmp_path / SCENE)).environment(), []
        for direction in directions.tolist():
            interaction = mi.SurfaceInteraction3f()
            interaction.wi = [-each for each in direction]
            seen.append(np.array(sky.eval(interaction)))
    expected = math.pi * basis(directions, 6) @ light
    torch.testing.assert_close(torch.from_numpy(np.array(seen)).double(), expected, rtol=0, atol=4e-4 * expected.max())


@pytest.mark.parametrize(("encoding", "normals"), [("linear", "smooth"), ("srgb", "flat")])
def test_mitsuba_renders_the_files_as_the_renderer_does(tmp_path, encoding, normals):
    """Inside the outline, on average to half of a 255th and in root mean square to a 200th, which is Mitsuba's noise at
    the texels' edges. The probe is positive all round."""
    mesh, light, settings = normalize(ball()), load_light("st_peters"), ImageSettings(24, 8, encoding, normals)
    write_mitsuba_scene(tmp_path / "mitsuba", mesh, 2.0, CAMERAS, settings, "../light.exr")
    write_map(tmp_path / "light.exr", mitsuba_map(light, 256))
    theirs = render_mitsuba_scene(tmp_path / "mitsuba" / SCENE, len(CAMERAS)).double()
    for operator, seen in zip(build_operators(mesh, CAMERAS, settings, choose("numpy"), 2.0), theirs, strict=True):
        ours = torch.zeros(4, 24 * 24, dtype=torch.float64)
        ours[:3, operator.pixels], ours[3, operator.pixels] = (
            operator.radiance(light).double(),
            operator.coverage.double(),
        )
        off, inside = ours.view(4, 24, 24) - seen, (ours[3].view(24, 24) == 1) & (seen[3] == 1)
        assert inside.sum() > 100 and off[3].abs().max() < 1 / 8
        assert off[:3, inside].mean().abs() < 0.5 / 255 and off[:3, inside].square().mean().sqrt() < 0.005


def test_gloss_survives_in_a_mitsuba_scene(tmp_path):
    """Factors and textures: metals to 5 %, dielectrics to 10 %, since the diffuse part of `principled` is Disney's."""
    textured, light = normalize(ball()), load_light("st_peters")
    rough, settings = np.random.default_rng(0).integers(100, 255, (9, 6, 2), dtype=np.uint8), ImageSettings(24, 8)
    shiny = replace(Gloss(0.6, metallic=1.0).on(textured), gloss_textures=(rough,))
    write_map(tmp_path / "light.exr", mitsuba_map(light, 256))
    images = {}
    for name, mesh in {"matte": textured, "shiny": shiny, "varnished": Gloss(0.4).on(textured)}.items():
        write_mitsuba_scene(tmp_path / name, mesh, 1.0, CAMERAS[:1], settings, "../light.exr")
        [theirs] = render_mitsuba_scene(tmp_path / name / SCENE, 1).double()
        [operator] = build_operators(mesh, CAMERAS[:1], settings, choose("numpy"))
        ours = torch.zeros(3, 24 * 24, dtype=torch.float64)
        ours[:, operator.pixels] = operator.radiance(light).double()
        images[name] = ours.view(3, 24, 24), theirs[:3]
    for name, most in (("shiny", 0.05), ("varnished", 0.1)):
        off = {other: (images[other][0] - images[name][1]).norm() / images[name][1].norm() for other in (name, "matte")}
        assert off[name] < most and off[name] < 0.8 * off["matte"]


def test_a_scene_is_rendered_on_a_single_core_too(tmp_path):
    """Mitsuba then has one thread, which would wait for its own reader of .exr, and this process with it."""
    write_mitsuba_scene(tmp_path, ball(), 1.0, [OrthographicCamera(1.0, 0.0, 2.0)], ImageSettings(8), "light.exr")
    write_map(tmp_path / "light.exr", torch.ones(8, 16, 3))
    drjit.set_thread_count(1)
    faulthandler.dump_traceback_later(60, exit=True)
    images = render_mitsuba_scene(tmp_path / SCENE, 1)
    faulthandler.cancel_dump_traceback_later()
    assert images.shape == (1, 4, 8, 8) and images[:, 3].any()
