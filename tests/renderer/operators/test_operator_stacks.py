"""Many views in one call, compared with the single views."""

from collections.abc import Callable
from functools import cache, partial

import pytest
import torch
from oracles import draw

import renderer
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.light.basis import HARMONICS, SumBasis
from renderer.light.lamps import Projector
from renderer.mesh import Mesh
from renderer.operators.build import build_operators
from renderer.operators.stack import TransferOperators
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss
from renderer.visibility import choose

# More than FEWEST_STACKED, so that the views are rendered as a stack.
VIEW_COUNT = 9
SIZE = 8
CAMERAS = orbit_cameras(VIEW_COUNT, 2.2)
# Its views cover different pixels.
CUP = renderer.solid("cup")
# The operators of a mesh with one color have one channel.
PLAIN = Mesh.plain(CUP.vertices, CUP.faces, (0.8, 0.4, 0.1))


def operators_of(
    mesh=CUP, basis=HARMONICS, dtype=torch.float64, size=SIZE, gloss=None, encoding="linear"
):
    settings = ImageSettings(size, 2, encoding)
    operators = build_operators(
        mesh, CAMERAS, settings, choose("numpy"), basis=basis, dtype=dtype, gloss=gloss
    )
    return TransferOperators(operators)


def sparse_operators() -> TransferOperators:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("renderer.operators.build.SMALL_MATRIX_SIZE", 0)
        operators = operators_of(basis=SumBasis((HARMONICS, Projector(16))))
    assert all(operator.sparse is not None for operator in operators)
    return operators


SCENES: dict[str, Callable[[], TransferOperators]] = {
    "colors": operators_of,
    "sRGB": partial(operators_of, encoding="srgb"),
    "one color": partial(operators_of, PLAIN),
    "gloss": partial(operators_of, PLAIN, gloss=Gloss(0.5), encoding="srgb"),
    "projector": partial(operators_of, basis=SumBasis((HARMONICS, Projector(16)))),
    "sparse": sparse_operators,
    "float32": partial(operators_of, dtype=torch.float32),
}


@cache
def scene_operators(scene: str) -> TransferOperators:
    return SCENES[scene]()


BEHIND = draw(VIEW_COUNT, 2, 3, SIZE, SIZE, seed=3).abs().clamp(max=1)


@pytest.mark.parametrize(
    ("batch", "per_view", "background", "background_of_view"),
    [
        ((), False, 0.2, [0.2] * VIEW_COUNT),
        ((2,), False, BEHIND[:, :1], BEHIND[:, :1]),
        ((VIEW_COUNT,), True, BEHIND[0, 0], [BEHIND[0, 0]] * VIEW_COUNT),
        ((VIEW_COUNT, 2), True, BEHIND, BEHIND),
    ],
    ids=["gray", "image of view", "image", "all images"],
)
@pytest.mark.parametrize("scene", SCENES)
def test_batched_views_are_the_single_views(scene, batch, per_view, background, background_of_view):
    operators = scene_operators(scene)
    tolerance = 1e-5 if scene == "float32" else 1e-12
    lights = 0.3 * draw(*batch, operators[0].basis.size, 3)

    variable = lights.clone().requires_grad_()
    found = operators.image(variable, background, light_per_view=per_view)
    single = lights.clone().requires_grad_()
    light_of_view = single if per_view else single.expand(VIEW_COUNT, *single.shape)
    images = []
    for operator, light, behind in zip(operators, light_of_view, background_of_view, strict=True):
        images.append(operator.image(light, behind))
    expected = torch.stack(images)
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)

    upstream = draw(*found.shape, seed=1)
    [gradient] = torch.autograd.grad(found, variable, upstream)
    [expected_gradient] = torch.autograd.grad(expected, single, upstream)
    torch.testing.assert_close(gradient, expected_gradient, rtol=tolerance, atol=100 * tolerance)
    without_autograd = operators.image_and_gradient(
        lights, lambda _: upstream, background=background, light_per_view=per_view
    )
    assert torch.equal(without_autograd[0], found)
    assert torch.equal(without_autograd[1], gradient)


@pytest.mark.parametrize("size", [SIZE, 100])
def test_images_are_differentiable_in_the_background(size):
    """The corner is background in all four images. Large images are computed in a loop."""
    operators = operators_of(size=size)[:2]
    lights = 0.3 * draw(2, 49, 3)
    background = torch.full((3, size, size), 0.25, dtype=torch.float64, requires_grad=True)
    images = operators.image(lights, background)
    expected = torch.stack([operator.image(lights, 0.25) for operator in operators])
    torch.testing.assert_close(images, expected, rtol=0, atol=1e-12)
    assert torch.equal(operators.image(lights, 0.25), expected)
    [gradient] = torch.autograd.grad(images.sum(), background)
    assert gradient[0, 0, 0] == 4


def test_operators_are_a_sequence():
    operators = renderer.precompute_transfer(CUP, CAMERAS, 8, rasterizer="numpy")
    first, *others = operators
    assert len(operators) == VIEW_COUNT
    assert operators[0] is first
    assert operators[-1] is others[-1]
    assert isinstance(operators[1:], TransferOperators)
    assert list(operators[1:]) == others
    assert operators + others == [*operators, *others]


def test_no_operators_and_operators_of_different_sizes_are_refused():
    with pytest.raises(InputError, match=r"^operators"):
        TransferOperators([])
    with pytest.raises(InputError, match=r"^operators"):
        TransferOperators([*scene_operators("colors"), *operators_of(size=4)])


def test_views_that_are_first_rendered_in_inference_mode_have_gradients_later():
    operators = operators_of(PLAIN)
    light = draw(49, 3)
    with torch.inference_mode():
        expected = operators.image(light)
    light.requires_grad_()
    images = operators.image(light)
    assert torch.equal(images, expected)
    images.sum().backward()
    assert light.grad.any()
