"""The folder of an attack is read back to the same image, and a damaged one is refused."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import draw_uniform, textured

import augment
from augment.attack_settings import PARAMETER_NAMES
from augment.attacks.adversary import DESCRIPTION, Adversary, reload, write_adversary
from augment.scene.objects import (
    Example,
    SceneObject,
    add_table,
    load_object,
    name_mesh,
    with_others,
)
from augment.scene.scene import Scene
from augment.settings import ObjectSettings
from renderer.errors import InputError
from renderer.mesh import Mesh, normalize
from renderer.solids import solid
from renderer.surface.gloss import Gloss
from renderer.visibility import choose
from tests.helpers import by_channel


@pytest.mark.parametrize("label", ["orange", 0, "0"])
def test_an_index_of_a_class_is_that_of_the_attacked_network_everywhere(label, tmp_path):
    first, other = by_channel(16), by_channel(16, ("sky", "orange", "lime"))
    # The last label is of no class.
    objects = [("solid:orange", label), *(("solid:ball", other) for other in (1, "1", 99))]
    scene = augment.build_scene([objects], 16, rasterizer="numpy")
    steps = augment.StepSettings("linf", 0.4, "sign", 0.1)
    settings = augment.AttackSettings(lighting=steps, allow_negative=True, max_steps=4)
    result = augment.attack(first, scene, settings=settings)
    assert augment.transfer(result, [other])[0]["clean_correct"] == [True]
    augment.save(result, tmp_path, verify=())
    assert reload(tmp_path / "example_000").shown.labels == ["orange", "lime", "lime", "99"]


def test_files_of_an_earlier_attack_in_the_same_folder_are_gone(attacked, tmp_path):
    views = augment.build_scene([("solid:orange", "orange")], 8, views=2, rasterizer="numpy")
    settings = augment.AttackSettings(pixels=augment.StepSettings("linf", 0.05), max_steps=1)
    options = {"settings": settings, "classes": ["orange", "other"], "force": True}
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(192, 2)).eval()
    augment.save(augment.attack(network, views, **options), tmp_path, verify=())
    (tmp_path / "notes.txt").write_text("kept")
    augment.save(attacked("lighting", max_steps=1), tmp_path, verify=())
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"attack.jsonl", "example_000", "example_000.png", "notes.txt"}
    assert not (tmp_path / "example_000" / "pixels.npy").exists()


OTHERS = {"skylight", "projector", "lamps", "positions", "pose"}  # Each has a test of its own.
CHANGE_TEXTURES = {"material", "albedo"}
SOFTWARE = choose("numpy")
BROWN = (0.4, 0.3, 0.2)  # color of the table

STEPS = {
    "albedo": augment.StepSettings("linf", 0.2, "sign", 0.1),
    "geometry": augment.StepSettings("linf", 0.01, "sign", 0.005),
    "pixels": augment.StepSettings("linf", 0.05, "sign", 0.025),
    "lighting": augment.StepSettings("linf", 0.3, "sign", 0.15),
    "material": augment.MaterialSettings("linf", 1.0, "sign", 0.5, hue=40.0),
}


def attacked(kinds: set[str], scene: Scene) -> augment.AttackResult:
    steps = {name: STEPS[name] for name in sorted(kinds)}
    settings = augment.AttackSettings(**steps, allow_negative=True, max_steps=3)
    return augment.attack(by_channel(scene.settings.size), scene, settings=settings, force=True)


def adversary_of(done: augment.AttackResult) -> Adversary:
    before = done.images_in_views_before[0]
    return Adversary.of(done.problem.scene, 0, done.conditions, before, done.images_in_views[0])


def tolerance(kinds: set[str]) -> float:
    return 1 / 255 if kinds & CHANGE_TEXTURES else 1e-5


def textured_pear() -> Mesh:
    mesh = solid("pear")
    draws = np.random.default_rng(0)
    is_textured = np.arange(len(mesh.faces)) % 2 == 1
    colors = mesh.corner_colors.copy()
    colors[is_textured] = 1
    uvs = draws.random((len(mesh.faces), 3, 2), dtype=np.float32)
    texture = draws.integers(0, 256, (16, 8, 3), dtype=np.uint8)
    colored = replace(mesh, corner_colors=np.float32(colors))
    return textured(colored, uvs, texture, np.where(is_textured, 0, -1))


def scene_with(item: SceneObject) -> Scene:
    options = {"rasterizer": "numpy", "width": 3.0, "degree": 6}
    scene = augment.build_scene([("solid:apple", "orange")], 16, **options)
    return scene.changed(objects=[item])


@pytest.mark.filterwarnings("ignore:.*takes light of degree")
@pytest.mark.parametrize(
    ("kinds", "encoding"),
    [
        ({"lighting", "geometry", "pixels"}, "srgb"),
        ({"albedo"}, "linear"),
        (set(PARAMETER_NAMES) - OTHERS, "srgb"),
    ],
    ids=lambda value: "+".join(sorted(value)) if isinstance(value, set) else value,
)
def test_an_adversary_is_read_back_to_the_same_images(tmp_path, kinds, encoding):
    options = {"shared": True, "rasterizer": "numpy", "encoding": encoding, "width": 2.4}
    scene = augment.build_scene([(textured_pear(), "orange")], 16, views=2, degree=6, **options)
    done = attacked(kinds, scene)
    assert (done.images - done.images_before).abs().max() > 0.02
    write_adversary(adversary_of(done), tmp_path)
    found = reload(tmp_path)
    assert torch.equal(found.images, done.images[0])
    assert torch.equal(found.images_before, done.images_before[0])
    image = found.render(SOFTWARE)
    torch.testing.assert_close(image, done.images[0], rtol=0, atol=tolerance(kinds))


@pytest.mark.parametrize("kind", ["geometry", "albedo"])
def test_an_adversary_with_gloss_beside_a_matte_table_is_read_back(tmp_path, kind):
    """With albedo, a texture of gloss is painted anew, so that it is even here."""
    size = (1, 1, 2) if kind == "albedo" else (4, 4, 2)
    texels = np.random.default_rng(1).integers(150, 255, size, dtype=np.uint8)
    mesh = Gloss(0.4, metallic=0.3).on(normalize(textured_pear()))
    glossy = replace(mesh, gloss_textures=(texels,))
    item = add_table(SceneObject("orange", glossy), BROWN)
    done = attacked({kind}, scene_with(item))
    write_adversary(adversary_of(done), tmp_path)
    image = reload(tmp_path).render(SOFTWARE)
    torch.testing.assert_close(image, done.images[0], rtol=0, atol=tolerance({kind}))

    matte = replace(item, mesh=replace(item.mesh, gloss=None))
    matte_images = attacked({kind}, scene_with(matte)).images
    assert (matte_images - done.images).abs().max() > 0.02


def test_the_objects_of_an_adversary_are_read_back_with_their_truth(tmp_path):
    given = [{"mesh": "solid:cup", "label": "lime", "scale": 0.6}, {"mesh": "solid:ball"}]
    item = load_object(ObjectSettings("solid:orange", "orange", others=given))
    done = attacked({"lighting"}, scene_with(add_table(item, BROWN)))
    write_adversary(adversary_of(done), tmp_path)
    found = reload(tmp_path)
    index_of = {"orange": 0, "lime": 1}.get
    truth, expected = (of.truth(index_of) for of in (found.scene(SOFTWARE), done.problem.scene))
    assert found.shown.labels == ["orange", "lime", ""]
    assert expected.labels[0, 0].tolist() == [0, 1]
    for name, values in vars(expected).items():
        torch.testing.assert_close(getattr(truth, name), values, msg=name)


def test_objects_beside_the_first_are_read_back_with_their_truth_if_some_have_textures(tmp_path):
    pear = textured_pear()
    given = [
        {"mesh": name, "label": label, "scale": 0.4, "at": [0.6, y]}
        for name, label, y in ((name_mesh(pear), "1", 1.0), ("solid:cup", "2", -1.0))
    ]
    item = load_object(ObjectSettings("solid:orange", "0", others=given))
    scene = scene_with(add_table(item, BROWN))
    start = scene.conditions(torch.arange(1))
    images = scene.render(start, torch.arange(1))[0]
    write_adversary(Adversary.of(scene, 0, start, images, images), tmp_path)
    truth, expected = (of.truth(int) for of in (reload(tmp_path).scene(SOFTWARE), scene))
    assert expected.labels[0, 0].tolist() == [0, 1, 2]
    torch.testing.assert_close(truth.masks, expected.masks)


@pytest.mark.parametrize("fov", [None, 50.0])
def test_exposure_albedo_scale_background_and_camera_are_kept(tmp_path, fov):
    """The example is as training draws them, with a camera that looks past the middle."""
    scene = augment.build_scene([("solid:orange", "orange")], 16, rasterizer="numpy", fov=fov)
    backgrounds = (255 * draw_uniform(2, 3, 16, 16).float()).round() / 255
    ((camera,),) = scene.cameras
    shifted = replace(camera, right=0.3, up=-0.2, width=3.0)
    example = Example(0, (shifted,), 1, exposure=1.7)
    objects = [replace(item, albedo_scale=0.6) for item in scene.objects]
    changed = scene.changed(examples=[example], objects=objects, backgrounds=backgrounds)
    done = attacked({"albedo", "lighting"}, changed)
    write_adversary(adversary_of(done), tmp_path)
    found = reload(tmp_path)
    assert torch.equal(found.background, backgrounds[1])
    assert found.cameras == example.cameras
    torch.testing.assert_close(found.render(SOFTWARE), done.images[0], rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def pear_with_prop() -> SceneObject:
    """Return a pear with a prop and a table; both meshes have textures of their own."""
    smaller = 0.3 * solid("pear").vertices + np.array([0.7, 0.7, 0.3])
    prop = replace(textured_pear(), vertices=smaller)
    item = SceneObject("orange", normalize(textured_pear()))
    return add_table(with_others(item, [("", prop)]), BROWN)


def points(item: SceneObject, own: bool) -> set[tuple[float, ...]]:
    used = np.unique(item.mesh.faces[item.own_faces == own])
    return set(map(tuple, item.mesh.vertices[used].astype(np.float32).tolist()))


def test_an_attack_on_albedo_paints_the_object_alone(pear_with_prop):
    done = attacked({"albedo"}, scene_with(pear_with_prop))
    painted = done.conditions.albedo[0]
    assert painted[pear_with_prop.own_faces].any()
    assert not painted[~pear_with_prop.own_faces].any()


def test_an_attack_on_shape_moves_the_object_alone_even_if_read_back(pear_with_prop, tmp_path):
    """A file has its faces in the order of textures, and its vertices in that of places."""
    scene = scene_with(pear_with_prop)
    for round_name in ("first", "second"):
        [item] = scene.objects
        done = attacked({"geometry"}, scene)
        offsets = (done.conditions.vertices - scene.vertices)[0]
        assert offsets[item.own_vertices].any()
        assert not offsets[~item.own_vertices].any()
        write_adversary(adversary_of(done), tmp_path / round_name)
        found = reload(tmp_path / round_name)
        image = found.render(SOFTWARE)
        torch.testing.assert_close(image, done.images[0], rtol=0, atol=1e-5)
        assert points(found.shown, own=False) == points(pear_with_prop, own=False)
        scene = found.scene(SOFTWARE)
    moved = points(scene.objects[0], own=True)
    before = points(pear_with_prop, own=True)
    assert moved != before
    assert len(moved) == len(before)


@pytest.mark.parametrize("factor", [-1.0, 3.0])
def test_a_large_change_of_the_shape_shows_the_same_from_files(factor, tmp_path):
    """A shape that is turned inside out shows its inside, and a large shape is not cut."""
    scene = augment.build_scene([("solid:orange", "orange")], 16, rasterizer="numpy")
    scene = scene.changed(one_light=True)
    every = torch.arange(1)
    after = replace(scene.conditions(every), vertices=factor * scene.vertices)
    [images] = scene.render(after, every)
    write_adversary(Adversary.of(scene, 0, after, images, images), tmp_path)
    torch.testing.assert_close(reload(tmp_path).render(SOFTWARE), images[0], rtol=0, atol=1e-5)


def test_shadows_change_when_a_light_is_attacked_after_a_shape():
    scene = augment.build_scene([("solid:cup", "orange")], 8, shadows=True, rasterizer="numpy")
    again = attacked({"lighting"}, attacked({"geometry"}, scene).problem.scene)
    expected = again.problem.scene.changed(one_light=True).render(again.conditions, torch.arange(1))
    torch.testing.assert_close(again.images_in_views, expected, rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def undamaged(tmp_path_factory) -> Path:
    scene = augment.build_scene([("solid:orange", "orange")], 8, rasterizer="numpy")
    folder = tmp_path_factory.mktemp("adversary")
    write_adversary(adversary_of(attacked({"pixels"}, scene)), folder)
    return folder


CAMERA = {"polar": 0, "azimuth": 0}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image": {"size": 9}}, "shape"),
        ({"cameras": [CAMERA | {"width": 0}]}, "width=0"),
        ({"own_faces": 0}, "own_faces=0"),
        ({"background": [1]}, r"adversary\.json: background=\[1\]"),
        ({"cameras": [CAMERA | {"width": 2, "distance": 0.5}]}, r"json: the mesh reaches"),
    ],
    ids=["another size", "a flat camera", "no own faces", "a list", "a camera in the mesh"],
)
def test_an_impossible_description_is_refused(undamaged, tmp_path, changes, message):
    folder = shutil.copytree(undamaged, tmp_path / "damaged")
    path = folder / DESCRIPTION
    description = json.loads(path.read_text())
    path.write_text(json.dumps(description | changes))
    with pytest.raises(InputError, match=message):
        reload(folder)


def announce_10_terabytes(folder: Path) -> None:
    header = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6, 3)}
    with open(folder / "after.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, header)


def put_pipe(folder: Path) -> None:
    """Put a pipe in place of the image, which would wait for a writer."""
    (folder / "after.npy").unlink()
    os.mkfifo(folder / "after.npy")


DAMAGES = {
    "no description": (lambda folder: (folder / DESCRIPTION).unlink(), "does not exist"),
    "cut": (lambda folder: (folder / DESCRIPTION).write_text("{"), "does not describe"),
    "no mesh": (lambda folder: (folder / "mesh.glb").unlink(), "mesh.glb does not exist"),
    "pipe": (put_pipe, "after.npy"),
    "10 TB": (announce_10_terabytes, "after.npy"),
    "beyond float32": (
        lambda folder: np.save(folder / "after.npy", np.full((1, 3, 8, 8), 1e300)),
        "after.npy",
    ),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_file_is_refused_by_name(undamaged, tmp_path, damage, message):
    folder = shutil.copytree(undamaged, tmp_path / "damaged")
    damage(folder)
    with pytest.raises(InputError, match=message):
        reload(folder)
