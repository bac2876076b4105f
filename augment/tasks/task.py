"""The base of all tasks: what the outputs of a network mean, and when an attack on them succeeds.

A task reads the outputs of a network (`Task.reader`). A criterion holds the truth of the images of
an attack. It reduces the outputs of each image to its evidence, a row of numbers: how strongly the
network finds each class. Loop, optimizers, checks and files of an attack know the criterion only.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.scene.truth import Truth

# Index that stands for "no class" in attacks without a source or a target class. It differs from
# all labels.
NO_CLASS = -(10**9)
# Function from the outputs of a network, and from the images that it got, to outputs of a task.
Reader = Callable[[Any, Tensor], Any]


@dataclass(frozen=True)
class Rows:
    """Base of data classes whose tensors have one row for each example."""

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Return a copy with changed tensors."""
        tensors = {name: item for name, item in vars(self).items() if isinstance(item, Tensor)}
        changed = {name: change(tensor) for name, tensor in tensors.items()}
        return replace(self, **changed)

    def select(self, rows: Tensor | slice) -> Self:
        """Return some of the rows."""
        return self.map(lambda tensor: tensor[rows])

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of several parts, one after the other."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*map(torch.cat, columns))


@dataclass(frozen=True)
class Criterion(Rows, ABC):
    """Source and target class of each view of an attack, and the truth that its task needs.

    An attack lowers what the network finds of the source class, and raises what it finds of the
    target class. Tensors have one row for each example, and then one for each view.

    Attributes:
        source: Source class of each view, one row for each example. NO_CLASS
            removes the source from the cost of a view, so that only its target
            counts.
        target: Target class of each view, one row for each example. NO_CLASS
            makes the attack on a view untargeted. None makes the attack on all
            views untargeted.
    """

    # Whether the criterion depends on where the objects are (`at`).
    needs_truth: ClassVar[bool] = False

    source: Int[Tensor, "*E V"]
    target: Int[Tensor, "*E V"] | None = None

    @property
    def view_count(self) -> int:
        """Number V of views of each example."""
        return self.source.shape[1]

    def at(self, truth: Truth) -> Self:
        """Return a copy for other positions of the objects."""
        return self

    @abstractmethod
    def evidence(self, outputs: Any) -> Float[Tensor, "N K"]:
        """Reduce the outputs of N single images to how strongly each class is found."""

    @abstractmethod
    def cost(self, outputs: Any) -> Float[Tensor, " N"]:
        """Compute the cost of single images, for a criterion that is flat."""

    @abstractmethod
    def gap(self, evidence: Float[Tensor, "... K"]) -> Float[Tensor, " ..."]:
        """Compute by how much each view reaches the criterion. A negative gap does not."""

    @abstractmethod
    def predicted(self, evidence: Float[Tensor, "... K"]) -> Int[Tensor, " ..."]:
        """Return what the network finds in each view: the source class, or what replaces it."""

    def is_overconfident(self, evidence: Float[Tensor, "... K"]) -> Bool[Tensor, " ..."]:
        """Return a mask of the views with so extreme values that noise must test a success."""
        return torch.zeros_like(evidence[..., 0], dtype=torch.bool)

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Return a mask of the examples that reach the criterion in all their views."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, " ..."]) -> Bool[Tensor, " ..."]:
        """Return a mask of the views that reach the criterion."""
        is_misclassified = predicted != self.source
        if self.target is None:
            return is_misclassified
        # The target `NO_CLASS` stands for a view without a target.
        is_untargeted = self.target == NO_CLASS
        return torch.where(is_untargeted, is_misclassified, predicted == self.target)


class Task(ABC):
    """What the outputs of a network mean. A subclass is a task, such as detection.

    Attributes:
        name: Name of the task in messages.
        returns: What a network of the task returns, in messages.
        missed: What is said of images in which the true class is not found.
    """

    name: ClassVar[str]
    returns: ClassVar[str]
    missed: ClassVar[str]

    @abstractmethod
    def recognizes(self, outputs: Any) -> bool:
        """Return whether outputs of a network are of this task."""

    @abstractmethod
    def class_names(self, network: Any, count: int | None) -> Sequence[str] | None:
        """Return the names of the classes of a network, or None if the user must give them."""

    @abstractmethod
    def reader(self, title: str, class_count: int | None = None) -> Reader:
        """Return a function that checks the outputs of a network and brings them into one form.

        `title` is the name of the network at the start of errors. None allows any number of
        classes.
        """

    def output_count(self, outputs: Any) -> int | None:
        """Return the number of classes of outputs. None if they do not tell."""
        return None

    @abstractmethod
    def require_finite(self, outputs: Any, images: Tensor, title: str) -> None:
        """Check that outputs of an attacked network are finite, and have the gradient of images."""

    @abstractmethod
    def has_gradient(self, outputs: Any) -> bool:
        """Return whether outputs have a gradient."""

    @abstractmethod
    def criterion(
        self, source: Int[Tensor, "E V"], truth: Callable[[], Truth], class_count: int
    ) -> Criterion:
        """Return the criterion of an untargeted attack. `truth` computes where objects are."""

    @abstractmethod
    def require_target(self, target: Any) -> None:
        """Check that an attack of this task can have a target class."""

    @abstractmethod
    def describe(self, evidence: Float[Tensor, " K"], classes: Sequence[str]) -> str:
        """Return the classes that are found most in one image, with their confidences."""

    def draw(
        self, image: Float[Tensor, "3 H W"], output: Any, classes: Sequence[str]
    ) -> Float[Tensor, "3 H W"]:
        """Draw the output of one image on it. By default, nothing is drawn."""
        return image
