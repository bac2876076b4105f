import json

import pytest
import torch
from torch import Tensor

import augment
from augment.attacks.evaluate import Checks
from augment.attacks.parameters import PARAMETERS
from renderer.errors import InputError
from renderer.light.nonnegative import project_nonnegative
from renderer.mesh import Mesh, load_mesh
from renderer.shapes import solid

OTHER_LIGHTS = {"skylight", "projector", "lamps", "positions"}
CLASSES = ("orange", "lime", "sky", "night")
SIGNED = augment.AttackSettings(lighting=augment.StepSettings(), allow_negative=True)
SMALL = {"rasterizer": "numpy", "width": 2.4}


@pytest.fixture
def classifier() -> augment.Classifier:
    """Orange is red, lime is green, sky is blue, night is dark."""

    def mean_color(images: Tensor) -> Tensor:
        means = 30 * images.mean((2, 3))
        return torch.cat([means, 12 - means.sum(1, keepdim=True)], dim=1)

    return augment.Classifier(mean_color, 8, CLASSES, "by_color")


def test_several_meshes_and_classes_are_attacked_in_one_scene_each_away_from_its_own(classifier):
    lime = Mesh.plain(solid("orange").vertices, solid("orange").faces, (0.1, 0.9, 0.1))
    scene = augment.build_scene([("solid:orange", "orange"), (lime, "lime")], 8, views=2, **SMALL)
    attacked = augment.attack(classifier, scene, settings=SIGNED)
    assert attacked.goal.source.tolist() == [[0], [0], [1], [1]]
    assert attacked.success.all() and (attacked.steps > 0).all()
    assert torch.equal(attacked.logits.argmax(2) != attacked.goal.source, attacked.success[:, None])
    assert attacked.images.shape == attacked.images_before.shape == (4, 1, 3, 8, 8)


@pytest.mark.parametrize("target", ["lime", ["lime", "night"]])
def test_shared_views_may_each_have_a_target(classifier, target):
    scene = augment.build_scene([("solid:orange", "orange")], 8, views=2, shared=True, **SMALL)
    attacked = augment.attack(classifier, scene, augment.Targeted(target), SIGNED)
    assert attacked.conditions.light.shape == (1, 49, 3) and attacked.images.shape == (1, 2, 3, 8, 8)
    names = [target] * 2 if isinstance(target, str) else target
    assert attacked.goal.target.tolist() == [[CLASSES.index(name) for name in names]]


@pytest.mark.parametrize("bounces", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_what_is_judged_has_the_shadows_of_the_shape_and_the_colors_that_leave(classifier, tmp_path, bounces):
    scene = augment.build_scene([("solid:cup:3", "orange")], 8, 2, shared=True, shadows=True, bounces=bounces, **SMALL)
    moved = {name: augment.StepSettings("linf", 0.05, "sign", 0.03) for name in ("geometry", "albedo")}
    settings = augment.AttackSettings(**moved, max_steps=2)
    attacked = augment.attack(classifier, scene, settings=settings, force=True)
    held = attacked.problem.images(attacked.descent.values)
    rerender_checks = {each.version: each for each in augment.save(attacked, tmp_path)}
    assert (held - attacked.images).abs().max() > 0.5 / 255
    assert rerender_checks["reload"].largest.max() < 0.1 / 255


def test_all_kinds_keep_to_their_norm_balls_beside_a_baseline_at_random(classifier, tmp_path):
    kinds = {name: augment.StepSettings("linf", 0.01, "sign", 0.004) for name in PARAMETERS.keys() - OTHER_LIGHTS}
    scene = augment.build_scene([("solid:orange", "orange")], 8, **SMALL)
    attacked = augment.attack(
        classifier, scene, settings=augment.AttackSettings(**kinds, max_steps=4, allow_negative=True)
    )
    moved = (attacked.descent.values - attacked.problem.start).abs()
    assert 0.009 < moved.max() <= 0.01 + 1e-6
    checks = augment.check(attacked)
    assert isinstance(checks, Checks) and checks.cost < checks.cost_before
    augment.save(attacked, tmp_path / "new", checks)
    *lines, last = [json.loads(line) for line in (tmp_path / "new" / "attack.jsonl").read_text().splitlines()]
    assert lines[0]["largest_change"].keys() == kinds.keys() and last["checks"]["random_search"] == checks.random_search
    shape = load_mesh(tmp_path / "new" / "example_000" / "mesh.glb")
    assert len(shape.faces) == len(scene.mesh(0).faces)


@pytest.mark.parametrize(("allow_negative", "physical"), [(False, True), (True, False)])
@pytest.mark.parametrize("kind", ["geometry", "albedo"])
def test_whatever_is_attacked_the_light_is_one_that_something_can_emit_unless_any_will_do(
    classifier, kind, allow_negative, physical, tmp_path
):
    """So that the files, whose maps hold no negative radiance, show the same."""
    scene = augment.build_scene([("solid:orange", "orange")], 8, **SMALL)
    settings = augment.AttackSettings(**{kind: augment.StepSettings()}, allow_negative=allow_negative, max_steps=2)
    attacked = augment.attack(classifier, scene, settings=settings)
    lights = attacked.conditions.light
    assert torch.equal(lights, project_nonnegative(scene.lights)) == physical
    assert torch.equal(lights, scene.lights) != physical
    images = [attacked.problem.images(values) for values in (attacked.problem.start, attacked.descent.values)]
    assert torch.equal(images[0], attacked.images_before) and torch.equal(images[1], attacked.images)
    augment.save(attacked, tmp_path)
    assert (tmp_path / "example_000" / "light.exr").is_file() == physical


def test_what_is_not_recognized_or_no_class_is_refused_in_one_sentence(classifier):
    scene = augment.build_scene([("solid:orange", "lime")], 8, **SMALL)
    with pytest.raises(InputError, match="1 of 1 images of solid:orange are not recognized as 'lime'"):
        augment.attack(classifier, scene)
    assert augment.attack(classifier, scene, force=True).descent.success_before.all()
    with pytest.raises(InputError, match="'mango' is not a class of the model"):
        augment.attack(classifier, augment.build_scene([("solid:orange", "mango")], 8, **SMALL))
    with pytest.raises(InputError, match="names 2 classes for 1 views"):
        augment.attack(classifier, scene, augment.Targeted(["lime", "sky"]), force=True)
    with pytest.raises(InputError, match="target=lime is the right class of an example"):
        augment.attack(classifier, scene, augment.Targeted("lime"), force=True)
    with pytest.raises(InputError, match="attack: name what to change"):
        augment.attack(classifier, scene, settings=augment.AttackSettings(), force=True)
