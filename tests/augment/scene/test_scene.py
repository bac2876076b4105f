import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import renderer
from augment.attacks.adversary import Adversary, reload, write_adversary
from augment.attacks.parameters import make_parameter
from augment.attacks.problem import AttackProblem
from augment.parameter_settings import SkylightSettings, StepSettings
from augment.scene import relighting
from augment.scene.build import build_scene, load_backgrounds
from augment.scene.conditions import Conditions, Example
from augment.scene.objects import load_object
from augment.scene.reshading import NEAR
from augment.scene.scene import Scene
from augment.settings import ObjectSettings, count_views
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.io.images import gray_or_image
from renderer.light.basis import Harmonics
from renderer.light.environment import to_map, write_map
from renderer.light.highlights import degree_for
from renderer.light.presets import ambient, probe
from renderer.settings import ImageSettings
from renderer.transport.operators import build_operators
from renderer.visibility.rasterizers import choose

EPS32 = torch.finfo(torch.float32).eps
RASTERIZER = choose("numpy")
SETTINGS = ImageSettings(size=8, samples=2)
GRAYS = [0.0, 0.25, 1.0]


def random_lights(count: int, seed: int = 0) -> torch.Tensor:
    draws = torch.Generator().manual_seed(seed)
    return 0.3 * torch.randn(count, 49, 3, generator=draws) + ambient(torch.full((3,), 0.3))


def test_views_follow_from_examples_meshes_and_backgrounds():
    assert count_views(100, 2, 5, None) == count_views(100, 2, 5, 10) == 10 and count_views(None, 7, 5, 36) == 36
    for impossible in ((100, 3, 5, None), (None, 2, 5, None), (100, 2, 5, 9), (100, 0, 5, None)):
        with pytest.raises(InputError, match=r"^examples=.* is not|must not be empty"):
            count_views(*impossible)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"meshes": []}, "meshes is empty"),
        ({"backgrounds": ()}, "backgrounds is empty"),
        ({"light": torch.zeros(7, 3)}, r"light has shape \(7, 3\): give \(\(degree \+ 1\)², 3\)"),
        ({"ground": [0.5, 2.0, 0.5]}, "ground=.* must be red, green and blue"),
        ({"exposure": math.nan}, "exposure=.* must be at least"),
    ],
)
def test_an_impossible_scene_is_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        build_scene(**{"meshes": [("solid:orange", "orange")], "size": 8, "rasterizer": "numpy"} | wrong)


def test_a_scene_without_light_is_refused():
    with pytest.raises(InputError, match="exposure=0 must be"):
        build_scene([("solid:orange", "orange")], 8, exposure=0)


def test_a_scene_takes_paths_as_text_and_as_path(tmp_path):
    renderer.export_mesh(renderer.solid("pear"), tmp_path / "pear.glb")
    renderer.save_light(tmp_path / "light.json", probe("grace"))
    Image.new("RGB", (8, 8), "teal").save(tmp_path / "behind.png")
    images = []
    for kind in (str, Path):
        options = {"light": kind(tmp_path / "light.json"), "backgrounds": [kind(tmp_path / "behind.png")]}
        for mesh in ((kind(tmp_path / "pear.glb"), "pear"), ObjectSettings(kind(tmp_path / "pear.glb"), "pear")):
            scene = build_scene([mesh], 8, **options, rasterizer="numpy")
            images.append(scene.render(scene.conditions(torch.arange(1)), torch.arange(1)))
    assert all(torch.equal(image, images[0]) for image in images)


