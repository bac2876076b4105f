"""The class `Classifier`: a network that takes rendered images, with the names of its classes.

A classifier shows its network batches of images in evaluation mode, and checks its outputs.
"""

from __future__ import annotations

import difflib
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from typing import Any, Self, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_pre_hook

from augment.losses import log_odds
from augment.progress import progress
from augment.settings import NormalizedLightSettings, NormalizeLight, read_normalized_light
from augment.transforms import normalize_light
from renderer.errors import (
    InputError,
    composed,
    describe,
    is_out_of_memory,
    require_range,
    single_line,
)
from renderer.image import to_unit
from renderer.settings import MAX_SIZE
from renderer.validation import as_list, as_tensor, require_kind, require_whole

# Name of one positive class, or names of several.
Label = str | Sequence[str]
# Image values may exceed the range [0, 1] by at most this much, because of interpolation and noise.
OVERSHOOT = 0.1
# A network is refused if its outputs for this many images look like probabilities. The logits of a
# single image may do so by chance.
MIN_PROBABILITY_ROWS = 2
# Probabilities may be rounded to multiples of this number.
ROUNDED = 1e-3
# The sum of many rounded probabilities may differ from 1 by at most this much.
MAX_DEVIATION = 0.01
# Pixel value of the gray image with which a function is called to find out whether it has
# gradients.
GRAY = 0.5


# Number of images that a network sees at a time if nothing else is said.
BATCH = 256

Result = TypeVar("Result")


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


class NetworkCall:
    """Call a network, and check that it returns logits and no probabilities.

    Attributes:
        name: Name of the network at the start of error messages.
        probability_rows: Number of images so far whose outputs look like
            probabilities. None as soon as a batch has other outputs. Then no
            further batch is checked, which saves time.
    """

    def __init__(self, name: str):
        self.name = name
        self.probability_rows: int | None = 0

    def __call__(
        self,
        network: Callable[[Tensor], Tensor],
        images: Float[Tensor, "N 3 H W"],
        classes: int | None = None,
    ) -> Float[Tensor, "N C"]:
        """Compute the logits of images, and check them."""
        shape = tuple(images.shape)
        try:
            logits = network(images)
        except Exception as error:
            # The caller handles errors of memory. An `InputError` already tells what is wrong.
            if isinstance(error, InputError) or is_out_of_memory(error):
                raise
            raise InputError(self._failure(network, images, error)) from error
        expected = (len(images), "C" if classes is None else classes)
        has_row_per_image = (
            isinstance(logits, Tensor) and logits.ndim == 2 and len(logits) == len(images)
        )
        if not has_row_per_image or classes not in (None, logits.shape[1]):
            returned = tuple(logits.shape) if isinstance(logits, Tensor) else type(logits).__name__
            remedy = f"it must return logits {expected}"
            if hasattr(logits, "logits") or (isinstance(logits, dict) and "logits" in logits):
                remedy = "give a function that returns its logits alone"
            raise InputError(f"{self.name} returned {returned} for images {shape}: {remedy}")
        self._require_no_probabilities(logits)
        return logits

    def _failure(
        self,
        network: Callable[[Tensor], Tensor],
        images: Float[Tensor, "N 3 H W"],
        error: Exception,
    ) -> str:
        """Return the message of the error for a network that failed on images."""
        weights = network.parameters() if isinstance(network, nn.Module) else iter(())
        dtypes = {weight.dtype for weight in weights if weight.is_floating_point()}
        given = f"{images.dtype} images {tuple(images.shape)}".removeprefix("torch.")
        reason = f"{self.name} fails on {given} ({type(error).__name__}: {single_line(error)})"
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
                f"{self.name} returned probabilities (values in [0, 1] that sum to 1) instead "
                "of logits: "
                "remove the softmax of the network, or return the logarithms of the probabilities",
            )


