"""What an attack is to reach: any error, or classes of one's choice. (foolbox calls these criteria.)"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from augment.classifiers.adapter import Classifier
from renderer.arguments import require_fields
from renderer.errors import InputError


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

    def __post_init__(self) -> None:
        require_fields(self)

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
