"""Criteria of success: which classes an attack leads to, and whether it has reached them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor

from augment.classifiers.adapter import Classifier
from augment.losses import NO_CLASS
from renderer.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Bool, Int


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
