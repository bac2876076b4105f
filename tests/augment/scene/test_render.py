"""Images of changed light, shape, albedo and pixels are those of a scene built so."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import draw, draw_uniform
from scipy.spatial.transform import Rotation
from torch import Tensor

import augment
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from renderer.image import decode, encode
from renderer.mesh import Mesh
from renderer.settings import ENCODINGS
from renderer.solids import solid

EPS = torch.finfo(torch.float64).eps
EPS32 = torch.finfo(torch.float32).eps
EVERY = torch.arange(3)
# Sums of 31 products below 1 are in another order, and the sRGB curve has a slope of 12.92.
ROUNDING = 13 * 8 * EPS


def own_lights(scene: Scene) -> Tensor:
    return scene.lights + 0.01 * draw(len(scene), 49, 3).to(scene.lights)


def test_moved_vertices_look_like_a_mesh_built_with_them(make_scene, stone):
    """The outline moves too."""
    scene = make_scene()
    lights = own_lights(scene)
    offsets = np.random.default_rng(0).normal(size=(3, *stone.vertices.shape))
    moved = stone.vertices + 0.1 * offsets
    images = scene.render(Conditions(lights, vertices=torch.from_numpy(moved)), EVERY)
    for row in range(3):
        other = make_scene(mesh=replace(stone, vertices=moved[row]))
        expected = other.render(Conditions(lights), EVERY)[row]
        torch.testing.assert_close(images[row], expected, rtol=0, atol=ROUNDING)
    is_changed = (images - scene.render(Conditions(lights), EVERY)).abs() > 1e-3
    assert is_changed.double().mean() > 0.3


@pytest.mark.parametrize("parts", [["albedo"], ["hue"], ["albedo", "hue"]])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_changed_albedo_looks_like_a_mesh_of_that_color(make_scene, stone, encoding, parts):
    """The linear albedo changes, whatever the encoding, and stays in [0, 1].

    Its hue is turned about gray before a color is added.
    """
    scene = make_scene(encoding=encoding)
    lights = own_lights(scene)
    offsets = draw_uniform(3, 20, 3) - 0.5
    changes = {"albedo": offsets, "hue": torch.full((3, 20), 100.0).double()}
    chosen = {part: changes[part] for part in parts}
    images = scene.render(Conditions(lights, **chosen), EVERY)
    linear = decode(torch.from_numpy(stone.corner_colors).double(), encoding).expand(3, -1, -1, -1)
    if "hue" in parts:
        turn = Rotation.from_rotvec(np.full(3, 100 / math.sqrt(3)), degrees=True)
        linear = linear @ torch.from_numpy(turn.as_matrix().T)
    # Shape (3, 20, 3 corners, 3).
    changed = linear + offsets[:, :, None] if "albedo" in parts else linear
    assert parts == ["hue"] or (changed < 0).any()
    for row in range(3):
        colors = encode(changed[row].clamp(0, 1), encoding).float().numpy()
        other = make_scene(mesh=replace(stone, corner_colors=colors), encoding=encoding)
        expected = other.render(Conditions(lights), EVERY)[row]
        # The color is stored in float32.
        torch.testing.assert_close(images[row], expected, rtol=0, atol=13 * 4 * EPS32)


def test_pixel_changes_are_added_last_and_clamped_and_keep_their_gradient_at_the_bounds(make_scene):
    """At its bounds `torch.clamp` has none or half of a gradient, and no attack could start."""
    backgrounds = torch.ones(3, 3, 6, 6)
    backgrounds[0] = 0
    scene = make_scene(backgrounds=backgrounds)
    change = 2 * draw_uniform(3, 2, 3, 6, 6) - 1
    images = scene.render(Conditions(scene.lights), EVERY)
    changed = scene.render(Conditions(scene.lights, pixels=change), EVERY)
    assert torch.equal(changed, (images + change).clamp(0, 1))
    assert (images == 0).any()
    assert (images == 1).any()
    pixels = torch.zeros_like(change).requires_grad_()
    unchanged = scene.render(Conditions(scene.lights, pixels=pixels), EVERY)
    (gradient,) = torch.autograd.grad(unchanged.sum(), pixels)
    assert torch.equal(gradient, torch.ones_like(pixels))


@pytest.mark.parametrize("bound", [0.0, 1.0])
def test_colors_at_their_bounds_keep_their_gradient(make_scene, stone, bound):
    gradients = []
    for gray in (bound, 0.5):
        colors = np.full_like(stone.corner_colors, gray)
        scene = make_scene(mesh=replace(stone, corner_colors=colors))
        albedo = torch.zeros(3, 20, 3, dtype=torch.float64, requires_grad=True)
        images = scene.render(replace(scene.conditions(EVERY), albedo=albedo), EVERY)
        gradients += torch.autograd.grad(images.sum(), albedo)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("part", ["light", "vertices", "albedo"])
def test_a_mesh_outside_the_image_leaves_backgrounds_and_a_zero_gradient(make_scene, stone, part):
    scene = make_scene(mesh=replace(stone, vertices=stone.vertices + 10))
    albedo = torch.zeros(20, 3).double()
    starts = {"light": scene.lights[0], "vertices": scene.vertices[0], "albedo": albedo}
    values = starts[part].expand(3, -1, -1).clone().requires_grad_(True)
    images = scene.render(replace(scene.conditions(EVERY), **{part: values}), EVERY)
    assert torch.equal(images.detach(), scene.backgrounds[:, None].expand_as(images))
    assert not torch.autograd.grad(images.sum(), values)[0].any()


def cup_image(gray: float, added: float, shadows: bool) -> Tensor:
    cup = solid("cup")
    mesh = Mesh.plain(cup.vertices, cup.faces, (gray, gray, gray))
    view = {"width": 2.4, "polar": 35.0, "backgrounds": [0.0], "rasterizer": "numpy"}
    scene = augment.build_scene([(mesh, "cup")], 24, normals="flat", shadows=shadows, **view)
    albedo = torch.full((1, len(mesh.faces), 3), added)
    return scene.render(Conditions(scene.lights, albedo=albedo), torch.arange(1))


def test_frozen_shadows_darken_with_the_color():
    """A cup that is painted half as bright looks like a cup of that color."""
    painted = cup_image(gray=0.6, added=-0.3, shadows=True)
    expected = cup_image(gray=0.3, added=0.0, shadows=True)
    without_shadows = cup_image(gray=0.3, added=0.0, shadows=False)
    assert (without_shadows - expected).abs().max() > 0.02
    torch.testing.assert_close(painted, expected, rtol=0, atol=1e-5)