@pytest.mark.filterwarnings("ignore")  # of rings, which a lower degree would show
def test_light_has_the_degree_of_the_smoothest_part_of_a_gloss_texture():
    """Half of the texture is rough. The degree is that of a mesh which is as smooth all over."""
    pear, roughness = renderer.solid("pear"), 64 / 255
    factors = np.full((8, 8, 2), 255, np.uint8)
    factors[:4, :, 0] = 64
    uvs, ids = np.zeros((len(pear.faces), 3, 2), np.float32), np.zeros(len(pear.faces), np.int32)
    gloss = np.tile(np.float32([1.0, 0.0, 1.0]), (len(pear.faces), 1))
    white = (np.full((8, 8, 3), 255, np.uint8),)
    textured = replace(pear, corner_uvs=uvs, texture_ids=ids, textures=white, gloss=gloss, gloss_textures=(factors,))
    smooth = replace(pear, gloss=gloss * np.float32([roughness, 1, 1]))
    bases = [build_scene([(mesh, "pear")], 8, 1, rasterizer="numpy").basis for mesh in (textured, smooth)]
    assert bases[0] == bases[1] and bases[0].degree > 6


def test_light_has_the_degree_that_gloss_needs_and_attacks_change_all_of_it(tmp_path):
    """An attack on a scene of this degree is written, and read back to the same image; of degree 6, rings are said."""
    write_map(tmp_path / "map.exr", to_map(probe("grace"), 64).clamp(min=0))
    shiny, matte, options = ObjectSettings("solid:pear", "pear", gloss=[0.35]), ("solid:orange", "pear"), {"samples": 1}
    options |= {"light": str(tmp_path / "map.exr"), "rasterizer": "numpy"}
    with pytest.warns(
        UserWarning, match="solid:pear has gloss of roughness 0.35, which takes light of degree 12: degree=6 takes"
    ):
        scene = build_scene([matte, shiny], 16, **options)
    assert scene.basis == Harmonics(degree_for(0.35)) == Harmonics(12)
    light = renderer.load_light(options["light"], 12, 0.35)
    ours = scene.render(scene.conditions(torch.tensor([1])), torch.tensor([1]))[0, 0]
    theirs = renderer.render(scene.objects[1].mesh, scene.cameras[1][0], light, 16, samples=1, rasterizer="numpy")
    torch.testing.assert_close(ours, theirs[0], rtol=0, atol=1e-5)
    assert build_scene([matte], 16, **options).basis == Harmonics(6)
    with pytest.warns(UserWarning, match="degree=7 shows the highlight"):
        assert build_scene([shiny], 16, degree=7, **options).basis == Harmonics(7)
    build_scene([shiny], 16, degree=12, **options)
    sky = make_parameter("skylight", scene, SkylightSettings())
    of_sky = sky.apply(sky.start[1:], scene.conditions(torch.tensor([1])), torch.tensor([1])).light
    assert of_sky.shape == (1, 169, 3) and not of_sky[:, 49:].any()
    problem, rows = AttackProblem(scene, [make_parameter("lighting", scene, StepSettings(radius=0.3))]), torch.arange(2)
    values = problem.sample(torch.Generator().manual_seed(0))
    after, images = problem.conditions(values, rows), problem.images(values)
    write_adversary(Adversary.of(scene, 1, after, images[1], images[1]), tmp_path / "adversary")
    torch.testing.assert_close(reload(tmp_path / "adversary").render(RASTERIZER), images[1], rtol=0, atol=1e-5)


def test_a_background_is_gray_or_an_images_center_square(tmp_path):
    wide = tmp_path / "wide.png"
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(wide)
    square = torch.from_numpy(pixels[:, 1:5]).permute(2, 0, 1) / 255
    assert all(torch.equal(gray_or_image("backgrounds", path, 4), square) for path in (wide, str(wide)))
    assert torch.equal(gray_or_image("backgrounds", "0.25", 4), torch.full((1, 4, 4), 0.25))
    assert load_backgrounds([0, 0.5], 4).shape == (2, 1, 4, 4)
    assert torch.equal(load_backgrounds([0.5, wide], 4), torch.stack([torch.full((3, 4, 4), 0.5), square]))


@pytest.mark.parametrize("choice", [-0.1, 255, math.nan, None, "absent.png"])
def test_other_gray_values_and_what_is_no_image_are_refused(choice):
    with pytest.raises(InputError, match=r"^backgrounds.*: give (gray values in|an image file)"):
        load_backgrounds([0.5, choice], 4)


