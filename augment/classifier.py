"""A classifier: a network whose outputs are logits, with the names of its classes."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.network import (
    Network,
    Remembered,
    are_probabilities,
    light_settings,
    with_normalized_light,
)
from augment.settings import NormalizedLightSettings, NormalizeLight, read_normalized_light
from renderer.errors import (
    InputError,
    as_list,
    as_tensor,
    composed,
    describe,
    is_out_of_memory,
    require_kind,
    require_whole,
    single_line,
)
from renderer.settings import MAX_SIZE

# Name of one positive class, or names of several.
Label = str | Sequence[str]
# Image values may exceed the range [0, 1] by at most this much, because of interpolation and noise.
OVERSHOOT = 0.1
# A network is refused if its outputs for this many images look like probabilities. The logits of a
# single image may do so by chance.
MIN_PROBABILITY_ROWS = 2
# Pixel value of the gray image with which a function is called to find out whether it has
# gradients.
GRAY = 0.5


@dataclass(frozen=True)
class OperatingPoint:
    """Threshold for the decision whether an image shows a class.

    An image shows the class if its log-odds of the class exceed the threshold.
    The threshold was chosen on a folder of photographs: it is the lowest one at
    which the false-positive rate is at most `false_positive_rate`.

    Attributes:
        label: Name of the class.
        threshold: Threshold of the log-odds.
        false_positive_rate: Largest permitted fraction of the photographs
            without the class that exceed the threshold, in [0, 1].
        folder: Name of the folder of photographs.
        images: Hash of the photographs.
        negatives: Number of photographs that do not show the class.
    """

    label: str
    threshold: float
    false_positive_rate: float
    folder: str
    images: str
    negatives: int


class LogitNetwork(Network):
    """Network whose outputs are checked: a row of logits for each image, and no probabilities.

    Attributes:
        title: Name of the network at the start of error messages.
        class_count: Number of logits of an image. None for any number.
        probability_rows: Number of images so far whose outputs look like
            probabilities. None as soon as a batch has other outputs. Then no
            further batch is checked, which saves time.
    """

    def __init__(
        self, network: Callable[[Tensor], Tensor], title: str, class_count: int | None = None
    ):
        super().__init__(network)
        self.title = title
        self.class_count = class_count
        self.probability_rows: int | None = 0

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N C"]:
        """Compute the logits of images, and check them."""
        try:
            logits = self.network(images)
        except Exception as error:
            # The caller handles errors of memory. An `InputError` already tells what is wrong.
            if isinstance(error, InputError) or is_out_of_memory(error):
                raise
            raise InputError(self._failure(images, error)) from error
        count = self.class_count
        has_row_per_image = (
            isinstance(logits, Tensor) and logits.ndim == 2 and len(logits) == len(images)
        )
        if not has_row_per_image or count not in (None, logits.shape[1]):
            shape = tuple(images.shape)
            returned = tuple(logits.shape) if isinstance(logits, Tensor) else type(logits).__name__
            expected = (len(images), "C" if count is None else count)
            remedy = f"it must return logits {expected}"
            if hasattr(logits, "logits") or (isinstance(logits, dict) and "logits" in logits):
                remedy = "give a function that returns its logits alone"
            raise InputError(f"{self.title} returned {returned} for images {shape}: {remedy}")
        self._require_no_probabilities(logits)
        return logits

    def _failure(self, images: Float[Tensor, "N 3 H W"], error: Exception) -> str:
        """Return the message of the error for a network that failed on images."""
        weights = [weight for weight in self.parameters() if weight.is_floating_point()]
        dtypes = {weight.dtype for weight in weights}
        given = f"{images.dtype} images {tuple(images.shape)}".removeprefix("torch.")
        reason = f"{self.title} fails on {given} ({type(error).__name__}: {single_line(error)})"
        if dtypes and images.dtype not in dtypes:
            of_weights = ", ".join(sorted(str(dtype).removeprefix("torch.") for dtype in dtypes))
            remedy = f"convert it with network.to({images.dtype}), or use light in {of_weights}"
            return f"{reason}: its weights are {of_weights}, {remedy}"
        return f"{reason}: give the size of its images, or use a network that takes such images"

    def _require_no_probabilities(self, logits: Float[Tensor, "N C"]) -> None:
        """Check that the network does not return probabilities instead of logits.

        It fails only if all outputs so far look like probabilities.
        """
        if self.probability_rows is None or not len(logits):
            return
        if not are_probabilities(logits):
            self.probability_rows = None
            return
        self.probability_rows += len(logits)
        if self.probability_rows >= MIN_PROBABILITY_ROWS:
            raise InputError(
                f"{self.title} returned probabilities (values in [0, 1] that sum to 1) instead "
                "of logits: "
                "remove the softmax of the network, or return the logarithms of the probabilities",
            )


class Classifier(LogitNetwork):
    """Frozen classifier from RGB images in [0, 1] to logits of C classes.

    If the network is a module of torch, the logits are differentiable with
    respect to the pixels. The parameters of the network get no gradient. The
    network stays in evaluation mode, even after `train()`. Images are not
    resized.

    Args:
        network: Function from images, shape (N, 3, size, size), to logits,
            shape (N, C). It takes tensors or NumPy arrays. If it is a
            `torch.nn.Module`, it is frozen, put in evaluation mode and moved
            with the classifier.
        size: Pixels per side of the images, from 1 to 4,096.
        classes: Names of the C classes in the order of the logits, at least
            two. Each name occurs once, because labels are found by name.
        name: Name of the classifier in messages.
        normalize_light: How the light of each image is normalized before the
            network sees it: True for the defaults, or a mapping with fields of
            `NormalizedLightSettings`. None for no normalization.

    Attributes:
        operating_points: Thresholds for `detect`, at most one for each class.
            Empty if the network has none.
        assumed: Those of "size" and "normalization" that neither the user nor
            the file of the network gave.

    Raises:
        InputError: If a class name occurs twice, if there are fewer than two
            classes, or if the size is out of range.
    """

    operating_points: Sequence[OperatingPoint] = ()
    assumed: Sequence[str] = ()

    def __init__(
        self,
        network: Callable[[Tensor], Tensor],
        size: int,
        classes: Sequence[str],
        name: str = "callable",
        normalize_light: NormalizeLight = None,
    ):
        """Check the arguments, which the docstring of the class explains. Freeze the network."""
        require_kind("name", name, str, "a string for messages")
        require_kind(
            "network", network, Callable, "a torch.nn.Module, or a function from images to logits"
        )
        require_whole(f"classifier {name}: size", size, 1, MAX_SIZE)
        names = as_class_names(f"classifier {name}: classes", classes)
        super().__init__(network, f"classifier {name}", len(names))
        self.network = with_normalized_light(self.network, normalize_light)
        self.size = size
        self.classes = names
        self.name = name
        if len(self.classes) < 2:
            raise InputError(
                f"classifier {name} has classes={self.classes}: give at least two, with one logit "
                "each (for a network with a single output z, return the logits 0 and z)"
            )
        if len(set(self.classes)) < len(self.classes):
            raise InputError(
                f"classifier {name}: classes has {len(self.classes)} names, "
                f"of which {len(set(self.classes))} are different: "
                "give each class a name of its own, in the order of the logits",
            )
        self.requires_grad_(False).eval()

    def forward(self, images: Float[Tensor, "N 3 size size"]) -> Float[Tensor, "N C"]:
        """Compute the logits of images.

        Args:
            images: RGB images in [0, 1], shape (N, 3, size, size).

        Returns:
            Logits, shape (N, C).

        Raises:
            InputError: If the images have another size or are far from [0, 1].
                Also if the network fails, or returns anything but finite logits
                with a gradient.
        """
        size = self.size
        images = as_images("images", images)
        if images.shape[1:] != (3, size, size):
            remedy = f"render at {size} pixels per side"
            if images.shape == (3, size, size):
                remedy = "give a batch, such as images[None]"
            elif images.shape[1:] == (size, size, 3):
                remedy = "put the channels first, such as images.permute(0, 3, 1, 2)"
            raise InputError(
                f"{self.title} takes images (N, 3, {size}, {size}), "
                f"not {tuple(images.shape)}: {remedy}"
            )
        # Lowest and highest value of all images. There are none if the batch is empty.
        extremes = torch.aminmax(images.detach()) if len(images) else ()
        logits = super().forward(images)
        # Check the range of the images after the call of the network. The check waits until the
        # GPU is idle.
        require_unit_range("images", *extremes)
        if not logits.is_floating_point() or not logits.isfinite().all():
            raise InputError(
                f"{self.title} returned NaN or infinite logits: check the weights of the network"
            )
        if torch.is_grad_enabled() and images.requires_grad and not logits.requires_grad:
            raise InputError(
                f"{self.title} returned logits without a gradient: compute them in torch, "
                "or choose optimizer='random_search'"
            )
        return logits

    @property
    def normalized_light(self) -> NormalizedLightSettings | None:
        """Settings with which the light of images is normalized. None if it is not normalized."""
        return light_settings(self.network)

    def normalizing_light(self, normalize_light: NormalizeLight = True) -> Classifier:
        """Return a classifier that first normalizes the light of images.

        It shares the network. It has no operating points, because its logits
        differ.

        Args:
            normalize_light: True for the defaults, or a mapping with fields of
                `NormalizedLightSettings`. With None or False, the classifier
                itself is returned.

        Raises:
            InputError: If this classifier normalizes the light already.

        Example:
            >>> import torch
            >>> import norm_balls as nb
            >>> def logits(images):
            ...     return images.mean((2, 3))
            >>> classifier = nb.Classifier(logits, size=8, classes=["red", "green", "blue"])
            >>> dark = torch.full((1, 3, 8, 8), 0.1)
            >>> classifier.normalizing_light({"level": 1.0})(dark).round(decimals=3)
            tensor([[1., 1., 1.]])
        """
        if read_normalized_light(normalize_light) is None:
            return self
        return Classifier(self.network, self.size, self.classes, self.name, normalize_light)

    def is_differentiable(self, like: Tensor) -> bool:
        """Return whether the logits are differentiable in the pixels.

        A network of torch with weights is assumed to have differentiable
        logits. Any other function is called with a gray image to find out.

        Args:
            like: Tensor with the dtype and the device of the image.
        """
        if next(self.parameters(), None) is not None:
            return True
        gray = like.new_full((1, 3, self.size, self.size), GRAY, requires_grad=True)
        try:
            with torch.enable_grad():
                return bool(super().forward(gray).requires_grad)
        except InputError:
            # A function that converts images to NumPy fails on images with gradients.
            return False

    def detect(
        self, images: Float[Tensor, "N 3 size size"], label: str | None = None
    ) -> Bool[Tensor, " N"]:
        """Decide which images show a class, by the threshold that is stored for the class.

        Args:
            images: RGB images in [0, 1], shape (N, 3, size, size).
            label: Name of the class. May be None if there is exactly one
                operating point.

        Returns:
            Mask of the images that show the class, shape (N,).

        Raises:
            InputError: If the class has no operating point, or if `forward`
                refuses the images.
        """
        require_kind("label", label, str | None, "the name of a class")
        points = [point for point in self.operating_points if label in (None, point.label)]
        if len(points) != 1:
            known = ", ".join(point.label for point in self.operating_points)
            remedy = f"set label to one of {known}" if known else "store one with nb.publish"
            raise InputError(
                f"{self.title} has no operating point for label={label}: {remedy}",
            )
        (point,) = points
        return log_odds(self(images).double(), self.label(point.label)) > point.threshold

    def train(self, mode: bool = True) -> Self:
        """Do nothing but keep evaluation mode, whatever `mode` is."""
        return super().train(False)

    def label(self, class_name: str | int) -> int:
        """Return the index of a class.

        Args:
            class_name: Name of the class, or its index.

        Raises:
            InputError: If there is no such class. The message suggests similar
                names.
        """
        return class_index(self.classes, class_name, self.title)


def as_images(name: str, images: object) -> Tensor:
    """Convert images to a tensor of floating-point numbers."""
    if isinstance(images, Tensor | np.ndarray) and images.dtype in (torch.uint8, np.uint8):
        raise InputError(
            f"{name} is {describe(images)}: use floating-point RGB in [0, 1], such as {name} / 255"
        )
    return as_tensor(name, images)


def require_unit_range(name: str, *extremes: Tensor) -> None:
    """Check that the values of images are in [0, 1], with a tolerance of `OVERSHOOT`.

    `extremes` are the lowest and the highest value, or nothing without images.
    """
    if not extremes:
        return
    low, high = torch.stack(extremes).tolist()
    if not (low >= -OVERSHOOT and high <= 1 + OVERSHOOT):
        raise InputError(
            f"{name} has values from {low:g} to {high:g}: "
            "use RGB in [0, 1], without normalization (divide bytes by 255)",
        )


def as_class_names(name: str, classes: object) -> tuple[str, ...]:
    """Convert a list of names of classes to a tuple of strings."""
    names = as_list(
        name, classes, str, "a list of the names of the classes, in the order of the logits"
    )
    return tuple(map(composed, names))


def class_index(classes: Sequence[str], name: str | int, subject: str) -> int:
    """Return the index of a class.

    The name may be an index, also as text. `subject` starts the error, which suggests similar
    names.
    """
    require_kind("label", name, str | int, "the name of a class, or its index")
    text = composed(str(name))
    names = [*map(composed, classes)]
    if isinstance(name, str) and text in names:
        return names.index(text)
    is_index = text.isascii() and text.isdecimal()
    if isinstance(name, str) and not is_index and _are_indices(classes):
        raise InputError(
            f"{subject}: {name!r} is a name, but the classes have only indices: "
            f"give an index from 0 to {len(classes) - 1}, or name the classes",
        )
    if is_index:
        if int(text) < len(classes):
            return int(text)
        raise InputError(
            f"{subject}: the label {text} is not a class: indices go from 0 to {len(classes) - 1}",
        )
    raise InputError(
        f"{subject}: {name!r} is not a class of the model: "
        f"choose one, such as {nearest(text, classes)}",
    )


def _are_indices(classes: Sequence[str]) -> bool:
    """Return whether the names of classes are "0", "1" and so on."""
    return [*classes] == [str(index) for index in range(len(classes))]


def nearest(name: str, choices: Sequence[str]) -> str:
    """Return the three names that are most similar to a misspelled name, as one text."""
    return ", ".join(difflib.get_close_matches(name, choices, n=3, cutoff=0))


def remembering(classifier: Classifier) -> Classifier:
    """Return a copy of a classifier that classifies each different image only once."""
    if isinstance(classifier.network, Remembered):
        return classifier
    network = Remembered(classifier.network)
    remembered = Classifier(network, classifier.size, classifier.classes, classifier.name)
    remembered.operating_points = classifier.operating_points
    return remembered


def log_odds(logits: Float[Tensor, "N classes"], label: int) -> Float[Tensor, " N"]:
    """Compute the log-odds of a class, log(p / (1 − p)), where p is its probability.

    The result is finite even if p rounds to 0 or 1.
    """
    others = torch.cat([logits[:, :label], logits[:, label + 1 :]], dim=1)
    return logits[:, label] - others.logsumexp(dim=1)
