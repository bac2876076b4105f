"""Scenes are varied within their settings, and each view differs as it should."""

import math
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from torch import Tensor
from torchvision.ops import masks_to_boxes

import augment
from augment.augmentation_settings import SpecularLayerSettings, VariationSettings
from augment.random_streams import generator
from augment.scene.build import build_scene
from augment.scene.objects import Conditions
from augment.scene.patterns import MAX_ZOOM, draw_patterns, draw_photograph_patterns, pixel_centers
from augment.scene.scene import Scene
from augment.scene.tabletop import irradiance
from augment.scene.vary import draw_camera_effects, vary
from augment.settings import LampsSettings, ObjectSettings, ProjectorSettings
from renderer.errors import InputError
from renderer.image import decode, encode
from renderer.io.images import read_image
from renderer.light.basis import HARMONICS
from renderer.light.files import ambient, load_light, probe, save_light
from renderer.mesh import Mesh
from renderer.settings import ImageSettings
from tests.helpers import images_of

SIZE = 48
EVEN_LIGHT = ambient(torch.full((3,), 0.1))


def built(*meshes: str, views: int = 1, **options) -> Scene:
    """Build a scene of each mesh before black; the label is the mesh's name."""
    choices = {"backgrounds": [0.0], "light": EVEN_LIGHT, "normals": "flat", "rasterizer": "numpy"}
    return augment.build_scene([(mesh, mesh) for mesh in meshes], SIZE, views, **choices | options)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return built("solid:plate", views=12, width=6.0)


def drawn(scene: Scene, seed: int = 0, **settings) -> Scene:
    """Vary the scene; keywords are those of `VariationSettings`."""
    return vary(scene, VariationSettings(**settings), generator(seed))


def cameras_of(scene: Scene) -> list:
    return [camera for (camera,) in scene.cameras]


def outlines(scene: Scene) -> tuple[Tensor, Tensor]:
    """Return the object's middles (E, 2) and extents (E,), in fractions of the image's width."""
    left, top, right, bottom = masks_to_boxes(images_of(scene).sum(1) > 0).double().T
    middles = torch.stack([left + right, -top - bottom], dim=1) / 2
    return middles / SIZE, (right - left + 1) / SIZE


def test_a_shift_moves_the_outline_and_a_scale_magnifies_it_about_its_middle(scene):
    middles, extents = outlines(scene)
    shifted_middles, shifted_extents = outlines(drawn(scene, shift=0.3))
    offsets = (shifted_middles - middles).abs()
    assert (offsets <= 0.3 + 1 / SIZE).all()
    assert (offsets.amax(0) > 0.2).all()
    # The shifts to the right and up are drawn independently.
    assert (offsets[:, 0] - offsets[:, 1]).abs().max() > 0.1
    torch.testing.assert_close(shifted_extents, extents, rtol=0, atol=2 / SIZE)
    scaled_middles, scaled_extents = outlines(drawn(scene, scale=[0.5, 1.5]))
    factors = scaled_extents / extents
    assert 0.4 < factors.min() < 0.8
    assert 1.2 < factors.max() < 1.6
    torch.testing.assert_close(scaled_middles, middles, rtol=0, atol=2 / SIZE)


def test_in_perspective_the_lens_varies_and_the_distance_stays():
    scene = built("solid:orange", views=6, fov=40.0)
    varied = drawn(scene, shift=0.3, scale=[0.5, 1.5], azimuth=20.0)
    cameras = cameras_of(varied)
    distances = {camera.distance for camera in cameras}
    assert distances == {camera.distance for camera in cameras_of(scene)}
    assert len(distances) == 1
    assert len({camera.angle for camera in cameras}) == 6
    origins = [camera.project(np.zeros((1, 3)))[0, :2] for camera in cameras]
    assert 0.3 < np.abs(origins).max() <= 0.6  # The image's half width is 1.
    assert len(torch.unique(images_of(varied), dim=0)) == 6


