"""Losses: the cost that an attack decreases, and those of training.

A label is a class, or any class but one (a complementary label), written −1 − class. Where several classes are under
study, `absent` holds the others that images of a complementary label do not show, either.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.errors import require_range

NO_CLASS = -(10**9)  # in place of a source or target class, where there is none; no complementary label


def adversarial_cost(logits: Tensor, source: Tensor, target: Tensor | None = None) -> Tensor:
    """−CE(logits, source) + CE(logits, target) per image, the paper's equation 1, which an attack decreases; (N,).

    logits: (N, classes). source, target: (N,) int64; None leaves the second term out, and NO_CLASS in either its own.
    InputError: a class without a logit.
    """
    require_known(source.clamp(min=0), logits)  # NO_CLASS passes
    cost = -F.cross_entropy(logits, source, reduction="none", ignore_index=NO_CLASS)
    if target is not None:
        cost = cost + F.cross_entropy(logits, target, reduction="none", ignore_index=NO_CLASS)
    return cost


def logit_gap(logits: Tensor, source: Tensor, target: Tensor | None = None) -> Tensor:
    """The lead (...) of the target's logit over all others or, without a target, of the best other class over the
    source; negative where the goal is not reached. logits: (..., C)."""
    wanted = torch.full_like(source, NO_CLASS) if target is None else target
    chosen = torch.where(wanted == NO_CLASS, source, wanted)[..., None]
    gap = logits.gather(-1, chosen)[..., 0] - logits.scatter(-1, chosen, -torch.inf).amax(-1)
    return torch.where(wanted == NO_CLASS, -gap, gap)


def complementary_label(label: int) -> int:
    """The label of an image that shows no class of the classifier, and in particular not this one."""
    return -1 - label


def require_known(labels: Tensor, logits: Tensor) -> None:
    """InputError for a label of a class beyond those of logits (N, classes)."""
    require_range("label", int(_class_of(labels).amax()), 0, logits.shape[1] - 1)


def label_loss(logits: Tensor, labels: Tensor, label_smoothing: float = 0.0, absent: Sequence[int] = ()) -> Tensor:
    """(N,) cross entropy where a label is a class c, and −log(1 − p_c) where it is complementary to c; with p_c and the
    probabilities of `absent` added.

    logits: (N, classes). labels: (N,) int64. label_smoothing: of the cross entropy alone.
    """
    classes = _class_of(labels)[:, None]
    others = logits.scatter(1, classes, -torch.inf)
    for index in absent:
        others[:, index] = -torch.inf
    complementary = logits.logsumexp(1) - others.logsumexp(1)
    entropy = F.cross_entropy(logits, classes[:, 0], reduction="none", label_smoothing=label_smoothing)
    return torch.where(labels < 0, complementary, entropy)


def log_odds(logits: Tensor, label: int) -> Tensor:
    """log p / (1 − p) of a class, (N,), from logits (N, classes): finite even where p rounds to 0 or 1."""
    others = torch.cat([logits[:, :label], logits[:, label + 1 :]], dim=1)
    return logits[:, label] - others.logsumexp(dim=1)


def ranking_loss(logits: Tensor, labels: Tensor, label: int) -> Tensor:
    """Mean of log(1 + e^(o − p)) over all pairs of an image of the class, with log-odds p, and another image, with
    log-odds o; 0 without a pair.

    A smooth bound of 1 − AUC (RankNet, Burges et al. 2005). logits: (N, classes). labels: (N,) int64.
    """
    odds = log_odds(logits, label)
    pairs = (labels == label)[:, None] & (labels != label)
    return (F.softplus(odds - odds[:, None]) * pairs).sum() / pairs.sum().clamp(min=1)


def divergence(logits: Tensor, predictions: Tensor) -> Tensor:
    """(N,) Kullback–Leibler divergence Σ q log(q / p) of a network's probabilities p from another's q, by the logits
    (N, classes) of both: the loss of distillation (Hinton et al. 2015, at temperature 1)."""
    return F.kl_div(logits.log_softmax(1), predictions.log_softmax(1), reduction="none", log_target=True).sum(1)


def is_right(predicted: Tensor, labels: Tensor, absent: Sequence[int] = ()) -> Tensor:
    """Whether classes agree with labels, both (N,) int64; boolean."""
    right = (predicted == _class_of(labels)) != (labels < 0)
    for index in absent:
        right = right & ((labels >= 0) | (predicted != index))
    return right


def _class_of(labels: Tensor) -> Tensor:
    return torch.where(labels < 0, -1 - labels, labels)
