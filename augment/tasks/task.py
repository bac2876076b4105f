"""The base of all tasks: what the outputs of a network mean, and when an attack on them succeeds.

A task reads the outputs of a network (`Task.reader`). A criterion holds the truth of the images of
an attack. It reduces the outputs of each image to its evidence, a row of numbers: how strongly the
network finds each class. Loop, optimizers, checks and files of an attack know the criterion only.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils._pytree import tree_leaves

from augment.scene.truth import Rows, Truth
from renderer.errors import InputError, require

# Index that stands for "no class" in attacks without a source or a target class. It differs from
# all labels.
NO_CLASS = -(10**9)
# Name of a class that is no object.
BACKGROUND = "background"
# What is predicted if no class is found.
NOTHING = "nothing"
# What errors say of a network whose outputs do not depend on the images for autograd.
NO_GRADIENT = (
    "returned outputs without a gradient: compute them in torch, or choose optimizer=random_search"
)
# Function from the outputs of a network, and from the images that it got, to outputs of a task.
Reader = Callable[[Any, Tensor], Any]
# Function that finds where the objects of the images of an attack are.
GetTruth = Callable[[], Truth]


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
    def targets(self) -> Int[Tensor, "*E V"]:
        """Target class of each view. NO_CLASS if there is none."""
        return torch.full_like(self.source, NO_CLASS) if self.target is None else self.target

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

    def reached(self, predicted: Int[Tensor, " ..."]) -> Bool[Tensor, " E"]:
        """Return a mask of the examples that reach the criterion in all their views."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, " ..."]) -> Bool[Tensor, " ..."]:
        """Return a mask of the views that reach the criterion."""
        is_misclassified = predicted != self.source
        return torch.where(self.targets == NO_CLASS, is_misclassified, predicted == self.targets)