def test_views_in_perspective_have_the_lens_drawn_and_the_width_of_their_own():
    varied = drawn(built("solid:orange", views=8), fov=[15.0, 35.0], scale=[0.5, 1.0])
    cameras = cameras_of(varied)
    lenses = [math.degrees(2 * math.atan(camera.width / 2 / camera.distance)) for camera in cameras]
    assert 15 <= min(lenses) < 22
    assert 28 < max(lenses) <= 35
    for camera in cameras:
        assert 2 <= camera.width <= 4


def test_each_object_is_turned_about_an_axis_of_its_own_and_its_props_stay_on_the_ground():
    prop = ObjectSettings(mesh="solid:ball", at=[2.0, 0.0])
    pear = ObjectSettings("solid:pear:1", "pear", others=[prop])
    scene = augment.build_scene([pear], 8, 6, rasterizer="numpy")
    item = scene.objects[0]
    before = item.mesh.vertices[item.mesh.faces[: item.own]].reshape(-1, 3)
    varied = drawn(scene, rotation=40.0)
    angles = []
    for turned in varied.objects:
        after = turned.mesh.vertices[turned.mesh.faces[: turned.own]].reshape(-1, 3)
        rotation, distance = Rotation.align_vectors(after, before)
        assert distance < 1e-4
        angles.append(math.degrees(rotation.magnitude()))
        np.testing.assert_array_equal(turned.mesh.corner_colors, item.mesh.corner_colors)
        prop_corners = turned.mesh.vertices[turned.mesh.faces[turned.own :]]
        ground = after[:, 2].min()
        assert turned.lowest == pytest.approx(ground)
        assert prop_corners[..., 2].min() == pytest.approx(ground)
    assert len(set(angles)) == 6
    assert 20 < max(angles) <= 40


SPECULAR_LAYER = SpecularLayerSettings(roughness=[0.4, 0.6], specular_factor=[0.5, 1.0])
VARNISHED = {"gloss": SPECULAR_LAYER, "rotation": 90.0, "instances": True}


def test_each_view_has_one_gloss_of_its_own_within_the_range_and_its_props_keep_theirs():
    prop = ObjectSettings(mesh="solid:ball", at=[2.0, 0.0], gloss=[0.9])
    pear = ObjectSettings("solid:pear", "pear", others=[prop])
    pears = augment.build_scene([pear], 8, 4, rasterizer="numpy", samples=1)
    objects = drawn(pears, **VARNISHED).objects
    roughness, metallic, strength = np.stack([item.mesh.gloss[0] for item in objects]).T
    assert len(np.unique(roughness)) == 4
    assert 0.4 <= roughness.min() < roughness.max() - 0.05
    assert roughness.max() <= 0.6
    assert not metallic.any()
    assert 0.5 <= strength.min() < strength.max() - 0.1
    assert strength.max() <= 1
    for item in objects:
        own, of_props = np.split(item.mesh.gloss, [item.own])
        assert (own == own[0]).all()
        expected = np.tile([0.9, 0, 1], (len(of_props), 1))
        np.testing.assert_allclose(of_props, expected, rtol=1e-6)


def test_instances_are_drawn_of_solids_without_a_seed_only():
    names = ["solid:plate", "solid:plate:0", "solid:orange"]
    scene = built(*names)
    first = drawn(scene, 0, instances=True).objects
    second = drawn(scene, 1, instances=True).objects
    assert [item.label for item in first] == names
    assert first[1] is scene.objects[1]
    for index in (0, 2):
        instances = [scene.objects[index], first[index], second[index]]
        assert len({item.mesh.corner_colors.tobytes() for item in instances}) == 3


def test_each_view_shows_another_instance_before_all_backgrounds():
    """Directional light depends on the objects of the examples."""
    scene = built("solid:apple", "solid:apple", views=3, backgrounds=[0.0, 1.0])
    varied = drawn(scene, instances=True, directional_fraction=0.5)
    objects = [row.object for row in varied.examples]
    assert objects == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    backgrounds = [row.background for row in varied.examples]
    assert backgrounds == [row.background for row in scene.examples]
    assert len({item.mesh.corner_colors.tobytes() for item in varied.objects}) == 6


