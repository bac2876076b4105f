"""What an attack is to reach, and the cost that it decreases on the way."""

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


NO_CLASS = -1  # in place of a class that does not count


@dataclass(frozen=True)
class Goal:
    """Per example and view, the class whose confidence falls and, where there is a target, the one whose rises.

    source: NO_CLASS where the target alone counts. target: the same, or None for an attack that takes
    any error, as it does where it is NO_CLASS. An example is fooled where every view is given its target, or without
    one, anything but `source`.
    """

    source: Int[Tensor, "E V"]
    target: Int[Tensor, "E V"] | None = None

    def of(self, examples: Tensor) -> Goal:
        """The same for some of the examples."""
        return Goal(self.source[examples], None if self.target is None else self.target[examples])

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Whether all views of an example are, for predicted classes."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, "E V"]:
        """Whether each view is, for predicted classes."""
        erred = predicted != self.source
        if self.target is None:
            return erred
        return torch.where(self.target == NO_CLASS, erred, predicted == self.target)


def adversarial_cost(
    logits: Float[Tensor, "E classes"], source: Int[Tensor, " E"], target: Int[Tensor, " E"] | None = None
) -> Float[Tensor, " E"]:
    """-CE(f, L_d) + CE(f, L_i) per example, the paper's equation 1, which an attack decreases.

    source: the classes whose confidence falls. target: those whose confidence rises; None attacks without a target.
    NO_CLASS in either leaves its term out. InputError for a class that there are no logits of.
    """
    require_known(source, logits)
    cost = -F.cross_entropy(logits, source, reduction="none", ignore_index=NO_CLASS)
    if target is not None:
        cost = cost + F.cross_entropy(logits, target, reduction="none", ignore_index=NO_CLASS)
    return cost


def logit_gap(logits: Tensor, source: Tensor, target: Tensor | None = None) -> Tensor:
    """By how much the goal is exceeded, negative where it is not reached: that of the wanted class over all others, or
    without one, that of the best other class over `source`. (E,)

    Shapes as in `adversarial_cost`.
    """
    wanted = torch.full_like(source, NO_CLASS) if target is None else target
    chosen = torch.where(wanted == NO_CLASS, source, wanted)[:, None]
    gap = logits.gather(1, chosen)[:, 0] - logits.scatter(1, chosen, -torch.inf).amax(1)
    return torch.where(wanted == NO_CLASS, -gap, gap)


@runtime_checkable
class Criterion(Protocol):
    """Anything with this method."""

    def targets(self, logits: Tensor, classifier: Classifier) -> Tensor | None:
        """(E, V) the classes to reach, given the logits (E, V, C) before; None where any error will do."""


@dataclass(frozen=True)
class Misclassification:
    """Any class but the right one."""

    def targets(self, logits: Tensor, classifier: Classifier) -> None:
        return None


@dataclass(frozen=True)
class Targeted:
    """A class by name for all images, or a list of them, one for each of the views that share what is attacked."""

    classes: str | Sequence[str]

    def targets(self, logits: Tensor, classifier: Classifier) -> Tensor:
        views = logits.shape[1]
        names = [self.classes] * views if isinstance(self.classes, str) else [str(name) for name in self.classes]
        if len(names) != views:
            raise InputError(
                f"target={names} names {len(names)} classes for {views} views that share what is attacked: give as "
                "many, and attack.shared=true"
            )
        wanted = torch.tensor([classifier.label(name) for name in names], device=logits.device)
        return wanted.expand(len(logits), views)


@dataclass(frozen=True)
class LeastLikely:
    """Of each image, the class that it had the least confidence in."""

    def targets(self, logits: Tensor, classifier: Classifier) -> Tensor:
        return logits.argmin(2)
