"""Attacks on networks whose logits are multiplied by a factor succeed in the same views."""

import pytest
import torch

import norm_balls as nb

VIEWS = 3
# Radius at which attacks with each optimizer succeed in some views and fail in others.
RADIUS = 0.08


@pytest.fixture(scope="module")
def network() -> nb.Classifier:
    return nb.load("none")


@pytest.fixture(scope="module")
def scene(network) -> nb.Scene:
    options = {"views": VIEWS, "samples": 1}
    return nb.build_scene([("solid:orange:7", "orange")], network.size, **options)


def attack(network, scene, factor, optimizer) -> nb.AttackResult:
    def logits(images: torch.Tensor) -> torch.Tensor:
        return factor * network.network(images)

    classifier = nb.Classifier(logits, network.size, network.classes)
    settings = nb.AttackSettings(
        optimizer=optimizer,
        max_steps=6,
        max_queries=None if optimizer == "gradient" else 60,
        allow_negative=True,  # Without the projection, the test takes less time.
        lighting=nb.StepSettings(radius=RADIUS),
    )
    return nb.attack(classifier, scene, settings=settings)


SEARCHES = [pytest.param(each, marks=pytest.mark.slow) for each in ("random_search", "cma_es")]


@pytest.mark.parametrize("optimizer", ["gradient", *SEARCHES])
def test_an_attack_succeeds_in_the_same_views_if_logits_are_multiplied(network, scene, optimizer):
    result = attack(network, scene, 1, optimizer)
    expected = result.success
    # All views can be attacked, and the radius separates them.
    assert result.clean_correct.all()
    assert 2 <= int(expected.sum()) <= VIEWS - 1
    found = attack(network, scene, 1e4, optimizer).success
    assert int((found ^ expected).sum()) <= 1


def test_a_network_of_half_precision_has_a_gradient_where_it_is_certain():
    """At log-odds of 30, the gradient by the logits is 1e-13, which is 0 in half precision."""

    def logits(images: torch.Tensor) -> torch.Tensor:
        brightness = images.half().mean((1, 2, 3))
        return torch.stack([60 * brightness, 0 * brightness], dim=1)

    classifier = nb.Classifier(logits, 8, ["orange", "other"])
    scene = nb.build_scene([("solid:orange", "orange")], 8, backgrounds=[0.7])
    settings = nb.AttackSettings(lighting=nb.StepSettings(step_size=0.1), max_steps=1)
    result = nb.attack(classifier, scene, settings=settings)
    assert result.logits_before[0, 0] > 20
    assert not result.minimum.zero_gradient.any()
    assert result.minimum.cost < result.minimum.cost_before