def built(*names: str, views: int = 2, **options) -> Scene:
    """All meshes from all cameras over GRAYS."""
    options = {"backgrounds": GRAYS, "normals": "flat", "rasterizer": "numpy"} | options
    return build_scene([(f"solid:{name}", name) for name in names], 8, views, **options)


def test_each_mesh_is_rasterized_once_in_all_views_and_not_before_it_is_needed(rasterized):
    scene = built("plate", "cup", views=4)
    assert rasterized == [] and scene.stacks and rasterized == [4, 4]


@pytest.fixture(scope="module", params=[relighting.STACKED, 1], ids=["one stack", "a stack per view"])
def several(request) -> Iterator[Scene]:
    """Two meshes of different sizes in mixed order: rows of two views, with a light, exposure and background each."""
    views, draws = orbit_cameras(3, 2.2), torch.Generator().manual_seed(3)
    rows = [
        Example(1, (views[0], views[1]), 0),
        Example(0, (views[2], views[1]), 1, exposure=0.5),
        Example(1, (views[0], views[2]), 1, exposure=2.0),
        Example(0, (views[2], views[2]), 2),
    ]
    lights = 0.3 * probe("grace").double() + 0.01 * torch.randn(4, 49, 3, generator=draws).double()
    behind = 0.2 + 0.6 * torch.rand(3, 3, 8, 8, generator=draws)
    objects = [load_object(ObjectSettings(f"solid:{name}", name)) for name in ("plate", "cup")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(relighting, "STACKED", request.param)
        yield Scene(objects, rows, behind, lights, SETTINGS, RASTERIZER)


@pytest.mark.parametrize("by", ["light", "vertices"])
@pytest.mark.parametrize("examples", [[0, 1, 2, 3], [3, 0], [2, 2, 1]])
def test_several_meshes_are_rendered_as_each_is_alone(several, examples, by):
    """By stacked operators and by rasterizing anew, beside `renderer.render`, which shares no code with the stacks."""
    chosen, conditions = torch.tensor(examples), several.conditions(torch.tensor(examples))
    if by == "vertices":
        conditions = replace(conditions, vertices=several.vertices[several.object_of[chosen]])
    images = several.render(conditions, chosen)
    assert images.shape == (len(examples), 2, 3, 8, 8)
    for image, example in zip(images, examples, strict=True):
        row = several.examples[example]
        light = several.lights[example] * row.exposure
        behind = several.backgrounds[row.background].view(3, 8, 8)
        alone = {"samples": 2, "normals": "flat", "rasterizer": "numpy"}
        expected = renderer.render(several.mesh(example), row.cameras, light, 8, behind, **alone)
        torch.testing.assert_close(image, expected, rtol=0, atol=64 * torch.finfo(torch.float64).eps)
    assert several.labels == ["cup", "plate", "cup", "plate"]


@pytest.mark.parametrize("parameter", ["geometry", "albedo"])
def test_a_smaller_mesh_in_a_scene_of_larger_ones_uses_only_its_values(several, parameter):
    """Unused values have no gradient and are never drawn; the L2 ball is that of the used values."""
    own = make_parameter(parameter, several, StepSettings("l2", 0.2))
    sizes = [len(item.mesh.vertices if parameter == "geometry" else item.mesh.faces) for item in several.objects]
    everything, used = torch.arange(4), torch.tensor([3 * sizes[row.object] for row in several.examples])
    assert len(set(sizes)) == 2 and own.start.shape == (4, 3 * max(sizes))
    drawn = own.sample(torch.Generator().manual_seed(0))
    beyond = torch.arange(drawn.shape[1]) >= used[:, None]
    assert beyond.any() and not drawn[beyond].any() and (drawn[~beyond] != 0).all()
    assert (drawn.norm(dim=1) <= 0.2 + 1e-9).all() and (drawn.norm(dim=1) > 0.19).all()
    values = own.start.clone().requires_grad_(True)
    images = several.render(own.apply(values, several.conditions(everything), everything), everything)
    (gradient,) = torch.autograd.grad(images.square().sum(), values)
    assert not gradient[beyond].any() and gradient.any(1).all()


@pytest.mark.parametrize(("names", "bounces"), [(["cup", "ball"], 0), (["cup"], 2)])
def test_shadows_of_unmoved_vertices_and_colors_are_those_of_the_operators(names, bounces):
    """The cup has 49 nonzero coefficients and the ball 31."""
    scene = built(*names, shadows=True, bounces=bounces)
    examples, lights = torch.arange(len(scene)), random_lights(len(scene))
    still, expected, counts = Conditions(lights), [], set()
    for item in scene.objects:
        for operator in build_operators(item.mesh, orbit_cameras(2, 2), scene.settings, RASTERIZER):
            counts.add(len(operator.nonzero))
            expected += [operator.image(lights[len(expected) + row], gray) for row, gray in enumerate(GRAYS)]
    assert bounces or counts == {49, 31}
    albedo = torch.zeros(len(scene), max(len(item.mesh.faces) for item in scene.objects), 3)
    for changed in ({}, {"vertices": scene.vertices[scene.object_of]}, {"albedo": albedo}):
        images = scene.render(replace(still, **changed), examples)[:, 0]
        torch.testing.assert_close(images, torch.stack(expected), rtol=0, atol=1000 * EPS32)


def test_a_table_is_shadowed_by_the_object_and_reflects_its_own_color_onto_it():
    """Green, mostly to the object; where the sky alone lights it, nothing changes."""
    seen = {"size": 16, "views": 1, "light": "st_peters", "exposure": 0.2, "backgrounds": [0.0], "width": 3.0}

    def image(shadows: bool, bounces: int = 0, ground: list[float] | None = (0.1, 0.8, 0.1)) -> torch.Tensor:
        fixed = {"shadows": shadows, "bounces": bounces, "ground": ground, "rasterizer": "numpy"}
        scene = build_scene([("solid:orange", "orange")], **seen | fixed)
        return scene.render(scene.conditions(torch.arange(1)), torch.arange(1))[0, 0]

    alone, open_sky, shadowed, lit = (image(False, ground=None), image(False), image(True), image(True, 2))
    object_, table = alone.sum(0) > 0, (alone.sum(0) == 0) & (open_sky.sum(0) > 0)
    kept = (shadowed / open_sky)[1, table]
    assert kept.min() < 0.3 and kept.max() > 0.8
    assert (shadowed <= open_sky + 0.02 * open_sky.max()).all()
    red, green, blue = ((lit - shadowed) / shadowed)[:, object_].mean(1)
    assert green > 3 * red > 0 and green > 3 * blue > 0


def test_shadows_are_recomputed_for_large_changes_of_shape_and_reused_for_small_ones():
    """Each example has its own shape; back where it began, it has the mesh's own shadows."""
    scene = built("cup", shadows=True)
    mesh, examples, lights = scene.mesh(0), torch.arange(len(scene)), random_lights(len(scene))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(scene), *mesh.vertices.shape))

    def off(radius: float) -> float:
        """From the operators of the moved meshes; the backgrounds take turns, then the cameras."""
        moved = (mesh.vertices + radius * signs).astype(np.float32)
        images = scene.render(Conditions(lights, torch.from_numpy(moved)), examples)
        expected = []
        for index, vertices in enumerate(moved.astype(np.float64)):
            shaped, [camera] = replace(mesh, vertices=vertices), scene.cameras[index]
            [operator] = build_operators(shaped, [camera], scene.settings, RASTERIZER)
            expected.append(operator.image(lights[index], GRAYS[index % len(GRAYS)]))
        return float((images[:, 0] - torch.stack(expected)).abs().max())

    assert off(0.02) < 1000 * EPS32
    assert 1e-4 < off(0.02 + 0.9 * NEAR) < 0.2
    assert off(0.0) < 1000 * EPS32
