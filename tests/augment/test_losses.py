"""Losses, costs and labels agree with scipy's softmax and with formulas."""

import numpy as np
import pytest
import torch
from scipy.special import log_softmax, logit, rel_entr, softmax

from augment.attacks.objective import (
    NO_CLASS,
    adversarial_cost,
    complementary_label,
    is_correct,
    label_loss,
    logit_gap,
)
from augment.classifier import log_odds
from train.training.recipe import kl_divergence, ranking_loss

EPS = torch.finfo(torch.float64).eps
ROWS = torch.arange(6)
LOGITS = 3 * torch.randn(6, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
CLASSES = torch.tensor([0, 1, 2, 3, 4, 0])
EXCLUDED = torch.tensor([complementary_label(label) for label in CLASSES.tolist()])
LOG_PROBABILITIES = torch.from_numpy(log_softmax(LOGITS.numpy(), axis=1))
PROBABILITIES = softmax(LOGITS.numpy(), axis=1)


def test_a_complementary_label_costs_the_negative_log_probability_of_all_other_classes():
    others = 1 - PROBABILITIES[ROWS, CLASSES]
    expected = -torch.from_numpy(others).log()
    loss = label_loss(LOGITS, EXCLUDED)
    torch.testing.assert_close(loss, expected, rtol=0, atol=32 * EPS)


@pytest.mark.parametrize("gap", [0, 5, 17, 30, 48])
def test_the_gradient_in_float32_is_exact_if_the_network_is_certain(gap):
    logits = torch.tensor([[0.5, 2.0 + gap, 2.0, 0.0]], requires_grad=True)
    probabilities = torch.from_numpy(softmax(logits.detach().double().numpy(), axis=1))
    # The gradient of log p is onehot − softmax. Float64 rounds 1 − p to 0 at a gap of 48, but not
    # the equal sum of the other probabilities.
    expected = -probabilities
    expected[0, 1] = probabilities[0, [0, 2, 3]].sum()
    adversarial_cost(logits, torch.tensor([1]), torch.tensor([NO_CLASS])).sum().backward()
    # The difference of two logits has an error of up to 50 / 2 · ε, which the exponential keeps.
    rtol = 50 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(logits.grad.double(), expected, rtol=rtol, atol=0)


@pytest.mark.parametrize("factor", [100, 1e4])
def test_the_gradient_of_an_overconfident_network_is_that_of_its_log_odds(factor):
    """The other class of the largest logit has all probability that the source does not have."""
    logits = factor * torch.tensor([[0.5, 4.0, 2.0, 0.0]])
    logits.requires_grad_(True)
    adversarial_cost(logits, torch.tensor([1])).sum().backward()
    assert logits.grad.tolist() == [[0.0, 1.0, -1.0, 0.0]]


def test_the_cost_grows_with_the_log_odds_on_both_sides_of_50():
    odds = torch.tensor([40.0, 49.9, 50.0, 50.1, 104.0, 1e5])
    logits = torch.stack([odds, torch.zeros_like(odds)], dim=1)
    cost = adversarial_cost(logits, torch.zeros(len(odds), dtype=torch.int64))
    assert (cost.diff() > 0).all()
    torch.testing.assert_close(cost[:3], torch.nn.functional.logsigmoid(odds[:3]), rtol=0, atol=0)


def test_a_class_costs_the_cross_entropy_in_a_batch_with_complementary_labels():
    is_class = ROWS % 2 == 0
    mixed = torch.where(is_class, CLASSES, EXCLUDED)
    loss = label_loss(LOGITS, mixed)[is_class]
    expected = -LOG_PROBABILITIES[ROWS, CLASSES][is_class]
    torch.testing.assert_close(loss, expected, rtol=16 * EPS, atol=16 * EPS)


def test_a_complementary_label_excludes_the_other_studied_classes_too():
    labels = torch.full((6,), complementary_label(1))
    excluded = PROBABILITIES[:, [1, 4]].sum(1)
    expected = torch.from_numpy(-np.log1p(-excluded))
    torch.testing.assert_close(label_loss(LOGITS, labels, absent=[4]), expected)
    predicted = torch.arange(5)
    of_all = torch.full((5,), complementary_label(1))
    assert is_correct(predicted, of_all, [4]).tolist() == [True, False, True, True, False]


def test_the_gap_of_a_target_is_its_lead_and_without_one_that_of_the_best_other_class():
    logits = torch.tensor([[3.0, 1.0, 2.0], [3.0, 1.0, 2.0], [0.0, 4.0, 1.5]])
    source = torch.tensor([1, 0, 1])
    target = torch.tensor([0, 2, NO_CLASS])
    assert logit_gap(logits, source, target).tolist() == [1.0, -1.0, -2.5]
    assert logit_gap(logits, source).tolist() == [2.0, -1.0, -2.5]


def test_the_gradient_is_finite_if_the_excluded_class_is_certain():
    certain = torch.tensor([[100.0, 0.0, 0.0]], requires_grad=True)
    label_loss(certain, torch.tensor([complementary_label(0)])).sum().backward()
    torch.testing.assert_close(certain.grad, torch.tensor([[1.0, -0.5, -0.5]]))


@pytest.mark.parametrize(
    ("predicted", "label", "right"),
    [
        (2, 2, True),
        (1, 2, False),
        (2, complementary_label(2), False),
        (0, complementary_label(2), True),
    ],
)
def test_a_class_is_right_for_its_label_and_for_complementary_labels_of_others(
    predicted, label, right
):
    assert is_correct(torch.tensor([predicted]), torch.tensor([label])).tolist() == [right]


def test_log_odds_are_the_logit_of_the_probability():
    expected = torch.from_numpy(logit(PROBABILITIES[:, 2]))
    torch.testing.assert_close(log_odds(LOGITS, 2), expected, rtol=64 * EPS, atol=64 * EPS)


def test_divergence_is_the_relative_entropy_of_the_predictions():
    predictions = LOGITS.flip(0) / 2
    terms = rel_entr(softmax(predictions.numpy(), axis=1), PROBABILITIES)
    expected = torch.from_numpy(terms.sum(1))
    found = kl_divergence(LOGITS, predictions)
    torch.testing.assert_close(found, expected, rtol=64 * EPS, atol=64 * EPS)


def test_ranking_is_the_mean_logistic_loss_of_all_pairs_of_the_class_and_another():
    other = complementary_label(2)
    labels = torch.tensor([2, 0, other, 2, other, 4])
    odds = log_odds(LOGITS, 2).numpy()
    pairs = []
    for positive in (0, 3):
        for negative in (1, 2, 4, 5):
            pairs.append(np.log1p(np.exp(odds[negative] - odds[positive])))
    loss = float(ranking_loss(LOGITS, labels, 2))
    assert loss == pytest.approx(np.mean(pairs), rel=64 * EPS)


@pytest.mark.parametrize("label", [2, complementary_label(2)])
def test_ranking_without_a_pair_is_zero_with_a_zero_gradient(label):
    logits = LOGITS.clone().requires_grad_(True)
    loss = ranking_loss(logits, torch.full((6,), label), 2)
    loss.backward()
    assert loss == 0
    assert not logits.grad.any()


def test_without_a_target_the_cost_is_the_log_probability_of_the_right_class():
    expected = LOG_PROBABILITIES[ROWS, CLASSES]
    cost = adversarial_cost(LOGITS, CLASSES)
    torch.testing.assert_close(cost, expected, rtol=16 * EPS, atol=16 * EPS)


def test_with_a_target_the_cost_is_the_difference_of_the_logits():
    target = (CLASSES + 2) % 5
    expected = LOGITS[ROWS, CLASSES] - LOGITS[ROWS, target]
    cost = adversarial_cost(LOGITS, CLASSES, target)
    torch.testing.assert_close(cost, expected, rtol=0, atol=64 * EPS)


def test_the_cost_without_any_class_is_zero():
    nothing = torch.full_like(CLASSES, NO_CLASS)
    assert NO_CLASS not in EXCLUDED
    assert not adversarial_cost(LOGITS, nothing, nothing).any()
