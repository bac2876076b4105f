"""The adapter of a classifier: one module that takes images as the renderer makes them, and names its classes.

Its network may be a user's own, returned by a function of a Python module.
"""

from __future__ import annotations

import difflib
import importlib
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from augment.losses import log_odds
from renderer.errors import InputError, describe, is_out_of_memory, require_range, single_line
from renderer.settings import MAX_SIZE
from renderer.validation import as_list, as_tensor, require_kind, require_whole

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


Label = str | Sequence[str]  # the class under study, or several
OVERSHOOT = 0.1  # beyond [0, 1], of values that an interpolation or noise may give
SEVERAL = 2  # images whose outputs are probabilities before a network is refused for it


@dataclass(frozen=True)
class OperatingPoint:
    """A threshold on the log-odds of the class `label`: images above it are taken for the class.

    It is the lowest that at most the fraction `false_positive_rate` of the `negatives` images of other things exceed in
    a folder of this name, whose `images` have this hash.
    """

    label: str
    threshold: float
    false_positive_rate: float
    folder: str
    images: str
    negatives: int


class NetworkCall:
    """Calls a network and refuses what it returns in place of logits.

    Attributes:
        name: Start of error messages, such as "classifier NAME".
        probability_rows: Number of outputs so far that are probabilities, or None once an output was none. From then
            on, outputs are not compared with probabilities, which costs nothing.
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
            InputError: If the network fails, or returns something else than one row of logits for each image.
        """
        shape = tuple(images.shape)
        try:
            logits = network(images)
        except Exception as error:
            if isinstance(error, InputError) or is_out_of_memory(error):
                raise
            raise InputError(self._failure(network, images, error)) from error
        expected = (len(images), "C" if classes is None else classes)
        fits = isinstance(logits, Tensor) and logits.ndim == 2 and len(logits) == len(images)
        if not fits or classes not in (None, logits.shape[1]):
            returned = tuple(logits.shape) if isinstance(logits, Tensor) else type(logits).__name__
            raise InputError(
                f"{self.name} returned {returned}: make it return logits {expected} of images {shape}"
            )
        self._require_no_probabilities(logits)
        return logits

    def _failure(
        self, network: Callable[[Tensor], Tensor], images: Tensor, error: Exception
    ) -> str:
        """Say why a network fails on images, and what to do about it."""
        weights = network.parameters() if isinstance(network, nn.Module) else iter(())
        dtypes = {weight.dtype for weight in weights if weight.is_floating_point()}
        given = f"{images.dtype} images {tuple(images.shape)}".removeprefix("torch.")
        reason = f"{self.name} fails on {given} ({type(error).__name__}: {single_line(error)})"
        if dtypes and images.dtype not in dtypes:
            of_weights = ", ".join(sorted(str(dtype).removeprefix("torch.") for dtype in dtypes))
            remedy = f"convert it with network.to({images.dtype}), or the light of the scene to {of_weights}"
            return f"{reason}: its weights are {of_weights}, {remedy}"
        return f"{reason}: make it take these"

    def _require_no_probabilities(self, logits: Tensor) -> None:
        """Refuse a network whose first outputs of several images are probabilities."""
        if self.probability_rows is None or not len(logits):
            return
        if not are_probabilities(logits):
            self.probability_rows = None
            return
        self.probability_rows += len(logits)
        if self.probability_rows >= SEVERAL:
            fault = "returned probabilities, which are in [0, 1] and sum to 1, in place of logits"
            raise InputError(
                f"{self.name} {fault}: leave out its softmax, or return the logarithm of its result"
            )


def are_probabilities(outputs: Tensor) -> bool:
    """Tell whether all rows (N, C) of several classes are in [0, 1] and sum to 1 up to rounding."""
    if outputs.shape[1] < 2 or not outputs.is_floating_point():
        return False
    values = outputs.detach()
    rounding = max(1e-5, torch.finfo(values.dtype).eps)
    off = (values.double().sum(1) - 1).abs().max()
    return bool((values.min() >= 0) & (off <= rounding))


