"""Scenes render each example as its mesh alone is rendered, in light of the degree it needs."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from oracles import draw, draw_uniform, mesh_of
from PIL import Image

import renderer
from augment.attack_settings import SkylightSettings, StepSettings
from augment.attacks.adversary import Adversary, reload, write_adversary
from augment.attacks.parameters import make_parameter
from augment.attacks.problem import SceneProblem
from augment.augmentation_settings import VariationSettings, views_of
from augment.network import say_once
from augment.scene import render
from augment.scene.build import build_scene, warn_of_exposure
from augment.scene.objects import Conditions, Example, load_object
from augment.scene.render import NEAR
from augment.scene.scene import Scene
from augment.scene.vary import vary
from augment.settings import LampsSettings, ObjectSettings, ProjectorSettings
from renderer.camera import orbit_cameras
from renderer.light.environment import to_map, write_map
from renderer.light.files import ambient, probe
from renderer.light.lamps import Projector
from renderer.operators.build import build_operators
from renderer.settings import ImageSettings
from renderer.visibility import choose
from tests.helpers import images_of

EPS = torch.finfo(torch.float64).eps
EPS32 = torch.finfo(torch.float32).eps
RASTERIZER = choose("numpy")
SETTINGS = ImageSettings(size=8, samples=2)
GRAYS = [0.0, 0.25, 1.0]
FIRST = torch.arange(1)


def random_lights(count: int) -> torch.Tensor:
    return 0.3 * draw(count, 49, 3).float() + ambient(torch.full((3,), 0.3))


def built(*names: str, views: int = 2, **options) -> Scene:
    choices = {"backgrounds": GRAYS, "normals": "flat", "rasterizer": "numpy"}
    meshes = [(f"solid:{name}", name) for name in names]
    return build_scene(meshes, 8, views, **choices | options)


@pytest.mark.parametrize(("examples", "meshes", "backgrounds"), [(100, 3, 5), (7, 3, 2), (2, 3, 1)])
def test_renders_are_shared_as_equally_as_possible(examples, meshes, backgrounds):
    entries = [("solid:orange", str(index)) for index in range(meshes)]
    views = views_of(examples, meshes, backgrounds)
    grays = [0.1 * index for index in range(backgrounds)]
    scene = build_scene(entries, 4, views, backgrounds=grays, samples=1).with_count(examples)
    shares = [scene.labels.count(str(index)) for index in range(meshes)]
    assert sum(shares) == examples
    assert shares == sorted(shares, reverse=True) and shares[0] - shares[-1] <= 1
    # Views and backgrounds are not repeated before all were shown.
    assert len({(e.object, e.cameras, e.background) for e in scene.examples}) == examples


LAMP_IN_SHADOWS = {"shadows": True, "lamps": LampsSettings([[3.0, 0.0, 3.0]], start=0.01)}


@pytest.mark.parametrize(
    ("light", "encoding", "more"),
    [("grace", "linear", {}), ("st_peters", "srgb", {}), ("grace", "linear", LAMP_IN_SHADOWS)],
)
def test_the_automatic_exposure_makes_the_mean_of_an_object_two_fifths(light, encoding, more):
    meshes = [("solid:orange", "orange"), ("solid:cup", "cup")]
    options = {"light": light, "encoding": encoding, "backgrounds": [0.0], "exposure": "auto"}
    scene = build_scene(meshes, 24, 3, **options, **more)
    images = images_of(scene)
    masks = scene.truth(lambda label: 0).masks[:, 0, 0]
    for rows in (slice(0, 3), slice(3, 6)):
        pixels = images[rows].movedim(1, 0)[:, masks[rows]]
        assert float(pixels.mean()) == pytest.approx(0.4, abs=1e-5)
    assert scene.examples[0].exposure != scene.examples[3].exposure


def test_a_light_of_no_exposure_keeps_its_own_beside_lamps_that_are_too_bright(caplog):
    build_scene([(mesh_of(trimesh.creation.box(), (0, 0, 0)), "box")], 8, exposure="auto")
    assert "its mean is 0\n" in caplog.text
    lamps = LampsSettings([[3.0, 0.0, 3.0]], start=50.0, power=100.0)
    entries = [("solid:orange", "orange")]
    scene = build_scene(entries, 24, lamps=lamps, exposure="auto", backgrounds=[0.0])
    assert scene.examples[0].exposure == 1
    mask = scene.truth(lambda label: 0).masks[0, 0, 0]
    mean = float(images_of(scene)[0][:, mask].mean())
    assert mean > 0.4 and f"its mean is {mean:.2g}, because projector and lamps" in caplog.text


def test_the_automatic_exposure_leaves_the_projector_within_its_power_and_its_radius(tmp_path):
    dark = ObjectSettings(mesh="solid:orange:7", label="orange", albedo_scale=0.2)
    projector = ProjectorSettings(pixels=4, polar=45.0)
    scene = build_scene([dark], 24, projector=projector, exposure="auto", backgrounds=[0.0])
    images = images_of(scene)
    mask = scene.truth(lambda label: 0).masks[0, 0, 0]
    assert float(images[0][:, mask].mean()) == pytest.approx(0.4, abs=1e-3)
    assert scene.examples[0].exposure > 2
    _, start = Projector.from_settings(projector)
    problem = SceneProblem(scene, [make_parameter("projector", scene, StepSettings("linf", 0.5))])
    values = problem.project(problem.start + 9.0, FIRST)
    conditions = problem.conditions(values, FIRST)
    after = problem.images(values)[0]
    write_adversary(Adversary.of(scene, 0, conditions, images, after), tmp_path)
    written = json.loads((tmp_path / "projector.json").read_text())
    coefficients = np.array(written["coefficients"])
    assert np.abs(coefficients - start.numpy()).max() <= 0.5 + 1e-6
    assert coefficients.max() <= written["power"]
    again = reload(tmp_path).scene(choose("numba"))
    torch.testing.assert_close(again.render(again.conditions(FIRST), FIRST)[0], after)


@pytest.mark.parametrize(("red", "white"), [(0, 0), (0, 2), (12, 0)])
def test_an_object_that_is_mostly_black_or_red_is_not_overexposed(red, white, tmp_path):
    box = trimesh.creation.box()
    box.visual.face_colors = [
        [255 * (face < max(red, white)), *[255 * (face < white)] * 2, 255] for face in range(12)
    ]
    box.export(tmp_path / "box.ply")
    options = {"light": "grace", "backgrounds": [0.0], "exposure": "auto"}
    scene = build_scene([(str(tmp_path / "box.ply"), "box")], 24, 6, **options)
    images = images_of(scene)
    masks = scene.truth(lambda label: 0).masks[:, 0, 0]
    values = images.movedim(1, 0)[:, masks]
    if red or white:
        assert float(values[values > 0].mean()) == pytest.approx(0.8, abs=0.01)
    else:
        assert scene.examples[0].exposure == 1


@pytest.mark.parametrize(("exposure", "word"), [(1e-3, "dark"), (1e3, "bright"), (1.0, "")])
def test_an_almost_black_or_white_object_is_warned_about(exposure, word, caplog):
    say_once.cache_clear()
    warn_of_exposure(build_scene([("solid:orange", "orange")], 16, exposure=exposure))
    assert (f"too {word}" in caplog.text) == bool(word)


def test_a_scene_takes_paths_as_text_and_as_path_and_cuts_the_center_out_of_a_background(tmp_path):
    renderer.export_mesh(renderer.solid("pear"), tmp_path / "pear.glb")
    renderer.save_light(tmp_path / "light.json", probe("grace"))
    pixels = np.random.default_rng(0).integers(0, 256, (8, 12, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "wide.png")
    square = torch.from_numpy(pixels[:, 2:10]).permute(2, 0, 1) / 255
    images = []
    for kind in (str, Path):
        mesh = kind(tmp_path / "pear.glb")
        behind = kind(tmp_path / "wide.png")
        options = {"light": kind(tmp_path / "light.json"), "rasterizer": "numpy"}
        for item in ((mesh, "pear"), ObjectSettings(mesh, "pear")):
            scene = build_scene([item], 8, backgrounds=[0.5, behind], **options)
            gray = torch.full((3, 8, 8), 0.5)
            assert torch.equal(scene.backgrounds, torch.stack([gray, square]))
            images.append(images_of(scene))
    assert all(torch.equal(image, images[0]) for image in images)


SHINY = ObjectSettings("solid:pear", "pear", gloss=[0.35])
MATTE = ("solid:orange", "pear")


@pytest.fixture(scope="module")
def map_options(tmp_path_factory) -> dict:
    path = tmp_path_factory.mktemp("map") / "map.exr"
    write_map(path, to_map(probe("grace"), 64).clamp(min=0))
    return {"light": str(path), "rasterizer": "numpy", "samples": 1}


@pytest.fixture(scope="module")
def glossy(map_options) -> Scene:
    with pytest.warns(UserWarning, match="gloss of roughness 0.35, which takes light of degree 12"):
        return build_scene([MATTE, SHINY], 8, **map_options)


def test_light_of_a_higher_degree_shows_the_image_of_the_renderer(glossy, map_options):
    row = torch.tensor([1])
    image = glossy.render(glossy.conditions(row), row)[0, 0]
    light = renderer.load_light(map_options["light"], 12, 0.35)
    mesh = glossy.objects[1].mesh
    camera = glossy.cameras[1][0]
    expected = renderer.render(mesh, camera, light, 8, samples=1, rasterizer="numpy")
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-5)


def test_a_sky_in_light_of_a_higher_degree_has_49_coefficients(glossy):
    row = torch.tensor([1])
    sky = make_parameter("skylight", glossy, SkylightSettings())
    light = sky.apply(sky.start[row], glossy.conditions(row), row).light
    assert light.shape == (1, 169, 3)
    assert not light[:, 49:].any()


def test_attacked_light_of_a_higher_degree_is_read_back_to_its_image(glossy, tmp_path):
    lighting = make_parameter("lighting", glossy, StepSettings(radius=0.3))
    problem = SceneProblem(glossy, [lighting])
    values = problem.sample(torch.Generator().manual_seed(0))
    conditions = problem.conditions(values, torch.arange(2))
    image = problem.images(values)[1]
    write_adversary(Adversary.of(glossy, 1, conditions, image, image), tmp_path / "adversary")
    found = reload(tmp_path / "adversary").render_views(RASTERIZER)
    torch.testing.assert_close(found, image, rtol=0, atol=1e-5)


def test_each_mesh_is_rasterized_once_when_it_is_needed_and_not_again_in_other_light(rasterized):
    scene, fresh = (built("plate", "cup", views=4) for _ in range(2))
    assert rasterized == []
    images_of(scene)
    changed = {"lights": scene.lights.flip(-1) / 2}
    found = images_of(scene.changed(**changed))
    assert rasterized == [4, 4]
    torch.testing.assert_close(found, images_of(fresh.changed(**changed)))


@pytest.mark.parametrize("one_light", [False, True])
def test_the_same_views_in_another_order_are_not_rasterized_again(rasterized, one_light):
    scenes = (built("cup", "ball", shadows=not one_light) for _ in range(2))
    scene, fresh = (each.changed(one_light=one_light) for each in scenes)

    def unpainted(scene: Scene) -> torch.Tensor:
        """Render with unchanged colors that could change, for which no operator is used."""
        every = torch.arange(len(scene))
        colors = torch.zeros(len(scene), max(len(item.mesh.faces) for item in scene.objects), 3)
        return scene.render(replace(scene.conditions(every), albedo=colors), every)

    expected = unpainted(fresh.changed(examples=fresh.examples[::-1]))
    unpainted(scene)
    rasterized.clear()
    found = unpainted(scene.changed(examples=scene.examples[::-1]))
    assert rasterized == []
    torch.testing.assert_close(found, expected)


def test_fewer_examples_of_moved_meshes_have_the_shadows_of_each_mesh():
    scene, fresh = (built("cup", "ball", shadows=True) for _ in range(2))

    def moved(scene: Scene) -> torch.Tensor:
        every = torch.arange(len(scene))
        vertices = 0.9 * scene.vertices[scene.object_of]
        return scene.render(replace(scene.conditions(every), vertices=vertices), every)

    expected = moved(fresh.with_count(2))
    moved(scene)
    torch.testing.assert_close(moved(scene.with_count(2)), expected)


STACKS = {"one stack": (render.PIXELS_PER_STACK, "linear"), "a stack per view": (1, "srgb")}


@pytest.fixture(scope="module", params=STACKS.values(), ids=STACKS)
def several(request) -> Iterator[Scene]:
    """Return a scene of two meshes of different sizes in mixed order, with two views each."""
    first, second, third = orbit_cameras(3, 2.2)
    examples = [Example(1, (first, second), 0), Example(0, (third, second), 1, exposure=0.5)]
    examples += [Example(1, (first, third), 1, exposure=2.0), Example(0, (third, third), 2)]
    lights = 0.3 * probe("grace").double() + 0.01 * draw(4, 49, 3, seed=3)
    backgrounds = (0.2 + 0.6 * draw_uniform(3, 3, 8, 8, seed=3)).float()
    names = ("plate", "cup")
    objects = [load_object(ObjectSettings(f"solid:{name}", name)) for name in names]
    objects[0] = replace(objects[0], albedo_scale=1.2)
    pixels_per_stack, encoding = request.param
    settings = replace(SETTINGS, encoding=encoding)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render, "PIXELS_PER_STACK", pixels_per_stack)
        yield Scene(objects, examples, backgrounds, lights, settings, RASTERIZER)


@pytest.mark.parametrize(
    ("examples", "changed"),
    [([0, 1, 2, 3], "light"), ([3, 0], "light"), ([2, 2, 1], "vertices"), ([1, 2], "albedo")],
)
def test_several_meshes_are_rendered_as_each_is_alone(several, examples, changed):
    """Light goes through stacked operators. `renderer.render` shares no code with the stacks."""
    rows = torch.tensor(examples)
    conditions = several.conditions(rows)
    if changed == "vertices":
        vertices = several.vertices[several.object_of[rows]]
        conditions = replace(conditions, vertices=vertices)
    if changed == "albedo":
        face_count = max(len(item.mesh.faces) for item in several.objects)
        conditions = replace(conditions, albedo=torch.zeros(len(rows), face_count, 3).double())
    images = several.render(conditions, rows)
    assert images.shape == (len(examples), 2, 3, 8, 8)
    options = {"samples": 2, "normals": several.settings.normals, "rasterizer": "numpy"}
    options["encoding"] = several.settings.encoding
    for image, row in zip(images, examples, strict=True):
        example = several.examples[row]
        light = several.lights[row] * example.exposure
        behind = several.backgrounds[example.background].view(3, 8, 8)
        mesh = several.mesh(row)
        options["albedo_scale"] = several.objects[example.object].albedo_scale
        expected = renderer.render(mesh, example.cameras, light, 8, behind, **options)
        torch.testing.assert_close(image, expected, rtol=0, atol=13 * 64 * EPS)


SIZES = {"geometry": lambda one: 3 * len(one.vertices), "albedo": lambda one: 3 * len(one.faces)}


@pytest.mark.parametrize("at_once", [2, 3])
@pytest.mark.parametrize("normals", ["smooth", "flat"])
def test_views_that_are_rendered_together_are_those_that_are_rendered_alone(
    normals, at_once, monkeypatch
):
    scene = built("ball", "cup", views=5, normals=normals, backgrounds=[0.2, 0.7], encoding="srgb")
    examples = torch.arange(len(scene))
    vertices = (1.05 * scene.vertices[scene.object_of[examples]]).requires_grad_()
    conditions = replace(scene.conditions(examples), vertices=vertices)
    found = []
    for count in (1, at_once):
        monkeypatch.setattr("augment.scene.scene.views_at_once", lambda *_, count=count: count)
        images = scene.render(conditions, examples)
        found.append((images, *torch.autograd.grad(images.square().sum(), vertices)))
    for alone, together in zip(*found, strict=True):
        torch.testing.assert_close(together, alone, rtol=0, atol=2e-5)


@pytest.mark.parametrize("name", SIZES)
def test_a_smaller_mesh_draws_and_has_gradients_of_its_own_values_only(name, several):
    parameter = make_parameter(name, several, StepSettings("l2", 0.2))
    counts = [SIZES[name](item.mesh) for item in several.objects]
    assert len(set(counts)) == 2
    used = torch.tensor([counts[example.object] for example in several.examples])
    assert parameter.start.shape == (4, max(counts))
    is_unused = torch.arange(max(counts)) >= used[:, None]
    drawn = parameter.sample(torch.Generator().manual_seed(0))
    assert not drawn[is_unused].any()
    assert (drawn[~is_unused] != 0).all()
    lengths = drawn.norm(dim=1)
    assert (lengths <= 0.2 + 1e-9).all()
    assert (lengths > 0.19).all()
    rows = torch.arange(4)
    values = parameter.start.clone().requires_grad_(True)
    conditions = parameter.apply(values, several.conditions(rows), rows)
    images = several.render(conditions, rows)
    (gradient,) = torch.autograd.grad(images.square().sum(), values)
    assert not gradient[is_unused].any()
    assert gradient.any(1).all()


@pytest.mark.parametrize(("names", "bounces"), [(["cup", "ball"], 0), (["cup"], 1)])
def test_shadows_of_unmoved_vertices_and_colors_are_those_of_the_operators(names, bounces):
    scene = built(*names, shadows=True, bounces=bounces)
    rows = torch.arange(len(scene))
    lights = random_lights(len(scene))
    expected = []
    coefficient_counts = set()
    for item in scene.objects:
        cameras = orbit_cameras(2, 2)
        for operator in build_operators(item.mesh, cameras, scene.settings, RASTERIZER):
            coefficient_counts.add(len(operator.nonzero))
            for gray in GRAYS:
                expected.append(operator.image(lights[len(expected)], gray))
    if names == ["cup", "ball"]:
        # The cup casts shadows on itself, the ball does not.
        assert coefficient_counts == {49, 31}

    face_count = max(len(item.mesh.faces) for item in scene.objects)
    unmoved = {"vertices": scene.vertices[scene.object_of]}
    unpainted = {"albedo": torch.zeros(len(scene), face_count, 3)}
    in_old_light = scene.changed(one_light=True)
    in_old_light.render(in_old_light.conditions(rows), rows)
    in_one_light = in_old_light.changed(lights=lights)
    for shown, change in ((scene, {}), (scene, unmoved), (scene, unpainted), (in_one_light, {})):
        images = shown.render(Conditions(lights, **change), rows)[:, 0]
        torch.testing.assert_close(images, torch.stack(expected), rtol=0, atol=1000 * EPS32)


@pytest.mark.parametrize("normals", ["flat", "smooth"])
@pytest.mark.parametrize("rasterizer", ["numba", "torch"])
def test_examples_that_are_rendered_together_have_the_bits_and_the_truth_of_each_alone(
    normals, rasterizer
):
    pairs = [(f"solid:{name}", name) for name in ("orange", "cup")]
    scene = build_scene([pairs, pairs[1], pairs[0]], 12, 6, normals=normals, rasterizer=rasterizer)
    settings = VariationSettings(fov=[20.0, 40.0], shift=0.3, exposure=[0.5, 2.0])
    scene = vary(scene, settings, torch.Generator().manual_seed(0), once=True)
    conditions = Conditions(random_lights(len(scene)))
    rows = torch.arange(len(scene)).flip(0)
    shown = replace(conditions, light=conditions.light[rows])
    images, maps = scene.render(shown, rows), scene.surface_maps(shown, rows)
    truth = scene.truth(hash, rows, shown)
    assert scene.one_light and len({example.exposure for example in scene.examples}) == len(scene)
    for place, row in enumerate(rows[:, None]):
        alone = Conditions(shown.light[place : place + 1])
        assert torch.equal(images[place], scene.render(alone, row)[0])
        assert torch.equal(maps[place], scene.surface_maps(alone, row)[0])
        of_row = scene.truth(hash, row, alone)
        count = of_row.labels.shape[-1]
        for name, values in vars(of_row).items():
            assert torch.equal(getattr(truth, name)[place, :, :count], values[0])


def test_shadows_in_light_of_degree_0_grow_with_the_light():
    scene = built("cup", shadows=True, light="uniform", degree=0)
    painted = torch.zeros(1, len(scene.objects[0].mesh.faces), 3)
    for light in (torch.full((1, 1, 3), radiance) for radiance in (0.2, 0.6)):
        images = [scene.render(Conditions(light, albedo=of), FIRST) for of in (None, painted)]
        torch.testing.assert_close(*images, rtol=0, atol=1000 * EPS32)


def test_shadows_are_computed_anew_for_large_changes_of_shape_and_kept_for_small_ones():
    """Each example has its own shape. Where it began, it has the mesh's own shadows again."""
    scene = built("cup", shadows=True)
    mesh = scene.mesh(0)
    count = len(scene)
    lights = random_lights(count)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (count, *mesh.vertices.shape))
    for radius, least, most in (
        (0.02, 0, 1000 * EPS32),
        (0.02 + 0.9 * NEAR, 1e-4, 0.2),
        (0.0, 0, 1000 * EPS32),
    ):
        moved = (mesh.vertices + radius * signs).astype(np.float32)
        conditions = Conditions(lights, torch.from_numpy(moved))
        images = scene.render(conditions, torch.arange(count))[:, 0]
        error = float((images - images_of_moved(scene, mesh, moved, lights)).abs().max())
        assert least <= error < most


