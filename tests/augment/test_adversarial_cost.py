import numpy as np
import torch
from scipy.special import log_softmax

from augment.losses import adversarial_cost

EPS = torch.finfo(torch.float64).eps
LOGITS = torch.from_numpy(np.random.default_rng(0).normal(0, 5, (20, 7)))
TRUE, TARGET = torch.arange(20) % 7, (3 * torch.arange(20) + 1) % 7


def log_probability(classes: torch.Tensor) -> np.ndarray:
    return log_softmax(LOGITS.numpy(), axis=1)[np.arange(20), classes]


def test_without_a_target_the_cost_is_the_log_probability_of_the_true_class():
    np.testing.assert_allclose(adversarial_cost(LOGITS, TRUE), log_probability(TRUE), rtol=16 * EPS, atol=16 * EPS)


def test_with_a_target_the_cost_is_the_difference_of_the_log_probabilities():
    """In which the normalization cancels: the difference of the logits."""
    cost = adversarial_cost(LOGITS, TRUE, TARGET)
    np.testing.assert_allclose(cost, log_probability(TRUE) - log_probability(TARGET), rtol=0, atol=64 * EPS)
    rows = torch.arange(20)
    torch.testing.assert_close(cost, LOGITS[rows, TRUE] - LOGITS[rows, TARGET], rtol=0, atol=64 * EPS)


def test_descent_lowers_the_decreased_class_and_raises_the_increased_one():
    logits = LOGITS.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(adversarial_cost(logits, TRUE, TARGET).sum(), logits)
    rows = torch.arange(20)
    different = TRUE != TARGET
    assert (gradient[rows, TRUE][different] > 0).all() and (gradient[rows, TARGET][different] < 0).all()
