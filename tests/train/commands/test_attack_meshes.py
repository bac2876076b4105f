"""The attack command: from its configuration to scenes, and its text."""

from unittest.mock import Mock

import pytest
import torch
from torch import Tensor

from augment.attacks.attack import AttackResult
from augment.attacks.checks import check
from augment.classifiers import Classifier
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.light.presets import probe
from renderer.visibility.rasterizers import opengl
from scripts.attack import main as attack_command
from tests.runs import loaded_run
from train.command_settings import AttackExperimentSettings
from train.commands.attack_meshes import attacks, overrides
from train.report.attack_tables import format_attack

CLASSES = ("orange", "lime", "sky")


def configured(*arguments: str) -> AttackExperimentSettings:
    """The real configuration; arguments are further overrides."""
    small = ["renderer.rasterizer=numpy", "renderer.shadows=false", "attack.max_steps=8"]
    return attack_command.read([*small, "attack.margin=0", *arguments])


def by_color(classes: tuple[str, ...] = CLASSES) -> Classifier:
    return Classifier(lambda images: 30 * images.mean((2, 3)), 8, classes, "by_color")


def attacked(*arguments: str, classifier: Classifier | None = None) -> AttackResult:
    ((_, _, result),) = attacks(configured(*arguments), classifier or by_color(), torch.device("cpu"))
    return result


def test_examples_are_each_view_before_all_backgrounds_at_equal_azimuths():
    several = "scene.views=3", "scene.backgrounds=[0.2,0.6]", "scene.polar=90", "scene.azimuth=30"
    result = attacked(*several, "attack.allow_negative=true", "attack.max_steps=0")
    cameras = orbit_cameras(3, 2.0, 90.0, 30.0)
    assert result.problem.scene.cameras == [(camera,) for camera in cameras for _ in range(2)]
    assert result.images_before[:, 0, :, 0, 0].tolist() == [[pytest.approx(gray)] * 3 for gray in [0.2, 0.6] * 3]
    assert torch.equal(result.problem.scene.lights, probe("grace").expand(6, -1, -1))


def test_exposure_multiplies_the_light_and_albedo_scale_the_surface():
    none = "attack.max_steps=0", "attack.force=true"
    brighter, same = attacked(*none, "scene.exposure=1.5"), attacked(*none)
    whiter = attacked(*none, "scene.meshes=[{mesh: 'solid:orange:0', albedo_scale: 1.5}]")
    torch.testing.assert_close(brighter.images_before, whiter.images_before, rtol=0, atol=1e-6)
    assert not torch.equal(brighter.images_before, same.images_before)


@pytest.mark.parametrize("light", ["projector", "lamps"])
def test_an_attacked_local_light_stands_in_the_scene_without_being_named(light):
    alone, bare = (attacked(f"attack={name}", "attack.max_steps=1") for name in (light, "lighting"))
    assert len(alone.problem.scene.lights[0]) > len(bare.problem.scene.lights[0])


def test_a_class_whose_name_is_a_number_is_a_target():
    result = attacked("target=7", "attack.max_steps=1", classifier=by_color(("orange", "7", "8")))
    assert result.goal.target.tolist() == [[1]]


def test_a_scene_is_searched_for_and_given_as_overrides():
    """Of a classifier that knows oranges before light gray alone."""

    def before_light(images: Tensor) -> Tensor:
        score = 100 * (images[..., 0, 0].mean(1) - 0.8)
        return torch.stack([score, -score], dim=1)

    settings, classifier = configured(), Classifier(before_light, 8, ("orange", "other"))
    ((name, scene, result),) = attacks(settings, classifier, torch.device("cpu"))
    assert name == "solid:orange:0" and result.clean_correct.all()
    assert overrides(scene, settings.scene) == "'scene.backgrounds=[0.9]'"
    with pytest.raises(InputError, match=r"^attack\.force=.* 1 of 1 images of solid:orange:0 are .* before any attack"):
        attacked("scene.search=0", classifier=classifier)


def test_a_rasterizer_that_does_not_start_is_an_error_of_its_key(monkeypatch, tiny, tmp_path):
    monkeypatch.setattr(opengl, "device", Mock(side_effect=InputError("no EGL device")))
    settings = tiny("renderer.rasterizer=opengl")
    for command in (
        lambda: attacked("renderer.rasterizer=opengl"),
        lambda: loaded_run(settings, tmp_path),
    ):
        with pytest.raises(InputError, match=r"^renderer\.rasterizer: no EGL device$"):
            command()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["attack.restarts=2"], r"restarts draws from the norm-balls: set the radius of every parameter"),
        (["scene.meshes=[]"], r"^scene\.meshes must not be empty"),
        (["label=mango"], r"classifier by_color: 'mango' is not a class of the model"),
        (["target=[lime]", "scene.views=2", "attack.shared=true"], r"names 1 classes for 2 views"),
        (["target=[[lime]]"], r"target: give a class, least_likely, or a list of classes"),
        (["scene.meshes=[{mesh: 'solid:orange:0', wight: 2}]"], r"scene.meshes\[0\]"),
        (["scene.meshes=[{mesh: a, props: [solid:cup]}]"], r"^scene\.meshes\[0\]\.props\[0\] is 'solid:cup'"),
        (["scene.meshes=[{mesh: a, props: [{mesh: b}]}]"], r"scene.meshes\[0\].*at is not set"),
        (["scene.meshes=[{mesh: a, props: [{mesh: b, at: [1]}]}]"], r"props\[0\]\.at=\[1\] must be x and y"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input_is_refused_in_one_sentence(arguments, message):
    with pytest.raises(InputError, match=message) as refused:
        attacked(*arguments)
    assert "\n" not in str(refused.value)


def test_success_is_printed_of_clean_correct_examples_and_of_their_views():
    """No light makes both views' images green and blue, so that of two views with a target each one remains."""
    result = attacked("target=[lime,sky]", "scene.views=2", "attack.shared=true", "attack.margin=0.5")
    text = format_attack("mesh", result, None)
    assert f", {int(result.success_with_margin)} with the margin of {result.settings.margin:g}" in text
    assert text.startswith("mesh: lighting against by_color: ") and len(text.splitlines()) == 1
    assert f"{int(result.success)} of 1 [" in text and f", {int(result.success_in_views.sum())} of 2 views" in text
    wrong = attacked("label=sky", "attack.force=true", "attack.max_steps=1", "scene.views=2")
    assert "none of 2 examples was correct before" in format_attack("mesh", wrong, None)
    checks = check(wrong)
    assert (checks["success"], checks["random_search"], set(checks["success_by_steps"].values())) == (0, 0, {0})