ONCE = VariationSettings(shift=0.1, instances=True, azimuth=30.0)


@pytest.mark.parametrize(
    ("options", "varied"),
    [
        ({"normals": "smooth", "encoding": "srgb"}, ONCE),
        ({"fov": 40.0, "ground": [0.5, 0.4, 0.3]}, ONCE),
        ({}, VariationSettings(**VARNISHED)),
    ],
)
def test_views_that_are_shown_once_are_shaded_as_their_operators_shade_them(options, varied):
    """Irradiance by a polynomial of each normal equals that by 31 coefficients per sample."""
    still = built("solid:cup", "solid:orange", views=2, **options)
    images = []
    gradients = []
    for once in (True, False):
        scene = vary(still, varied, generator(0), once)
        assert scene.one_light == once
        lights = scene.lights.clone().requires_grad_()
        rendered = scene.render(Conditions(lights), torch.arange(len(scene)))
        images.append(rendered)
        gradients += torch.autograd.grad(rendered.square().sum(), lights)
    # The sRGB curve has a slope of 13 near black, which magnifies the rounding of float32.
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=2e-6)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-4, atol=1e-4)


def test_views_with_shadows_have_operators_even_if_they_are_shown_once():
    scene = built("solid:cup", shadows=True)
    assert not vary(scene, VariationSettings(shift=0.1), generator(0), True).one_light


@pytest.fixture(scope="module")
def degree_6_and_9() -> list[Scene]:
    pear = [("solid:pear", "pear")]
    options = {"rasterizer": "numpy", "samples": 1}
    return [augment.build_scene(pear, 8, 4, degree=degree, **options) for degree in (6, 9)]


def test_light_of_probes_varies_alike_in_every_degree(degree_6_and_9):
    """The probes' coefficients beyond degree 2 are zero."""
    settings = {"environments": ["eucalyptus", "uniform"], "lit_background": True}
    settings |= {"exposure": [0.5, 2.0], "background_saturation": 1.0}
    low, high = (drawn(scene, **settings) for scene in degree_6_and_9)
    assert high.basis.degree == 9
    torch.testing.assert_close(images_of(high), images_of(low), rtol=0, atol=1e-5)


@pytest.mark.filterwarnings("ignore:.*blurs its highlights")
def test_a_map_makes_no_dark_rings_on_gloss(tmp_path):
    lamp = np.full((16, 32, 3), 0.01, dtype=np.float32)
    lamp[4, 16] = 100
    path = str(tmp_path / "lamp.npy")
    np.save(path, lamp)
    glossy = ObjectSettings("solid:pear", label="pear", gloss=[0.4])
    scene = augment.build_scene([glossy], 8, light=path, samples=1)
    assert torch.equal(drawn(scene, environments=[path]).lights, scene.lights)


def test_an_environment_beyond_the_degree_of_the_scene_is_refused(degree_6_and_9, tmp_path):
    low, high = degree_6_and_9
    light = high.lights[0].clone()
    light[70] = 0.1
    path = str(tmp_path / "light.json")
    save_light(path, light, high.basis)
    assert torch.equal(load_light(path, 9), light)
    with pytest.raises(InputError, match=r"light.json has harmonics beyond degree=6"):
        drawn(low, environments=[path])


def test_a_white_table_is_seen_from_above_darkened_below_the_object_and_lights_it():
    """Some of the views have a table."""
    even = ambient(torch.full((3,), 0.2))
    scene = built("solid:plate", views=12, backgrounds=[1.0], light=even, width=6.0)
    varied = drawn(scene, tables=0.5, azimuth=90.0)
    backgrounds = varied.backgrounds[[row.background for row in varied.examples]].flatten(2)
    darkest = backgrounds.amin((1, 2))
    has_table = darkest < 0.9 * backgrounds.amax((1, 2))
    assert 0 < has_table.sum() < 12
    polar = torch.tensor([camera.polar for camera in cameras_of(varied)])[has_table]
    assert (polar >= 15).all()
    assert (polar <= 75).all()
    assert (varied.backgrounds[~has_table] == 1).all()
    corners = varied.backgrounds[has_table][..., 0, 0]
    assert (corners - 0.2 * math.pi).abs().max() < 0.06
    down = HARMONICS.irradiance(torch.tensor([[0.0, 0.0, -1.0]]))
    irradiance = down @ varied.lights[has_table][:, HARMONICS.nonzero]
    assert (irradiance - 0.2 * math.pi).abs().max() < 0.01