def test_drafts_of_moved_vertices_have_nearly_the_shadows_of_all_directions():
    """Images that are no drafts have exactly these shadows."""
    scene = built("cup", shadows=True)
    mesh = scene.mesh(0)
    rows = torch.arange(len(scene))
    lights = scene.lights
    moved = (1.1 * mesh.vertices[None].repeat(len(scene), 0)).astype(np.float32)
    expected = images_of_moved(scene, mesh, moved, lights)
    for is_draft, least, most in ((False, 0, 1000 * EPS32), (True, 1e-4, 0.02)):
        images = scene.render(Conditions(lights, torch.from_numpy(moved)), rows, is_draft)[:, 0]
        assert least <= float((images - expected).square().mean().sqrt()) < most


def test_drafts_of_moved_vertices_have_at_most_two_samples_along_a_side_of_a_pixel():
    vertices = 1.1 * built("cup").vertices
    drafts = []
    for samples in (2, 8):
        scene = built("cup", shadows=True, samples=samples)
        rows = torch.arange(len(scene))
        of_rows = vertices.expand(len(scene), -1, -1)
        drafts.append(scene.render(Conditions(scene.lights, of_rows), rows, is_draft=True))
    assert torch.equal(*drafts)


def images_of_moved(scene, mesh, vertices, lights) -> torch.Tensor:
    images = []
    for row, example in enumerate(scene.examples):
        moved = replace(mesh, vertices=vertices[row].astype(np.float64))
        cameras = list(example.cameras)
        [operator] = build_operators(moved, cameras, scene.settings, RASTERIZER)
        gray = GRAYS[row % len(GRAYS)]  # The backgrounds take turns, then the cameras.
        images.append(operator.image(lights[row], gray))
    return torch.stack(images)


def test_cameras_alone_have_the_gradient_that_they_have_beside_vertices():
    scene = build_scene(
        [("solid:pear", "pear")], 16, rasterizer="numpy", silhouettes=True, fov=40.0
    )
    examples = torch.arange(1)
    weights = torch.linspace(0, 1, 16)
    gradients = []
    for change in ({}, {"vertices": scene.vertices}):
        move = torch.zeros(1, 3, requires_grad=True)
        conditions = replace(scene.conditions(examples), cameras=move, **change)
        images = scene.render(conditions, examples)
        gradients += torch.autograd.grad((images * weights).sum(), move)
    assert gradients[0].abs().min() > 0
    assert torch.equal(*gradients)
