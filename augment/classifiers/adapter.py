"""The class `Classifier`: a network that takes rendered images, with the names of its classes.

The network may be the user's own. A function of a Python module then returns it.
"""

from __future__ import annotations

import difflib
import importlib
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from augment.classifiers.normalized_light import normalize_light
from augment.losses import log_odds
from augment.settings import NormalizedLightSettings, NormalizeLight, read_normalized_light
from renderer.errors import InputError, describe, is_out_of_memory, require_range, single_line
from renderer.settings import MAX_SIZE
from renderer.validation import as_list, as_tensor, require_kind, require_whole

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

# Name of one positive class, or names of several.
Label = str | Sequence[str]
# `require_unit_range` accepts image values that exceed [0, 1] by at most this much.
# Interpolation and noise can produce such values.
OVERSHOOT = 0.1
# `NetworkCall` refuses a network that returned probabilities for this many images.
# Logits of a single image may be in [0, 1] and sum to 1 by chance.
MIN_PROBABILITY_ROWS = 2
# Value of all pixels of the image with which `Classifier.has_gradients` calls a function.
GRAY = 0.5


@dataclass(frozen=True)
class OperatingPoint:
    """Threshold on the log-odds of a class. Images above it are classified as the class.

    The threshold is the lowest at which the false-positive rate on a folder of
    photographs is at most `false_positive_rate`.

    Attributes:
        label: Name of the class.
        threshold: Log-odds above which an image is classified as the class.
        false_positive_rate: Largest allowed fraction of negatives above the
            threshold, in [0, 1].
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
    """Calls a network and checks that it returns logits.

    Attributes:
        name: Start of error messages, such as "classifier NAME".
        probability_rows: Number of images so far for which the network returned
            probabilities. None after the first batch that has other values.
            Later batches are then no longer checked, which saves time.
    """

    def __init__(self, name: str):
        self.name = name
        self.probability_rows: int | None = 0

    def __call__(
        self, network: Callable[[Tensor], Tensor], images: Tensor, classes: int | None = None
    ) -> Tensor:
        """Compute the logits of images.

        Args:
            network: Any callable from images to logits.
            images: RGB in [0, 1], shape (N, 3, H, W).
            classes: Number of classes C, None if unknown.

        Returns:
            Logits, shape (N, C).

        Raises:
            InputError: If the network fails, or does not return one row of
                logits for each image.
        """
        shape = tuple(images.shape)
        try:
            logits = network(images)
        except Exception as error:
            # `BatchSize` needs errors of memory as they are, and an `InputError` is clear already.
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
        self, network: Callable[[Tensor], Tensor], images: Tensor, error: Exception
    ) -> str:
        """Write the error message for a network that raised an error.

        Args:
            network: The network.
            images: Images with which the network was called, shape (N, 3, H, W).
            error: Error that the network raised.

        Returns:
            A sentence with the error and a remedy. If no weight of the network has the dtype of
            the images, the remedy is another dtype.
        """
        weights = network.parameters() if isinstance(network, nn.Module) else iter(())
        dtypes = {weight.dtype for weight in weights if weight.is_floating_point()}
        given = f"{images.dtype} images {tuple(images.shape)}".removeprefix("torch.")
        reason = f"{self.name} fails on {given} ({type(error).__name__}: {single_line(error)})"
        if dtypes and images.dtype not in dtypes:
            of_weights = ", ".join(sorted(str(dtype).removeprefix("torch.") for dtype in dtypes))
            remedy = f"convert it with network.to({images.dtype}), or use light in {of_weights}"
            return f"{reason}: its weights are {of_weights}, {remedy}"
        return f"{reason}: use a network that takes such images"

    def _require_no_probabilities(self, logits: Tensor) -> None:
        """Raise InputError if the network has returned probabilities so far.

        Args:
            logits: Outputs of the network for a batch, shape (N, C).
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
                "remove its softmax, or return its logarithm",
            )


def are_probabilities(outputs: Tensor) -> bool:
    """Return whether outputs of a network are probabilities.

    Args:
        outputs: Outputs for N images and C classes, shape (N, C).

    Returns:
        Whether all values are in [0, 1] and each row sums to 1 up to rounding.
        Outputs with a single class do not count as probabilities.
    """
    if outputs.shape[1] < 2 or not outputs.is_floating_point():
        return False
    values = outputs.detach()
    rounding = max(1e-5, torch.finfo(values.dtype).eps)
    deviation = (values.double().sum(1) - 1).abs().max()
    return bool((values.min() >= 0) & (deviation <= rounding))


