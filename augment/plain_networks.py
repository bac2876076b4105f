"""Make a classifier of a plain network of the user.

A plain network does not tell the size of its images or the names of its classes. It is called once
to find out the number of its classes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from augment.classifier import Classifier, LogitNetwork, as_class_names
from augment.distributed import rank
from augment.network import ChannelNormalization, Function, Network
from augment.settings import NormalizeLight
from renderer.errors import (
    InputError,
    as_device,
    as_list,
    describe,
    require_file,
    require_kind,
    require_whole,
)
from renderer.settings import MAX_SIZE

# normalization="imagenet" stands for the following mean and standard deviation of red, green and
# blue, which most networks use that were trained on ImageNet.
IMAGENET = "imagenet"
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Number of color channels.
COLORS = 3
# Default values of black and white that a network takes.
UNIT_RANGE = (0.0, 1.0)
# Pixels per side of the images of most networks that were trained on ImageNet.
USUAL_SIZE = 224
# Number of images with which a network is called to count its outputs. With a single image, logits
# could look like probabilities by chance.
CHECKED_COUNT = 2
# Names of module classes of torchvision, kornia and this library that normalize images.
NORMALIZING = frozenset({"Normalize", "ChannelNormalization"})
# Names of buffers that contain the mean in networks that normalize images themselves.
MEANS = frozenset({"mean", "image_mean", "pixel_mean"})

Normalization = str | tuple[Sequence[float], Sequence[float]] | None


@dataclass(frozen=True)
class NetworkFacts:
    """Classes, image size and normalization that the user gives for a network.

    None leaves the choice to the source of the network, such as torchvision.

    Attributes:
        classes: Names of the classes in the order of the outputs. If neither
            the user nor the source gives names, they are "0", "1" and so on.
        size: Pixels per side of the images.
        normalization: "imagenet", or mean and standard deviation of the
            channels red, green and blue, in units of [0, 1].
    """

    classes: tuple[str, ...] | None = None
    size: int | None = None
    normalization: Normalization = None


def assumed_facts(size: int | None, normalization: Normalization) -> tuple[str, ...]:
    """Return which of the two arguments neither the user nor the network gives."""
    given = {"size": size, "normalization": normalization}
    return tuple(name for name, value in given.items() if value is None)


def as_facts(
    classes: Sequence[str] | str | Path | None = None,
    size: int | None = None,
    normalization: Normalization = None,
) -> NetworkFacts:
    """Check the classes, size and normalization that the user gives for a network.

    Classes may be a text file with a name in each line.
    """
    if isinstance(classes, str | Path):
        require_file(classes, "give a text file with the name of a class in each line")
        lines = Path(classes).read_text(encoding="utf-8").splitlines()
        classes = [line.strip() for line in lines if line.strip()]
    names = None if classes is None else as_class_names("classes", classes)
    if size is not None:
        require_whole("size", size, 1, MAX_SIZE)
    if normalization is not None:
        mean_and_std(normalization)
    return NetworkFacts(names, size, normalization)


def require_no_facts(name: str, facts: NetworkFacts) -> None:
    """Check that the user gives no facts about a network that defines them itself."""
    for setting, value in vars(facts).items():
        if value is not None:
            raise InputError(
                f"{setting} cannot be set for {name}, because this network already defines "
                f"{setting}: leave {setting} out",
                setting,
            )


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
    dtype: torch.dtype = torch.float32,
) -> Classifier:
    """Make a classifier of a plain network, and check it on gray images.

    Without a size, that of the network counts or, if it tells none, 224. Classes are "0", "1" and
    so on by default. Mean and standard deviation are in units of `value_range`, the values of black
    and white. A `Classifier` only gets `normalize_light`.
    """
    if isinstance(network, Classifier):
        if classes is not None or normalization is not None or value_range != UNIT_RANGE:
            raise InputError(
                "classes, normalization and value_range are for a plain network: "
                "leave them out, because the given Classifier already defines them"
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
    known_size = own_size(network)
    device = device_of(network) if device is None else as_device(device)
    function = _preprocessed(network, normalization, value_range).to(device)
    name = name or type(network).__name__
    if size is None:
        assumed = assumed_facts(known_size, normalization_of(function) or None)
        # timm records the size of the published weights, which need not be those of the network.
        published = getattr(network, "pretrained_cfg", {}).get("input_size", [USUAL_SIZE])
        size = known_size or published[-1]
        say_inputs(name, function, size, assumed)
    count = _count_outputs(function, size, device, dtype, argument)
    if names is not None and len(names) != count:
        raise InputError(
            f"classes has {len(names)} names, but the network returns {count} outputs: "
            "give one name per output",
        )
    return Classifier(function, size, names or index_names(count), name, normalize_light)


def own_size(network: object) -> int | None:
    """Return the pixels per side that a transformer of torchvision or timm was built for.

    Its position embeddings have a fixed size. None for any other network.
    """
    for module in network.modules() if isinstance(network, nn.Module) else ():
        for size in (getattr(module, "image_size", None), getattr(module, "img_size", None)):
            found = size[0] if isinstance(size, tuple) and size else size
            if isinstance(found, int):
                return found
    return None


def require_evaluation_mode(network: object, argument: str) -> None:
    """Check that no module of a network is in training mode."""
    if not isinstance(network, nn.Module) or not any(part.training for part in network.modules()):
        return
    # A module of torch.export has its own attribute `eval`, which raises an error.
    if "eval" in vars(network):
        raise InputError(
            f"{argument} is a module of torch.export, which has no eval(): save it by "
            "torch.export.save, and give norm_balls.load_classifier('network.pt2', "
            "trust_code=True)"
        )
    raise InputError(
        f"{argument} is a network in training mode: call the method eval() of the network first"
    )


def device_of(network: object) -> torch.device:
    """Return the device of the parameters of a network. It is the CPU if there are none."""
    parameters = network.parameters() if isinstance(network, nn.Module) else iter(())
    first = next(parameters, None)
    return torch.device("cpu") if first is None else first.device


@contextmanager
def gradient_flags_kept(network: object) -> Iterator[None]:
    """Restore `requires_grad` of all parameters of a network at the end of a `with` block."""
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
    """Return a network that takes images in [0, 1], scales and normalizes them."""
    module = network if isinstance(network, nn.Module) else Function(network)
    mean, std = mean_and_std(normalization)
    black, white = as_list("value_range", value_range, float | int, "the values of black and white")
    if not black < white:
        raise InputError(f"value_range is ({black}, {white}): give black before white")
    if normalization is None and (black, white) == UNIT_RANGE:
        return module.eval()
    if normalization is not None:
        _require_no_normalization(module)
    if normalization == IMAGENET:
        # Scaling the mean and the standard deviation of ImageNet to the range of the network is
        # the same as normalizing values in [0, 1] with them.
        black, white = UNIT_RANGE
    if normalization is not None and not black <= min(mean) <= max(mean) <= white:
        raise InputError(
            f"normalization has the mean {tuple(mean)}, which is not between black, {black:g}, and "
            f"white, {white:g}: give the mean in the units of value_range, or another value_range"
        )
    # A value x in [0, 1] becomes (black + span · x - mean) / std for the network. This is equal to
    # (x - scaled_mean) / scaled_std, which `ChannelNormalization` computes.
    span = white - black
    scaled_mean = [(value - black) / span for value in mean]
    scaled_std = [value / span for value in std]
    return Network(module, [ChannelNormalization(scaled_mean, scaled_std)]).eval()


def mean_and_std(normalization: Normalization) -> tuple[Sequence[float], Sequence[float]]:
    """Return the mean and the standard deviation of the channels red, green and blue.

    None stands for mean 0 and standard deviation 1.
    """
    if normalization is None:
        return (0.0,) * COLORS, (1.0,) * COLORS
    if normalization == IMAGENET:
        return IMAGENET_MEAN, IMAGENET_STD
    expected = "'imagenet', or (mean, std) of three numbers each"
    rows = as_list("normalization", normalization, tuple | list, expected)
    if [len(row) for row in rows] != [COLORS, COLORS] or not min(rows[1]) > 0:
        raise InputError(
            f"normalization is {describe(normalization)}: "
            "give 'imagenet', or (mean, std) of three numbers each"
        )
    return rows[0], rows[1]


def _require_no_normalization(network: nn.Module) -> None:
    """Raise InputError if a network seems to normalize images itself.

    Networks of several libraries are known by the names of their modules and buffers.
    """
    kinds = {type(module).__name__ for module in network.modules()}
    buffers = {name for name, _ in network.named_buffers() if name.rpartition(".")[2] in MEANS}
    found = sorted(kinds & NORMALIZING) + sorted(buffers)
    if found:
        raise InputError(
            f"normalization is given, and the network contains {found[0]}, so that images would "
            "be normalized twice: leave normalization out"
        )


@torch.no_grad()
def _count_outputs(
    network: nn.Module, size: int, device: torch.device | str, dtype: torch.dtype, argument: str
) -> int:
    """Call a network on gray images to find out the number of its classes."""
    shades = torch.linspace(0.3, 0.7, CHECKED_COUNT, device=device, dtype=dtype)
    images = shades.view(-1, 1, 1, 1).expand(-1, COLORS, size, size)
    return LogitNetwork(network, argument)(images.contiguous()).shape[1]


def say_inputs(name: str, network: Any, size: int, assumed: Sequence[str] = ()) -> None:
    """Log the size and the normalization of the images of a network, once for each text.

    `assumed` are the arguments that neither the user nor the network gave.
    """
    text = f"network {name}: images of {size} × {size} pixels, "
    text += normalization_of(network) or "values in [0, 1], not normalized before the network"
    if assumed:
        are = " and ".join(assumed) + (" is assumed" if len(assumed) == 1 else " are assumed")
        text += f"; {are}: give {'it' if len(assumed) == 1 else 'them'} if the network needs others"
    if rank() == 0:
        _say_once(text)


def say_inputs_of(classifier: Classifier) -> None:
    """Log the size and the normalization of the images of a classifier."""
    say_inputs(classifier.name, classifier.network, classifier.size, classifier.assumed)


@cache
def _say_once(text: str) -> None:
    """Log a text, which is shown without any settings of `logging`."""
    logging.getLogger(__name__).warning(text)


def normalization_of(network: Any) -> str:
    """Describe the first mean and standard deviation of three channels in a network, if any."""
    for module in network.modules() if isinstance(network, nn.Module) else ():
        mean, std = (_channels(getattr(module, name, None)) for name in ("mean", "std"))
        if mean and std:
            order = " of blue, green and red" if getattr(module, "bgr", False) else ""
            return f"normalized by mean {mean} and std {std}{order}"
    return ""


def _channels(value: Any) -> str:
    """Write three numbers, such as "(0.485, 0.456, 0.406)". Any other value gives ""."""
    if not isinstance(value, Tensor | list | tuple):
        return ""
    numbers = torch.as_tensor(value).flatten().tolist()
    return f"({', '.join(f'{number:.3g}' for number in numbers)})" if len(numbers) == 3 else ""