def are_probabilities(outputs: Float[Tensor, "N C"]) -> bool:
    """Return whether outputs of a network are probabilities.

    They are in [0, 1], and each row sums to 1 up to rounding to three decimals. A single class does
    not count.
    """
    if outputs.shape[1] < 2 or not outputs.is_floating_point():
        return False
    values = outputs.detach()
    rounding = max(torch.finfo(values.dtype).eps, ROUNDED * outputs.shape[1] / 2)
    deviation = (values.double().sum(1) - 1).abs().max()
    return bool((values.min() >= 0) & (deviation <= min(rounding, MAX_DEVIATION)))


class Classifier(nn.Module):
    """Frozen classifier from RGB images in [0, 1] to logits of C classes.

    If the function is a network of torch, the logits are differentiable with
    respect to the pixels. The parameters of the network get no gradient. The
    network stays in evaluation mode, even after `train()`. Images are not
    resized.

    Args:
        function: Function from images, shape (N, 3, size, size), to logits,
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
        function: Callable[[Tensor], Tensor],
        size: int,
        classes: Sequence[str],
        name: str = "callable",
        normalize_light: NormalizeLight = None,
    ):
        """Check the arguments, which the docstring of the class explains. Freeze the function."""
        super().__init__()
        require_kind("name", name, str, "a string for messages")
        require_kind(
            "function", function, Callable, "a torch.nn.Module, or a function from images to logits"
        )
        require_whole(f"classifier {name}: size", size)
        require_range(f"classifier {name}: size", size, 1, MAX_SIZE)
        module = function if isinstance(function, nn.Module) else AnyFunction(function)
        self.function: Callable[[Tensor], Tensor] = with_normalized_light(module, normalize_light)
        self.size = size
        self.classes = as_class_names(f"classifier {name}: classes", classes)
        self.name = name
        self._call_network = NetworkCall(f"classifier {name}")
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
        name = f"classifier {self.name}"
        size = self.size
        images = as_images("images", images)
        if images.shape[1:] != (3, size, size):
            remedy = f"render at {size} pixels per side"
            if images.shape == (3, size, size):
                remedy = "give a batch, such as images[None]"
            elif images.shape[1:] == (size, size, 3):
                remedy = "put the channels first, such as images.permute(0, 3, 1, 2)"
            raise InputError(
                f"{name} takes images (N, 3, {size}, {size}), not {tuple(images.shape)}: {remedy}"
            )
        # Lowest and highest value of all images. There are none if the batch is empty.
        extremes = torch.aminmax(images.detach()) if len(images) else ()
        logits = self._call_network(self.function, images, len(self.classes))
        # Check the range of the images after the call of the network. The check waits until the
        # GPU is idle.
        require_unit_range("images", *extremes)
        if not logits.is_floating_point() or not logits.isfinite().all():
            raise InputError(
                f"{name} returned NaN or infinite logits: check the weights of the network"
            )
        if torch.is_grad_enabled() and images.requires_grad and not logits.requires_grad:
            raise InputError(
                f"{name} returned logits without a gradient: compute them in torch, "
                "or choose optimizer='random_search'"
            )
        return logits

    @property
    def normalized_light(self) -> NormalizedLightSettings | None:
        """Settings with which the light of images is normalized. None if it is not normalized."""
        return light_settings(self.function)

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
        return Classifier(self.function, self.size, self.classes, self.name, normalize_light)

    def is_differentiable(self, like: Tensor) -> bool:
        """Return whether the logits are differentiable in the pixels.

        A network of torch with weights is assumed to have differentiable
        logits. Any other function is called with a gray image to find out.

        Args:
            like: Tensor with the dtype and the device of the image.
        """
        parameters = self.function.parameters() if isinstance(self.function, nn.Module) else ()
        weight = next(iter(parameters), None)
        if weight is not None:
            return True
        gray = like.new_full((1, 3, self.size, self.size), GRAY, requires_grad=True)
        try:
            with torch.enable_grad():
                return bool(self._call_network(self.function, gray).requires_grad)
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
                f"classifier {self.name} has no operating point for label={label}: {remedy}",
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
        return class_index(self.classes, class_name, f"classifier {self.name}")


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


class Wrapper(nn.Module):
    """Base class of modules that change the images or the logits of another network.

    Args:
        network: Module or function from images to logits.
    """

    def __init__(self, network: Callable[[Any], Any]):
        super().__init__()
        self.network: Any = network

    def forward(self, images: Tensor) -> Tensor:
        """Compute the logits (N, C) of images (N, 3, H, W)."""
        return self.network(images)


def unwrapped(network: Any) -> Any:
    """Remove all `Wrapper` modules from around a network, and return the network inside."""
    while isinstance(network, Wrapper):
        network = network.network
    return network


class ArrayFunction(Wrapper):
    """Make a module of a function that computes scores without torch. It has no gradients.

    If the scores of the first call are probabilities, the module returns the
    logarithms of the scores in all calls.

    Args:
        function: Function from images in [0, 1], shape (N, 3, H, W), to scores,
            shape (N, C), as an array of NumPy or as lists of numbers.
        takes_tensors: Whether the function takes tensors. Otherwise, it takes
            arrays of float32.

    Attributes:
        has_probabilities: Whether the scores are probabilities. None before the
            first call.
    """

    def __init__(self, function: Callable[[Any], Any], takes_tensors: bool = False):
        super().__init__(function)
        self.takes_tensors = takes_tensors
        self.has_probabilities: bool | None = None

    def forward(self, images: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N C"]:
        """Compute the scores of images, or their logarithms if they are probabilities."""
        detached = images.detach()
        given = detached if self.takes_tensors else detached.cpu().float().numpy()
        scores = torch.as_tensor(np.asarray(self.network(given))).to(images)
        if self.has_probabilities is None and scores.ndim == 2:
            self.has_probabilities = are_probabilities(scores)
        if self.has_probabilities:
            # Replace 0 by the smallest positive number, because the logarithm of 0 is infinite.
            return scores.clamp(min=torch.finfo(scores.dtype).tiny).log()
        return scores


class AnyFunction(Wrapper):
    """Make a module of a function from images to scores that takes tensors or NumPy arrays.

    The first call finds out which of them the function takes: it is called with
    a tensor and, if it fails or does not return a tensor, with a NumPy array.

    Attributes:
        call: Function that takes tensors and returns scores as a tensor. None
            before the first call.
    """

    def __init__(self, function: Callable[[Any], Any]):
        super().__init__(function)
        self.call: Callable[[Tensor], Tensor] | None = None

    def forward(self, images: Tensor) -> Tensor:
        """Compute the scores (N, C) of images (N, 3, H, W)."""
        # The first call has found out what the function takes.
        if self.call is not None:
            return self.call(images)
        in_training: list[str] = []

        def note(module: nn.Module, _: object) -> None:
            # Transformations of images are modules in training mode, too, but have no weights.
            has_weights = any(True for _ in module.parameters(recurse=False))
            has_mode = isinstance(
                module, nn.modules.dropout._DropoutNd | nn.modules.batchnorm._NormBase
            )
            if module.training and (has_weights or has_mode):
                in_training.append(type(module).__name__)

        hook = register_module_forward_pre_hook(note)
        try:
            scores = self._first_call(images)
        finally:
            hook.remove()
        if in_training:
            self.call = None
            raise InputError(
                f"the function calls a network in training mode ({in_training[0]}): "
                "call the method eval() of the network first"
            )
        return scores

    def _first_call(self, images: Tensor) -> Tensor:
        """Compute the scores (N, C) of images, and find out what the function takes."""
        failure = None
        try:
            scores = self.network(images)
            if isinstance(scores, Tensor):
                self.call = self.network
                return scores
        except Exception as error:  # Users' functions raise errors of many kinds.
            failure = error
        # The function failed on a tensor, or did not return one. Try an array of NumPy, then a
        # tensor without a gradient.
        for takes_tensors in (False, True):
            converted = ArrayFunction(self.network, takes_tensors)
            with suppress(Exception):
                scores = converted(images)
                self.call = converted
                return scores
        if failure is not None:
            raise failure
        return scores  # The caller raises an error, because this is not a tensor.


class Normalized(Wrapper):
    """Normalize RGB images in [0, 1] as (x − mean) / std before a network.

    The normalized images have the memory layout "channels last", with which
    convolutions on a CPU are about a quarter faster.

    Args:
        network: Network that takes normalized images (N, 3, H, W).
        mean: Mean of the three channels, in units of [0, 1] and in the order of
            the network.
        std: Standard deviation of the channels, in the same unit and order.
        bgr: Whether the channels of the network are blue, green and red.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, network: nn.Module, mean: Sequence[float], std: Sequence[float], bgr: bool = False
    ):
        super().__init__(network)
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1))
        self.bgr = bgr

    def forward(self, images: Tensor) -> Tensor:
        """Compute the logits (N, C) of RGB images (N, 3, H, W) in [0, 1]."""
        ordered = images.flip(1) if self.bgr else images
        normalized = (ordered - self.mean) / self.std
        return self.network(normalized.contiguous(memory_format=torch.channels_last))