class Classifier(nn.Module):
    """Frozen classifier from RGB images in [0, 1] to logits of C classes.

    The logits of a network are differentiable with respect to the pixels. The parameters of
    the network need no gradient. The network stays in evaluation mode, even
    after `train()`. Images are not resized.

    Args:
        function: Network, or another function from images (N, 3, size, size),
            tensors or NumPy arrays, to logits (N, C). If it is a module, it is
            frozen, put in evaluation mode and moved with the classifier.
        size: Pixels per side of the images, from 1 to 4,096.
        classes: Names of the C classes in the order of the logits. Each name
            occurs once, because labels are found by name.
        name: Name of the classifier in messages.
        normalize_light: Whether the light of each image is normalized before
            the network sees it: True, or a mapping with fields of
            `NormalizedLightSettings`.

    Attributes:
        operating_points: Thresholds for `detect`, at most one for each class.
            Empty if the network stores none.

    Raises:
        InputError: If a class name occurs twice, if there is no class, or if
            the size is out of range.
    """

    operating_points: Sequence[OperatingPoint] = ()

    def __init__(
        self,
        function: Callable[[Tensor], Tensor],
        size: int,
        classes: Sequence[str],
        name: str = "callable",
        normalize_light: NormalizeLight = None,
    ):
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
        if not 0 < len(set(self.classes)) == len(self.classes):
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
        # Lowest and highest value of all images.
        extremes = torch.aminmax(images.detach()) if len(images) else ()
        logits = self._call_network(self.function, images, len(self.classes))
        # The range is checked after the network was called: on a GPU, this check waits
        # for results, and the network computes meanwhile.
        require_unit_range("images", *extremes)
        if not logits.is_floating_point() or not logits.isfinite().all():
            raise InputError(f"{name} returned NaN or infinite logits: check its weights")
        if torch.is_grad_enabled() and images.requires_grad and not logits.requires_grad:
            raise InputError(
                f"{name} returned logits without a gradient: compute them in torch, "
                "or choose optimizer='random_search'"
            )
        return logits

    @property
    def normalized_light(self) -> NormalizedLightSettings | None:
        """How the light of images is normalized first. None if it is not."""
        return light_settings(self.function)

    def normalizing_light(self, normalize_light: NormalizeLight = True) -> Classifier:
        """Return a classifier of the same network that normalizes the light of images first.

        It has no operating points, because its log-odds differ.

        Args:
            normalize_light: True, or a mapping with fields of
                `NormalizedLightSettings`. None or False returns the classifier
                as it is.

        Returns:
            The classifier. It shares the network.

        Raises:
            InputError: If the light is normalized already.

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

    @cached_property
    def has_gradients(self) -> bool:
        """Whether the logits are differentiable in the pixels.

        A network of torch with weights is assumed to have differentiable
        logits. Any other function is called with a gray image to find out.
        """
        parameters = self.function.parameters() if isinstance(self.function, nn.Module) else ()
        weight = next(iter(parameters), None)
        if weight is not None:
            return True
        gray = torch.full((1, 3, self.size, self.size), GRAY, requires_grad=True)
        try:
            with torch.enable_grad():
                return bool(self._call_network(self.function, gray).requires_grad)
        except InputError:
            # A function that converts images to NumPy fails on images with gradients.
            return False

    def detect(
        self, images: Float[Tensor, "N 3 size size"], label: str | None = None
    ) -> Bool[Tensor, " N"]:
        """Decide which images show a class, by the threshold of its operating point.

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
            remedy = f"set label to one of {known}" if known else "store one with pnb-publish"
            raise InputError(
                f"classifier {self.name} has no operating point for label={label}: {remedy}",
            )
        (point,) = points
        return log_odds(self(images).double(), self.label(point.label)) > point.threshold

    def train(self, mode: bool = True) -> Self:
        """Keep evaluation mode: running batch statistics and no dropout."""
        return super().train(False)

    def label(self, class_name: str | int) -> int:
        """Return the index of a class.

        Args:
            class_name: Name of the class, or its index.

        Returns:
            The index.

        Raises:
            InputError: If there is no such class. The sentence suggests the
                nearest names.
        """
        return class_index(self.classes, class_name, f"classifier {self.name}")