class Classifier(nn.Module):
    """A frozen classifier: images, RGB in [0, 1], to logits of C classes; differentiable in the pixels.

    name: for messages. size: pixels per side; images are to be rendered at it, nothing is resized here. classes:
    the C names, each once. The parameters need no gradient and the mode stays eval, also after `train()`.
    operating_points: of a published network that carries some, one for each class, for `detect`.
    """

    operating_points: Sequence[OperatingPoint] = ()

    def __init__(
        self,
        function: Callable[[Tensor], Tensor],
        size: int,
        classes: Sequence[str],
        name: str = "callable",
    ):
        """function: any callable from such images to logits. A module is moved with this one, frozen and put in eval
        mode. InputError for a class name that occurs twice, since labels are found by name, and a size beyond 4,096."""
        super().__init__()
        require_kind("name", name, str, "a string for messages")
        require_kind(
            "function", function, Callable, "a torch.nn.Module, or a function from images to logits"
        )
        require_whole(f"classifier {name}: size", size)
        require_range(f"classifier {name}: size", size, 1, MAX_SIZE)
        self.function = function
        self.size = size
        self.classes = as_class_names(f"classifier {name}: classes", classes)
        self.name = name
        self._call_network = NetworkCall(f"classifier {name}")
        if not 0 < len(set(self.classes)) == len(self.classes):
            remedy = "name its classes, in the order of its logits, by different names"
            raise InputError(f"classifier {name}: {remedy}")
        self.requires_grad_(False).eval()

    def forward(self, images: Float[Tensor, "N 3 size size"]) -> Float[Tensor, "N C"]:
        """InputError for images of another size or far from [0, 1], and for a callable that fails or returns something
        else than finite logits with a gradient, such as probabilities."""
        name = f"classifier {self.name}"
        size = self.size
        images = as_images("images", images)
        if images.shape[1:] != (3, size, size):
            remedy = f"render at {size} pixels per side"
            raise InputError(
                f"{name} takes images (N, 3, {size}, {size}), not {tuple(images.shape)}: {remedy}"
            )
        extremes = torch.aminmax(images.detach()) if len(images) else ()
        logits = self._call_network(self.function, images, len(self.classes))
        require_unit_range("images", *extremes)  # only now, since the host waits here for a GPU
        if not logits.is_floating_point() or not logits.isfinite().all():
            raise InputError(f"{name} returned NaN or infinite logits: check its weights")
        if torch.is_grad_enabled() and images.requires_grad and not logits.requires_grad:
            raise InputError(f"{name} returned logits without a gradient: compute them in torch")
        return logits

    def detect(
        self, images: Float[Tensor, "N 3 size size"], label: str | None = None
    ) -> Bool[Tensor, " N"]:
        """Whether images, RGB in [0, 1], show a class, by the threshold of its operating point instead of argmax.

        label: the class, where there are operating points of several. InputError without one, and as of `forward`.
        """
        require_kind("label", label, str | None, "the name of a class")
        points = [point for point in self.operating_points if label in (None, point.label)]
        if len(points) != 1:
            known = ", ".join(point.label for point in self.operating_points)
            remedy = ": choose one when it is published (pnb-publish)"
            if known:
                remedy = f"s but of {known}: give one of these as label"
            raise InputError(f"classifier {self.name} has no operating point{remedy}")
        (point,) = points
        return log_odds(self(images).double(), self.label(point.label)) > point.threshold

    def train(self, mode: bool = True) -> Self:
        """Stays in eval mode: running batch statistics, no dropout."""
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
    """Convert images to a tensor of floating-point numbers; InputError for bytes and for what is no number."""
    if isinstance(images, Tensor | np.ndarray) and images.dtype in (torch.uint8, np.uint8):
        raise InputError(
            f"{name} is {describe(images)}: give floating-point RGB in [0, 1], such as {name} / 255"
        )
    return as_tensor(name, images)


def require_unit_range(name: str, *extremes: Tensor) -> None:
    """Check that images are RGB in [0, 1], which values may exceed a little.

    Args:
        name: Name of the argument, for the error.
        extremes: The lowest and the highest value; none of no images.

    Raises:
        InputError: If values are far from [0, 1], as of bytes and of normalized images, or NaN.
    """
    if not extremes:
        return
    low, high = torch.stack(extremes).tolist()
    if not (low >= -OVERSHOOT and high <= 1 + OVERSHOOT):
        remedy = "give RGB in [0, 1], not normalized; divide bytes by 255"
        raise InputError(f"{name} holds values from {low:g} to {high:g}: {remedy}")