class NormalizedLight(Wrapper):
    """Normalize the light of RGB images in [0, 1] before a network.

    Args:
        network: Network that takes RGB images (N, 3, H, W) in [0, 1].
        settings: How the light is normalized.
    """

    def __init__(self, network: nn.Module, settings: NormalizedLightSettings):
        super().__init__(network)
        self.settings = settings

    def forward(self, images: Tensor) -> Tensor:
        """Compute the logits (N, C) of RGB images (N, 3, H, W) in [0, 1]."""
        return self.network(normalize_light(images, self.settings))

    def extra_repr(self) -> str:
        """Return the settings as a part of the text of the module.

        The text distinguishes the stored logits of different networks.
        """
        return str(self.settings)


def with_normalized_light(network: nn.Module, value: NormalizeLight) -> nn.Module:
    """Return a network that normalizes the light of images and then calls a given network."""
    settings = read_normalized_light(value)
    if settings is None:
        return network
    if light_settings(network) is not None:
        raise InputError(
            "normalize_light is set, but the network normalizes light already: "
            "remove normalize_light",
            "normalize_light",
        )
    normalized = NormalizedLight(network, settings)
    # Copy the mode without a call of `train`, which networks of torch.export refuse.
    normalized.training = network.training
    return normalized


def light_settings(network: object) -> NormalizedLightSettings | None:
    """Return the settings with which a network normalizes light. None if it does not."""
    return network.settings if isinstance(network, NormalizedLight) else None


