"""Classification: the outputs of a network are logits, one for each class.

A label is the index of a class. A complementary label says that an image does not show a class. It
is the number −1 − class. If there are several positive classes, the argument `absent` contains the
other classes that images with a complementary label do not show, either.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.network import are_probabilities, plain_outputs, unwrapped
from augment.tasks.task import NO_CLASS, Criterion, GetTruth, Task, stored_names
from renderer.errors import InputError, composed, require, require_kind

# Logits of N images, and labels or predicted classes of them.
Logits = Float[Tensor, "N C"]
Labels = Int[Tensor, " N"]
# A network is overconfident where its log-odds exceed this number. Networks rarely do so, unless
# their logits are multiplied by a factor.
OVERCONFIDENT = 50.0
# A network is refused if its outputs for this many images look like probabilities. The logits of a
# single image may do so by chance.
MIN_PROBABILITY_ROWS = 2


@dataclass(frozen=True)
class Classification(Task):
    """Task of a network that returns a row of logits for each image, one for each class.

    An attack succeeds if the class with the largest logit is not the true
    class or, with a target, if it is the target.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> def logits(images):
        ...     mean = images.mean((1, 2, 3))
        ...     return torch.stack([mean, 0.3 + 0 * mean], dim=1)
        >>> scene = nb.build_scene([("solid:orange", "0")], size=8)
        >>> settings = nb.AttackSettings(lighting=nb.StepSettings(step_size=0.5), max_steps=2)
        >>> result = nb.attack(logits, scene, task=nb.Classification(), settings=settings)
        >>> result.logits.shape
        torch.Size([1, 2])
    """

    name = "classification"
    returns = "a tensor of logits (N, C)"
    confidence = "probability"
    finds = "photographs", "keeps the class of"

    def recognizes(self, outputs: Any) -> bool:
        """Return whether outputs are a tensor with two dimensions, such as logits."""
        plain = plain_outputs(outputs)
        return isinstance(plain, Tensor) and plain.ndim == 2

    def class_names(self, network: Any, count: int | None) -> Sequence[str]:
        """Return the names that transformers stores, or otherwise "0", "1" and so on."""
        names = stored_names(unwrapped(network))
        return names if len(names) == count else [*map(str, range(count or 0))]

    def reader(self, title: str, class_count: int | None = None) -> _LogitReader:
        """Return a function that checks logits."""
        return _LogitReader(title, class_count)

    def criterion(self, source: Tensor, truth: GetTruth, class_count: int) -> ClassCriterion:
        """Return the criterion of an untargeted attack, for which positions do not matter."""
        return ClassCriterion(source)

    def as_found(self, outputs: Tensor, classes: Sequence[str]) -> tuple[Tensor, ClassCriterion]:
        """Return the criterion of an attack on the class of each image."""
        return torch.arange(len(outputs)), ClassCriterion(outputs.argmax(1, keepdim=True))

    def confidences(self, evidence: Float[Tensor, "... C"]) -> Float[Tensor, "... C"]:
        """Return the probability of each class."""
        return evidence.softmax(-1)


# What errors advise if a classifier has a single class.
TWO_CLASSES = "give at least two, with one logit each (for one output z, the logits 0 and z)"


class _LogitReader:
    """Function that checks the outputs of a classifier: rows of logits, and no probabilities.

    Attributes:
        title: Name of the network at the start of error messages.
        class_count: Number of logits of an image. None for any number.
        probability_rows: Number of images so far whose outputs look like
            probabilities. None as soon as a batch has other outputs. Then no
            further batch is checked, which saves time.
    """

    def __init__(self, title: str, class_count: int | None):
        self.title = title
        self.class_count = class_count
        self.probability_rows: int | None = 0

    def __call__(self, outputs: Any, images: Float[Tensor, "N 3 H W"]) -> Logits:
        logits = plain_outputs(outputs)
        is_tensor = isinstance(logits, Tensor)
        has_row_per_image = is_tensor and logits.ndim == 2 and len(logits) == len(images)
        if not has_row_per_image or self.class_count not in (None, logits.shape[1]):
            returned = tuple(logits.shape) if is_tensor else type(logits).__name__
            remedy = f"it must return logits {(len(images), self.class_count or 'C')}, or set task"
            shape = tuple(images.shape)
            raise InputError(f"{self.title} returned {returned} for images {shape}: {remedy}")
        if logits.shape[1] < 2:
            raise InputError(f"{self.title} returned one logit for each image: {TWO_CLASSES}")
        if self.probability_rows is not None and len(logits):
            rows = self.probability_rows + len(logits)
            self.probability_rows = rows if are_probabilities(logits) else None
        # A network is refused only if all outputs so far look like probabilities.
        if (self.probability_rows or 0) >= MIN_PROBABILITY_ROWS:
            reason = f"{self.title} returned probabilities instead of logits"
            raise InputError(f"{reason}: remove the softmax, or return their logarithms")
        return logits


@dataclass(frozen=True)
class ClassCriterion(Criterion):
    """Criterion of an attack on a classifier. The evidence of an image is its logits.

    A view reaches the criterion when it is classified as its target or, without a target, as any
    class except its source.
    """

    def evidence(self, outputs: Logits) -> Logits:
        """Return the logits themselves."""
        return outputs

    def predicted(self, evidence: Float[Tensor, "... C"]) -> Int[Tensor, " ..."]:
        """Return the classes with the largest logits."""
        return evidence.argmax(-1)

    def is_overconfident(self, evidence: Float[Tensor, "... C"]) -> Bool[Tensor, " ..."]:
        """Return a mask of the images with a class of log-odds above 50 or below −50."""
        lowest, highest = evidence.aminmax(dim=-1)
        return highest - lowest > OVERCONFIDENT

    def cost(self, logits: Logits) -> Float[Tensor, " N"]:
        """Compute the cost of single images, for a criterion that is flat.

        Without a target, the cost and its gradient round to 0 if the log-odds o of the source are
        large. Where they exceed 50, o − 50 is therefore added.
        """
        # `require_known` refuses NO_CLASS, which is negative. Class 0 stands for it.
        source = self.source.clamp(min=0)
        require_known(source, logits)
        # The logarithm of the probability is log σ of the log-odds. Its gradient is accurate even
        # if the probability rounds to 1. The gradient of `cross_entropy` then loses the term of
        # the class.
        other_logits = logits.scatter(1, source[:, None], -torch.inf)
        odds = logits.gather(1, source[:, None])[:, 0] - other_logits.logsumexp(1)
        is_added = (odds > OVERCONFIDENT) & (self.targets == NO_CLASS)
        cost = F.logsigmoid(odds) + torch.where(is_added, odds - OVERCONFIDENT, 0)
        cost = torch.where(self.source == NO_CLASS, 0, cost)
        if self.target is None:
            return cost
        return cost + F.cross_entropy(logits, self.target, reduction="none", ignore_index=NO_CLASS)

    def gap(self, logits: Float[Tensor, "... C"]) -> Float[Tensor, " ..."]:
        """Compute by how much each view reaches the criterion: its logit gap.

        With a target class, it is the logit of the target minus the largest other logit. Without
        one, it is the largest logit of the other classes minus the logit of the source class. It is
        negative if the view does not reach the criterion.
        """
        has_target = self.targets != NO_CLASS
        # Class whose logit is compared with the others, shape (..., 1).
        compared_class = torch.where(has_target, self.targets, self.source)[..., None]
        compared_logit = logits.gather(-1, compared_class)[..., 0]
        largest_other = logits.scatter(-1, compared_class, -torch.inf).amax(-1)
        difference = compared_logit - largest_other
        return torch.where(has_target, difference, -difference)


def complementary_label(label: int) -> int:
    """Return the complementary label of a class. It says that images do not show the class."""
    return -1 - label


def require_known(labels: Labels, logits: Float[Tensor, "_ classes"]) -> None:
    """Check that every label has a logit. Labels may be complementary."""
    largest, last = _class_of(labels).amax(), logits.shape[1] - 1
    fault = "label={} must be at least 0 and at most {}".format
    require(largest <= last, lambda: InputError(fault(largest, last), "label"))


def label_loss(
    logits: Logits, labels: Labels, label_smoothing: float = 0.0, absent: Sequence[int] = ()
) -> Float[Tensor, " N"]:
    """Compute the loss of each image by its label.

    An image of class c has the label c. Its loss is the cross entropy. An image that does not
    show class c has the complementary label −1 − c. Its loss is −log(1 − p), where p is the sum
    of the probabilities of c and of the classes `absent`.
    """
    classes = _class_of(labels)
    # Set the logits of the classes that are not shown to -∞. Only the logits of the other
    # classes remain.
    other_logits = logits.scatter(1, classes[:, None], -torch.inf)
    # A list of indices would be copied to a GPU in each step.
    for other in absent:
        other_logits[:, other] = -torch.inf
    # The other classes have the probability Σ exp(other_logits) / Σ exp(logits) = 1 - p.
    complementary = logits.logsumexp(1) - other_logits.logsumexp(1)
    entropy = F.cross_entropy(logits, classes, reduction="none", label_smoothing=label_smoothing)
    return torch.where(labels < 0, complementary, entropy)


def is_correct(predicted: Labels, labels: Labels, absent: Sequence[int] = ()) -> Bool[Tensor, " N"]:
    """Return a mask of the predictions that agree with the labels.

    A label that is a class demands the prediction of this class. The complementary label
    −1 − c says that the image does not show class c. It demands a prediction that is neither c
    nor one of the classes `absent`.
    """
    # The first row compares with the class of the label, and each other row with an absent class.
    is_equal = torch.stack([predicted.eq(_class_of(labels)), *map(predicted.eq, absent)])
    return torch.where(labels < 0, ~is_equal.any(0), is_equal[0])


def _class_of(labels: Tensor) -> Tensor:
    """Return the class c of each label, which is c or, if it is complementary, −1 − c."""
    return torch.where(labels < 0, -1 - labels, labels)


def class_index(classes: Sequence[str], name: str | int, subject: str) -> int:
    """Return the index of a class.

    The name may be an index, also as text. `subject` starts the error, which suggests similar
    names.
    """
    require_kind("label", name, str | Integral, "the name of a class, or its index")
    # Unicode can write an accent in two ways. `composed` makes them equal.
    text = composed(str(name))
    names = [*map(composed, classes)]
    if isinstance(name, str) and text in names:
        return names.index(text)
    last = len(classes) - 1
    if text.isascii() and text.isdecimal():
        if int(text) <= last:
            return int(text)
        reason = f"the label {text} is not a class: indices go from 0 to {last}"
    elif names == [*map(str, range(len(classes)))]:
        advice = f"give an index from 0 to {last}, or name the classes"
        reason = f"{text!r} is not a class, and the classes have only indices: {advice}"
    else:
        similar = nearest(text, classes)
        reason = f"{text!r} is not a class of the model: choose one, such as {similar}"
    raise InputError(f"{subject}: {reason}")


def nearest(name: str, choices: Sequence[str]) -> str:
    """Return the three names that are most similar to a misspelled name, as one text."""
    return ", ".join(difflib.get_close_matches(name, choices, n=3, cutoff=0))


def log_odds(logits: Logits, label: int) -> Float[Tensor, " N"]:
    """Compute the log-odds of a class, log(p / (1 − p)), where p is its probability.

    The result is finite even if p rounds to 0 or 1.
    """
    others = torch.cat([logits[:, :label], logits[:, label + 1 :]], dim=1)
    return logits[:, label] - others.logsumexp(dim=1)
