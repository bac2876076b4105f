from dataclasses import replace

import pytest
import torch
from torch import Tensor

import augment
from augment.attack_settings import StepSettings
from augment.attacks.result import AttackResult, warnings
from renderer.errors import InputError
from tests.helpers import CHANNELS, by_channel

SMALL_STEPS = {"lighting": StepSettings(step_size=0.02)}


def test_checks_tell_that_the_cost_falls_and_that_more_steps_succeed_more_often(attacked):
    """Nothing is drawn, so that a longer descent repeats the shorter one."""
    slow_attack = attacked(SMALL_STEPS, {"backgrounds": [0.3, 0.5, 0.7]}, max_steps=3)
    checks = augment.check(slow_attack)
    descent = slow_attack.minimum
    assert checks["cost_before"] == pytest.approx(float(descent.cost_before.mean()))
    assert checks["cost"] == pytest.approx(float(descent.cost.mean()))
    assert checks["cost"] < checks["cost_before"]
    assert checks["cost_fell"] == 1
    assert checks["zero_gradient"] == 0
    assert 0 <= checks["random_search"] <= 1
    assert list(checks["success_by_steps"]) == [3, 9, 30]
    rates = list(checks["success_by_steps"].values())
    assert rates == sorted(rates)
    assert rates[0] == checks["success"] < 1
    assert rates[-1] == 1


def test_a_cost_that_stays_the_same_does_not_count_as_one_that_fell(attacked):
    """No light changes the logits of the classifier."""

    def constant(images: Tensor) -> Tensor:
        nothing = 0 * images.mean((1, 2, 3))
        return torch.stack([nothing + 2, nothing], dim=1)

    classifier = augment.Classifier(constant, 8, ("orange", "other"))
    with pytest.warns(UserWarning, match="classifier callable .* constant scores"):
        result = attacked("lighting", classifier=classifier, max_steps=2)
    checks = augment.check(result)
    assert checks["cost"] == checks["cost_before"]
    assert checks["cost_fell"] == 0
    assert checks["zero_gradient"] == 1


def test_a_success_counts_at_the_very_last_step_and_if_a_margin_sends_it_on(attacked):
    [last] = attacked(SMALL_STEPS, max_steps=60).steps.tolist()
    assert 1 < last < 60
    checks = augment.check(attacked(SMALL_STEPS, max_steps=last, margin=100.0))
    assert checks["success"] == 1
    assert checks["success_by_steps"][last] == 1
    assert augment.check(attacked(SMALL_STEPS, max_steps=last - 1))["success"] == 0


def test_checks_count_the_steps_of_all_starts(attacked):
    step = StepSettings(radius=0.1, step_size=0.01)
    found = augment.check(attacked({"lighting": step}, max_steps=2, restarts=2))
    assert [*found["success_by_steps"]] == [6, 18, 60]
    # Both searches succeed in the first start.
    large = StepSettings(radius=10.0, step_size=1.0)
    found = augment.check(attacked({"lighting": large}, max_steps=100, restarts=10**4))
    assert [*found["success_by_steps"]] == [1_000_100, 3_000_300, 10_001_000]


def test_random_search_that_does_as_well_is_a_warning(attacked):
    """The classifier knows images of almost exactly one brightness alone."""
    brightness = attacked("lighting", max_steps=0).images_before.mean()
    width = 1e-4

    def narrow(images: Tensor) -> Tensor:
        distance = (images.mean((1, 2, 3)) - brightness - width / 2).abs()
        margin = width - distance
        return torch.stack([margin, 0 * margin], dim=1)

    light = {"lighting": StepSettings(radius=0.1)}
    classifier = augment.Classifier(narrow, 8, ("orange", "other"))
    checks = augment.check(attacked(light, classifier=classifier))
    assert checks["success"] == checks["random_search"] == 1
    assert len(warnings(checks)) == 1


@pytest.fixture(scope="module")
def linear(make_scene, make_linear) -> AttackResult:
    """Attack pixels, none of which is clamped, so that logits are linear in what is added."""
    classifier = augment.Classifier(make_linear(2, bias=3.0), 6, ("stone", "other"))
    shown = make_scene()
    shown.objects[0] = replace(shown.objects[0], label="stone")
    pixels = StepSettings("linf", 0.05, "sign", 0.2)
    settings = augment.AttackSettings(pixels=pixels, max_steps=2, margin=0.0, quantized=False)
    return augment.attack(classifier, shown, settings=settings)


def smallest_radii(linear: AttackResult) -> Tensor:
    """Return the radius (E,) of an adversary: the gap falls by at most ε times |w₀ - w₁|₁."""
    weight = linear.classifier.network[1].weight
    gap = linear.logits_before[..., 0] - linear.logits_before[..., 1]
    slope = (weight[0] - weight[1]).abs().sum()
    return (gap / slope).amax(1)


def test_a_ball_holds_an_adversary_from_the_radius_on_at_which_a_linear_classifier_errs(linear):
    needed_radii = smallest_radii(linear)
    scales = []
    for radius in needed_radii.tolist():
        scales += [0.98 * radius / 0.05, 1.02 * radius / 0.05]
    for row in augment.success_by_radius(linear, scales):
        assert torch.equal(row["adversarial"], row["radii"]["pixels"] > needed_radii)


