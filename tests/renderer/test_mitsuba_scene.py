"""Scene files rendered by Mitsuba, compared with images of the renderer."""

import faulthandler
from dataclasses import replace

import drjit
import numpy as np
import pytest
import torch
import trimesh
from oracles import image_of, mesh_of, operator_of, path_traced, relative_error, textured
from torch import Tensor

from renderer.camera import OrthographicCamera, PerspectiveCamera
from renderer.light.environment import write_map
from renderer.light.files import load_light
from renderer.mesh import Mesh, normalize
from renderer.mitsuba_scene import SCENE, render_mitsuba_scene, write_mitsuba_scene
from renderer.pinhole import PinholeCamera
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss

ASIDE = {"roll": 34.0, "center_x": 0.3, "principal_right": 0.3, "principal_up": -0.2}
CAMERAS = [
    OrthographicCamera(57.3, 126.1, 2.3),
    OrthographicCamera(131.8, 292.2, 2.7, right=0.2, up=-0.1),
    PerspectiveCamera(80.2, 17.2, 2.7, right=0.2, up=-0.1, distance=2.2),
    PinholeCamera(80.2, 17.2, 2.9, distance=3.2, **ASIDE),
]


def ball() -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    draws = np.random.default_rng(0)
    mesh = Mesh.plain(sphere.vertices, sphere.faces, draws.uniform(0.2, 1, sphere.vertices.shape))
    is_above = sphere.vertices[sphere.faces].mean(axis=1)[:, 2] > 0
    colors = np.where(is_above[:, None, None], [0.9, 0.8, 0.6], mesh.corner_colors)
    uvs = (sphere.vertices[:, :2] / 2 + 0.5)[sphere.faces]
    texture = draws.integers(0, 256, (9, 6, 3), dtype=np.uint8)
    colored = replace(mesh, corner_colors=np.float32(colors))
    return textured(colored, uvs, texture, np.where(is_above, 0, -1))


def can() -> Mesh:
    return mesh_of(trimesh.creation.cylinder(0.8, 1.2), (0.5, 0.4, 0.3))


@pytest.mark.parametrize(
    ("make_mesh", "encoding", "normals"), [(ball, "srgb", "flat"), (can, "linear", "smooth")]
)
def test_mitsuba_renders_the_files_as_the_renderer_does(tmp_path, make_mesh, encoding, normals):
    """The errors are the noise of Mitsuba at the edges of texels."""
    mesh = normalize(make_mesh())
    light = load_light("st_peters")
    settings = ImageSettings(24, 8, encoding, normals)
    references = path_traced(tmp_path, mesh, CAMERAS, light, settings, albedo_scale=2.0)
    for camera, expected in zip(CAMERAS, references, strict=True):
        found = image_of(operator_of(mesh, camera, settings, albedo_scale=2.0), light)
        error = found - expected
        is_inside = (found[3] == 1) & (expected[3] == 1)
        assert is_inside.sum() > 100
        assert error[3].abs().max() < 1 / 8
        radiance_error = error[:3, is_inside]
        assert radiance_error.mean().abs() < 0.5 / 255
        assert radiance_error.square().mean().sqrt() < 0.005


def nook() -> Mesh:
    """A floor with a texture and a wall without one, between which light bounces."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 2], [-1, 1, 2]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 5], [0, 5, 4]])
    colors = np.where(np.arange(4)[:, None, None] < 2, 1.0, [0.8, 0.7, 0.5])
    mesh = replace(Mesh.plain(corners, faces), corner_colors=np.float32(colors + np.zeros((3, 1))))
    texture = np.random.default_rng(0).integers(160, 220, (9, 6, 3), dtype=np.uint8)
    return textured(mesh, corners[faces][..., :2] / 2 + 0.5, texture, [0, 0, -1, -1])


def black_mirror() -> Mesh:
    return Gloss(0.4).on(mesh_of(trimesh.creation.icosphere(subdivisions=3), (0, 0, 0)))


@pytest.mark.parametrize("make_mesh", [nook, black_mirror])
def test_mitsuba_scales_the_albedo_at_each_bounce(tmp_path, make_mesh):
    """Values of the scaled texture exceed 1. Specular reflection is not scaled."""
    mesh = normalize(make_mesh())
    light = load_light("st_peters") / 3
    settings = ImageSettings(24, 2, "srgb", bounces=3)
    [expected] = path_traced(tmp_path, mesh, CAMERAS[:1], light, settings, albedo_scale=3.0)
    found = image_of(operator_of(mesh, CAMERAS[0], settings, albedo_scale=3.0), light)
    is_inside = (found[3] == 1) & (expected[3] == 1)
    assert is_inside.sum() > 100
    found_mean, expected_mean = (image[:3, is_inside].mean() for image in (found, expected))
    assert abs(found_mean / expected_mean - 1) < 0.02


def test_gloss_survives_in_a_mitsuba_scene(tmp_path):
    """Dielectrics agree within 10%, because `principled` has another diffuse part."""
    with_texture = normalize(ball())
    light = load_light("st_peters")
    settings = ImageSettings(24, 8)
    gloss_texture = np.random.default_rng(0).integers(100, 255, (9, 6, 2), dtype=np.uint8)
    metal = replace(Gloss(0.6, metallic=1.0).on(with_texture), gloss_textures=(gloss_texture,))
    varnished = Gloss(0.4).on(with_texture)

    def render(mesh: Mesh) -> Tensor:
        return image_of(operator_of(mesh, CAMERAS[0], settings), light)[:3]

    for mesh, largest_error in ((metal, 0.05), (varnished, 0.1)):
        expected = path_traced(tmp_path, mesh, CAMERAS[:1], light, settings)[0, :3]
        error = relative_error(render(mesh), expected)
        assert error < largest_error
        assert error < 0.8 * relative_error(render(with_texture), expected)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_a_dark_albedo_scale_leaves_white_reflection_as_it_is(tmp_path, metallic):
    mesh = Gloss(0.5, metallic).on(normalize(ball()))
    light = load_light("uniform")
    settings = ImageSettings(24, 4)
    [expected] = path_traced(tmp_path, mesh, CAMERAS[:1], light, settings, albedo_scale=0.1)
    found = image_of(operator_of(mesh, CAMERAS[0], settings, albedo_scale=0.1), light)
    found_mean, expected_mean = (image[:3].mean() for image in (found, expected))
    assert abs(found_mean / expected_mean - 1) < 0.06


def test_a_scene_is_rendered_on_a_single_core_too(tmp_path):
    """With a single thread, Mitsuba would wait forever for its own reader of .exr files."""
    camera = OrthographicCamera(57.3, 0.0, 2.0)
    write_mitsuba_scene(tmp_path, ball(), 1.0, [camera], ImageSettings(8), "light.exr")
    write_map(tmp_path / "light.exr", torch.ones(8, 16, 3))
    drjit.set_thread_count(1)
    faulthandler.dump_traceback_later(60, exit=True)
    images = render_mitsuba_scene(tmp_path / SCENE, 1, (8, 8))
    faulthandler.cancel_dump_traceback_later()
    assert images.shape == (1, 4, 8, 8)
    assert images[:, 3].any()
