"""Makes a classifier of a user's plain network.

A plain network contains neither the size of its images nor the names of its
classes. The number of its classes is found by calling it once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from augment.classifiers.adapter import (
    AnyFunction,
    Classifier,
    NetworkCall,
    Normalized,
    as_class_names,
)
from augment.settings import NormalizeLight
from renderer.errors import InputError, as_device, describe, require_file, require_range
from renderer.settings import MAX_SIZE
from renderer.validation import as_list, require_kind, require_whole

# Value of the argument `normalization` that stands for the mean and the standard deviation of
# red, green and blue below. Most networks that were trained on ImageNet use these numbers.
IMAGENET = "imagenet"
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Number of color channels.
COLORS = 3
# Default of the argument `value_range`: the values of black and white.
UNIT_RANGE = (0.0, 1.0)
# Pixels per side of the images of most networks that were trained on ImageNet.
USUAL_SIZE = 224
# Number of images with which `_count_outputs` calls a network. A single row of logits may
# look like probabilities by chance, so there are two.
CHECKED_COUNT = 2
# Class names of the modules of torchvision, kornia and this library that normalize images.
NORMALIZING = frozenset({"Normalize", "Normalized"})
# Names of buffers in which networks that normalize images themselves keep the mean.
MEANS = frozenset({"mean", "image_mean", "pixel_mean"})

Normalization = str | tuple[Sequence[float], Sequence[float]] | None


@dataclass(frozen=True)
class NetworkFacts:
    """Classes, image size and normalization that a user gives for a network.

    Attributes:
        classes: Names of the classes in the order of the outputs. None for the
            names of the source or, if it has none, for "0", "1" and
            so on.
        size: Pixels per side of the images. None for the size of the source.
        normalization: "imagenet", or mean and standard deviation of the
            channels red, green and blue, in units of [0, 1]. None for the
            normalization of the source.
    """

    classes: tuple[str, ...] | None = None
    size: int | None = None
    normalization: Normalization = None


NO_FACTS = NetworkFacts()


def as_facts(
    classes: Sequence[str] | str | Path | None = None,
    size: int | None = None,
    normalization: Normalization = None,
) -> NetworkFacts:
    """Check the classes, size and normalization that a user gives for a network.

    Args:
        classes: Names of the classes, or a text file with a name in each line.
        size: Pixels per side of the images.
        normalization: "imagenet", or mean and standard deviation.

    Returns:
        The facts.

    Raises:
        InputError: If the file is missing, or an argument is of another kind.
    """
    if isinstance(classes, str | Path):
        require_file(classes, "give a text file with the name of a class in each line")
        lines = Path(classes).read_text(encoding="utf-8").splitlines()
        classes = [line.strip() for line in lines if line.strip()]
    names = None if classes is None else as_class_names("classes", classes)
    if size is not None:
        require_whole("size", size)
        require_range("size", size, 1, MAX_SIZE)
    if normalization is not None:
        mean_and_std(normalization)
    return NetworkFacts(names, size, normalization)


def require_no_facts(name: str, facts: NetworkFacts) -> None:
    """Check that no facts are given for a network whose source has its own.

    Args:
        name: Name of the network, for the error.
        facts: Facts that the user gave.

    Raises:
        InputError: If a fact is given.
    """
    for key, value in vars(facts).items():
        if value is not None:
            raise InputError(f"{key} cannot be set for {name}, which has its own: remove it", key)


def index_names(count: int) -> tuple[str, ...]:
    """Return names for classes without names: "0", "1" and so on."""
    return tuple(str(index) for index in range(count))


def as_classifier(
    network: Classifier | Callable[[Tensor], Tensor],
    size: int | None = None,
    classes: Sequence[str] | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    device: torch.device | str | None = None,
    argument: str = "network",
    name: str | None = None,
    normalize_light: NormalizeLight = None,
) -> Classifier:
    """Make a classifier of a plain network, and check it on gray images.

    Args:
        network: A classifier, of which only the light is normalized, or a network from
            images to logits: a `torch.nn.Module` in evaluation mode, or a
            function of tensors or of NumPy arrays.
        size: Pixels per side of the images. None for 224.
        classes: Names of the classes in the order of the logits. None for the
            indices "0", "1" and so on.
        normalization: "imagenet", or mean and standard deviation of the
            channels red, green and blue, in units of [0, 1]. None if the
            network takes images as they are, or normalizes them itself.
        value_range: Values of black and white that the network takes before
            normalization, such as (0, 255) or (-1, 1).
        device: Device of the images. None for that of the network.
        argument: Name of the argument `network` of the caller, for errors.
        name: Name for messages. None for the name of the network's class.
        normalize_light: Whether the light of each image is normalized first:
            True, or a mapping with fields of `NormalizedLightSettings`.

    Returns:
        The classifier. It contains the network itself.

    Raises:
        InputError: If the network is in training mode, would normalize twice,
            fails on the images or returns something else than one row of
            logits for each image, or if the number of names does not fit.

    Example:
        >>> network = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten()).eval()
        >>> classifier = as_classifier(network, size=8, normalization="imagenet")
        >>> classifier.classes
        ('0', '1', '2')
    """
    if isinstance(network, Classifier):
        if classes is not None or normalization is not None or value_range != UNIT_RANGE:
            raise InputError(
                "classes, normalization and value_range are for a plain network: "
                "leave them out, because a Classifier has its own"
            )
        if size not in (None, network.size):
            raise InputError(
                f"size={size} does not fit classifier {network.name}, "
                f"which takes images of {network.size} pixels per side: use this size"
            )
        return network.normalizing_light(normalize_light)
    require_kind(
        argument, network, Callable, "a torch.nn.Module, a function to logits, or a Classifier"
    )
    names = None if classes is None else as_class_names("classes", classes)
    if isinstance(network, type):
        name = network.__name__
        raise InputError(f"{argument} is the class {name}: give a network, such as {name}(...)")
    require_evaluation_mode(network, argument)
    size = USUAL_SIZE if size is None else size
    device = device_of(network) if device is None else as_device(device)
    function = _preprocessed(network, normalization, value_range).to(device)
    count = _count_outputs(function, size, device, argument)
    if names is not None and len(names) != count:
        raise InputError(
            f"classes has {len(names)} names, but the network returns {count} outputs: "
            "give one name per output",
        )
    name = name or type(network).__name__
    return Classifier(function, size, names or index_names(count), name, normalize_light)


def require_evaluation_mode(network: object, argument: str) -> None:
    """Check that no part of a network is in training mode.

    Args:
        network: A module. Other values have no mode.
        argument: Name of the argument of the caller, for errors.

    Raises:
        InputError: If a part is in training mode.
    """
    if not isinstance(network, nn.Module) or not any(part.training for part in network.modules()):
        return
    # torch.export replaces the method by one that raises an error.
    if "eval" in vars(network):
        raise InputError(
            f"{argument} is a module of torch.export, which has no eval(): save it by "
            "torch.export.save, and give nb.load_classifier('network.pt2')"
        )
    raise InputError(f"{argument} is a network in training mode: call its eval() first")


def device_of(network: object) -> torch.device:
    """Return the device of the parameters of a network. It is the CPU if there are none."""
    parameters = network.parameters() if isinstance(network, nn.Module) else iter(())
    first = next(parameters, None)
    return torch.device("cpu") if first is None else first.device


@contextmanager
def gradient_flags_kept(network: object) -> Iterator[None]:
    """Restore `requires_grad` of a network's parameters at the end of a `with` block.

    Args:
        network: A module. Other values are ignored.
    """
    parameters = list(network.parameters()) if isinstance(network, nn.Module) else []
    flags = [parameter.requires_grad for parameter in parameters]
    try:
        yield
    finally:
        for parameter, flag in zip(parameters, flags, strict=True):
            parameter.requires_grad_(flag)


def _preprocessed(
    network: Callable[[Tensor], Tensor],
    normalization: Normalization,
    value_range: tuple[float, float],
) -> nn.Module:
    """Put the scaling and the normalization of images in front of a network.

    Args:
        network: The network.
        normalization: "imagenet", or mean and standard deviation. None for no normalization.
        value_range: Values of black and white that the network takes before normalization.

    Returns:
        A module in evaluation mode that takes images in [0, 1].

    Raises:
        InputError: If the range or the normalization is wrong, or if the network normalizes
            images itself and a normalization is given.
    """
    module = network if isinstance(network, nn.Module) else AnyFunction(network)
    mean, std = mean_and_std(normalization)
    black, white = as_list("value_range", value_range, float | int, "the values of black and white")
    if not black < white:
        raise InputError(f"value_range is ({black}, {white}): give black before white")
    if normalization is None and (black, white) == UNIT_RANGE:
        return module.eval()
    if normalization is not None:
        _require_no_normalization(module)
    if normalization is not None and not black <= min(mean) <= max(mean) <= white:
        raise InputError(
            f"normalization has the mean {tuple(mean)}, which is not between black, {black:g}, and "
            f"white, {white:g}: give it in these units, or the value_range of the network"
        )
    # For a value x in [0, 1], the network takes (black + span · x - mean) / std. This is
    # (x - scaled_mean) / scaled_std, which `Normalized` computes.
    span = white - black
    scaled_mean = [(value - black) / span for value in mean]
    scaled_std = [value / span for value in std]
    return Normalized(module, scaled_mean, scaled_std).eval()


def mean_and_std(normalization: Normalization) -> tuple[Sequence[float], Sequence[float]]:
    """Return the mean and the standard deviation of each channel."""
    if normalization is None:
        return (0.0,) * COLORS, (1.0,) * COLORS
    if normalization == IMAGENET:
        return IMAGENET_MEAN, IMAGENET_STD
    expected = "'imagenet', or (mean, std) of three numbers each"
    rows = as_list("normalization", normalization, tuple | list, expected)
    if [len(row) for row in rows] != [COLORS, COLORS] or not min(rows[1]) > 0:
        raise InputError(f"normalization is {describe(normalization)}: give {expected}")
    return rows[0], rows[1]


def _require_no_normalization(network: nn.Module) -> None:
    """Raise InputError if a network contains a module that normalizes images."""
    kinds = {type(module).__name__ for module in network.modules()}
    buffers = {name for name, _ in network.named_buffers() if name.rpartition(".")[2] in MEANS}
    found = sorted(kinds & NORMALIZING) + sorted(buffers)
    if found:
        raise InputError(
            f"normalization is given, and the network contains {found[0]}, so that images would "
            "be normalized twice: leave normalization out"
        )


@torch.no_grad()
def _count_outputs(network: nn.Module, size: int, device: torch.device | str, argument: str) -> int:
    """Call a network on gray images, and return the number of its outputs.

    Args:
        network: Network that takes images in [0, 1].
        size: Pixels per side of the images.
        device: Device of the images.
        argument: Name of the network in error messages.

    Returns:
        Number of classes C of its logits (N, C).
    """
    shades = torch.linspace(0.3, 0.7, CHECKED_COUNT, device=device)
    images = shades.view(-1, 1, 1, 1).expand(-1, COLORS, size, size)
    call = NetworkCall(argument)
    return call(network, images.contiguous()).shape[1]
