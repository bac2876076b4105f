"""A rectangular image is the center of the larger square image of the same pixels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import path_traced
from scipy.ndimage import center_of_mass

import norm_balls as nb
from augment.attacks.files import save
from augment.augmentation_settings import CameraEffectSettings, VariationSettings
from augment.random_streams import generator
from augment.scene import patterns
from augment.scene.surfaces import draw_shading
from augment.scene.vary import vary
from renderer.camera import OrthographicCamera, PerspectiveCamera
from renderer.pinhole import PinholeCamera
from renderer.settings import ImageSettings
from renderer.visibility import choose
from tests.helpers import bright_or_dark, images_of

ASIDE = {"roll": 34.0, "principal_right": 0.3, "principal_up": -0.2, "pixel_aspect": 1.1}
CAMERAS = {
    "parallel": OrthographicCamera(63.0, 22.9, 2.4, 0.1, -0.2),
    "perspective": PerspectiveCamera(63.0, 22.9, 2.4, 0.1, -0.2, distance=5.0),
    "pinhole": PinholeCamera(80.2, 17.2, 2.4, distance=3.2, **ASIDE),
}
SHAPES = [(12, 20), (20, 12)]
each_shape = pytest.mark.parametrize("shape", SHAPES, ids=["wide", "tall"])
each_view = pytest.mark.parametrize(
    ("camera", "shape"), [*zip(CAMERAS.values(), [*SHAPES, SHAPES[0]], strict=True)], ids=CAMERAS
)
CUP = nb.solid("cup")
LIGHT = nb.load_light("grace")


def around(camera, shape):
    """Return the camera and the side of the square image whose center has this shape."""
    width = shape[1]
    side = max(shape)
    wider = replace(camera, width=camera.width * side / width)
    if isinstance(camera, PinholeCamera):
        offsets = (camera.principal_right, camera.principal_up)
        right, up = (offset * width / side for offset in offsets)
        wider = replace(wider, principal_right=right, principal_up=up)
    return wider, side


def center(image, shape):
    top, left = ((side - cut) // 2 for side, cut in zip(image.shape[-2:], shape, strict=True))
    return image[..., top : top + shape[0], left : left + shape[1]]


@pytest.mark.parametrize("rasterizer", ["numpy", "numba", "opengl"])
@each_view
def test_a_rectangle_is_the_center_of_a_square(shape, camera, rasterizer):
    try:
        choose(rasterizer)
    except nb.InputError as error:
        pytest.skip(str(error))
    background = torch.rand(3, 20, 20, generator=torch.Generator().manual_seed(0))
    wider, side = around(camera, shape)
    options = {"rasterizer": rasterizer, "encoding": "srgb"}
    whole = nb.render(CUP, wider, LIGHT, side, background, **options)
    cut = nb.render(CUP, camera, LIGHT, shape, center(background, shape), **options)
    assert (cut - center(background, shape)).abs().max() > 0.1
    torch.testing.assert_close(cut, center(whole, shape), atol=1e-5, rtol=0)


@each_view
def test_gradients_at_silhouettes_are_those_of_the_square(shape, camera):
    wider, side = around(camera, shape)
    # Silhouettes at the border of the rectangle move into pixels outside of it.
    inner = (3, shape[0] - 2, shape[1] - 2)
    weights = torch.rand(inner, generator=torch.Generator().manual_seed(1)).double()
    weights = torch.nn.functional.pad(weights, (1, 1, 1, 1))
    gradients = []
    options = {"silhouettes": True, "samples": 3, "rasterizer": "numpy"}
    for seen, size in ((camera, shape), (wider, side)):
        vertices = torch.from_numpy(CUP.vertices).requires_grad_()
        image = nb.render(CUP, seen, LIGHT.double(), size, vertices=vertices, **options)
        (center(image, shape) * weights).sum().backward()
        gradients.append(vertices.grad)
    assert gradients[0].abs().max() > 0.01
    torch.testing.assert_close(*gradients, atol=1e-4, rtol=1e-4)


VIEW = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]


def ball_seen_at(camera, shape, radius, place):
    ball = nb.solid("ball")
    small = replace(ball, vertices=radius * ball.vertices + place)
    image = 1 - nb.render(small, camera, 0 * LIGHT, shape, 1.0, samples=8)[0]
    row, column = center_of_mass(image.numpy())
    return column + 0.5, row + 0.5


def test_a_point_is_seen_where_its_intrinsics_say():
    """A small ball at (x, y, z) is seen at (fx x / z + cx, fy y / z + cy)."""
    camera = nb.PinholeCamera.from_matrix(VIEW, [[60, 0, 16], [0, 66, 16], [0, 0, 1]], size=32)
    # The square of 32 rows begins 4 rows above this image.
    expected = (60 * 0.8 / 5 + 16, 66 * 0.4 / 5 + 16 - 4)
    found = ball_seen_at(camera, (24, 32), 0.1, [0.8, 0.4, 0.0])
    assert found == pytest.approx(expected, abs=0.05)


@each_shape
def test_the_camera_of_a_whole_photograph_shows_all_of_it(shape):
    height, width = shape
    intrinsics = [[20, 0, width - 5], [0, 22, height - 5], [0, 0, 1]]
    camera = nb.PinholeCamera.from_matrix(VIEW, intrinsics, (width, height), whole=True)
    found = ball_seen_at(camera, shape, 0.3, [0, 0, 0])
    assert found == pytest.approx((width - 5, height - 5), abs=0.05)


@each_view
def test_mitsuba_agrees(tmp_path, shape, camera):
    settings = ImageSettings(shape, 8)
    camera = replace(camera, pixel_aspect=1.0) if isinstance(camera, PinholeCamera) else camera
    light = torch.zeros(49, 3)
    light[0] = 1.0
    [theirs] = path_traced(tmp_path, CUP, [camera], light, settings)
    coverage = 1 - nb.render(CUP, camera, 0 * light, shape, 1.0, samples=8)[0]
    assert theirs.shape[-2:] == shape
    assert 0.1 < coverage.mean() < 0.9
    torch.testing.assert_close(theirs[3].float(), coverage, atol=0.13, rtol=0)
    assert (theirs[3] - coverage).abs().mean() < 0.01


@each_shape
def test_patterns_and_slides_are_the_center_of_the_square(shape):
    width = shape[1]
    points = patterns.pixel_centers(shape)
    whole = patterns.pixel_centers(max(shape)) * (max(shape) / width)
    torch.testing.assert_close(points, center(whole, shape))
    assert patterns.draw_slides(8, shape, generator(0, "slides")).shape == (8, 3, *shape)
    assert draw_shading(2, shape, generator(0, "shading")).shape == (2, 1, *shape)


def test_a_photograph_in_a_pattern_keeps_its_proportions():
    """A disk in a wide photograph stays a disk."""
    rows, columns = np.mgrid[:40, :80] + 0.5
    disk = torch.from_numpy((rows - 20) ** 2 + (columns - 40) ** 2 < 15**2).float()
    points = patterns.pixel_centers((60, 120))
    draws = generator(3, "photograph")
    shown = patterns.draw_photograph_patterns(disk.expand(1, 3, -1, -1), points, draws)[0, 1]
    rows, columns = torch.nonzero(shown[10:50, 40:80] > 0.5).T.double()
    assert rows.std().item() == pytest.approx(columns.std().item(), rel=0.05)


@each_shape
def test_varied_scenes_have_tables_and_effects_of_the_size(shape):
    scene = nb.build_scene([("solid:cup", "cup")], shape, 2, rasterizer="numpy", width=3.0)
    settings = VariationSettings(
        tables=1.0, lit_background=True, camera=CameraEffectSettings(blur=1.0, pattern_fraction=1.0)
    )
    varied = vary(scene, settings, generator(0, "vary"))
    assert images_of(varied).shape == (2, 3, *shape)


def test_an_attack_is_saved_and_read_again(tmp_path):
    shape = SHAPES[1]
    scene = nb.build_scene([("solid:cup", "0")], shape, rasterizer="numpy", samples=1)
    steps = {"lighting": nb.StepSettings(step_size=0.5), "pixels": nb.StepSettings(step_size=0.1)}
    result = nb.attack(bright_or_dark, scene, settings=nb.AttackSettings(max_steps=2, **steps))
    assert result.images.shape == (1, 3, *shape)
    save(result, tmp_path)
    adversary = nb.reload(tmp_path / "example_000")
    torch.testing.assert_close(adversary.render(), result.images[0], atol=2e-3, rtol=0)
    assert adversary.settings.shape == shape
    result.save_animation(tmp_path / "attack.gif", frame_count=2)
    result.plot()


def test_a_classifier_of_rectangles_refuses_other_images():
    classifier = nb.Classifier(bright_or_dark, (8, 12), ["0", "1"])
    assert classifier(torch.zeros(2, 3, 8, 12)).shape == (2, 2)
    with pytest.raises(nb.InputError, match=r"\(2, 3, 12, 8\): give \(N, 3, 8, 12\)"):
        classifier(torch.zeros(2, 3, 12, 8))
