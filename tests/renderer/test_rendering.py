import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import renderer
from renderer.errors import InputError
from renderer.image import as_background, encode
from renderer.light.basis import HARMONICS, SumBasis, with_local_lights
from renderer.light.lamps import Lamps
from renderer.light.presets import ambient, load_light
from renderer.light.projector import Projector
from renderer.rendering import light_sphere
from renderer.settings import ENCODINGS, NORMALS, ImageSettings
from renderer.transport.operators import build_operators
from renderer.visibility.rasterizers import choose

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
CAMERAS = renderer.orbit_cameras(3, 2.4)
SMALL = {"size": 9, "rasterizer": "numpy"}


@pytest.fixture(scope="module")
def stone() -> renderer.Mesh:
    """No symmetry, a color per face."""
    solid, rng = trimesh.creation.icosahedron(), np.random.default_rng(0)
    plain = renderer.Mesh.plain(solid.vertices * [1.0, 0.9, 0.8], solid.faces)
    colors = np.broadcast_to(rng.uniform(0.2, 0.8, (len(solid.faces), 1, 3)), plain.corner_colors.shape)
    return replace(plain, corner_colors=colors.astype(np.float32))


@pytest.fixture(scope="module")
def light() -> Tensor:
    """Nothing clamps under it."""
    draws = torch.Generator().manual_seed(0)
    return ambient(torch.full((3,), 0.2).double()) + 0.02 * torch.randn(49, 3, generator=draws).double()


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("normals", NORMALS)
def test_an_operators_image_is_the_rendered_one(stone, light, encoding, normals):
    choices = SMALL | {"encoding": encoding, "normals": normals, "albedo_scale": 1.2}
    images = renderer.render(stone, CAMERAS, light, background=0.3, **choices)
    assert images.shape == (3, 3, 9, 9)
    for image, operator in zip(images, renderer.precompute_transfer(stone, CAMERAS, **choices), strict=True):
        # The operator is in float32: sums of 31 terms below 1, and the slope of 12.92 of the sRGB curve near black.
        torch.testing.assert_close(operator.image(light, 0.3), image, rtol=0, atol=13 * 8 * EPS32)


def test_the_image_is_differentiable_in_light_vertices_and_albedo(stone, light):
    """By light and albedo it is linear where nothing clamps; the vertices' gradient is `radiance`'s, tested there."""
    albedo = torch.full((20, 3), 0.5, dtype=torch.float64)
    inputs = {"light": light, "vertices": torch.from_numpy(stone.vertices), "albedo": albedo}
    inputs = {name: value.clone().requires_grad_(True) for name, value in inputs.items()}
    (image,) = renderer.render(stone, CAMERAS[0], **inputs, **SMALL)
    gradients = dict(zip(inputs, torch.autograd.grad(image.sum(), inputs.values()), strict=True))
    assert all(gradient.any() for gradient in gradients.values())
    for name in ("light", "albedo"):
        change = 1e-3 * torch.randn(inputs[name].shape, generator=torch.Generator().manual_seed(1)).double()
        moved = renderer.render(stone, CAMERAS[0], **inputs | {name: inputs[name] + change}, **SMALL)
        found, expected = float((moved - image).detach().sum()), float((gradients[name] * change).sum())
        assert found == pytest.approx(expected, abs=1e3 * EPS)


def test_vertices_and_albedo_replace_those_of_the_mesh(stone, light):
    turned = stone.vertices[:, [1, 2, 0]]
    expected = renderer.render(replace(stone, vertices=turned), CAMERAS, light, **SMALL)
    assert torch.equal(renderer.render(stone, CAMERAS, light, vertices=torch.from_numpy(turned), **SMALL), expected)
    plain, rng = renderer.Mesh.plain(stone.vertices, stone.faces), np.random.default_rng(1)
    texture = rng.integers(0, 256, (4, 5, 3)).astype(np.uint8)
    uvs, texture_ids = rng.random((20, 3, 2)).astype(np.float32), np.zeros(20, dtype=np.int32)
    textured = replace(plain, corner_uvs=uvs, texture_ids=texture_ids, textures=(texture,))
    per_face = torch.from_numpy(stone.corner_colors[:, 0]).double()
    black = replace(textured, textures=(0 * texture,))
    for mesh, other, albedo in [(stone, plain, per_face), (textured, black, torch.from_numpy(texture).double() / 255)]:
        expected = renderer.render(mesh, CAMERAS, light, **SMALL)
        found = renderer.render(other, CAMERAS, light, albedo=albedo, **SMALL)
        torch.testing.assert_close(found, expected, rtol=0, atol=4 * EPS)