def test_steps_grow_with_the_radius(linear):
    """Two steps of a quarter of the radius lead half as far as the ball reaches."""
    pixels = StepSettings("linf", 0.05, "sign", 0.25 * 0.05)
    half_way = replace(linear, settings=replace(linear.settings, pixels=pixels))
    needed_radii = smallest_radii(linear)
    for radius in needed_radii.tolist():
        scales = [2 * 0.98 * radius / 0.05, 2 * 1.02 * radius / 0.05]
        # The descent within a larger ball begins where that within a smaller one has ended.
        for scale in scales:
            [row] = augment.success_by_radius(half_way, [scale])
            assert torch.equal(row["adversarial"], 0.5 * 0.05 * scale > needed_radii)


def test_larger_balls_hold_the_successes_of_smaller_ones_and_more_than_random_draws_find(linear):
    rows = augment.success_by_radius(linear, [0.3, 0.05, 1.0, 0.1])
    radii = [row["radii"]["pixels"] for row in rows]
    assert radii == pytest.approx([0.0025, 0.005, 0.015, 0.05])
    adversarial = torch.stack([row["adversarial"] for row in rows])
    random = torch.stack([row["random"] for row in rows])
    for success in (adversarial, random):
        assert success.shape == (4, 3)
        assert (success[1:] >= success[:-1]).all()
    assert (adversarial >= random).all()


TWO_VIEWS = {"views": 2, "backgrounds": [0.4]}
BOTH = torch.arange(2)


def network(classes=CHANNELS, size: int = 12) -> augment.Classifier:
    return by_channel(size, classes, f"{classes[0]}{size}")


@pytest.fixture(scope="module")
def result(attacked) -> AttackResult:
    found = attacked("lighting", TWO_VIEWS, network(), max_steps=20)
    assert found.success.all()
    return found


def confidence(logits: Tensor) -> list[list[float]]:
    return [pytest.approx(views, abs=1e-4) for views in logits.softmax(2).amax(2).tolist()]


@pytest.mark.parametrize("parameters", ["lighting", "lighting+geometry+albedo", "pixels"])
def test_the_attacked_network_itself_predicts_the_same(attacked, parameters):
    result = attacked(parameters, TWO_VIEWS, network(), max_steps=20)
    (row,) = augment.transfer(result, [network()])
    chosen = result.success
    assert chosen.any()
    assert row["network"] == "orange12"
    assert all(row["clean_correct"])
    assert all(row["success"])
    assert row["confidence_before"] == confidence(result.logits_in_views_before[chosen])
    assert row["confidence"] == confidence(result.logits_in_views[chosen])


@pytest.fixture(scope="module")
def sky_attack(attacked) -> AttackResult:
    light = {"lighting": StepSettings(step_size=0.2)}
    return attacked(light, {"views": 2}, network(), "sky", max_steps=60)


def test_another_network_gets_a_render_at_its_size_and_has_its_own_order_of_classes(sky_attack):
    other = network(("sky", "orange", "lime"), size=36)
    (row,) = augment.transfer(sky_attack, [other])
    assert row["predicted"] == [["sky"]] * 2
    assert all(row["clean_correct"])
    assert all(row["success"])
    scene = sky_attack.problem.scene
    backgrounds = scene.backgrounds[..., :1, :1].expand(-1, -1, 36, 36)
    settings = replace(scene.settings, size=36)
    finer = scene.changed(settings=settings, backgrounds=backgrounds)
    images = finer.render(sky_attack.conditions, BOTH)
    assert row["confidence"] == confidence(other(images[:, 0])[:, None])


def test_the_index_of_a_label_belongs_to_the_attacked_network():
    scene = augment.build_scene([("solid:orange", 0)], 12)
    settings = augment.AttackSettings(lighting=StepSettings(step_size=0.2), max_steps=60)
    result = augment.attack(network(), scene, settings=settings)
    (row,) = augment.transfer(result, [network(("sky", "orange", "lime"))])
    assert row["predicted_before"] == [["orange"]]
    assert row["clean_correct"] == [True]


def test_a_network_without_the_target_class_is_refused(sky_attack):
    with pytest.raises(InputError, match="'sky'"):
        augment.transfer(sky_attack, [network(("orange", "lime"))])


def test_a_transfer_is_to_a_scene_with_turned_cameras_or_with_another_mesh(result):
    """The apple has the label lime, but not its color."""
    objects = augment.build_scene([("solid:apple", "lime")], 12).objects
    turned_row, row = augment.transfer(result, azimuths=[-30.0], objects=objects)
    assert turned_row["azimuth"] == "-30°"
    assert row["mesh"] == "solid:apple"
    assert not any(row["clean_correct"])
    scene = result.problem.scene
    turned = []
    for example in scene.examples:
        [camera] = example.cameras
        camera = replace(camera, azimuth=camera.azimuth - 30)
        turned.append(replace(example, cameras=(camera,)))
    scenes = scene.changed(examples=turned), scene.changed(objects=objects)
    for shown, found in zip(scenes, (turned_row, row), strict=True):
        images = shown.render(result.conditions, BOTH)
        assert found["confidence"] == confidence(network()(images[:, 0])[:, None])


def test_only_clean_correct_examples_are_transferred(result):
    logits_before = result.logits_in_views_before.clone()
    logits_before[0] *= -1  # The first example becomes misclassified.
    (row,) = augment.transfer(replace(result, evidence_in_views_before=logits_before), [network()])
    assert row["confidence"] == confidence(result.logits_in_views[1:])
    nothing = replace(result, evidence_in_views_before=-result.logits_in_views_before)
    (row,) = augment.transfer(nothing, [network()])
    assert row["confidence"] == row["success"] == []
