from dataclasses import replace

import pytest
import torch

import augment
from augment.attacks.attack import AttackResult, AttackSettings
from augment.attacks.norm_ball import StepSettings

SCALES = [0.3, 0.05, 1.0, 0.1]


@pytest.fixture
def attacked(make_scene, make_linear) -> AttackResult:
    """Three examples of pixels, whose logits are linear in what is added: class 0 against 1, far from any clamp."""
    classifier = augment.Classifier(make_linear(2, bias=3.0), 6, ("stone", "other"))
    shown = make_scene()
    shown.objects[0] = replace(shown.objects[0], label="stone")
    settings = AttackSettings(pixels=StepSettings("linf", 0.05, "sign", 0.2), max_steps=2, margin=0.0, rounded=False)
    return augment.attack(classifier, shown, settings=settings)


def test_a_ball_fools_from_the_radius_on_at_which_a_linear_classifier_gives_way(attacked):
    """By hand: within L∞ of ε, the gap of two logits w₀, w₁ falls by ε |w₀ - w₁|₁ at most."""
    weight = attacked.classifier.function[1].weight
    most = (weight[0] - weight[1]).abs().sum()
    gap = attacked.logits_before[..., 0] - attacked.logits_before[..., 1]
    needed = (gap / most).amax(1)  # of the worse of two views, each of which has pixels of its own
    scales = [factor * float(radius) / 0.05 for radius in needed for factor in (0.98, 1.02)]
    found = augment.success_by_radius(attacked, scales)
    radii = torch.tensor([each["pixels"] for each in found.radii], dtype=needed.dtype)
    assert torch.equal(radii, radii.sort().values)
    assert torch.equal(found.adversarial, radii[:, None] > needed)


def test_larger_balls_hold_what_smaller_ones_do_and_more_than_random_draws_find(attacked):
    found = augment.success_by_radius(attacked, SCALES)
    assert [each["pixels"] for each in found.radii] == pytest.approx([0.05 * scale for scale in sorted(SCALES)])
    for method in (found.adversarial, found.random):
        assert method.shape == (4, 3) and (method[1:] >= method[:-1]).all()
    assert (found.adversarial >= found.random).all()
    again = augment.success_by_radius(attacked, SCALES)
    assert torch.equal(again.random, found.random) and torch.equal(again.adversarial, found.adversarial)


def test_radii_are_scaled_and_those_without_are_the_scale(attacked):
    kinds = {"lighting": StepSettings(), "pixels": StepSettings("linf", 0.002)}
    both = augment.attack(attacked.classifier, attacked.problem.scene, settings=AttackSettings(**kinds, max_steps=1))
    assert augment.success_by_radius(both, [0.5]).radii == [{"lighting": 0.5, "pixels": 0.001}]
