"""Losses: the cost that an attack decreases, and the losses of training.

A label is the index of a class. A complementary label says that an image does not show a class. It
is written as −1 − class. If there are several positive classes, `absent` contains the other classes
that images with a complementary label do not show, either.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.errors import require_range

# Stands for "no class" as a source or target. No complementary label has this value.
NO_CLASS = -(10**9)


def adversarial_cost(logits: Tensor, source: Tensor, target: Tensor | None = None) -> Tensor:
    """Compute the cost that an attack decreases.

    It is −CE(logits, source) + CE(logits, target), equation 1 of the paper, where CE is the cross
    entropy.

    Args:
        logits: The logits of N images, shape (N, classes).
        source: The class that each image is led away from, int64, shape (N,). NO_CLASS leaves the
            first term out.
        target: The class that each image is led to, int64, shape (N,). NO_CLASS leaves the second
            term out, and so does None for all images.

    Returns:
        The cost of each image, shape (N,).

    Raises:
        InputError: If a source class has no logit.
    """
    # NO_CLASS is negative. `clamp` turns it into class 0, which passes the check.
    require_known(source.clamp(min=0), logits)
    cost = -F.cross_entropy(logits, source, reduction="none", ignore_index=NO_CLASS)
    if target is not None:
        cost = cost + F.cross_entropy(logits, target, reduction="none", ignore_index=NO_CLASS)
    return cost


def logit_gap(logits: Tensor, source: Tensor, target: Tensor | None = None) -> Tensor:
    """Compute by how much an attack's criterion is reached.

    Args:
        logits: The logits, shape (..., classes).
        source: The class to lead away from, shape (...).
        target: The class to lead to, shape (...). NO_CLASS or None is no target.

    Returns:
        The lead of the target's logit over all others. Without a target, the lead of the best
        other class over the source. It is negative if the criterion is not reached. Shape (...).
    """
    wanted = torch.full_like(source, NO_CLASS) if target is None else target
    has_no_target = wanted == NO_CLASS
    # The target if there is one, or else the source, shape (..., 1).
    compared_class = torch.where(has_no_target, source, wanted)[..., None]
    best_of_others = logits.scatter(-1, compared_class, -torch.inf).amax(-1)
    # Lead of the compared class. An attack without a target wants the source not to lead.
    lead = logits.gather(-1, compared_class)[..., 0] - best_of_others
    return torch.where(has_no_target, -lead, lead)


def complementary_label(label: int) -> int:
    """Return the complementary label of a class.

    Args:
        label: The class that it does not show.

    Returns:
        The complementary label, −1 − label.
    """
    return -1 - label


def require_known(labels: Tensor, logits: Tensor) -> None:
    """Check that every label has a logit.

    Args:
        labels: The labels, int64, shape (N,).
        logits: The logits, shape (N, classes).

    Raises:
        InputError: If a label is of a class beyond those of the logits.
    """
    require_range("label", int(_class_of(labels).amax()), 0, logits.shape[1] - 1)


def label_loss(
    logits: Tensor,
    labels: Tensor,
    label_smoothing: float = 0.0,
    absent: Sequence[int] = (),
) -> Tensor:
    """Compute the loss of each image by its label.

    The loss is the cross entropy for a class c. For a label that is complementary to c, it is
    −log(1 − p), where p is the sum of the probabilities of c and of the classes `absent`.

    Args:
        logits: The logits, shape (N, classes).
        labels: The labels, int64, shape (N,).
        label_smoothing: The label smoothing of the cross entropy, at least 0 and below 1.
        absent: Further classes that images of a complementary label do not show.

    Returns:
        The losses, shape (N,).
    """
    classes = _class_of(labels)[:, None]
    # A logit of -∞ is a probability of 0, so these logits leave out the classes that an image
    # with a complementary label does not show.
    logits_of_others = logits.scatter(1, classes, -torch.inf)
    for index in absent:
        logits_of_others[:, index] = -torch.inf
    # This is -log(1 - p), where 1 - p is the sum of the probabilities of the other classes.
    complementary = logits.logsumexp(1) - logits_of_others.logsumexp(1)
    cross_entropy = F.cross_entropy(
        logits, classes[:, 0], reduction="none", label_smoothing=label_smoothing
    )
    return torch.where(labels < 0, complementary, cross_entropy)


def log_odds(logits: Tensor, label: int) -> Tensor:
    """Compute the log-odds of a class, log(p / (1 − p)), where p is its probability.

    The result is finite even if p rounds to 0 or 1.

    Args:
        logits: The logits, shape (N, classes).
        label: The class.

    Returns:
        The log-odds, shape (N,).
    """
    others = torch.cat([logits[:, :label], logits[:, label + 1 :]], dim=1)
    return logits[:, label] - others.logsumexp(dim=1)


def ranking_loss(logits: Tensor, labels: Tensor, label: int) -> Tensor:
    """Compute the loss of ranking the images of a class before all others.

    It is the mean of log(1 + exp(o − p)) over all pairs of an image of the class, with log-odds
    p, and another image, with log-odds o. It is a smooth upper bound of 1 − AUC, up to a factor
    (RankNet, Burges et al. 2005).

    Args:
        logits: The logits, shape (N, classes).
        labels: The labels, int64, shape (N,).
        label: The class.

    Returns:
        The loss, a scalar. It is 0 if there is no pair.
    """
    odds = log_odds(logits, label)
    is_of_class = labels == label
    # The first axis is the image of the class, and the second the other image, shape (N, N).
    is_pair = is_of_class[:, None] & ~is_of_class
    losses = F.softplus(odds - odds[:, None]) * is_pair
    return losses.sum() / is_pair.sum().clamp(min=1)


def kl_divergence(logits: Tensor, predictions: Tensor) -> Tensor:
    """Compute the divergence of a network's predictions from the predictions of another network.

    This is the Kullback–Leibler divergence Σ q log(q / p) of the probabilities p of the network
    from the probabilities q of the other one: the loss of distillation (Hinton et al. 2015) at
    temperature 1.

    Args:
        logits: The logits of the network, shape (N, classes).
        predictions: The logits of the other network, shape (N, classes).

    Returns:
        The divergence of each image, shape (N,).
    """
    terms = F.kl_div(
        logits.log_softmax(1), predictions.log_softmax(1), reduction="none", log_target=True
    )
    return terms.sum(1)


def is_correct(predicted: Tensor, labels: Tensor, absent: Sequence[int] = ()) -> Tensor:
    """Return a mask of the predictions that agree with the labels.

    A prediction agrees with a complementary label if it is another class than the one that the
    image does not show, and none of the classes `absent`.

    Args:
        predicted: The predicted classes, int64, shape (N,).
        labels: The labels, int64, shape (N,).
        absent: Further classes that images of a complementary label do not show.

    Returns:
        Mask of the predictions, bool, shape (N,).
    """
    is_complementary = labels < 0
    # For a complementary label, a prediction of its class is wrong instead of right.
    right = (predicted == _class_of(labels)) != is_complementary
    for index in absent:
        right = right & (~is_complementary | (predicted != index))
    return right


def _class_of(labels: Tensor) -> Tensor:
    """Return the class of each label. A complementary label gives the class that is not shown."""
    return torch.where(labels < 0, -1 - labels, labels)
