"""Image classifiers that take RGB images in [0, 1].

`load_classifier` makes a classifier from a name, and `Classifier(function, size, classes)` makes
one from a function. Both hide the channel order and the normalization of the network.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from augment.classifiers.adapter import Classifier, OperatingPoint, load_python
from augment.classifiers.sources import (
    SQUEEZENET_CAFFE,
    build_efficientnet_lite,
    build_squeezenet_caffe,
    build_timm,
    build_torchvision,
    load_efficientnet_lite,
    load_squeezenet_caffe,
    load_timm,
    load_torchvision,
)
from augment.progress import progress_message
from renderer.errors import InputError
from renderer.validation import as_path, require_kind

__all__ = [
    "SOURCES",
    "Classifier",
    "OperatingPoint",
    "Source",
    "build_classifier",
    "load_classifier",
]


class Source(NamedTuple):
    """Functions that make the classifiers of one source.

    If the name of the source ends in a colon, the name of the model follows
    there, and it is the first argument of both functions.

    Attributes:
        load: Makes a classifier with weights. Its last argument is a file of
            weights, or None for the weights of the source.
        build: Makes a classifier with random weights. Its last argument is the
            number of pixels per side.
    """

    load: Callable[..., Classifier]
    build: Any


def _efficientnet_lite(version: int) -> Source:
    """Return the source of EfficientNet-Lite 0, 1 or 2."""
    load = partial(load_efficientnet_lite, version)
    build = partial(build_efficientnet_lite, version)
    return Source(load, build)


# `train.networks` adds "run:", the networks that this project trains.
SOURCES = {
    "efficientnet_lite0": _efficientnet_lite(0),
    "efficientnet_lite1": _efficientnet_lite(1),
    "efficientnet_lite2": _efficientnet_lite(2),
    SQUEEZENET_CAFFE: Source(load_squeezenet_caffe, build_squeezenet_caffe),
    "torchvision:": Source(load_torchvision, build_torchvision),
    "timm:": Source(load_timm, build_timm),
    # The function of a user loads its own weights.
    "python:": Source(load_python, lambda model, size: load_python(model)),
}


def load_classifier(name: str, weights: str | Path | None = None) -> Classifier:
    """Load a classifier by name, on the CPU.

    Args:
        name: `efficientnet_lite0`, `efficientnet_lite1`, `efficientnet_lite2`,
            `squeezenet_caffe`, `torchvision:NAME`, `timm:NAME` or
            `python:package.module:function`. The commands also take
            `run:FOLDER`, which is `train.load_run(FOLDER)` in Python.
        weights: File of weights. None for the weights that the source contains
            or downloads.

    Returns:
        The classifier.

    Raises:
        InputError: If the name is unknown, if the weights are missing, damaged
            or of another network, or if a package is not installed.

    Example:
        >>> load_classifier("torchvision:squeezenet1_1", "absent.pt")
        Traceback (most recent call last):
        renderer.errors.InputError: absent.pt does not exist: give the path of a file of weights
    """
    require_kind("name", name, str, "the name of a classifier, such as 'torchvision:resnet50'")
    path = None if weights is None else as_path("weights", weights)
    source, colon, model = name.partition(":")
    if source + colon not in SOURCES:
        choices = [f"{known}NAME" if known.endswith(":") else known for known in SOURCES]
        message = f"name={name} is not known: choose one of {', '.join(choices)}"
        raise InputError(message, "name")
    load = SOURCES[source + colon].load
    with progress_message(f"loading {name}"):
        return load(model, path) if colon else load(path)


def build_classifier(name: str, size: int) -> Classifier:
    """Build the network of `load_classifier` with random weights.

    The function of `python:package.module:function` keeps the weights and the
    size that it chooses.

    Args:
        name: Name of a classifier, as for `load_classifier`.
        size: Pixels per side.

    Returns:
        The classifier.
    """
    source, colon, model = name.partition(":")
    build = SOURCES[source + colon].build
    return build(model, size) if colon else build(size)
