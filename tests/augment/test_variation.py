import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from torch import Tensor, nn

import augment
from augment.backgrounds import load_background, load_backgrounds
from augment.objects import ObjectSettings, SceneObject, load_object, on_ground
from augment.scene import Scene
from augment.service import AugmentationService, AugmentationSettings
from augment.utils import Phases, generator
from augment.variation import VariationSettings, vary
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.image import ImageSettings, decode
from renderer.light.presets import ambient, probe
from renderer.mesh import Mesh
from renderer.rasterizer import choose

SIZE = 48
LIGHT = ambient(torch.full((3,), 0.1))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A plate twelve times, on black."""
    plate, settings = load_object(ObjectSettings("solid:plate", "plate")), ImageSettings(SIZE, samples=2)
    return Scene.grid([plate], orbit_cameras(12, 6.0), load_backgrounds([0.0], SIZE), LIGHT, settings, choose("numpy"))


def drawn(scene: Scene, seed: int = 0, **settings) -> Scene:
    return vary(scene, VariationSettings(**settings), generator(seed))


def images(scene: Scene) -> Tensor:
    everything = torch.arange(len(scene))
    return scene.render(scene.conditions(everything), everything)[:, 0]


def outlines(scene: Scene) -> tuple[Tensor, Tensor]:
    """(E, 2) middles of what is covered, right and up, and (E,) its extent to the right, as fractions of the width."""
    covered = images(scene).sum(1) > 0
    middles, extents = [], []
    for mask in covered:
        rows, columns = torch.nonzero(mask).double().unbind(1)
        middle = torch.stack([columns.min() + columns.max(), -(rows.min() + rows.max())]) / 2
        middles.append(middle / SIZE)
        extents.append((columns.max() - columns.min() + 1) / SIZE)
    return torch.stack(middles), torch.stack(extents)


def test_without_variation_the_scene_is_returned(scene):
    assert drawn(scene) is scene


def test_a_shift_moves_the_mesh_within_its_range_and_keeps_its_size(scene):
    (middles, extents), (before, extents_before) = outlines(drawn(scene, shift=0.3)), outlines(scene)
    offsets = (middles - before).abs()
    assert (offsets <= 0.3 + 1 / SIZE).all() and (offsets.amax(0) > 0.2).all()
    torch.testing.assert_close(extents, extents_before, rtol=0, atol=2 / SIZE)


def test_a_scale_magnifies_about_the_middle(scene):
    (middles, extents), (before, extents_before) = outlines(drawn(scene, scale=[0.5, 1.5])), outlines(scene)
    factors = extents / extents_before
    assert 0.4 < factors.min() < 0.8 and 1.2 < factors.max() < 1.6
    torch.testing.assert_close(middles, before, rtol=0, atol=2 / SIZE)


def test_in_perspective_the_lens_varies_and_the_distance_stays():
    scene = augment.build_scene([("solid:orange", "orange")], 16, 6, rasterizer="numpy", fov=40.0)
    rows = drawn(scene, shift=0.3, scale=[0.5, 1.5], azimuth=20.0)
    (before,), cameras = {view.distance for (view,) in scene.cameras}, [view for (view,) in rows.cameras]
    origins = np.concatenate([camera.project(np.zeros((1, 3))) for camera in cameras])[:, :2]
    assert {camera.distance for camera in cameras} == {before} and len({camera.angle for camera in cameras}) == 6
    assert 0.3 < np.abs(origins).max() <= 0.6
    assert len(torch.unique(images(rows), dim=0)) == 6


def test_an_exposure_multiplies_the_light_and_keeps_the_cameras(scene):
    varied = drawn(scene, exposure=[0.5, 2.0])
    factors = torch.tensor([row.exposure for row in varied.examples])
    assert 0.5 <= factors.min() < 0.8 and 1.25 < factors.max() <= 2
    torch.testing.assert_close(images(varied), images(scene) * factors.view(-1, 1, 1, 1), rtol=1e-5, atol=0)
    assert varied.cameras == scene.cameras


def test_backgrounds_come_from_the_images_of_a_folder(scene, tmp_path):
    rng, files = np.random.default_rng(0), [tmp_path / "a.png", tmp_path / "below" / "b.jpg"]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8)).save(file)
    (tmp_path / "notes.txt").write_text("no image")
    varied = images(drawn(scene, backgrounds=str(tmp_path)))
    free = ~(images(scene).sum(1) > 0).any(0)
    choices = [load_background(file, SIZE)[:, free] for file in files]
    shown = [[torch.equal(image[:, free], choice) for choice in choices] for image in varied]
    assert all(sum(row) == 1 for row in shown) and len({tuple(row) for row in shown}) == 2
    with pytest.raises(InputError, match=f"backgrounds={tmp_path / 'empty'} holds no image: give a folder"):
        (tmp_path / "empty").mkdir()
        drawn(scene, backgrounds=str(tmp_path / "empty"))


def test_instances_are_drawn_of_solids_without_a_seed_only(scene):
    names = ["solid:plate", "solid:plate:0", "solid:orange"]
    objects = [load_object(ObjectSettings(name, name)) for name in names]
    settings, row = ImageSettings(SIZE, samples=2), scene.examples[0]
    rows = [replace(row, object=index) for index in range(3)]
    mixed = Scene(objects, rows, load_backgrounds([0.0], SIZE), LIGHT, settings, choose("numpy"))
    first, second = (drawn(mixed, seed, instances=True).objects for seed in (0, 1))
    assert first[1] is objects[1] and [item.label for item in first] == names
    for index in (0, 2):
        colors = [each[index].mesh.corner_colors for each in (objects, first, second)]
        assert not any(np.array_equal(a, b) for a, b in itertools.combinations(colors, 2))


def test_each_view_shows_another_instance_before_all_backgrounds():
    """In directional light, which depends on the objects of the rows."""
    apple, settings = load_object(ObjectSettings("solid:apple", "apple")), ImageSettings(SIZE, samples=2)
    backgrounds = load_backgrounds([0.0, 1.0], SIZE)
    grid = Scene.grid([apple, apple], orbit_cameras(3, 3.0), backgrounds, LIGHT, settings, choose("numpy"))
    varied = drawn(grid, instances=True, directional_fraction=0.5)
    assert [row.object for row in varied.examples] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert [row.background for row in varied.examples] == [row.background for row in grid.examples]
    assert len({item.mesh.corner_colors.tobytes() for item in varied.objects}) == 6


def test_each_example_is_in_one_of_the_environments(scene):
    varied = drawn(scene, environments=["eucalyptus", "st_peters"])
    choices = torch.stack([probe("eucalyptus"), probe("st_peters")])
    counts = (varied.lights[:, None] == choices).flatten(2).all(2).sum(0)
    assert counts.sum() == 12 and (counts > 0).all()


def test_directional_light_is_white_from_the_cameras_side_and_adds_to_the_fill_light(scene):
    """Its harmonics of degree 1 point to where it comes from; its mean is a quarter of what it gives."""
    lit = drawn(scene, directional_fraction=1.0, fill_light=[0.5, 0.5])
    lamps = (lit.lights - 0.5 * scene.lights)[:, :, 0].double()
    towards = lamps[:, [3, 1, 2]] / lamps[:, 1:4].norm(dim=1, keepdim=True)  # Y₁₁ ∝ x, Y₁₋₁ ∝ y, Y₁₀ ∝ z
    for example, direction in zip(scene.examples, towards, strict=True):
        camera = example.cameras[0]
        polar, azimuth = math.acos(direction[2]), math.atan2(direction[1], direction[0])
        off = [  # beyond the pole an angle is negative, and the azimuth turned around
            (sign * polar - camera.polar, math.remainder(azimuth + turned - camera.azimuth, 2 * math.pi))
            for sign, turned in ((1, 0.0), (-1, math.pi))
        ]
        assert min(max(map(abs, angles)) for angles in off) <= math.radians(70) + 1e-6
    assert torch.equal(lit.lights[:, :, 0], lit.lights[:, :, 2])
    torch.testing.assert_close(lamps[:, 0], torch.full((12,), 1 / math.sqrt(4 * math.pi)).double(), rtol=1e-6, atol=0)
    assert len(towards.unique(dim=0)) == 12


def test_an_object_on_a_table_is_not_lit_from_below(scene):
    """Light from above is where it was without a table."""
    height = {}
    for ground in (None, [0.5, 0.5, 0.5]):
        objects = [item if ground is None else on_ground(item, ground) for item in scene.objects]
        lights = drawn(replace(scene, objects=objects), directional_fraction=1.0).lights
        height[ground is None] = lights[:, 2, 0]
    assert (height[True] < 0).any()
    assert torch.equal(height[False], height[True].abs())


def test_a_fraction_of_the_examples_is_in_directional_light(scene):
    lit = drawn(scene, directional_fraction=0.5)
    own = (lit.lights == scene.lights).all((1, 2))
    assert 0 < own.sum() < len(scene)
    assert (lit.lights[~own, 0] > 0).all()


def test_a_lit_background_is_shaded_as_a_wall_facing_the_camera():
    """It looks as the middle of a white ball does, and is white or gray in the same light."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    settings = ImageSettings(SIZE, samples=2, encoding="srgb", normals="smooth")
    white = SceneObject("ball", Mesh.plain(ball.vertices, ball.faces, (1.0, 1.0, 1.0)))
    behind = load_backgrounds([1.0, 0.5], SIZE)
    balls = Scene.grid([white], orbit_cameras(3, 2.5), behind, probe("grace"), settings, choose("numpy"))
    seen = decode(images(drawn(balls, lit_background=True, exposure=[0.3, 0.6])), "srgb")
    middle, corner = seen[:, :, SIZE // 2 - 1 : SIZE // 2 + 1, SIZE // 2 - 1 : SIZE // 2 + 1], seen[:, :, 0, 0]
    middle = middle.mean((2, 3))
    white, gray = corner[::2], corner[1::2] / decode(torch.tensor(0.5), "srgb")
    torch.testing.assert_close(white, middle[::2], rtol=0.01, atol=0)  # the middle is four pixels wide
    torch.testing.assert_close(gray, middle[1::2], rtol=0.01, atol=0)


def test_every_regeneration_draws_other_variations_that_repeat(scene):
    vary_all = VariationSettings(shift=0.1, scale=[0.8, 1.2], exposure=[0.5, 2.0])
    settings = AugmentationSettings(arm="random", examples=12, vary=vary_all)
    model = nn.Sequential(nn.Flatten(), nn.Linear(3 * SIZE**2, 2))
    service = AugmentationService(settings, scene, torch.zeros(12, dtype=torch.int64), 0, Phases())
    first, second, again = (service.regenerate(model, epoch).images for epoch in (0, 1, 0))
    assert torch.equal(first, again) and not torch.equal(first, second)


@pytest.mark.parametrize(
    ("name", "value"),
    [("shift", -0.1), ("shift", math.nan), ("scale", [1.0]), ("scale", [2.0, 1.0]), ("exposure", [0.0, 1.0]),
     ("exposure", [1.0, math.inf]), ("azimuth", 200.0)],
)  # fmt: skip
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        VariationSettings(**{name: value})
