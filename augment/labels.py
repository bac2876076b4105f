"""Labels of examples: a class, or "anything but" a class, which is written −1 − class."""

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.errors import require_range


def complementary_label(label: int) -> int:
    """The label of what is of no class that the classifier knows, and in particular not of this one."""
    return -1 - label


def require_known(labels: Tensor, logits: Tensor) -> None:
    """InputError for a label of a class beyond those of logits (N, classes)."""
    require_range("label", int(_subject(labels).amax()), 0, logits.shape[1] - 1)


def label_loss(logits: Tensor, labels: Tensor, label_smoothing: float = 0.0) -> Tensor:
    """(N,) cross entropy where a label is a class c, and −log(1 − p_c) where it is anything but c.

    logits: (N, classes). labels: (N,) int64. label_smoothing: of the cross entropy alone.
    """
    subject = _subject(labels)[:, None]
    others = logits.scatter(1, subject, -torch.inf)
    denial = logits.logsumexp(1) - others.logsumexp(1)
    entropy = F.cross_entropy(logits, subject[:, 0], reduction="none", label_smoothing=label_smoothing)
    return torch.where(labels < 0, denial, entropy)


def log_odds(logits: Tensor, label: int) -> Tensor:
    """log p / (1 − p) of a class, (N,), from logits (N, classes): finite also where p rounds to 0 or 1."""
    others = torch.cat([logits[:, :label], logits[:, label + 1 :]], dim=1)
    return logits[:, label] - others.logsumexp(dim=1)


def ranking_loss(logits: Tensor, labels: Tensor, label: int) -> Tensor:
    """How far images of a class are from standing above all others in its log-odds: the mean of log(1 + e^(o − p)) over
    the pairs of an image of the class, of log-odds p, and one of none, of log-odds o; 0 without a pair.

    A smooth bound of 1 − AUC (RankNet, Burges et al. 2005). logits: (N, classes). labels: (N,) int64.
    """
    odds = log_odds(logits, label)
    pairs = (labels == label)[:, None] & (labels != label)
    return (F.softplus(odds - odds[:, None]) * pairs).sum() / pairs.sum().clamp(min=1)


def divergence(logits: Tensor, predictions: Tensor) -> Tensor:
    """(N,) Kullback–Leibler divergence Σ q log(q / p) of a network's probabilities p from another's q, by their logits
    (N, classes): what distillation lessens (Hinton et al. 2015, at temperature 1)."""
    return F.kl_div(logits.log_softmax(1), predictions.log_softmax(1), reduction="none", log_target=True).sum(1)


def is_right(predicted: Tensor, labels: Tensor) -> Tensor:
    """Whether classes agree with labels, both (N,) int64; boolean."""
    return (predicted == _subject(labels)) != (labels < 0)


def _subject(labels: Tensor) -> Tensor:
    """The class that each label speaks of."""
    return torch.where(labels < 0, -1 - labels, labels)
