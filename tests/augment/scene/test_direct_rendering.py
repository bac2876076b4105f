from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import augment
from augment.scene.conditions import Conditions
from augment.scene.scene import Scene
from renderer.geometry.mesh import Mesh
from renderer.geometry.shapes import solid
from renderer.image import decode, encode
from renderer.settings import ENCODINGS
from renderer.transport.operators import build_operators
from renderer.visibility.rasterizers import choose

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
RASTERIZER = choose("numpy")
EVERY = torch.arange(3)
# Sums of 31 products below 1 in another order, and the slope of 12.92 of the sRGB curve near black.
ROUNDING = 13 * 8 * EPS


def own_lights(scene: Scene, seed: int = 0) -> Tensor:
    """(E, 49, 3), a light for each example."""
    draws = torch.Generator().manual_seed(seed)
    return scene.lights + 0.01 * torch.randn(len(scene), 49, 3, generator=draws).to(scene.lights)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("dtype", "rounding"), [(torch.float32, ROUNDING * EPS32 / EPS), (torch.float64, ROUNDING)]
)
def test_images_equal_the_operators_of_each_view(make_scene, dtype, rounding, encoding):
    """In the dtype of the light. Unchanged vertices and albedo are shaded by code that operators do not use."""
    scene = make_scene(dtype=dtype, encoding=encoding, albedo_scale=1.2)
    lights, item = own_lights(scene), scene.objects[0]
    still = (
        {"vertices": scene.vertices.expand(3, -1, -1)},
        {"albedo": torch.zeros(3, 20, 3, dtype=dtype)},
    )
    for change in ({}, *still):
        images = scene.render(Conditions(lights, **change), EVERY)
        assert images.shape == (3, 2, 3, 6, 6) and images.dtype == dtype
        assert images.min() > 0 and images.max() < 1  # nothing clamps here
        for shown, light, cameras, behind in zip(
            images, lights, scene.cameras, scene.backgrounds, strict=True
        ):
            scale_and_dtype = {"albedo_scale": item.albedo_scale, "dtype": dtype}
            operators = build_operators(
                item.mesh, cameras, scene.settings, RASTERIZER, **scale_and_dtype
            )
            expected = torch.stack([operator.image(light, behind) for operator in operators])
            torch.testing.assert_close(shown, expected, rtol=0, atol=rounding)


@pytest.mark.parametrize("part", ["light", "vertices", "albedo", "pixels"])
def test_examples_in_any_order_have_the_same_images(make_scene, part):
    scene, draws = make_scene(), torch.Generator().manual_seed(1)
    shape = {"vertices": (12, 3), "albedo": (20, 3), "pixels": (2, 3, 6, 6)}
    change = (
        {}
        if part == "light"
        else {part: 0.05 * torch.randn(3, *shape[part], generator=draws).double()}
    )
    if part == "vertices":
        change[part] += scene.vertices
    conditions = Conditions(own_lights(scene), **change)
    everything = scene.render(conditions, EVERY)
    for examples in ([1], [2, 0], [0, 2, 2, 1, 0]):
        chosen = torch.tensor(examples)
        some = Conditions(
            conditions.light[chosen], **{name: value[chosen] for name, value in change.items()}
        )
        torch.testing.assert_close(
            scene.render(some, chosen), everything[chosen], rtol=0, atol=ROUNDING
        )


def test_moved_vertices_look_like_a_mesh_built_with_them(make_scene, stone):
    """Its outline too: half of the pixels change at least a little."""
    scene, draws = make_scene(), np.random.default_rng(0)
    moved = stone.vertices + 0.1 * draws.normal(size=(3, *stone.vertices.shape))
    images = scene.render(Conditions(own_lights(scene), vertices=torch.from_numpy(moved)), EVERY)
    for row in range(3):
        other = make_scene(mesh=replace(stone, vertices=moved[row]))
        expected = other.render(Conditions(own_lights(scene)), EVERY)[row]
        torch.testing.assert_close(images[row], expected, rtol=0, atol=ROUNDING)
    assert (
        (images - scene.render(Conditions(own_lights(scene)), EVERY)).abs() > 1e-3
    ).double().mean() > 0.3


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_changed_albedo_looks_like_a_mesh_of_that_color(make_scene, stone, encoding):
    """The linear albedo changes, whatever the encoding, and keeps to [0, 1]."""
    scene = make_scene(encoding=encoding)
    offset = torch.rand(3, 20, 3, generator=torch.Generator().manual_seed(0)).double() - 0.5
    images = scene.render(Conditions(own_lights(scene), albedo=offset), EVERY)
    own = decode(torch.from_numpy(stone.corner_colors).double(), encoding)
    assert ((own + offset[:, :, None]) < 0).any()
    for row in range(3):
        color = encode((own + offset[row][:, None]).clamp(0, 1), encoding)
        other = make_scene(
            mesh=replace(stone, corner_colors=color.float().numpy()), encoding=encoding
        )
        expected = other.render(Conditions(own_lights(scene)), EVERY)[row]
        # The color is stored in float32.
        torch.testing.assert_close(images[row], expected, rtol=0, atol=13 * 4 * EPS32)