def test_a_table_is_as_bright_as_the_exposure_makes_the_object():
    white = built("solid:plate", views=3, backgrounds=[1.0])
    given, darker = (drawn(white, tables=1.0, exposure=[each] * 2) for each in (1.0, 0.25))
    assert given.backgrounds.amax() < 1  # Clipped values would hide the factor.
    torch.testing.assert_close(darker.backgrounds, 0.25 * given.backgrounds)


def test_the_wall_stands_behind_all_objects_of_an_entry(monkeypatch):
    light_room = Mock(side_effect=irradiance)
    monkeypatch.setattr("augment.scene.vary.irradiance", light_room)
    behind = ObjectSettings("solid:apple:1", at=[-3.0, 0.0])
    scene = build_scene([ObjectSettings("solid:plate:1", others=[behind])], 8, width=8)
    drawn(scene.with_count(6), tables=1.0)
    vertices = torch.from_numpy(scene.objects[0].mesh.vertices)
    for call in light_room.call_args_list:
        room, camera = call.args[:2]
        azimuth = math.radians(camera.azimuth)
        towards_camera = (
            vertices[:, :2] @ torch.tensor([math.cos(azimuth), math.sin(azimuth)]).double()
        )
        assert towards_camera.min() >= -room.wall
    assert light_room.call_count == 6


def test_a_draw_without_a_table_leaves_light_and_backgrounds_as_they_are(scene):
    """With a small fraction of tables, no example of a few may get one."""
    varied = drawn(scene, tables=1e-6)
    torch.testing.assert_close(varied.lights, scene.lights)
    shown = [
        each.backgrounds[[row.background for row in each.examples]] for each in (varied, scene)
    ]
    torch.testing.assert_close(shown[0], shown[1].expand_as(shown[0]))


@pytest.mark.parametrize("options", [{"ground": [0, 0, 0]}, {"views": 2, "shared": True}])
def test_tables_are_refused_in_scenes_where_they_would_be_wrong(options):
    with pytest.raises(InputError, match=r"^tables"):
        drawn(built("solid:plate", **options), tables=0.5)


PLACES = [[0.6, 1.5, 2.0], [0.0, -2.0, 1.5]]
LAMPS = LampsSettings(positions=PLACES, radius=0.3, start=[[2, 1, 0.5], [0.5, 1, 2]])
LOCAL_LIGHTS = {"lamps": LAMPS, "projector": ProjectorSettings(polar=20.0, pattern=0.8)}


def test_local_lights_light_a_drawn_table_as_they_do_a_ground_of_triangles():
    """The object and its prop throw their shadows on both."""
    prop = ObjectSettings(mesh="solid:ball", at=[0.7, -0.4], scale=0.3)
    meshes = [ObjectSettings("solid:pear:1", "pear", others=[prop])]
    options = {"rasterizer": "numpy", "light": torch.zeros(49, 3), "polar": 30.0, "width": 2.4}
    options |= LOCAL_LIGHTS
    white = [1.0, 1.0, 1.0]
    with_ground = augment.build_scene(meshes, SIZE, ground=white, backgrounds=[0.0], **options)
    without = augment.build_scene(meshes, SIZE, backgrounds=[1.0], **options)
    expected = images_of(with_ground)[0]
    errors = (images_of(drawn(without, tables=1.0))[0] - expected).abs()

    everywhere_lit = with_ground.changed(lights=torch.ones_like(with_ground.lights))
    is_covered = images_of(everywhere_lit).amin((0, 1)) > 0
    total = expected.sum(0)[is_covered]
    is_dark = total < 0.3 * total.median()
    assert is_covered.float().mean() > 0.7
    assert 0.01 < is_dark.float().mean() < 0.5
    assert expected.max() > 0.3
    assert errors[:, is_covered].median() < 1e-3
    # The samples of a pixel differ at the edge of a shadow.
    assert errors[:, is_covered].quantile(0.97) < 0.05