def as_class_names(name: str, classes: object) -> tuple[str, ...]:
    """Convert the names of classes, in the order of the logits, to a tuple of strings.

    Raises:
        InputError: If it is no list of strings, but for example one string.
    """
    return tuple(
        as_list(
            name, classes, str, "a list of the names of the classes, in the order of the logits"
        )
    )


class Wrapper(nn.Module):
    """A module around a network, whose weights have the names of the network's own file.

    Attributes:
        network: Module or function from images to logits.
    """

    def __init__(self, network: Callable[[Any], Any]):
        super().__init__()
        self.network: Any = network

    def forward(self, images: Tensor) -> Tensor:
        """Compute the logits (N, C) of images (N, 3, H, W)."""
        return self.network(images)


def unwrapped(network: Any) -> Any:
    """Return the network inside all wrappers."""
    while isinstance(network, Wrapper):
        network = network.network
    return network


class ArrayFunction(Wrapper):
    """A function from NumPy arrays to scores, for tensors. It has no gradients.

    Args:
        function: Function from images (N, 3, H, W), float32 in [0, 1], to
            scores (N, C).
    """

    def forward(self, images: Tensor) -> Tensor:
        """Compute the scores (N, C) of images (N, 3, H, W), in the images' dtype."""
        scores = self.network(images.detach().cpu().float().numpy())
        return torch.as_tensor(np.asarray(scores)).to(images)


class Normalized(Wrapper):
    """A network behind its own normalization: takes images (N, 3, H, W), RGB in [0, 1], as (x − mean) / std.

    mean, std: in units of [0, 1] and in the network's own order of channels. bgr: whether that order is blue first.
    The network gets them channels last, in which a CPU convolves about a quarter faster.
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
        ordered = images.flip(1) if self.bgr else images
        return self.network(
            ((ordered - self.mean) / self.std).contiguous(memory_format=torch.channels_last)
        )


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
    if isinstance(name, str) and not name.isdecimal() and _are_indices(classes):
        remedy = f"give an index from 0 to {len(classes) - 1}, or name the classes"
        raise InputError(f"{subject}: the classes have no names, and {name!r} is given: {remedy}")
    if text.isascii() and text.isdecimal():
        if int(text) < len(classes):
            return int(text)
        indices = f"indices go from 0 to {len(classes) - 1}"
        raise InputError(f"{subject}: the label {text} is not a class: {indices}")
    raise InputError(
        f"{subject}: {name!r} is not a class of the model: choose one, such as {nearest(text, classes)}"
    )


def _are_indices(classes: Sequence[str]) -> bool:
    """Tell whether the names of classes are "0", "1" and so on."""
    return [*classes] == [str(index) for index in range(len(classes))]


def nearest(name: str, choices: Sequence[str]) -> str:
    """The three choices most like a name: 'a, b, c'."""
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
    """Call a function of a user that makes a network.

    Args:
        name: "package.module:function" or "package.module.function", found from
            the current folder or installed.

    Returns:
        The network, which is a module or a function from images
        (N, 3, size, size), RGB in [0, 1], to logits; the pixels per side of
        its images; and the names of its classes in the order of its logits.

    Raises:
        InputError: If there is no such function, or if the function or its
            module raises or returns something else.
    """
    module, _, function = name.partition(":") if ":" in name else name.rpartition(".")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        network, size, classes = getattr(importlib.import_module(module), function)()
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # of the user's code, or where there is none
        at = traceback.extract_tb(error.__traceback__)[-1]
        reason = (
            f"{type(error).__name__}: {single_line(error)}, in line {at.lineno} of {at.filename}"  # type: ignore[arg-type]
        )
        expected = "python:package.module:function, which returns (module, size, classes)"
        raise InputError(f"name=python:{name} fails ({reason}): give {expected}", "name") from error
    ordered = isinstance(classes, Sequence) and not isinstance(classes, str)
    if not (
        callable(network) and type(size) is int and ordered and all(type(c) is str for c in classes)
    ):
        kinds = ", ".join(type(item).__name__ for item in (network, size, classes))
        expected = "return (torch.nn.Module, pixels per side, class names)"
        raise InputError(f"name=python:{name} returns ({kinds}): {expected}", "name")
    return network, size, classes