def as_images(name: str, images: object) -> Tensor:
    """Convert images to a tensor of floating-point numbers.

    Args:
        name: Name of the argument, for errors.
        images: Tensor, NumPy array or nested list.

    Returns:
        The images.

    Raises:
        InputError: If the images are bytes, or not numbers.
    """
    if isinstance(images, Tensor | np.ndarray) and images.dtype in (torch.uint8, np.uint8):
        raise InputError(
            f"{name} is {describe(images)}: use floating-point RGB in [0, 1], such as {name} / 255"
        )
    return as_tensor(name, images)


def require_unit_range(name: str, *extremes: Tensor) -> None:
    """Check that values of images are in [0, 1], up to `OVERSHOOT`.

    Args:
        name: Name of the argument, for the error.
        extremes: The lowest and the highest value. Empty if there are no
            images.

    Raises:
        InputError: If a value is NaN or far from [0, 1]. This happens with
            bytes and with normalized images.
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
    """Convert the names of classes to a tuple of strings.

    Args:
        name: Name of the argument, for errors.
        classes: List of names in the order of the logits.

    Returns:
        The names.

    Raises:
        InputError: If `classes` is not a list of strings. A single string is
            refused, too.
    """
    return tuple(
        as_list(
            name, classes, str, "a list of the names of the classes, in the order of the logits"
        )
    )


class Wrapper(nn.Module):
    """Module that holds another network and passes images to it.

    Subclasses change the images before, or the logits after.

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
    """Return the network that is inside of nested `Wrapper` modules, or the network itself."""
    while isinstance(network, Wrapper):
        network = network.network
    return network


