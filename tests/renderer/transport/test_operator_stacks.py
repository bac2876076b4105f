"""Many views in one call are the single views."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from oracles import draw

import renderer
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.light.basis import HARMONICS, SumBasis
from renderer.light.projector import Projector
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss
from renderer.transport.operator_stacks import TransferOperators
from renderer.transport.operators import build_operators
from renderer.visibility.rasterizers import choose

VIEWS, SIZE = 9, 12
CAMERAS = orbit_cameras(VIEWS, 2.2)
PEAR = renderer.solid("pear")


def operators_of(mesh=PEAR, basis=HARMONICS, dtype=torch.float64, size=SIZE, gloss=None, **settings):
    images = ImageSettings(size, 2, **settings)
    built = build_operators(mesh, CAMERAS, images, choose("numpy"), basis=basis, dtype=dtype, gloss=gloss)
    return TransferOperators(built)


def plain_mesh():
    """Of one color, so that the operators have one channel."""
    return Mesh.plain(PEAR.vertices, PEAR.faces, (0.8, 0.4, 0.1))


SCENES = {
    "colors": partial(operators_of),
    "sRGB": partial(operators_of, encoding="srgb"),
    "one color": partial(operators_of, plain_mesh()),
    "gloss": partial(operators_of, plain_mesh(), gloss=Gloss(0.5), encoding="srgb"),
    "projector": partial(operators_of, basis=SumBasis((HARMONICS, Projector(64)))),
    "float32": partial(operators_of, dtype=torch.float32),
}


@pytest.mark.parametrize("scene", SCENES)
def test_all_views_in_one_call_are_the_single_views(scene):
    """Images and gradients, under several lights and with a light per view, over one background and over many."""
    operators = SCENES[scene]()
    rows = operators[0].basis.size
    tolerance = {"rtol": 0, "atol": 1e-5 if scene == "float32" else 1e-12}
    images = draw(VIEWS, 2, 3, SIZE, SIZE, seed=3).abs().clamp(max=1)
    for lights, per_view, background in (
        (0.3 * draw(rows, 3), False, 0.2),
        (0.3 * draw(2, rows, 3), False, images[:, :1]),
        (0.3 * draw(VIEWS, rows, 3), True, images[0, 0]),
        (0.3 * draw(VIEWS, 2, rows, 3), True, images),
    ):
        variable = lights.clone().requires_grad_()
        found = operators.image(variable, background, light_per_view=per_view)
        alone = lights.clone().requires_grad_()
        of_views = alone if per_view else alone.expand(VIEWS, *alone.shape)
        behind = [background] * VIEWS if not torch.is_tensor(background) or background.ndim < 5 else background
        pairs = zip(operators, of_views, behind, strict=True)
        expected = torch.stack([operator.image(light, image) for operator, light, image in pairs])
        torch.testing.assert_close(found, expected, **tolerance)
        upstream = draw(*found.shape, seed=1)
        [gradient] = torch.autograd.grad(found, variable, upstream)
        [by_single_views] = torch.autograd.grad(expected, alone, upstream)
        torch.testing.assert_close(gradient, by_single_views, rtol=tolerance["atol"], atol=100 * tolerance["atol"])
        call = {"background": background, "light_per_view": per_view}
        direct = operators.image_and_gradient(lights, lambda shown, upstream=upstream: upstream, **call)
        assert torch.equal(direct[0], found) and torch.equal(direct[1], gradient)


@pytest.mark.parametrize("size", [SIZE, 100])
def test_large_images_and_backgrounds_that_are_differentiated_give_the_same_images(size):
    """Those take the way of a loop."""
    operators = operators_of(size=size)[:2]
    lights = 0.3 * draw(2, 49, 3)
    expected = torch.stack([operator.image(lights, 0.25) for operator in operators])
    assert torch.equal(operators.image(lights, 0.25), expected)
    behind = torch.full((3, size, size), 0.25, dtype=torch.float64, requires_grad=True)
    found = operators.image(lights, behind)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    assert torch.autograd.grad(found.sum(), behind)[0][0, 0, 0] == 4


def test_the_operators_are_a_sequence_as_a_list_is():
    operators = renderer.precompute_transfer(PEAR, CAMERAS, 8, rasterizer="numpy")
    first, *others = operators
    assert len(operators) == VIEWS and operators[0] is first and operators[-1] is others[-1]
    assert list(operators[1:]) == others and isinstance(operators[1:], TransferOperators)
    assert operators + others == [*operators, *others]
    light = renderer.load_light("grace")
    assert torch.equal(TransferOperators([first]).image(light)[0], first.image(light))
    assert operators.to("cpu").image(light).shape == (VIEWS, 3, 8, 8)


def test_views_outside_of_the_image_show_the_background():
    away = replace(PEAR, vertices=PEAR.vertices + np.array([20, 0, 0]))
    operators = operators_of(away)
    assert all(len(operator.pixels) == 0 for operator in operators[:1])
    light = draw(49, 3).requires_grad_()
    images = operators.image(light, 0.25)
    assert (images[0] == 0.25).all()
    assert not torch.autograd.grad(images[0].sum(), light)[0].any()


def test_what_does_not_fit_is_refused_by_name():
    operators = operators_of()
    light = draw(49, 3)
    for lights, per_view, message in (
        (light[:9], False, "lights of shape"),
        (light * torch.nan, False, "lights holds NaN"),
        (light, True, "one per view"),
        (light.expand(3, -1, -1), True, "one per view"),
    ):
        with pytest.raises(InputError, match=message):
            operators.image(lights, light_per_view=per_view)
    with pytest.raises(InputError, match=r"background of shape .* does not broadcast"):
        operators.image(light, torch.zeros(4, 3, SIZE, SIZE))
    with pytest.raises(InputError, match="loss_gradient returned"):
        operators.image_and_gradient(light, lambda images: images[0])
    with pytest.raises(InputError, match="operators is empty"):
        TransferOperators([])
    with pytest.raises(InputError, match="operators differ"):
        TransferOperators([*operators, *operators_of(size=8)])
