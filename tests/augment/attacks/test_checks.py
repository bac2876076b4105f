"""Checks, success by radius and transfer of an attack's result."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import augment
from augment.attacks.attack import AttackResult
from augment.attacks.checks import warnings
from augment.parameter_settings import StepSettings
from renderer.errors import InputError

# ------------------------------------------------------------------------------------- checks


def test_checks_tell_that_the_cost_falls_and_that_more_steps_succeed_more_often(attacked):
    light = {"lighting": StepSettings(step_size=0.02)}
    result = attacked(light, {"backgrounds": [0.3, 0.5, 0.7]}, max_steps=3)
    checks = augment.check(result)
    assert checks["cost_before"] == pytest.approx(float(result.descent.cost_before.mean()))
    assert (
        checks["cost"] == pytest.approx(float(result.descent.cost.mean()))
        and checks["cost"] < checks["cost_before"]
    )
    assert (
        checks["cost_fell"] == 1
        and checks["zero_gradient"] == 0
        and 0 <= checks["random_search"] <= 1
    )
    assert list(checks["success_by_steps"]) == [3, 9, 30]
    rates = list(checks["success_by_steps"].values())
    # A longer descent repeats the shorter one: nothing here is drawn.
    assert rates == sorted(rates) and rates[0] == checks["success"] < rates[-1] == 1
    assert checks == augment.check(result)


def test_a_success_within_the_steps_counts_also_where_a_margin_sends_it_on(attacked):
    checks = augment.check(
        attacked({"lighting": StepSettings(step_size=0.2)}, margin=100, max_steps=3)
    )
    assert checks["success"] == 1 and checks["success_by_steps"] == {3: 1, 9: 1, 30: 1}


def test_a_success_at_the_very_last_step_counts_among_those_of_as_many_steps(attacked):
    light = {"lighting": StepSettings(step_size=0.02)}
    [last] = attacked(light, max_steps=60).steps.tolist()
    assert 1 < last < 60
    checks = augment.check(attacked(light, max_steps=last))
    assert checks["success"] == 1 and checks["success_by_steps"][last] == 1
    assert augment.check(attacked(light, max_steps=last - 1))["success"] == 0


def test_random_search_that_does_as_well_is_a_warning(attacked):
    """Any change is a success against a classifier that knows images of almost exactly one brightness alone."""
    brightness, width = attacked("lighting", max_steps=0).images_before.mean(), 1e-4

    def narrow(images: Tensor) -> Tensor:
        margin = width - (images.mean((1, 2, 3)) - brightness - width / 2).abs()
        return torch.stack([margin, 0 * margin], dim=1)

    light = {"lighting": StepSettings(radius=0.1)}
    checks = augment.check(
        attacked(light, classifier=augment.Classifier(narrow, 8, ("orange", "other")))
    )
    assert checks["success"] == checks["random_search"] == 1
    assert warnings(checks) == ["random search does as well or better"]


def test_warnings_follow_from_the_numbers():
    good = {
        "cost_fell": 1.0,
        "zero_gradient": 0.0,
        "success": 0.8,
        "random_search": 0.5,
        "success_without_noise": 0.9,
    }
    none = {"random_search": 0.0, "success": 0.0, "success_without_noise": 0.0}
    assert warnings(good) == warnings(good | none) == []
    assert len(warnings(good | {"success": 0.4, "random_search": 0.0})) == 1
    assert len(warnings(good | {"cost_fell": 0.9, "zero_gradient": 0.1})) == 2


# ------------------------------------------------------------------------------------- success by radius


@pytest.fixture
def linear(make_scene, make_linear) -> AttackResult:
    """Three examples of pixels, whose logits are linear in what is added: class 0 against 1, far from any clamp."""
    classifier = augment.Classifier(make_linear(2, bias=3.0), 6, ("stone", "other"))
    shown = make_scene()
    shown.objects[0] = replace(shown.objects[0], label="stone")
    pixels = StepSettings("linf", 0.05, "sign", 0.2)
    settings = augment.AttackSettings(pixels=pixels, max_steps=2, margin=0.0, quantized=False)
    return augment.attack(classifier, shown, settings=settings)


def test_a_ball_holds_an_adversary_from_the_radius_on_at_which_a_linear_classifier_errs(linear):
    """By hand: within L∞ of ε, the gap of two logits w₀, w₁ falls by ε |w₀ - w₁|₁ at most."""
    weight = linear.classifier.function[1].weight
    gap = linear.logits_before[..., 0] - linear.logits_before[..., 1]
    # The worse of two views, each of which has pixels of its own, decides.
    needed = (gap / (weight[0] - weight[1]).abs().sum()).amax(1)
    scales = [factor * float(radius) / 0.05 for radius in needed for factor in (0.98, 1.02)]
    for row in augment.success_by_radius(linear, scales):
        assert torch.equal(row["adversarial"], row["radii"]["pixels"] > needed)


def test_larger_balls_hold_the_successes_of_smaller_ones_and_more_than_random_draws_find(linear):
    rows = augment.success_by_radius(linear, [0.3, 0.05, 1.0, 0.1])  # scales of its radius
    assert [row["radii"]["pixels"] for row in rows] == pytest.approx([0.0025, 0.005, 0.015, 0.05])
    adversarial, random = (
        torch.stack([row[method] for row in rows]) for method in ("adversarial", "random")
    )
    for success in (adversarial, random):
        assert success.shape == (4, 3) and (success[1:] >= success[:-1]).all()
    assert (adversarial >= random).all()


# ------------------------------------------------------------------------------------- transfer

CLASSES = ("orange", "lime", "sky")


def network(classes: tuple[str, ...] = CLASSES, size: int = 12) -> augment.Classifier:
    """The brightest channel of the mean color, whatever the order of the classes."""
    order = [CLASSES.index(name) for name in classes]
    return augment.Classifier(
        lambda images: 30 * images.mean((2, 3))[:, order], size, classes, f"{classes[0]}{size}"
    )


@pytest.fixture
def result(attacked) -> AttackResult:
    """Of two views, each an example, before gray."""
    found = attacked("lighting", {"views": 2, "backgrounds": [0.4]}, network(), max_steps=20)
    assert found.success.all()
    return found


def confidence(logits: Tensor) -> list[list[float]]:
    return [pytest.approx(views, abs=1e-4) for views in logits.softmax(2).amax(2).tolist()]


@pytest.mark.parametrize("parameters", ["lighting", "lighting+geometry+albedo", "pixels"])
def test_the_attacked_network_itself_predicts_the_same(attacked, parameters):
    result = attacked(parameters, {"views": 2, "backgrounds": [0.4]}, network(), max_steps=20)
    (row,) = augment.transfer(result, [network()])
    chosen = result.success
    assert (
        row["network"] == "orange12" and all(row["clean_correct"] + row["success"]) and chosen.any()
    )
    assert row["confidence_before"] == confidence(result.logits_before[chosen])
    assert row["confidence"] == confidence(result.logits[chosen])


def test_another_network_gets_a_render_at_its_size_and_has_its_own_order_of_classes(attacked):
    result = attacked(
        {"lighting": StepSettings(step_size=0.2)}, {"views": 2}, network(), "sky", max_steps=60
    )
    other = network(("sky", "orange", "lime"), size=36)
    (row,) = augment.transfer(result, [other])
    assert row["predicted"] == [["sky"]] * 2 and all(row["clean_correct"] + row["success"])
    scene = result.problem.scene
    behind = scene.backgrounds[..., :1, :1].expand(-1, -1, 36, 36)
    finer = scene.changed(settings=replace(scene.settings, size=36), backgrounds=behind)
    images = finer.render(result.conditions, torch.arange(2))
    assert row["confidence"] == confidence(other(images[:, 0])[:, None])
    with pytest.raises(InputError, match="'sky' is not a class of the model"):
        augment.transfer(result, [network(("orange", "lime"))])


def test_other_azimuths_and_other_meshes_are_those_of_a_scene_with_them(result):
    scene = result.problem.scene
    apple = scene.changed(objects=augment.build_scene([("solid:apple", "lime")], 12).objects)
    turned, other = augment.transfer(result, azimuths=[-30.0], objects=apple.objects)
    assert (turned["azimuth"], other["mesh"]) == ("-30°", "solid:apple")
    cameras = [
        replace(row.cameras[0], azimuth=row.cameras[0].azimuth - 30) for row in scene.examples
    ]
    rows = [
        replace(row, cameras=(camera,)) for row, camera in zip(scene.examples, cameras, strict=True)
    ]
    for row, shown in ((turned, scene.changed(examples=rows)), (other, apple)):
        logits = network()(shown.render(result.conditions, torch.arange(2))[:, 0])[:, None]
        assert row["confidence"] == confidence(logits)
    assert not any(other["clean_correct"])  # a lime by its label, and none by its color


def test_only_clean_correct_examples_with_success_are_transferred(result):
    before = result.logits_before.clone()
    before[0] = -before[0]  # as if the first had been misclassified
    (row,) = augment.transfer(replace(result, logits_before=before), [network()])
    assert row["confidence"] == confidence(result.logits[1:])
    (none,) = augment.transfer(replace(result, logits_before=-result.logits_before), [network()])
    assert none["confidence"] == none["success"] == []