def test_pixel_changes_are_added_last_and_clamped_and_keep_their_gradient(make_scene):
    """At its bounds `torch.clamp` has none or half of a gradient, and an attack could not start there."""
    backgrounds = torch.zeros(3, 3, 6, 6)
    backgrounds[1:] = 1
    scene = make_scene(backgrounds=backgrounds)
    change = 2 * torch.rand(3, 2, 3, 6, 6, generator=torch.Generator().manual_seed(0)).double() - 1
    pixels = torch.zeros_like(change, requires_grad=True)
    images, changed = (
        scene.render(Conditions(scene.lights, pixels=added), EVERY) for added in (pixels, change)
    )
    assert (
        torch.equal(changed, (images + change).clamp(0, 1))
        and (images == 0).any()
        and (images == 1).any()
    )
    assert torch.equal(torch.autograd.grad(images.sum(), pixels)[0], torch.ones_like(pixels))


def test_colors_at_their_bounds_keep_their_gradient(make_scene, stone):
    sums = []
    for color in (0.0, 0.5, 1.0):
        colored = replace(stone, corner_colors=np.full_like(stone.corner_colors, color))
        scene = make_scene(mesh=colored)
        albedo = torch.zeros(3, 20, 3, dtype=torch.float64, requires_grad=True)
        images = scene.render(replace(scene.conditions(EVERY), albedo=albedo), EVERY)
        sums.append(torch.autograd.grad(images.sum(), albedo)[0])
    torch.testing.assert_close(sums[0], sums[1], rtol=0, atol=ROUNDING)
    torch.testing.assert_close(sums[2], sums[1], rtol=0, atol=ROUNDING)


def test_a_mesh_outside_the_image_leaves_the_backgrounds_and_a_gradient_of_zero(make_scene, stone):
    scene = make_scene(mesh=replace(stone, vertices=stone.vertices + 10))
    for part, value in (
        ("light", scene.lights[0]),
        ("vertices", scene.vertices[0]),
        ("albedo", torch.zeros(20, 3).double()),
    ):
        values = value.expand(3, -1, -1).clone().requires_grad_(True)
        images = scene.render(replace(scene.conditions(EVERY), **{part: values}), EVERY)
        behind = scene.backgrounds[:, None].expand_as(images)
        torch.testing.assert_close(images.detach(), behind, rtol=0, atol=0)
        assert not torch.autograd.grad(images.sum(), values)[0].any()


def test_frozen_shadows_darken_with_the_color():
    """A cup shades itself inside. Painted half as bright, it looks like a cup of that color."""
    cup, images = solid("cup"), []
    options = {
        "encoding": "linear",
        "normals": "flat",
        "rasterizer": "numpy",
        "width": 2.4,
        "polar": 35.0,
    }
    for gray, added, shadows in ((0.6, -0.3, True), (0.3, 0.0, True), (0.3, 0.0, False)):
        mesh = Mesh.plain(cup.vertices, cup.faces, (gray, gray, gray))
        scene = augment.build_scene(
            [(mesh, "cup")], 24, 1, **options, shadows=shadows, backgrounds=[0.0]
        )
        albedo = torch.full((1, len(mesh.faces), 3), added)
        images.append(scene.render(Conditions(scene.lights, albedo=albedo), torch.arange(1)))
    painted, expected, without_shadows = images
    assert (without_shadows - expected).abs().max() > 0.02
    torch.testing.assert_close(painted, expected, rtol=0, atol=1e-5)
