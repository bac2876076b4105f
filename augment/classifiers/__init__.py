"""Image classifiers that take RGB images in [0, 1].

`load_classifier` makes a classifier from a name, and `Classifier(function, size, classes)` makes
one from a function. Both hide the channel order and the normalization of the network.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from augment.classifiers.adapter import Classifier, OperatingPoint, load_python
from augment.classifiers.files import SUFFIXES, build_file, load_file
from augment.classifiers.plain_networks import (
    NetworkFacts,
    Normalization,
    as_facts,
    require_no_facts,
)
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
from augment.settings import NormalizeLight
from renderer.errors import InputError
from renderer.validation import as_path, require_kind

# Start of the name of a Python function.
PYTHON = "python:"

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
        load: Makes a classifier with weights. It takes a file of weights, or
            None for the weights of the source and, if `takes_facts`, the
            `NetworkFacts`.
        build: Makes a classifier with random weights. It takes the number of
            pixels per side and, if `takes_facts`, the `NetworkFacts`.
        takes_facts: Whether the networks have any classes, sizes and
            normalizations.
    """

    load: Callable[..., Classifier]
    build: Any
    takes_facts: bool = False


def _efficientnet_lite(version: int) -> Source:
    """Return the source of EfficientNet-Lite 0, 1 or 2."""
    load = partial(load_efficientnet_lite, version)
    build = partial(build_efficientnet_lite, version)
    return Source(load, build)


def _load_python(name: str, weights: Path | None) -> Classifier:
    """Call a function of a user, which loads its own weights."""
    if weights is not None:
        raise InputError(
            f"weights={weights} is not for python:{name}, which loads its own: leave it out",
            "weights",
        )
    return load_python(name)


# `train.networks` adds "run:", the networks that this project trains.
SOURCES = {
    "efficientnet_lite0": _efficientnet_lite(0),
    "efficientnet_lite1": _efficientnet_lite(1),
    "efficientnet_lite2": _efficientnet_lite(2),
    SQUEEZENET_CAFFE: Source(load_squeezenet_caffe, build_squeezenet_caffe),
    "torchvision:": Source(load_torchvision, build_torchvision, takes_facts=True),
    "timm:": Source(load_timm, build_timm, takes_facts=True),
    # The function of a user loads its own weights.
    PYTHON: Source(_load_python, lambda model, size: load_python(model)),
}


def load_classifier(
    name: str,
    weights: str | Path | None = None,
    classes: Sequence[str] | str | Path | None = None,
    size: int | None = None,
    normalization: Normalization = None,
    normalize_light: NormalizeLight = None,
) -> Classifier:
    """Load a classifier by name, on the CPU.

    Args:
        name: `efficientnet_lite0`, `efficientnet_lite1`, `efficientnet_lite2`,
            `squeezenet_caffe`, `torchvision:NAME`, `timm:NAME`,
            `python:package.module:function`, or the path of a file of
            TorchScript, `torch.export` (.pt2) or ONNX (.onnx). The commands
            also take `run:FOLDER`, which is `nb.load_run(FOLDER)` in Python.
        weights: File of weights. None for the weights that the source contains
            or downloads. The number of classes is read from the file.
        classes: Names of the classes in the order of the outputs, or a text
            file with a name in each line. None for the names that the source
            knows or, if it knows none, for "0", "1" and so on.
        size: Pixels per side of the images. None for the size of the source.
        normalization: "imagenet", or mean and standard deviation of the
            channels red, green and blue, in units of [0, 1]. None for the
            normalization of the source.
        normalize_light: Whether the light of each image is normalized first:
            True, or a mapping with fields of `NormalizedLightSettings`. This
            has nothing to do with `normalization`.

    Returns:
        The classifier.

    Raises:
        InputError: If the name is unknown, if the weights are missing, damaged
            or of another network, if the classes are not as many as the
            network has, or if a package is not installed.

    Example:
        >>> import norm_balls as nb
        >>> nb.load_classifier("torchvision:squeezenet1_1", "absent.pt")
        Traceback (most recent call last):
        renderer.errors.InputError: absent.pt does not exist: give the path of a file of weights
    """
    require_kind("name", name, str, "the name of a classifier, such as 'torchvision:resnet50'")
    path = None if weights is None else as_path("weights", weights)
    facts = as_facts(classes, size, normalization)
    classifier = _load(name, path, facts)
    return classifier.normalizing_light(normalize_light)


def _load(name: str, path: Path | None, facts: NetworkFacts) -> Classifier:
    """Load a classifier without normalized light."""
    source, colon, model = name.partition(":")
    if source + colon in SOURCES:
        arguments: list[Any] = [model, path] if colon else [path]
        load = SOURCES[source + colon].load
        if SOURCES[source + colon].takes_facts:
            arguments.append(facts)
        else:
            require_no_facts(name, facts)
        with progress_message(f"loading {name}"):
            return load(*arguments)
    if Path(name).suffix.lower() in SUFFIXES:
        if path is not None:
            raise InputError(
                f"weights={path} cannot be combined with {name}, which contains its own weights: "
                "remove weights",
                "weights",
            )
        with progress_message(f"loading {name}"):
            return load_file(name, facts)
    choices = [f"{known}NAME" if known.endswith(":") else known for known in SOURCES]
    choices.append(f"a file ({', '.join(SUFFIXES)})")
    raise InputError(f"name={name} is not known: choose one of {', '.join(choices)}", "name")


def build_classifier(name: str, size: int, classes: Sequence[str] | None = None) -> Classifier:
    """Build the network of `load_classifier` with random weights.

    The function of `python:package.module:function` keeps the weights and the
    size that it chooses, and a file keeps its weights.

    Args:
        name: Name of a classifier, as for `load_classifier`.
        size: Pixels per side.
        classes: Names of the classes. None for those of the source.

    Returns:
        The classifier.
    """
    facts = as_facts(classes)
    source, colon, model = name.partition(":")
    if source + colon not in SOURCES:
        return build_file(name, size, facts)
    known = SOURCES[source + colon]
    arguments: list[Any] = [model, size] if colon else [size]
    return known.build(*arguments, *([facts] if known.takes_facts else []))
