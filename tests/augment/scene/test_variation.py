import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from torch import Tensor

import augment
from augment.random_streams import generator
from augment.scene.camera_effects import draw_camera_effects
from augment.scene.conditions import Conditions
from augment.scene.patterns import draw_patterns
from augment.scene.scene import Scene
from augment.scene.variation import vary
from augment.settings import (
    LampsSettings,
    ObjectSettings,
    ProjectorSettings,
    PropSettings,
    VariationSettings,
    VarnishSettings,
)
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.image import decode, encode
from renderer.io.images import read_image
from renderer.light.basis import HARMONICS
from renderer.light.light_files import save_light
from renderer.light.presets import ambient, load_light, probe
from renderer.settings import ImageSettings

SIZE = 48
LIGHT = ambient(torch.full((3,), 0.1))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A plate twelve times, on black."""
    return built("solid:plate", views=12, width=6.0)


def built(*meshes: str, **options) -> Scene:
    options = {"backgrounds": [0.0], "light": LIGHT, "normals": "flat", "rasterizer": "numpy"} | options
    return augment.build_scene([(mesh, mesh) for mesh in meshes], SIZE, **options)


def drawn(scene: Scene, seed: int = 0, **settings) -> Scene:
    return vary(scene, VariationSettings(**settings), generator(seed))


def images(scene: Scene) -> Tensor:
    everything = torch.arange(len(scene))
    return scene.render(scene.conditions(everything), everything)[:, 0]


def outlines(scene: Scene) -> tuple[Tensor, Tensor]:
    """(E, 2) middles of what is covered, right and up, and (E,) its extent to the right, as fractions of the width."""
    middles, extents = [], []
    for image in images(scene):
        rows, columns = torch.nonzero(image.sum(0) > 0).double().unbind(1)
        middles.append(torch.stack([columns.min() + columns.max(), -(rows.min() + rows.max())]) / 2)
        extents.append(columns.max() - columns.min() + 1)
    return torch.stack(middles) / SIZE, torch.stack(extents) / SIZE


def test_a_shift_keeps_the_size_and_a_scale_magnifies_about_the_middle(scene):
    middles, extents = outlines(scene)
    (shifted, same), (still, scaled) = outlines(drawn(scene, shift=0.3)), outlines(drawn(scene, scale=[0.5, 1.5]))
    offsets, factors = (shifted - middles).abs(), scaled / extents
    assert (offsets <= 0.3 + 1 / SIZE).all() and (offsets.amax(0) > 0.2).all()
    assert 0.4 < factors.min() < 0.8 and 1.2 < factors.max() < 1.6
    torch.testing.assert_close(same, extents, rtol=0, atol=2 / SIZE)
    torch.testing.assert_close(still, middles, rtol=0, atol=2 / SIZE)


def test_in_perspective_the_lens_varies_and_the_distance_stays():
    scene = built("solid:orange", views=6, fov=40.0)
    rows = drawn(scene, shift=0.3, scale=[0.5, 1.5], azimuth=20.0)
    (before,), cameras = {view.distance for (view,) in scene.cameras}, [view for (view,) in rows.cameras]
    origins = np.concatenate([camera.project(np.zeros((1, 3))) for camera in cameras])[:, :2]
    assert {camera.distance for camera in cameras} == {before} and len({camera.angle for camera in cameras}) == 6
    assert 0.3 < np.abs(origins).max() <= 0.6
    assert len(torch.unique(images(rows), dim=0)) == 6


def test_views_in_perspective_have_the_lens_drawn_and_the_width_of_their_own():
    cameras = [view for (view,) in drawn(built("solid:orange", views=8), fov=[15.0, 35.0], scale=[0.5, 1.0]).cameras]
    lenses = [math.degrees(2 * math.atan(camera.width / 2 / camera.distance)) for camera in cameras]
    assert 15 <= min(lenses) < 22 and 28 < max(lenses) <= 35 and all(2 <= camera.width <= 4 for camera in cameras)


def test_each_view_of_an_object_is_turned_about_an_axis_of_its_own_and_its_props_stay():
    prop = PropSettings(mesh="solid:ball", at=[2.0, 0.0])
    scene = augment.build_scene([ObjectSettings("solid:pear:1", "pear", props=[prop])], 8, 6, rasterizer="numpy")
    before, angles = scene.objects[0], []
    rows = drawn(scene, rotation=40.0)
    for item in (rows.objects[row.object] for row in rows.examples):
        own, turned = before.mesh.faces[: before.own], item.mesh.faces[: item.own]
        pairs = item.mesh.vertices[turned].reshape(-1, 3), before.mesh.vertices[own].reshape(-1, 3)
        rotation, distance = Rotation.align_vectors(*pairs)
        assert distance < 1e-4 and np.array_equal(item.mesh.corner_colors, before.mesh.corner_colors)
        angles.append(math.degrees(rotation.magnitude()))
        rest = item.mesh.vertices[item.mesh.faces[item.own :]]
        assert rest.min((0, 1))[2] == pytest.approx(item.lowest) == pytest.approx(pairs[0][:, 2].min())
    assert len(rows.objects) == 6 and len(set(angles)) == 6 and 20 < max(angles) <= 40


def test_in_light_of_a_higher_degree_everything_varies_as_in_degree_6(tmp_path):
    """Of probes, whose higher bands are zero; white lamps, which have all bands, are left out."""
    choices = {"environments": ["eucalyptus", "uniform"], "lit_background": True, "exposure": [0.5, 2.0]}
    scenes = [
        augment.build_scene([("solid:pear", "pear")], 8, 4, degree=degree, rasterizer="numpy") for degree in (6, 9)
    ]
    six, nine = (drawn(scene, **choices, background_saturation=1.0) for scene in scenes)
    assert nine.basis.degree == 9
    torch.testing.assert_close(images(nine), images(six), rtol=0, atol=1e-5)
    for settings in ({"directional_fraction": 1.0}, {"tables": 1.0}):  # which lights of degree 6 truncate
        changed = [images(drawn(scene, **settings)) for scene in scenes]
        assert 0 < (changed[1] - changed[0]).abs().max() < 0.05
    light = scenes[1].lights[0].index_fill(0, torch.tensor([70]), 0.1)
    save_light(tmp_path / "light.json", light, scenes[1].basis)
    assert torch.equal(load_light(str(tmp_path / "light.json"), 9), light)
    with pytest.raises(InputError, match=r"light.json has harmonics beyond degree=6"):
        drawn(scenes[0], environments=[str(tmp_path / "light.json")])


def test_each_view_of_an_object_has_a_gloss_of_its_own_and_its_props_keep_theirs():
    prop = PropSettings(mesh="solid:ball", at=[2.0, 0.0], gloss=[0.9])
    scene = augment.build_scene([ObjectSettings("solid:pear", "pear", props=[prop])], 8, 6, rasterizer="numpy")
    ranges = {"roughness": [0.3, 0.6], "strength": [0.5, 1.0]}
    settings = {"gloss": VarnishSettings(**ranges), "rotation": 90.0, "instances": True}
    first, again = drawn(scene, **settings), drawn(scene, **settings)
    values = np.stack([item.mesh.gloss[0] for item in first.objects])
    assert len(np.unique(values[:, 0])) == 6 and not values[:, 1].any()
    for column, (low, high) in zip((0, 2), ranges.values(), strict=True):
        assert (
            (values[:, column] >= low).all() and (values[:, column] <= high).all() and np.ptp(values[:, column]) > 0.1
        )
    for item in first.objects:
        assert (item.mesh.gloss[: item.own] == item.mesh.gloss[0]).all()
        assert item.mesh.gloss[item.own :] == pytest.approx(np.tile([0.9, 0, 1], (len(item.mesh.faces) - item.own, 1)))
    assert torch.equal(images(first), images(again))
    one_light = vary(scene, VariationSettings(**settings), generator(0), once=True)
    torch.testing.assert_close(images(one_light), images(first), rtol=0, atol=1e-5)
    matte = drawn(scene, rotation=90.0, instances=True)
    assert (images(matte) - images(first)).abs().max() > 0.02


@pytest.mark.parametrize("limits", [{"roughness": [0.1, 0.5]}, {"strength": [0.5, 1.5]}, {"strength": [1.0]}])
def test_gloss_out_of_range_is_refused(limits):
    with pytest.raises(InputError, match=f"^{next(iter(limits))}"):
        VarnishSettings(**limits)


def test_on_a_table_views_come_from_above_and_darken_the_table_under_the_object_alone():
    even = {"backgrounds": [1.0], "light": ambient(torch.full((3,), 0.2)), "width": 6.0}
    scene = built("solid:plate", views=12, **even)
    rows = drawn(scene, tables=0.5, azimuth=90.0)
    polar = torch.tensor([camera.polar for (camera,) in rows.cameras])
    corners = rows.backgrounds[[row.background for row in rows.examples]]
    on_table = corners.flatten(2).amin((1, 2)) < 0.9 * corners.flatten(2).amax((1, 2))
    assert 0 < on_table.sum() < 12 and torch.equal(rows.backgrounds[~on_table].unique(), torch.tensor([1.0]))
    assert (polar[on_table] >= 15).all() and (polar[on_table] <= 75).all()
    assert (corners[on_table][..., 0, 0] - 0.2 * math.pi).abs().max() < 0.06
    from_below = HARMONICS.irradiance(torch.tensor([[0.0, 0.0, -1.0]])) @ rows.lights[on_table][:, HARMONICS.nonzero]
    assert (from_below - 0.2 * math.pi).abs().max() < 0.01  # what a white table reflects


def test_backgrounds_take_colors_up_to_the_saturation():
    white = built("solid:plate", views=60, backgrounds=[1.0], encoding="srgb")
    saturation = 1 - drawn(white, background_saturation=0.3).backgrounds.amin((1, 2, 3))
    assert 0.24 < saturation.max() <= 0.3 + 1e-6


LOCAL = {
    "lamps": LampsSettings(positions=[[0.6, 1.5, 2.0], [0.0, -2.0, 1.5]], radius=0.3, start=[[2, 1, 0.5], [0.5, 1, 2]]),
    "projector": ProjectorSettings(polar=20.0, pattern=0.8),
}


@pytest.mark.parametrize("name", LOCAL)
def test_local_lights_and_props_light_and_shadow_a_drawn_table_as_they_do_a_ground_of_triangles(name):
    prop = PropSettings(mesh="solid:ball", at=[0.7, -0.4], scale=0.3)
    meshes = [ObjectSettings("solid:pear:1", "pear", props=[prop])]
    options = {"rasterizer": "numpy", "light": torch.zeros(49, 3), "polar": 30.0, "width": 2.4, name: LOCAL[name]}
    onto = augment.build_scene(meshes, SIZE, ground=[1.0] * 3, backgrounds=[0.0], **options)
    rows = drawn(augment.build_scene(meshes, SIZE, backgrounds=[1.0], **options), tables=1.0)
    expected, seen = images(onto)[0], images(rows)[0]
    on_ground = images(onto.changed(lights=torch.ones_like(onto.lights))).amin((0, 1)) > 0
    errors, dark = (seen - expected).abs()[:, on_ground], expected.sum(0)[on_ground] < 0.02
    assert on_ground.float().mean() > 0.7 and 0.01 < dark.float().mean() < 0.5 and expected.max() > 0.3
    assert errors.median() < 1e-3 and errors.quantile(0.97) < 0.05  # samples of a pixel differ where a shadow ends


@pytest.mark.parametrize("name", LOCAL)
def test_environments_and_directional_light_are_drawn_as_without_local_lights_which_stay(name):
    settings = {"environments": ["grace", "eucalyptus"], "directional_fraction": 0.5, "tables": 0.5}
    without, beside = built("solid:plate", views=6), built("solid:plate", views=6, **{name: LOCAL[name]})
    lights = drawn(beside, lit_background=True, **settings).lights
    assert torch.equal(lights[:, :49], drawn(without, lit_background=True, **settings).lights)
    assert torch.equal(lights[:, 49:], beside.lights[:, 49:]) and beside.lights[:, 49:].any()


@pytest.mark.parametrize("options", [{"ground": [0, 0, 0]}, {"views": 2, "shared": True}])
def test_tables_are_refused_where_they_would_be_wrong(options):
    with pytest.raises(InputError, match=r"^tables are for"):
        drawn(built("solid:plate", **options), tables=0.5)


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
    choices = [read_image(file, SIZE)[:, free] for file in files]
    shown = [[torch.equal(image[:, free], choice) for choice in choices] for image in varied]
    assert all(sum(row) == 1 for row in shown) and len({tuple(row) for row in shown}) == 2
    with pytest.raises(InputError, match=f"backgrounds={tmp_path / 'empty'} holds no image: give a folder"):
        (tmp_path / "empty").mkdir()
        drawn(scene, backgrounds=str(tmp_path / "empty"))


def test_instances_are_drawn_of_solids_without_a_seed_only():
    names = ["solid:plate", "solid:plate:0", "solid:orange"]
    mixed = built(*names)
    first, second = (drawn(mixed, seed, instances=True).objects for seed in (0, 1))
    assert first[1] is mixed.objects[1] and [item.label for item in first] == names
    for index in (0, 2):
        colors = [objects[index].mesh.corner_colors for objects in (mixed.objects, first, second)]
        assert not any(np.array_equal(a, b) for a, b in itertools.combinations(colors, 2))


@pytest.mark.parametrize(
    "options", [{"normals": "smooth", "encoding": "srgb"}, {"fov": 40.0, "ground": [0.5, 0.4, 0.3]}]
)
def test_views_that_are_shown_once_are_shaded_as_their_operators_shade_them(options):
    """Irradiance by a polynomial of each normal, against a box filter of 31 coefficients; with the light's gradient."""
    still, shown = built("solid:cup", "solid:orange", views=2, **options), []
    for once in (True, False):
        scene = vary(still, VariationSettings(shift=0.1, instances=True, azimuth=30.0), generator(0), once)
        assert scene.one_light == once
        lights = scene.lights.clone().requires_grad_()
        rendered = scene.render(Conditions(lights), torch.arange(len(scene)))
        shown.append((rendered, *torch.autograd.grad(rendered.square().sum(), lights)))
    torch.testing.assert_close(shown[0][0], shown[1][0], rtol=0, atol=2e-6)  # of float32, and sRGB's slope of 13
    torch.testing.assert_close(shown[0][1], shown[1][1], rtol=1e-4, atol=1e-4)
    shadowed = still.changed(settings=replace(still.settings, shadows=True))
    assert not vary(shadowed, VariationSettings(shift=0.1), generator(0), True).one_light