def without_normalized_light(network: Any) -> Any:
    """Remove the normalization of light, if there is one, from in front of a network."""
    return network.network if isinstance(network, NormalizedLight) else network


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


class Remembered(Wrapper):
    """Call a function from images to scores only once for each different image.

    An attack shows the same image to a classifier several times: before, during
    and after the search. This is expensive if the function is slow or paid for.
    The scores have no gradients.

    Attributes:
        scores: Scores of the C classes for each image so far, shape (C,), by the
            hash of the image.
    """

    def __init__(self, network: Callable[[Tensor], Tensor]):
        super().__init__(network)
        self.scores: dict[bytes, Tensor] = {}

    def forward(self, images: Tensor) -> Tensor:
        """Compute the scores (N, C) of images (N, 3, H, W)."""
        keys = [_digest(image) for image in images.detach().cpu()]
        # Index of each new image in the batch, by its hash. Equal images have one entry.
        new_images = {}
        for index, key in enumerate(keys):
            if key not in self.scores:
                new_images[key] = index
        if new_images:
            indices = torch.tensor(list(new_images.values()), device=images.device)
            scores = self.network(images.detach()[indices])
            self.scores.update(zip(new_images, scores.detach(), strict=True))
        return torch.stack([self.scores[key] for key in keys]).to(images)


