"""Image classifiers as the attacks take them: adapters that own size, channel order, normalization and class names.

`load_classifier` makes one from a name; `Classifier(function, size, classes)` makes one of any callable.
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
from augment.progress import announced
from renderer.errors import InputError
from renderer.validation import as_path, require_kind

__all__ = ["SOURCES", "Classifier", "OperatingPoint", "Source", "build_classifier", "load_classifier"]


class Source(NamedTuple):
    """How to make a classifier with its weights, and with fresh ones for images of a size; the latter None for no."""

    load: Callable[..., Classifier]
    build: Any


# A name that ends in a colon is followed by the source's own name for the model, the first argument of both.
# `train.networks` adds `run:`, the networks that this project trains.
SOURCES = {
    **{
        f"efficientnet_lite{n}": Source(partial(load_efficientnet_lite, n), partial(build_efficientnet_lite, n))
        for n in range(3)
    },
    SQUEEZENET_CAFFE: Source(load_squeezenet_caffe, build_squeezenet_caffe),
    "torchvision:": Source(load_torchvision, build_torchvision),
    "timm:": Source(load_timm, build_timm),
    "python:": Source(load_python, lambda model, size: load_python(model)),
}


def load_classifier(name: str, weights: str | Path | None = None) -> Classifier:
    """`efficientnet_lite0` (to 2), `squeezenet_caffe`, `torchvision:NAME`, `timm:NAME` or
    `python:package.module:function`, on the CPU. In the commands also `run:FOLDER`, in Python `train.load_run(FOLDER)`.

    weights: a local file; None for those that the source brings or downloads. InputError for an unknown name, for
    weights that are missing, damaged or another network's, and where a package or the network is wanting.

    >>> load_classifier("torchvision:squeezenet1_1", "absent.pt")
    Traceback (most recent call last):
    renderer.errors.InputError: absent.pt does not exist: give the path of a file of weights
    """
    require_kind("name", name, str, "the name of a classifier, such as 'torchvision:resnet50'")
    path = None if weights is None else as_path("weights", weights)
    source, colon, model = name.partition(":")
    if source + colon not in SOURCES:
        choices = [f"{source}NAME" if source.endswith(":") else source for source in SOURCES]
        raise InputError(f"classifier={name} is not known: choose one of {', '.join(choices)}")
    load = SOURCES[source + colon].load
    with announced(f"loading {name}"):
        return load(model, path) if colon else load(path)


def build_classifier(name: str, size: int) -> Classifier:
    """The network of `load_classifier` for images of a size, with fresh weights, those of `python:` aside."""
    source, colon, model = name.partition(":")
    return SOURCES[source + colon].build(*([model] if colon else []), size)