def test_light_is_drawn_as_without_local_lights_and_these_stay():
    settings = {"environments": ["grace", "eucalyptus"], "directional_fraction": 0.5}
    settings |= {"tables": 0.5, "lit_background": True}
    without = built("solid:plate", views=6)
    beside = built("solid:plate", views=6, **LOCAL_LIGHTS)
    lights = drawn(beside, **settings).lights
    assert torch.equal(lights[:, :49], drawn(without, **settings).lights)
    assert torch.equal(lights[:, 49:], beside.lights[:, 49:])
    assert beside.lights[:, 49:].any()


def test_an_exposure_multiplies_the_light_and_keeps_the_cameras(scene):
    varied = drawn(scene, exposure=[0.5, 2.0])
    exposures = torch.tensor([row.exposure for row in varied.examples])
    assert 0.5 <= exposures.min() < 0.8
    assert 1.25 < exposures.max() <= 2
    expected = images_of(scene) * exposures.view(-1, 1, 1, 1)
    torch.testing.assert_close(images_of(varied), expected, rtol=1e-5, atol=0)
    assert varied.cameras == scene.cameras


def test_each_example_is_in_one_of_the_environments(scene):
    varied = drawn(scene, environments=["eucalyptus", "st_peters"])
    choices = torch.stack([probe("eucalyptus"), probe("st_peters")])
    is_choice = (varied.lights[:, None] == choices).flatten(2).all(2)
    assert (is_choice.sum(1) == 1).all()
    assert is_choice.any(0).all()


def test_the_exposure_of_a_scene_holds_for_the_environments_that_are_drawn():
    lit, dim = (
        drawn(build_scene([("solid:plate", "")], 8, exposure=factor), environments=["st_peters"])
        for factor in (1.0, 0.25)
    )
    torch.testing.assert_close(dim.lights, 0.25 * lit.lights, rtol=1e-6, atol=0)


def test_white_directional_light_of_unit_strength_comes_from_the_cameras_side(scene):
    """Both angles are within 70° of the camera's. Beyond the pole, the azimuth is turned around."""
    lit = drawn(scene, directional_fraction=1.0, fill_light=[0.5, 0.5])
    sunlight = (lit.lights - 0.5 * scene.lights).double()
    assert torch.equal(sunlight[..., 0].float(), sunlight[..., 2].float())
    # The mean of the radiance is a quarter of what the light gives.
    expected = torch.full((12,), 1 / math.sqrt(4 * math.pi)).double()
    torch.testing.assert_close(sunlight[:, 0, 0], expected, rtol=1e-6, atol=0)
    # Y₁₁ is proportional to x, Y₁₋₁ to y, and Y₁₀ to z.
    directions = torch.nn.functional.normalize(sunlight[:, [3, 1, 2], 0], dim=1)
    assert len(directions.unique(dim=0)) == 12
    for camera, (x, y, z) in zip(cameras_of(scene), directions.tolist(), strict=True):
        polar = math.degrees(math.acos(z))
        azimuth = math.degrees(math.atan2(y, x))
        largest_turns = [
            max(abs(p - camera.polar), abs(math.remainder(a - camera.azimuth, 360)))
            for p, a in ((polar, azimuth), (-polar, azimuth - 180))
        ]
        assert min(largest_turns) <= 70 + 1e-4


def test_a_fraction_of_the_examples_has_directional_light(scene):
    lights = drawn(scene, directional_fraction=0.5).lights
    is_unchanged = (lights == scene.lights).all(2).all(1)
    assert 0 < is_unchanged.sum() < len(scene)


def test_an_object_on_a_table_is_not_lit_from_below(scene):
    """Light from above is where it was without a table."""
    on_table = built("solid:plate", views=12, width=6.0, ground=[0.5, 0.5, 0.5])
    free = drawn(scene, directional_fraction=1.0).lights[:, 2, 0]
    standing = drawn(on_table, directional_fraction=1.0).lights[:, 2, 0]
    assert (free < 0).any()
    assert torch.equal(standing, free.abs())