def test_backgrounds_are_grays_colors_and_images_of_one_view_or_all(stone, light):
    empty = replace(stone, vertices=stone.vertices + 10)
    draws = torch.rand(3, 3, 9, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    color = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    for background, expected in [
        (0.25, torch.full((3, 3, 9, 9), 0.25)),
        (color, color.view(1, 3, 1, 1).expand(3, 3, 9, 9)),
        (draws[0], draws[:1].expand(3, -1, -1, -1)),
        (draws, draws),
    ]:
        found = renderer.render(empty, CAMERAS, light, background=background, **SMALL)
        torch.testing.assert_close(found, expected.to(found), rtol=0, atol=0)


@pytest.mark.parametrize("background", [-0.1, math.nan, torch.rand(2), torch.rand(3, 8, 9)])
def test_backgrounds_of_another_shape_or_range_are_refused(background):
    with pytest.raises(InputError, match=r"^background "):
        as_background(background, 9, torch.zeros(1))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"vertices": torch.zeros(4, 3)}, r"vertices of shape \(4, 3\) does not fit the mesh: give \(12, 3\)"),
        ({"albedo": torch.zeros(4, 3)}, r"albedo of shape \(4, 3\) does not fit the mesh: give \(20, 3\)"),
        ({"light": torch.full((49, 3), math.nan)}, "light holds NaN"),
        ({"light": torch.zeros(48, 3)}, r"light has shape \(48, 3\)"),
        ({"cameras": []}, "cameras is empty"),
        ({"size": 0}, "size=0 must be at least 1"),
        ({"encoding": "jpeg"}, "encoding=jpeg"),
        ({"rasterizer": "eyes"}, "rasterizer=eyes"),
        (
            {"lights": [(Projector(), torch.zeros(9, 3))]},
            "lights: a projector of 16² pixels has coefficients",
        ),
    ],
)
def test_bad_input_is_refused_in_one_sentence(stone, light, wrong, message):
    with pytest.raises(InputError, match=message):
        renderer.render(**{"mesh": stone, "cameras": CAMERAS, "light": light.float(), **SMALL, **wrong})


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_an_image_of_few_pixels_is_the_mean_of_those_of_a_finer_one(stone, light, size):
    few, finer = (
        renderer.render(stone, CAMERAS, light, pixels, samples=12 // pixels, rasterizer="numpy")
        for pixels in (size, 12)
    )
    expected = finer.unflatten(3, (size, -1)).mean(4).unflatten(2, (size, -1)).mean(3)
    torch.testing.assert_close(few, expected, rtol=0, atol=64 * EPS)


@pytest.mark.parametrize("light", [None, load_light("grace")], ids=["alone", "beside"])
@pytest.mark.parametrize("samples", [1, 2])
def test_lamps_and_projectors_are_added_as_by_operators(light, samples):
    """With all their power where they have no coefficients, and shadows."""
    cup, lamps, projector = renderer.solid("cup"), Lamps(((2.0, 1.0, 2.0),), radius=0.3), Projector(8, 28.6, 91.7)
    pattern = torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
    choices = {"size": 9, "samples": samples, "normals": "flat", "shadows": True, "rasterizer": "numpy"}
    images = renderer.render(cup, CAMERAS, light, lights=[lamps, (projector, pattern)], **choices)
    parts = [(lamps, torch.full((1, 3), lamps.power)), (projector, pattern)]
    basis, coefficients = with_local_lights(torch.zeros(49, 3) if light is None else light, parts)
    settings = ImageSettings(9, samples, normals="flat", shadows=True)
    operators = build_operators(cup, CAMERAS, settings, choose("numpy"), basis=basis)
    expected = torch.stack([operator.image(coefficients) for operator in operators])
    torch.testing.assert_close(images, expected, rtol=0, atol=1e-5)
    assert (images > 0.5).any()


def on_the_ball(size: int) -> tuple[Tensor, Tensor]:
    """Normals (size, size, 3) of a ball of radius 1 seen from above, right is +y, and the pixels well inside it."""
    at = (torch.arange(size).double() + 0.5) * 2 / size - 1
    right, up = at.expand(size, -1), -at[:, None].expand(-1, size)
    back = (1 - right**2 - up**2).clamp(min=0).sqrt()
    return torch.stack([-up, right, back], dim=2), back > 0.3


def test_a_light_sphere_shows_even_light_on_white_and_lamps_by_inverse_squares():
    """c · cos / d². The ball's edges of 0.036 leave its faces 0.036² / 8 inside of it; sRGB's slope is 1.7 at 0.1.
    Within a pixel the lamp's terminator is a kink."""
    position, power = torch.tensor([0.3, -0.4, 2.5]).double(), torch.tensor([0.5, 1.0, 2.0]).double()
    light = torch.cat([ambient(torch.full((3,), 0.1)), power[None].float()])
    basis = SumBasis((HARMONICS, Lamps((tuple(position.tolist()),))))
    image = light_sphere(light, 64, renderer.OrthographicCamera(0.0, 0.0, 2.0), basis)
    normal, inside = on_the_ball(64)
    toward = position - normal
    arriving = ((toward * normal).sum(2) / toward.norm(dim=2) ** 3).clamp(min=0)
    expected = encode((0.1 + power[:, None, None] * arriving).clamp(max=1), "srgb").float()
    assert expected[:, inside].std() > 0.05 and (image[:, ::63, ::63] == 1).all()
    torch.testing.assert_close(image[:, inside], expected[:, inside], rtol=0, atol=6e-3)
    alone = light_sphere(ambient(torch.tensor([0.1, 0.4, 0.9])), 16)
    expected = encode(torch.tensor([0.1, 0.4, 0.9]), "srgb")
    torch.testing.assert_close(alone[:, 8, 8], expected, rtol=0, atol=1e-6)
