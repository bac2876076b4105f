import numpy as np
import pytest
import torch
from scipy.special import log_softmax, logit, rel_entr, softmax

from augment.losses import (
    NO_CLASS,
    adversarial_cost,
    complementary_label,
    is_correct,
    kl_divergence,
    label_loss,
    log_odds,
    ranking_loss,
)

EPS = torch.finfo(torch.float64).eps
LOGITS = 3 * torch.randn(6, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
CLASSES = torch.tensor([0, 1, 2, 3, 4, 0])
EXCLUDED = torch.tensor([complementary_label(label) for label in CLASSES.tolist()])


def test_a_complementary_label_costs_the_negative_log_probability_of_all_other_classes():
    others = 1 - softmax(LOGITS.numpy(), axis=1)[range(6), CLASSES]
    torch.testing.assert_close(
        label_loss(LOGITS, EXCLUDED), -torch.from_numpy(others).log(), rtol=0, atol=32 * EPS
    )
    smoothed = label_loss(LOGITS, EXCLUDED, label_smoothing=0.1)
    torch.testing.assert_close(smoothed, label_loss(LOGITS, EXCLUDED), rtol=0, atol=0)


def test_a_class_costs_the_cross_entropy_in_a_batch_with_complementary_labels():
    mixed = torch.where(torch.arange(6) % 2 == 0, CLASSES, EXCLUDED)
    expected = -torch.from_numpy(log_softmax(LOGITS.numpy(), axis=1))[torch.arange(6), CLASSES]
    torch.testing.assert_close(
        label_loss(LOGITS, mixed)[::2], expected[::2], rtol=16 * EPS, atol=16 * EPS
    )


def test_a_complementary_label_leaves_out_the_other_classes_under_study_too_and_changes_no_other_loss():
    expected = -np.log1p(-softmax(LOGITS.numpy(), axis=1)[:, [1, 4]].sum(1))
    labels = torch.full((6,), complementary_label(1))
    torch.testing.assert_close(label_loss(LOGITS, labels, absent=[4]), torch.from_numpy(expected))
    assert torch.equal(label_loss(LOGITS, CLASSES, absent=[4]), label_loss(LOGITS, CLASSES))
    assert is_correct(torch.arange(5), torch.full((5,), complementary_label(1)), [4]).tolist() == [
        1,
        0,
        1,
        1,
        0,
    ]
    assert is_correct(torch.arange(5), torch.full((5,), 4), [4]).tolist() == [0, 0, 0, 0, 1]


def test_the_gradient_is_exact_and_finite_where_the_excluded_class_is_certain():
    assert torch.autograd.gradcheck(
        lambda logits: label_loss(logits, EXCLUDED), LOGITS.clone().requires_grad_(True)
    )
    certain = torch.tensor([[100.0, 0.0, 0.0]], requires_grad=True)
    label_loss(certain, torch.tensor([complementary_label(0)])).sum().backward()
    torch.testing.assert_close(certain.grad, torch.tensor([[1.0, -0.5, -0.5]]))


@pytest.mark.parametrize(
    ("predicted", "label", "right"), [(2, 2, True), (1, 2, False), (2, -3, False), (0, -3, True)]
)
def test_a_class_is_right_for_its_label_and_for_complementary_labels_of_others(
    predicted, label, right
):
    assert is_correct(torch.tensor([predicted]), torch.tensor([label])).tolist() == [right]


def test_log_odds_are_the_logit_of_the_probability():
    expected = logit(softmax(LOGITS.numpy(), axis=1)[:, 2])
    torch.testing.assert_close(
        log_odds(LOGITS, 2), torch.from_numpy(expected), rtol=64 * EPS, atol=64 * EPS
    )


def test_divergence_is_the_relative_entropy_of_the_predictions():
    predictions = LOGITS.flip(0) / 2
    expected = rel_entr(softmax(predictions.numpy(), axis=1), softmax(LOGITS.numpy(), axis=1)).sum(
        1
    )
    close = {"rtol": 64 * EPS, "atol": 64 * EPS}
    torch.testing.assert_close(
        kl_divergence(LOGITS, predictions), torch.from_numpy(expected), **close
    )


def test_ranking_is_the_mean_logistic_loss_of_all_pairs_of_the_class_and_another():
    labels = torch.tensor([2, 0, complementary_label(2), 2, complementary_label(2), 4])
    odds = log_odds(LOGITS, 2).numpy()
    pairs = [np.log1p(np.exp(odds[other] - odds[own])) for own in (0, 3) for other in (1, 2, 4, 5)]
    assert float(ranking_loss(LOGITS, labels, 2)) == pytest.approx(np.mean(pairs), rel=64 * EPS)


def test_ranking_is_zero_with_a_zero_gradient_without_a_pair():
    logits = LOGITS.clone().requires_grad_(True)
    for labels in (torch.full((6,), 2), torch.full((6,), complementary_label(2))):
        loss = ranking_loss(logits, labels, 2)
        loss.backward()
        assert loss == 0 and not logits.grad.any()


def test_the_cost_is_the_log_probability_of_the_right_class_less_that_of_the_target():
    """With a target the normalization cancels: the cost is the difference of the logits."""
    rows, target = torch.arange(6), (CLASSES + 2) % 5
    expected = torch.from_numpy(log_softmax(LOGITS.numpy(), axis=1))[rows, CLASSES]
    torch.testing.assert_close(
        adversarial_cost(LOGITS, CLASSES), expected, rtol=16 * EPS, atol=16 * EPS
    )
    difference = LOGITS[rows, CLASSES] - LOGITS[rows, target]
    torch.testing.assert_close(
        adversarial_cost(LOGITS, CLASSES, target), difference, rtol=0, atol=64 * EPS
    )
    nothing = torch.full_like(target, NO_CLASS)
    assert NO_CLASS not in EXCLUDED and not adversarial_cost(LOGITS, nothing, nothing).any()