@dataclass(frozen=True)
class ObjectCriterion(Criterion):
    """Criterion of an attack on an object in an image, which succeeds if its class is not found.

    The evidence has a column for each of C classes, and then a limit. A class is found if its
    evidence is at least the limit.
    """

    needs_truth = True

    def split(self, evidence: Float[Tensor, "... K"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the evidence of the source class, the limit, and the evidence of the others.

        The others (..., C) have −∞ for the source class.
        """
        source = self.source[..., None]
        others = evidence[..., :-1].scatter(-1, source, -torch.inf)
        return evidence.gather(-1, source)[..., 0], evidence[..., -1], others

    def gap(self, evidence: Float[Tensor, "... K"]) -> Float[Tensor, " ..."]:
        """Return how far the source class is below the limit."""
        own, limit, _ = self.split(evidence)
        return limit - own

    def predicted(self, evidence: Float[Tensor, "... K"]) -> Int[Tensor, " ..."]:
        """Return the source class if it is found, or else the best other class or C."""
        own, limit, others = self.split(evidence)
        # The limit takes the index C. It is largest if no other class is found.
        best = torch.cat([others, limit[..., None]], dim=-1).argmax(-1)
        return torch.where(own >= limit, self.source, best)


class Task(ABC):
    """What the outputs of a network mean. A subclass is a task, such as detection.

    Attributes:
        name: Name of the task in messages.
        returns: What a network of the task returns, in messages.
        confidence: What `confidences` are, on the axis of a chart.
        finds: What `as_found` gives, and how a network keeps them, in sentences.
    """

    name: ClassVar[str]
    returns: ClassVar[str]
    confidence: ClassVar[str]
    finds: ClassVar[tuple[str, str]]

    @abstractmethod
    def recognizes(self, outputs: Any) -> bool:
        """Return whether outputs of a network are of this task."""

    @abstractmethod
    def class_names(self, network: Any, count: int | None) -> Sequence[str] | None:
        """Return the names of the classes of a network, or None if the user must give them."""

    def outputs(self, network: Any, images: Tensor) -> Any:
        """Return all outputs of a network that the task can use."""
        return network(images)

    def are_background(self, classes: Sequence[str]) -> list[bool]:
        """Return which classes are no objects, such as `__background__` of torchvision."""
        return [name.strip("_").lower() == BACKGROUND for name in classes]

    @abstractmethod
    def reader(self, title: str, class_count: int | None = None) -> Reader:
        """Return a function that checks the outputs of a network and brings them into one form.

        `title` is the name of the network at the start of errors. None allows any number of
        classes.
        """

    def output_count(self, network: Any, outputs: Any) -> int | None:
        """Return the number of classes of a network and its outputs. None if they do not tell.

        By default, it is the number of logits of an image, or of a pixel.
        """
        return int(outputs.shape[1])

    def require_finite(self, outputs: Any, images: Tensor, title: str) -> None:
        """Check that outputs of an attacked network are finite, and have the gradient of images."""
        values = [item for item in tensors_of(outputs) if item.is_floating_point()]
        fault = f"{title} returned NaN or infinite outputs: check its weights"
        if not values:
            raise InputError(f"{title} returned no floating-point outputs: convert them")
        for item in values:
            require(item.isfinite().all(), lambda: InputError(fault))
        # A detector that finds nothing has no gradient.
        is_empty = not any(item.numel() for item in values)
        needs_gradient = torch.is_grad_enabled() and images.requires_grad and not is_empty
        if needs_gradient and not any(item.requires_grad for item in values):
            raise InputError(f"{title} {NO_GRADIENT}")

    @abstractmethod
    def criterion(self, source: Tensor, truth: GetTruth, class_count: int) -> Criterion:
        """Return the criterion of an untargeted attack. `truth` computes where objects are."""

    @abstractmethod
    def as_found(self, outputs: Any, classes: Sequence[str]) -> tuple[Int[Tensor, " E"], Criterion]:
        """Return criteria of attacks on what a network finds in images, and the image of each.

        What it finds in unchanged images is the truth for the same images in other light.
        """

    def require_target(self, target: Any) -> None:  # noqa: B027 (Some tasks accept every target.)
        """Check that an attack of this task can have a target class."""

    def confidences(self, evidence: Float[Tensor, "... K"]) -> Float[Tensor, "... C"]:
        """Return how surely each class is found, from 0 to 1.

        By default, the evidence is log-odds, and its last column is a limit (`ObjectCriterion`).
        """
        return evidence[..., :-1].sigmoid()

    def found(
        self, evidence: Tensor, predicted: Tensor, classes: Sequence[str], when: str = ""
    ) -> dict[str, Any]:
        """Return names and confidences of what is predicted, for a JSON file.

        The confidence of nothing is that of the class that is found most. The suffix `when`, such
        as "_before", ends the two keys.
        """
        confidences = self.confidences(evidence)
        # The index C, one beyond the classes, stands for nothing, so append a column and a name.
        largest = confidences.amax(-1, keepdim=True)
        values = torch.cat([confidences, largest], dim=-1).gather(-1, predicted[..., None])
        names = np.asarray([*classes, NOTHING])[predicted.cpu().numpy()]
        return {f"predicted{when}": names.tolist(), f"confidence{when}": values[..., 0].tolist()}

    def describe(self, evidence: Float[Tensor, " K"], classes: Sequence[str]) -> str:
        """Return the five classes that are found most in one image, with their confidences."""
        confidences = self.confidences(evidence)
        indices = confidences.topk(min(5, len(confidences))).indices.tolist()
        return ", ".join(f"{classes[i]} {confidences[i]:.1%}" for i in indices)

    def draw(self, image: Tensor, output: Any, classes: Sequence[str]) -> Tensor:
        """Draw the output of one image on it. By default, nothing is drawn."""
        return image


def tensors_of(outputs: Any) -> list[Tensor]:
    """Return the tensors of outputs, also in lists and dictionaries."""
    return [item for item in tree_leaves(outputs) if isinstance(item, Tensor)]


def gradient_of(values: Tensor, images: Tensor, weights: Tensor | None = None) -> Tensor | None:
    """Compute the gradient of values with respect to images. None if they do not depend on them."""
    if not values.requires_grad:
        return None
    return torch.autograd.grad(values, images, weights, allow_unused=True)[0]


def unique_names(names: Sequence[str]) -> list[str]:
    """Add its index to each name that occurs twice, because labels are found by name."""
    return [f"{name} {i}" if names.count(name) > 1 else name for i, name in enumerate(names)]


def stored_names(raw: Any) -> list[str]:
    """Return the names of the classes that a network of transformers or Ultralytics stores."""
    # Ultralytics has dictionaries from index to name in `names`, transformers in `id2label`.
    names = getattr(raw, "names", None)
    if not isinstance(names, Mapping):
        names = getattr(getattr(raw, "config", None), "id2label", None) or {}
    return unique_names([str(names[index]) for index in sorted(names)])
