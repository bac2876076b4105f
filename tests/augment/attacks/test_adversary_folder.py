"""What an attack leaves behind is read back to the same image, and what is damaged is refused."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import augment
from augment.attacks.adversary import DESCRIPTION, Adversary, reload, write_adversary
from augment.parameter_settings import PARAMETER_NAMES
from augment.scene.conditions import Example
from augment.scene.objects import SceneObject, add_table, with_props
from augment.scene.scene import Scene
from renderer.errors import InputError
from renderer.geometry.mesh import Mesh, normalize
from renderer.geometry.shapes import solid
from renderer.shading.gloss import Gloss
from renderer.visibility.rasterizers import choose

OTHERS = {"skylight", "projector", "lamps", "positions", "pose"}  # each has a test of its own
PAINTED = {"material", "albedo"}  # change textures
CLASSES = ("orange", "lime", "sky")
SOFTWARE = choose("numpy")


def attacked(kinds: set[str], scene: Scene) -> augment.AttackResult:
    classifier = augment.Classifier(
        lambda images: 30 * images.mean((2, 3)), scene.settings.size, CLASSES
    )
    radii = {"albedo": 0.2, "geometry": 0.01, "pixels": 0.05, "lighting": 0.3}
    steps = {
        name: augment.StepSettings("linf", radii[name], "sign", 0.5 * radii[name])
        for name in kinds & set(radii)
    }
    steps |= {
        name: augment.MaterialSettings("linf", 1.0, "sign", 0.5, hue=40.0)
        for name in kinds & {"material"}
    }
    settings = augment.AttackSettings(**steps, allow_negative=True, max_steps=3)
    return augment.attack(classifier, scene, settings=settings, force=True)


def textured() -> Mesh:
    """A pear with a texture on half of its faces, colors at the corners of the others."""
    mesh, draws = solid("pear"), np.random.default_rng(0)
    ids = np.where(np.arange(len(mesh.faces)) % 2, 0, -1).astype(np.int32)
    return replace(
        mesh,
        texture_ids=ids,
        corner_uvs=draws.random((len(ids), 3, 2), dtype=np.float32),
        corner_colors=np.where((ids >= 0)[:, None, None], 1, mesh.corner_colors).astype(np.float32),
        textures=(draws.integers(0, 256, (16, 8, 3), dtype=np.uint8),),
    )


def adversary_of(done: augment.AttackResult) -> Adversary:
    return Adversary.of(
        done.problem.scene, 0, done.conditions, done.images_before[0], done.images[0]
    )


@pytest.mark.parametrize(
    ("kinds", "encoding"),
    [
        ({"lighting"}, "linear"),
        ({"geometry"}, "srgb"),
        ({"albedo"}, "linear"),
        ({"albedo"}, "srgb"),
        (set(PARAMETER_NAMES) - OTHERS, "srgb"),
    ],
    ids=lambda value: "+".join(sorted(value)) if isinstance(value, set) else value,
)
def test_an_adversary_is_read_back_to_the_same_images_within_a_255th(tmp_path, kinds, encoding):
    """And exactly but for rounding to float32 where no texture is painted."""
    choices = {"shared": True, "rasterizer": "numpy", "encoding": encoding, "width": 2.4}
    scene = augment.build_scene([(textured(), "orange")], 24, views=2, degree=6, **choices)
    done = attacked(kinds, scene)
    write_adversary(adversary_of(done), tmp_path)
    found = reload(tmp_path)
    assert torch.equal(found.images, done.images[0]) and torch.equal(
        found.images_before, done.images_before[0]
    )
    assert (done.images - done.images_before).abs().max() > 0.02
    limit = 1 / 255 if kinds & PAINTED else 1e-5
    torch.testing.assert_close(found.render(SOFTWARE), done.images[0], rtol=0, atol=limit)


@pytest.mark.parametrize("kind", ["lighting", "geometry", "albedo"])
def test_an_adversary_with_gloss_is_read_back_to_the_same_images_within_a_255th(tmp_path, kind):
    """Beside a matte table. The texture of gloss is painted anew from the nearest texels, so it is even with albedo."""
    mesh = Gloss(0.4, metallic=0.3).on(normalize(textured()))
    size = (1, 1, 2) if kind in PAINTED else (4, 4, 2)
    texels = np.random.default_rng(1).integers(150, 255, size, dtype=np.uint8)
    item = add_table(
        SceneObject("orange", replace(mesh, gloss_textures=(texels,))), (0.4, 0.3, 0.2)
    )
    scene = augment.build_scene(
        [("solid:apple", "orange")], 24, rasterizer="numpy", width=3.0, degree=6
    )
    scene = scene.changed(objects=[item])
    done = attacked({kind}, scene)
    write_adversary(adversary_of(done), tmp_path)
    limit = 1 / 255 if kind in PAINTED else 1e-5
    torch.testing.assert_close(
        reload(tmp_path).render(SOFTWARE), done.images[0], rtol=0, atol=limit
    )
    matte = adversary_of(
        attacked(
            {kind}, scene.changed(objects=[replace(item, mesh=replace(item.mesh, gloss=None))])
        )
    )
    assert (matte.images - done.images[0]).abs().max() > 0.02


def test_props_and_table_are_never_attacked_not_after_they_are_read_back_either(tmp_path):
    """With textures of their own: the faces of a file are ordered by texture, and its vertices by place."""
    beside = replace(textured(), vertices=0.3 * solid("pear").vertices + np.array([0.7, 0.7, 0.3]))
    item = add_table(
        with_props(SceneObject("orange", normalize(textured())), [beside]), (0.4, 0.3, 0.2)
    )
    scene = augment.build_scene(
        [("solid:apple", "orange")], 24, rasterizer="numpy", width=3.0, degree=6
    )
    scene = scene.changed(objects=[item])
    painted = attacked({"albedo"}, scene).conditions.albedo[0]
    assert painted[item.own_faces].any() and not painted[~item.own_faces].any()
    for folder in (tmp_path / "first", tmp_path / "second"):
        [shown] = scene.objects
        done = attacked({"geometry"}, scene)
        moved = (done.conditions.vertices - scene.vertices)[0]
        assert moved[shown.own_vertices].any() and not moved[~shown.own_vertices].any()
        write_adversary(adversary_of(done), folder)
        found = reload(folder)
        torch.testing.assert_close(found.render(SOFTWARE), done.images[0], rtol=0, atol=1e-5)
        assert points(found.shown, own=False) == points(item, own=False)
        scene = found.scene(SOFTWARE)
    assert len(points(found.shown, own=True)) == len(points(item, own=True))
    assert points(found.shown, own=True) != points(item, own=True)


def points(item: SceneObject, own: bool) -> set[tuple[float, ...]]:
    used = np.unique(item.mesh.faces[item.own_faces == own])
    return set(map(tuple, item.mesh.vertices[used].astype(np.float32).tolist()))


@pytest.mark.parametrize("fov", [None, 50.0])
def test_exposure_albedo_scale_background_and_camera_are_kept(tmp_path, fov):
    """A row as training draws them: its own exposure, an image behind it, a camera that looks past the middle."""
    scene = augment.build_scene([("solid:orange", "orange")], 16, rasterizer="numpy", fov=fov)
    backgrounds = (
        torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0)).mul(255).round() / 255
    )
    ((camera,),) = scene.cameras
    row = Example(0, (replace(camera, right=0.3, up=-0.2, width=3.0),), 1, exposure=1.7)
    objects = [replace(each, albedo_scale=0.6) for each in scene.objects]
    done = attacked(
        {"albedo", "lighting"},
        scene.changed(examples=[row], objects=objects, backgrounds=backgrounds),
    )
    write_adversary(adversary_of(done), tmp_path)
    found = reload(tmp_path)
    assert torch.equal(found.background, backgrounds[1]) and found.cameras == row.cameras
    torch.testing.assert_close(found.render(SOFTWARE), done.images[0], rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def undamaged(tmp_path_factory) -> Path:
    scene = augment.build_scene([("solid:orange", "orange")], 8, rasterizer="numpy")
    folder = tmp_path_factory.mktemp("adversary")
    write_adversary(adversary_of(attacked({"pixels"}, scene)), folder)
    return folder


def described(**changes):
    def change(folder: Path) -> None:
        path = folder / DESCRIPTION
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def pipe(folder: Path) -> None:
    (folder / "after.npy").unlink()
    os.mkfifo(folder / "after.npy")


def progress_message(folder: Path) -> None:
    """10 TB by its header, which is all of the file."""
    with open(folder / "after.npy", "wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6, 3)}
        np.lib.format.write_array_header_1_0(file, header)


DAMAGES = {
    "no description": (
        lambda folder: (folder / DESCRIPTION).unlink(),
        "does not exist: give a folder that an attack",
    ),
    "no JSON": (
        lambda folder: (folder / DESCRIPTION).write_text("{"),
        "does not describe an adversary",
    ),
    "another size": (described(image={"size": 9}), "has shape"),
    "a flat camera": (described(cameras=[{"polar": 0, "azimuth": 0, "width": 0}]), "width=0"),
    "no faces of its own": (described(own_faces=0), "own_faces=0 must be at least 1"),
    "no mesh": (lambda folder: (folder / "mesh.glb").unlink(), "mesh.glb does not exist"),
    "a list for a background": (
        described(background=[1]),
        r"adversary\.json: background=\[1\]: give gray values",
    ),
    "a camera within the mesh": (
        described(cameras=[{"polar": 0, "azimuth": 0, "width": 2, "distance": 0.5}]),
        r"adversary\.json: the mesh reaches the camera at distance 0\.5",
    ),
    "a pipe for images": (pipe, "after.npy is not a regular file"),
    "images of 10 TB": (progress_message, "after.npy cannot be read"),
    "images of 1e300": (
        lambda folder: np.save(folder / "after.npy", np.full((1, 3, 8, 8), 1e300)),
        "cannot be read",
    ),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_folder_is_refused_in_one_sentence(undamaged, tmp_path, damage, message):
    folder = shutil.copytree(undamaged, tmp_path / "damaged")
    damage(folder)
    with pytest.raises(InputError, match=message) as refused:
        reload(folder)
    assert "\n" not in str(refused.value)