def _digest(image: Tensor) -> bytes:
    """Return a hash of the dtype and the values of an image (3, H, W)."""
    content = image.numpy().tobytes()
    return blake2b(content, digest_size=16, key=str(image.dtype).encode()).digest()


def remembering(classifier: Classifier) -> Classifier:
    """Return a copy of a classifier that classifies each different image only once."""
    if isinstance(classifier.function, Remembered):
        return classifier
    function = Remembered(classifier.function)
    remembered = Classifier(function, classifier.size, classifier.classes, classifier.name)
    remembered.operating_points = classifier.operating_points
    return remembered


@torch.no_grad()
def compute_outputs(
    network: Callable[[Tensor], Tensor],
    images: Tensor | Iterable[Tensor],
    batch_size: int = BATCH,
    device: torch.device | str | None = None,
) -> Tensor:
    """Compute the outputs (..., *) of a network for many images (..., 3, H, W), without gradients.

    The images are in [0, 1] or have 8 bits. They can also come as an iterable of batches
    (N, 3, H, W), which are read one after the other. A network of torch is in eval mode meanwhile.
    `device` is that of the network. None if the images are there, too.
    """
    limit = BatchSize(batch_size)
    batches = images
    if isinstance(images, Tensor):
        batches = progress(images.flatten(0, -4).split(batch_size), "predictions")
    outputs: list[Tensor] = []
    with eval_mode(network):
        for batch in batches:
            moved = batch if device is None else batch.to(device)
            shown = to_unit(moved) if moved.dtype == torch.uint8 else moved
            # No images are a batch, too, which gives outputs their shape.
            computed = limit.map(lambda rows, shown=shown: network(shown[rows]), len(shown) or 1)
            # The network may compute in half precision.
            outputs += [output.to(shown.dtype) for output in computed]
    joined = torch.cat(outputs)
    return joined.unflatten(0, images.shape[:-3]) if isinstance(images, Tensor) else joined


@dataclass
class BatchSize:
    """Number of images that a classifier sees at a time. It is halved when memory runs out.

    Attributes:
        images: Number of images, at least 1. It does not grow again.
    """

    images: int

    def map(self, compute: Callable[[slice], Result], total: int) -> Iterator[Result]:
        """Call a function for one batch of images after the other.

        The function takes the slice of the images of a batch. If memory runs out, it is called
        again with half of it.
        """
        begin = 0
        while begin < total:
            part = slice(begin, begin + self.images)
            try:
                result = compute(part)
            except (RuntimeError, MemoryError) as error:
                if self.images == 1 or not is_out_of_memory(error):
                    raise
                self.images //= 2
                warn_once(self.images)
            else:
                yield result
                begin = part.stop
                continue
            # Empty the cache outside of the `except` block, because the error refers to tensors
            # there.
            torch.cuda.empty_cache()


@cache
def warn_once(images: int) -> None:
    """Warn that memory ran out and batches have fewer images, once for each number of images."""
    logger = logging.getLogger(__name__)
    logger.warning("memory ran out: the attack goes on with %d images per pass", images)


@contextmanager
def eval_mode(network: Any) -> Iterator[None]:
    """Set a network to eval mode in a `with` block, and then restore the mode of each module.

    A function is left as it is.
    """
    modules = network.modules() if isinstance(network, nn.Module) else ()
    training = [module for module in modules if module.training]
    # `eval` of a large network takes as long as rendering an image, so call it only if needed.
    if training:
        network.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True


@contextmanager
def frozen_eval_mode(network: nn.Module) -> Iterator[None]:
    """Set a network to eval mode, without gradients of its parameters, in a `with` block.

    The mode of each module, `requires_grad` of each parameter and the state of
    the global random generators are restored after the block.
    """
    trainable = [parameter for parameter in network.parameters() if parameter.requires_grad]
    gpus = {parameter.device for parameter in network.parameters() if parameter.is_cuda}
    for parameter in trainable:
        parameter.requires_grad_(False)
    try:
        with eval_mode(network), torch.random.fork_rng(devices=sorted(gpus, key=str)):
            yield
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)