class ArrayFunction(Wrapper):
    """A function that computes scores without torch, for tensors. It has no gradients.

    If its first scores are probabilities, it returns the logarithms of all.

    Args:
        function: Function from images (N, 3, H, W), in [0, 1], to scores
            (N, C), an array of NumPy or lists of numbers.
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

    def forward(self, images: Tensor) -> Tensor:
        """Compute the scores of images.

        Args:
            images: Images in [0, 1], shape (N, 3, H, W).

        Returns:
            Scores, or logarithms of probabilities, in the dtype and on the device of the
            images, shape (N, C).
        """
        detached = images.detach()
        given = detached if self.takes_tensors else detached.cpu().float().numpy()
        scores = torch.as_tensor(np.asarray(self.network(given))).to(images)
        if self.has_probabilities is None and scores.ndim == 2:
            self.has_probabilities = are_probabilities(scores)
        if self.has_probabilities:
            # The logarithm of 0 is infinite, so 0 is replaced by the smallest positive number.
            return scores.clamp(min=torch.finfo(scores.dtype).tiny).log()
        return scores


class AnyFunction(Wrapper):
    """A function from images to scores, which takes tensors or NumPy arrays.

    The first call finds out which: it gives the function a tensor, and a NumPy
    array if the function then fails or returns no tensor.

    Attributes:
        call: Function from tensors to scores. None before the first call.
    """

    def __init__(self, function: Callable[[Any], Any]):
        super().__init__(function)
        self.call: Callable[[Tensor], Tensor] | None = None

    def forward(self, images: Tensor) -> Tensor:
        """Compute the scores (N, C) of images (N, 3, H, W)."""
        # A former call has found out what the function takes.
        if self.call is not None:
            return self.call(images)
        failure = None
        try:
            scores = self.network(images)
            if isinstance(scores, Tensor):
                self.call = self.network
                return scores
        except Exception as error:  # Users' functions raise errors of many kinds.
            failure = error
        # The function failed on a tensor, or returned no tensor. It may take arrays of NumPy.
        # Or it may take tensors that are cut from the gradient, and return arrays.
        for takes_tensors in (False, True):
            converted = ArrayFunction(self.network, takes_tensors)
            with suppress(Exception):
                scores = converted(images)
                self.call = converted
                return scores
        if failure is not None:
            raise failure
        return scores  # `NetworkCall` says what is wrong with it.


class Normalized(Wrapper):
    """Network that takes RGB images in [0, 1] and normalizes them as (x − mean) / std.

    The images are stored channels last, with which convolutions on a CPU are
    about a quarter faster.

    Args:
        network: Network that takes normalized images (N, 3, H, W).
        mean: Mean of the three channels in the network's order, in units of
            [0, 1].
        std: Standard deviation of the channels, in the same order and unit.
        bgr: Whether the network takes blue as the first channel.
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
    """Network that takes RGB images in [0, 1] and first normalizes their light.

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
        """Return the settings, by which stored logits of networks are told apart."""
        return str(self.settings)


def with_normalized_light(network: nn.Module, value: NormalizeLight) -> nn.Module:
    """Put the normalization of light in front of a network.

    Args:
        network: Network that takes RGB images in [0, 1].
        value: Value of `normalize_light`, see `read_normalized_light`.

    Returns:
        The network itself if `value` is None or False.

    Raises:
        InputError: If the light is normalized already, or if the value is wrong.
    """
    settings = read_normalized_light(value)
    if settings is None:
        return network
    if light_settings(network) is not None:
        raise InputError(
            "normalize_light is given, and the network normalizes light already: leave it out",
            "normalize_light",
        )
    normalized = NormalizedLight(network, settings)
    # Networks of torch.export refuse a change of the mode.
    normalized.training = network.training
    return normalized


def light_settings(network: object) -> NormalizedLightSettings | None:
    """Return how a network normalizes light. None if it does not."""
    return network.settings if isinstance(network, NormalizedLight) else None


def without_normalized_light(network: Any) -> Any:
    """Return the network behind the normalization of light, or the network itself."""
    return network.network if isinstance(network, NormalizedLight) else network


def class_index(classes: Sequence[str], name: str | int, subject: str) -> int:
    """Return the index of a class.

    Args:
        classes: Names of all classes.
        name: Name of the class, or its index, which may be written as text.
        subject: Start of the error, such as "label" or "classifier NAME": the
            argument that names the class, or the thing that lacks it.

    Returns:
        The index.

    Raises:
        InputError: If there is no such class. The sentence suggests the nearest
            names.
    """
    require_kind("label", name, str | int, "the name of a class, or its index")
    if name in classes:
        return classes.index(str(name))
    text = str(name)
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
    """Return the three most similar choices as one text.

    Args:
        name: Name that was given.
        choices: Names to choose from.

    Returns:
        The nearest names, such as "a, b, c".
    """
    return ", ".join(difflib.get_close_matches(name, choices, n=3, cutoff=0))


def load_python(name: str) -> Classifier:
    """Call a function of a user that makes a network.

    Args:
        name: "package.module:function" or "package.module.function", see
            `call_python`.

    Returns:
        The classifier.

    Raises:
        InputError: If there is no such function, or if the function or its
            module raises or returns something else.
    """
    return Classifier(*call_python(name), f"python:{name}")


def call_python(name: str) -> tuple[Callable[[Tensor], Tensor], int, Sequence[str]]:
    """Call a function of a user that makes a network, and check what it returns.

    Args:
        name: "package.module:function" or "package.module.function". The module
            is in the current folder or installed.

    Returns:
        Three values: the network, which maps RGB images (N, 3, size, size) in
        [0, 1] to logits; the pixels per side of its images; and the names of
        its classes in the order of the logits.

    Raises:
        InputError: If there is no such function, or if the function or its
            module raises or returns something else.
    """
    separator = ":" if ":" in name else "."
    module_name, _, function_name = name.rpartition(separator)
    current_folder = str(Path.cwd())
    if current_folder not in sys.path:
        sys.path.insert(0, current_folder)
    try:
        module = importlib.import_module(module_name)
        if not hasattr(module, function_name):
            choices = nearest(function_name, [*vars(module)])
            raise InputError(
                f"name=python:{name}: {module.__file__} has no function {function_name}: "
                f"did you mean {choices}?",
                "name",
            )
        network, size, classes = getattr(module, function_name)()
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # The user's code may raise any exception.
        if isinstance(error, ModuleNotFoundError) and error.name == module_name:
            raise InputError(
                f"name=python:{name}: there is no module {module_name} in {current_folder}: "
                "start the command beside it",
                "name",
            ) from error
        last_call = traceback.extract_tb(error.__traceback__)[-1]
        kind = type(error).__name__
        place = f"line {last_call.lineno} of {last_call.filename}"
        reason = single_line(error)  # type: ignore[arg-type]
        raise InputError(
            f"name=python:{name} fails ({kind}: {reason}, in {place}): "
            "use python:package.module:function, which returns (module, size, classes)",
            "name",
        ) from error
    # A string is a sequence of strings, too, but no list of names.
    is_list = isinstance(classes, Sequence) and not isinstance(classes, str)
    has_names = is_list and all(type(item) is str for item in classes)
    if not (callable(network) and type(size) is int and has_names):
        kinds = ", ".join(type(item).__name__ for item in (network, size, classes))
        raise InputError(
            f"name=python:{name} returns ({kinds}): "
            "return (torch.nn.Module, pixels per side, class names)",
            "name",
        )
    return network, size, classes