def test_backgrounds_take_colors_up_to_the_saturation():
    white = built("solid:plate", views=60, backgrounds=[1.0], encoding="srgb")
    backgrounds = drawn(white, background_saturation=0.3).backgrounds
    saturation = 1 - backgrounds.amin((1, 2, 3))
    assert 0.24 < saturation.max() <= 0.3 + 1e-6


def test_backgrounds_come_from_the_images_of_a_folder(scene, tmp_path):
    draws = np.random.default_rng(0)
    files = [tmp_path / "a.png", tmp_path / "below" / "b.jpg"]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(draws.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8)).save(file)
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "._a.png").write_text("notes of macOS about a.png")
    is_free = ~(images_of(scene).sum(1) > 0).any(0)
    choices = [read_image(file, SIZE)[:, is_free] for file in files]
    shown = set()
    for image in images_of(drawn(scene, backgrounds=str(tmp_path))):
        [index] = [i for i in (0, 1) if torch.equal(image[:, is_free], choices[i])]
        shown.add(index)
    assert shown == {0, 1}


def test_a_lit_background_is_shaded_as_a_wall_facing_the_camera():
    """A white wall looks like the middle of a white ball."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    ball = Mesh.plain(sphere.vertices, sphere.faces, (1.0, 1.0, 1.0))
    options = {"encoding": "srgb", "width": 2.5, "rasterizer": "numpy"}
    scene = augment.build_scene([(ball, "ball")], SIZE, 3, backgrounds=[1.0, 0.5], **options)
    varied = drawn(scene, lit_background=True, exposure=[0.3, 0.6])
    linear = decode(images_of(varied), "srgb")
    inner = slice(SIZE // 2 - 1, SIZE // 2 + 1)
    middle = linear[:, :, inner, inner].mean((2, 3))
    wall = linear[:, :, 0, 0]
    gray = decode(torch.tensor(0.5), "srgb")
    # White and gray backgrounds take turns.
    torch.testing.assert_close(wall[::2], middle[::2], rtol=0.01, atol=0)
    torch.testing.assert_close(wall[1::2] / gray, middle[1::2], rtol=0.01, atol=0)


WIDTH = 12
COUNT = 40
IMAGES = torch.rand(COUNT, 2, 3, WIDTH, WIDTH, generator=generator(0), dtype=torch.float64)
EVERY = torch.arange(COUNT)


def photographed(images: Tensor = IMAGES, examples: Tensor = EVERY, **settings) -> Tensor:
    """Apply camera effects to sRGB images; keywords are those of `CameraEffectSettings`."""
    chosen = augment.CameraEffectSettings(**settings)
    image_settings = ImageSettings(WIDTH, encoding="srgb")
    effects = draw_camera_effects(chosen, COUNT, image_settings, generator(1))
    return effects(images, examples)


def linear_light(images: Tensor) -> Tensor:
    return decode(images, "srgb")


def test_a_pattern_multiplies_the_light_of_object_and_background():
    patterned = photographed(pattern_fraction=0.5, pattern_fill=[0.2, 0.2])
    ratio = linear_light(patterned) / linear_light(IMAGES)
    assert 0.3 < (ratio - 1).abs().lt(1e-4).flatten(1).all(1).double().mean() < 0.7
    torch.testing.assert_close(ratio[:, 0], ratio[:, 1], rtol=1e-5, atol=0)
    assert 0.2 - 1e-5 <= ratio.min() < 0.25
    assert 0.99 < ratio.max() <= 1 + 1e-5


def test_white_balance_is_a_gain_of_each_channel_in_stops():
    dark = encode(linear_light(IMAGES) / 4, "srgb")
    ratio = linear_light(photographed(dark, white_balance=1.0)) / linear_light(dark)
    stops = ratio.log2().flatten(3)
    torch.testing.assert_close(stops, stops[..., :1].expand_as(stops), rtol=0, atol=1e-4)
    assert -1.001 < stops.min() < -0.8
    assert 0.8 < stops.max() < 1.001


def test_a_blur_is_scipys_gaussian_of_the_linear_light():
    light = linear_light(photographed(blur=1.2)).numpy()
    sharp = linear_light(IMAGES).numpy()

    def error(sigma: float, row: int) -> float:
        sigmas = (0, 0, sigma, sigma)
        expected = gaussian_filter(sharp[row], sigmas, mode="nearest", radius=(0, 0, 3, 3))
        return np.abs(expected - light[row]).max()

    fits = []
    for row in range(0, COUNT, 13):
        search = {"bounds": (0.01, 1.2), "options": {"xatol": 1e-9}}
        fits.append(minimize_scalar(error, args=(row,), **search))
    assert max(fit.fun for fit in fits) < 1e-5
    assert max(fit.x for fit in fits) > 0.6


def test_noise_differs_in_deviation_from_image_to_image():
    gray = torch.full_like(IMAGES, 0.5)
    deviations = (photographed(gray, noise=0.1) - gray).flatten(1).std(1)
    assert deviations.max() < 0.12
    assert deviations.min() < 0.03
    assert 0.035 < deviations.mean() < 0.065


EFFECTS = {"pattern_fraction": 1.0, "white_balance": 0.5, "blur": 1.0, "noise": 0.05}


def test_examples_in_any_order_have_the_same_effects_which_pass_a_gradient():
    rows = torch.tensor([7, 3])
    expected = photographed(**EFFECTS)[rows]
    images = IMAGES[rows].clone().requires_grad_(True)
    found = photographed(images, rows, **EFFECTS)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    (gradient,) = torch.autograd.grad(found.sum(), images)
    assert gradient.abs().max() > 0.01


def test_a_pattern_has_at_most_two_colors_and_its_brighter_one_is_full():
    patterns = draw_patterns(200, 24, generator(0))
    assert patterns.shape == (200, 3, 24, 24)
    assert 0 <= patterns.min() <= patterns.max() <= 1
    color_counts = {pattern.flatten(1).unique(dim=1).shape[1] for pattern in patterns}
    assert color_counts == {1, 2}
    # A pattern of two halves may leave its bright half out of the image.
    assert (patterns.amax((1, 2, 3)) == 1).double().mean() > 0.9


def test_photographs_of_any_shape_are_turned_without_distortion_and_mirrored_beyond_the_border():
    height, width = 18, 30
    photograph = torch.rand(1, 1, height, width, generator=generator(2)).expand(-1, 3, -1, -1)
    points = pixel_centers((height, width))
    shown = draw_photograph_patterns(photograph, points, generator(3))[0, 0]
    turn, zoom, _ = torch.rand(3, 1, 1, 1, generator=generator(3)).flatten().tolist()
    scale = MAX_ZOOM ** (2 * zoom - 1)
    errors = []
    # Either direction is as good.
    for angle in (2 * np.pi * turn, -2 * np.pi * turn):
        turned = Rotation.from_euler("z", angle).as_matrix()[:2, :2] @ points.flatten(1).numpy()
        # Pixels are square, and the image is 2 wide.
        column, row = (scale * width * turned + [[width - 1], [height - 1]]) / 2
        place = [row.reshape(height, width), column.reshape(height, width)]
        expected = map_coordinates(photograph[0, 0].numpy(), place, order=1, mode="reflect")
        errors.append(np.abs(shown.numpy() - expected).max())
    assert min(errors) < 1e-4


def test_half_of_the_patterns_show_photographs_of_a_folder(tmp_path):
    Image.new("RGB", (20, 10), (150, 150, 150)).save(tmp_path / "gray.png")
    patterned = photographed(pattern_fraction=1.0, slides=str(tmp_path))
    ratio = (linear_light(patterned) / linear_light(IMAGES)).flatten(1)
    gray = decode(torch.tensor(150 / 255, dtype=torch.float64), "srgb")
    shows_photograph = ((ratio - gray).abs() < 1e-4).all(1)
    assert 0.3 < shows_photograph.double().mean() < 0.7
