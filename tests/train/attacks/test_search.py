"""Where a classifier does not recognize a mesh, a scene is found in which it does."""

import math
import shlex
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from augment.classifiers import Classifier
from renderer.errors import InputError
from train.attacks.experiment import attacks
from train.attacks.search import LENS, LIGHT_GRAY, _candidates, overrides, search
from train.attacks.settings import AttackExperimentSettings
from train.settings import compose, read_object, read_settings

CPU = torch.device("cpu")
CHANGED = ("polar", "azimuth", "width", "fov", "light", "exposure")


def configured(*more: str) -> AttackExperimentSettings:
    small = ["renderer.rasterizer=numpy", "renderer.cache=null", "attack.checks=false", "attack.max_steps=1"]
    return read_settings(AttackExperimentSettings, compose("attack", [*small, "attack.allow_negative=true", *more]))


def bright_and_small(images: Tensor) -> Tensor:
    """An orange is bright in the middle, on a wide border of the background's gray."""
    middle, border = images[..., 6:10, 6:10].mean((1, 2, 3)), images[..., :2, :].mean((1, 2, 3))
    score = torch.minimum(60 * (middle - 0.5), 200 * (0.02 - (border - 0.5).abs()))
    return torch.stack([score, -score], dim=1)


def by_size() -> Classifier:
    return Classifier(bright_and_small, 16, ("orange", "other"), "by_size")


def found(*more: str, classifier: Classifier | None = None):
    settings = configured(*more)
    item = read_object(settings.scene.meshes[0], settings.label, 0)
    return settings, search(item, settings, classifier or by_size(), CPU)


def test_a_scene_that_is_recognized_stays_as_it_is():
    always = Classifier(
        lambda images: torch.stack([images.mean((1, 2, 3)) + 1, images.mean((1, 2, 3))], 1), 16, list("ab")
    )
    settings, chosen = found("label=a", classifier=always)
    assert chosen == settings.scene


@pytest.mark.parametrize("more", [[], ["scene.views=2"], ["scene.views=2", "attack.shared=true"], ["scene.fov=40"]])
def test_a_camera_and_a_light_are_found_under_which_all_views_are_recognized(more):
    settings, chosen = found("scene.search=40", *more)
    assert chosen != settings.scene
    assert replace(chosen, **{name: getattr(settings.scene, name) for name in CHANGED}) == settings.scene
    settings = replace(settings, scene=replace(chosen, search=0))
    ((_, _, attacked),) = attacks(settings, by_size(), CPU)
    assert attacked.clean_correct.all()


def test_cameras_of_a_wide_lens_are_drawn_from_where_all_of_the_mesh_lies_before_them():
    scene = configured("scene.fov=90", "scene.search=50").scene
    _, *drawn = _candidates(replace(scene, backgrounds=["behind.png"]), torch.Generator().manual_seed(0))
    assert len(drawn) == 49 and {each.fov for each in drawn} == {90}
    widths = [each.width for each in drawn]
    assert min(widths) >= 4 and max(widths) > 7


def test_every_other_camera_has_perspective_and_a_gray_gives_way_to_a_light_one():
    own, lighter, *drawn = _candidates(configured("scene.search=5").scene, torch.Generator().manual_seed(0))
    assert own == configured("scene.search=5").scene and lighter == replace(own, backgrounds=[LIGHT_GRAY])
    assert [each.fov for each in drawn] == [LENS, LENS, None, None] * 2
    assert [each.backgrounds for each in drawn] == [[0.5], [LIGHT_GRAY]] * 4


def test_what_is_recognized_before_light_gray_alone_is_found_there():
    def before_light(images: Tensor) -> Tensor:
        score = 100 * (images[..., 0, 0].mean(1) - 0.8)
        return torch.stack([score, -score], dim=1)

    settings, chosen = found(classifier=Classifier(before_light, 16, ("orange", "other"), "before_light"))
    assert overrides(chosen, settings.scene) == f"'scene.backgrounds=[{LIGHT_GRAY}]'"


def test_what_was_found_is_told_as_overrides_and_follows_from_the_seed():
    settings, chosen = found("scene.search=40")
    _, again = found("scene.search=40")
    assert again == chosen
    _, told = found("scene.search=0", *shlex.split(overrides(chosen, settings.scene)))
    assert replace(told, search=40) == chosen
    assert math.isclose(told.exposure, chosen.exposure)


def test_where_nothing_is_found_the_mesh_is_refused_with_the_classifiers_answers():
    never = Classifier(
        lambda images: torch.stack([0 * images.sum((1, 2, 3)), images.mean((1, 2, 3)) + 1], 1), 16, list("ab")
    )
    with pytest.raises(InputError, match="1 of 1 images of solid:orange:0 are not recognized as 'a' before any attack"):
        list(attacks(configured("scene.search=2", "label=a"), never, CPU))
