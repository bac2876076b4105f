"""Criteria of success, and the cost that an attack decreases on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.classifiers.adapter import Classifier
from augment.labels import require_known
from renderer.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


NO_CLASS = -1  # in place of a class, where there is none


@dataclass(frozen=True)
class Goal:
    """Source and target class of each view: an attack is to lower the confidence in one and to raise it in the other.

    source: NO_CLASS where only the target counts. target: NO_CLASS, or None for all views, where any error will do. A
    goal is reached where every view is classified as its target or, without a target, as anything but its source.
    """

    source: Int[Tensor, "E V"]
    target: Int[Tensor, "E V"] | None = None

    def of(self, examples: Tensor) -> Goal:
        """The goal of some of the examples."""
        return Goal(self.source[examples], None if self.target is None else self.target[examples])

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Whether the predicted classes reach the goal in all views of an example."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, "E V"]:
        """Whether the predicted classes reach the goal, view by view."""
        erred = predicted != self.source
        if self.target is None:
            return erred
        return torch.where(self.target == NO_CLASS, erred, predicted == self.target)


def adversarial_cost(
    logits: Float[Tensor, "E classes"], source: Int[Tensor, " E"], target: Int[Tensor, " E"] | None = None
) -> Float[Tensor, " E"]:
    """−CE(logits, source) + CE(logits, target) per image, the paper's equation 1, which an attack decreases.

    target: None leaves the second term out. NO_CLASS in either leaves its term out. InputError for a class beyond the
    logits.
    """
    require_known(source, logits)
    cost = -F.cross_entropy(logits, source, reduction="none", ignore_index=NO_CLASS)
    if target is not None:
        cost = cost + F.cross_entropy(logits, target, reduction="none", ignore_index=NO_CLASS)
    return cost


def logit_gap(logits: Tensor, source: Tensor, target: Tensor | None = None) -> Tensor:
    """The lead (E,) of the target's logit over all others or, without a target, of the best other class over the
    source; negative where the goal is not reached. Shapes as in `adversarial_cost`."""
    wanted = torch.full_like(source, NO_CLASS) if target is None else target
    chosen = torch.where(wanted == NO_CLASS, source, wanted)[:, None]
    gap = logits.gather(1, chosen)[:, 0] - logits.scatter(1, chosen, -torch.inf).amax(1)
    return torch.where(wanted == NO_CLASS, -gap, gap)


@runtime_checkable
class Criterion(Protocol):
    """Chooses the target classes of an attack."""

    def targets(self, logits: Tensor, classifier: Classifier) -> Tensor | None:
        """The target classes (E, V), given the logits (E, V, C) before; None where any error will do."""


@dataclass(frozen=True)
class Misclassification:
    """Any class but the right one."""

    def targets(self, logits: Tensor, classifier: Classifier) -> None:
        return None


@dataclass(frozen=True)
class Targeted:
    """A class by name for all images, or a list of classes, one for each of the views that share what is attacked."""

    classes: str | Sequence[str]

    def targets(self, logits: Tensor, classifier: Classifier) -> Tensor:
        views = logits.shape[1]
        names = [self.classes] * views if isinstance(self.classes, str) else [str(name) for name in self.classes]
        if len(names) != views:
            raise InputError(
                f"target={names} names {len(names)} classes for {views} views that share what is attacked: give one "
                "class per view, and shared=true"
            )
        wanted = torch.tensor([classifier.label(name) for name in names], device=logits.device)
        return wanted.expand(len(logits), views)


@dataclass(frozen=True)
class LeastLikely:
    """The class of each image's lowest confidence."""

    def targets(self, logits: Tensor, classifier: Classifier) -> Tensor:
        return logits.argmin(2)