def test_each_view_shows_another_instance_before_all_backgrounds():
    """In directional light, which depends on the objects of the rows."""
    grid = built("solid:apple", "solid:apple", views=3, backgrounds=[0.0, 1.0])
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
        polar, azimuth = math.degrees(math.acos(direction[2])), math.degrees(math.atan2(direction[1], direction[0]))
        off = [  # beyond the pole an angle is negative, and the azimuth turned around
            (sign * polar - camera.polar, math.remainder(azimuth + turned - camera.azimuth, 360))
            for sign, turned in ((1, 0.0), (-1, 180.0))
        ]
        assert min(max(map(abs, angles)) for angles in off) <= 70 + 1e-4
    assert torch.equal(lit.lights[:, :, 0], lit.lights[:, :, 2])
    torch.testing.assert_close(lamps[:, 0], torch.full((12,), 1 / math.sqrt(4 * math.pi)).double(), rtol=1e-6, atol=0)
    assert len(towards.unique(dim=0)) == 12
    unlit = (drawn(scene, directional_fraction=0.5).lights == scene.lights).all((1, 2))
    assert 0 < unlit.sum() < len(scene)


def test_an_object_on_a_table_is_not_lit_from_below(scene):
    """Light from above is where it was without a table."""
    on_table = built("solid:plate", views=12, width=6.0, ground=[0.5, 0.5, 0.5])
    free, standing = (drawn(each, directional_fraction=1.0).lights[:, 2, 0] for each in (scene, on_table))
    assert (free < 0).any() and torch.equal(standing, free.abs())


