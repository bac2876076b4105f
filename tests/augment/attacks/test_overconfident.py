"""Attacks on networks whose logits are multiplied by a factor succeed in the same views."""

import pytest
import torch

import norm_balls as nb

VIEWS = 8


def attack(factor: float, optimizer: str, dtype: torch.dtype = torch.float32) -> nb.AttackResult:
    """Attack pretrained/none, whose logits are multiplied by a factor, in eight views."""
    network = nb.load("none")
    inner = network.function.to(dtype)

    def logits(images: torch.Tensor) -> torch.Tensor:
        return factor * inner(images.to(dtype))

    classifier = nb.Classifier(logits, network.size, network.classes)
    scene = nb.build_scene([("solid:orange:1", "orange")], network.size, views=VIEWS)
    queries = None if optimizer == "gradient" else 150
    settings = nb.AttackSettings(
        optimizer=optimizer, max_queries=queries, lighting=nb.StepSettings(radius=0.3)
    )
    return nb.attack(classifier, scene, settings=settings, force=True)


@pytest.mark.parametrize(
    "optimizer",
    [
        "gradient",
        pytest.param("random_search", marks=pytest.mark.slow),
        pytest.param("cma_es", marks=pytest.mark.slow),
    ],
)
def test_an_attack_succeeds_in_the_same_views_for_each_factor_of_the_logits(optimizer):
    if optimizer == "cma_es":
        pytest.importorskip("cma")
    expected = attack(1, optimizer).success
    for factor in (100, 1e4):
        found = attack(factor, optimizer).success
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
    assert not result.descent.zero_gradient.any()
    assert result.descent.cost < result.descent.cost_before
