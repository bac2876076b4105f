"""Labels of examples: a class, or "anything but" a class, which is written −1 − class."""

import torch
import torch.nn.functional as F
from torch import Tensor


def anything_but(label: int) -> int:
    """The label of what is of no class that the classifier knows, and in particular not of this one."""
    return -1 - label


def label_loss(logits: Tensor, labels: Tensor, label_smoothing: float = 0.0) -> Tensor:
    """(N,) cross entropy where a label is a class c, and −log(1 − p_c) where it is anything but c.

    logits: (N, classes). labels: (N,) int64. label_smoothing: of the cross entropy alone.
    """
    subject = _subject(labels)[:, None]
    others = logits.scatter(1, subject, -torch.inf)
    denial = logits.logsumexp(1) - others.logsumexp(1)
    entropy = F.cross_entropy(logits, subject[:, 0], reduction="none", label_smoothing=label_smoothing)
    return torch.where(labels < 0, denial, entropy)


def is_right(predicted: Tensor, labels: Tensor) -> Tensor:
    """Whether classes agree with labels, both (N,) int64; boolean."""
    return (predicted == _subject(labels)) != (labels < 0)


def _subject(labels: Tensor) -> Tensor:
    """The class that each label speaks of."""
    return torch.where(labels < 0, -1 - labels, labels)