def test_a_lit_background_is_shaded_as_a_wall_facing_the_camera():
    """It looks as the middle of a white ball does, and is white or gray in the same light."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    white, choices = Mesh.plain(ball.vertices, ball.faces, (1.0, 1.0, 1.0)), {"encoding": "srgb", "width": 2.5}
    balls = augment.build_scene([(white, "ball")], SIZE, 3, backgrounds=[1.0, 0.5], rasterizer="numpy", **choices)
    seen = decode(images(drawn(balls, lit_background=True, exposure=[0.3, 0.6])), "srgb")
    middle, corner = seen[:, :, SIZE // 2 - 1 : SIZE // 2 + 1, SIZE // 2 - 1 : SIZE // 2 + 1], seen[:, :, 0, 0]
    middle = middle.mean((2, 3))
    white, gray = corner[::2], corner[1::2] / decode(torch.tensor(0.5), "srgb")
    torch.testing.assert_close(white, middle[::2], rtol=0.01, atol=0)  # the middle is four pixels wide
    torch.testing.assert_close(gray, middle[1::2], rtol=0.01, atol=0)


def test_the_generator_decides_what_is_drawn(scene):
    settings = {"shift": 0.1, "scale": [0.8, 1.2], "exposure": [0.5, 2.0]}
    first, again, other = (images(drawn(scene, seed, **settings)) for seed in (0, 0, 1))
    assert drawn(scene) is scene and torch.equal(first, again) and not torch.equal(first, other)


WIDTH, COUNT = 12, 40
IMAGES = torch.rand(COUNT, 2, 3, WIDTH, WIDTH, generator=generator(0), dtype=torch.float64)
EVERY = torch.arange(COUNT)


def photographed(images=IMAGES, examples=EVERY, encoding="srgb", **settings) -> torch.Tensor:
    image = ImageSettings(WIDTH, encoding=encoding)
    return draw_camera_effects(augment.CameraEffectSettings(**settings), COUNT, image, generator(1))(images, examples)


def test_without_effects_the_render_is_unchanged():
    torch.testing.assert_close(photographed(), IMAGES, rtol=0, atol=1e-6)  # the draws are single precision


def test_a_pattern_multiplies_the_light_of_object_and_background():
    ratio = decode(photographed(pattern_fraction=1.0, pattern_fill=[0.2, 0.2]), "srgb") / decode(IMAGES, "srgb")
    torch.testing.assert_close(ratio[:, 0], ratio[:, 1], rtol=1e-5, atol=0)
    assert 0.2 - 1e-5 <= ratio.min() < 0.25 and 0.99 < ratio.max() <= 1 + 1e-5
    untouched = (photographed(pattern_fraction=0.5) == photographed()).flatten(1).all(1).double().mean()
    assert 0.3 < untouched < 0.7


def test_white_balance_is_a_gain_of_each_channel_in_stops():
    dark = encode(decode(IMAGES, "srgb") / 4, "srgb")
    stops = (decode(photographed(dark, white_balance=1.0), "srgb") / decode(dark, "srgb")).log2().flatten(3)
    torch.testing.assert_close(stops, stops[..., :1].expand_as(stops), rtol=0, atol=1e-4)
    assert -1.001 < stops.min() < -0.8 and 0.8 < stops.max() < 1.001


def test_a_blur_is_scipys_gaussian_of_the_linear_light():
    light = decode(photographed(blur=1.2), "srgb")

    def error(sigma: float, index: int) -> float:
        sharp, sigmas = decode(IMAGES[index], "srgb").numpy(), (0, 0, sigma, sigma)
        expected = gaussian_filter(sharp, sigmas, mode="nearest", radius=(0, 0, 3, 3))
        return np.abs(expected - light[index].numpy()).max()

    rows = range(0, COUNT, 13)
    closest = [minimize_scalar(error, bounds=(0.01, 1.2), args=(row,), options={"xatol": 1e-9}) for row in rows]
    assert max(each.fun for each in closest) < 1e-5 and max(each.x for each in closest) > 0.6


def test_noise_differs_in_deviation_from_image_to_image():
    gray = torch.full_like(IMAGES, 0.5)
    deviations = (photographed(gray, noise=0.1) - gray).flatten(1).std(1)
    assert deviations.max() < 0.12 and deviations.min() < 0.03 and 0.035 < deviations.mean() < 0.065


def test_examples_in_any_order_have_the_same_effects():
    settings = {"pattern_fraction": 1.0, "white_balance": 0.5, "blur": 1.0, "noise": 0.05}
    some = torch.tensor([7, 3])
    expected = photographed(**settings)[some]
    torch.testing.assert_close(photographed(IMAGES[some], some, **settings), expected, rtol=0, atol=1e-12)
    image = IMAGES[:1, :1].clone().requires_grad_(True)
    assert torch.autograd.grad(photographed(image, EVERY[:1], **settings).sum(), image)[0].abs().max() > 0.01


@pytest.mark.parametrize(
    ("name", "value"), [("pattern_fraction", 1.5), ("blur", -1.0), ("noise", math.nan), ("pattern_fill", [0.5, 0.2])]
)
def test_settings_beyond_their_range_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        augment.CameraEffectSettings(**{name: value})


def test_a_pattern_has_at_most_two_colors_and_its_brighter_one_is_full():
    patterns = draw_patterns(200, 24, generator(0))
    assert patterns.shape == (200, 3, 24, 24) and patterns.min() >= 0 and patterns.max() <= 1
    assert {len(pattern.flatten(1).unique(dim=1).T) for pattern in patterns} == {1, 2}
    assert (patterns.amax((1, 2, 3)) == 1).double().mean() > 0.9  # a half may leave the bright side out
