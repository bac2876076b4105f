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
from augment.classifiers.inputs import say_inputs_of
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
from renderer.validation import as_path, require_flag, require_kind

# A classifier with this prefix is loaded by a Python function, as in python:my_module.load.
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
    """Functions that make the classifiers of one source, such as torchvision.

    A source with several models has a name with a colon at the end, such as
    "torchvision:". Its functions take the name of the model as their first
    argument.

    Attributes:
        load: Function that makes a classifier with weights. It takes a file of
            weights (None for the published weights) and, if `takes_facts` is
            True, `NetworkFacts`.
        build: Function that makes a classifier with random weights. It takes the
            pixels per side of the images and, if `takes_facts` is True,
            `NetworkFacts`.
        takes_facts: Whether the user may choose classes, image size and
            normalization (the `NetworkFacts`).
    """

    load: Callable[..., Classifier]
    build: Any
    takes_facts: bool = False


def _efficientnet_lite(version: int) -> Source:
    """Return the functions that load or build a classifier EfficientNet-Lite."""
    load = partial(load_efficientnet_lite, version)
    build = partial(build_efficientnet_lite, version)
    return Source(load, build)


def _load_python(name: str, weights: Path | None) -> Classifier:
    """Load a classifier by a Python function that the user wrote."""
    if weights is not None:
        raise InputError(
            f"weights={weights} cannot be combined with python:{name}, a function that "
            "loads the weights itself: leave weights out",
            "weights",
        )
    return load_python(name)


# Sources by their names. The module `train.networks` adds "run:", for networks that this project
# trains.
SOURCES = {
    "efficientnet_lite0": _efficientnet_lite(0),
    "efficientnet_lite1": _efficientnet_lite(1),
    "efficientnet_lite2": _efficientnet_lite(2),
    SQUEEZENET_CAFFE: Source(load_squeezenet_caffe, build_squeezenet_caffe),
    "torchvision:": Source(load_torchvision, build_torchvision, takes_facts=True),
    "timm:": Source(load_timm, build_timm, takes_facts=True),
    # A function of the user chooses the size itself, so the size is not used.
    PYTHON: Source(_load_python, lambda model, size: load_python(model)),
}


def load_classifier(
    name: str,
    weights: str | Path | None = None,
    classes: Sequence[str] | str | Path | None = None,
    size: int | None = None,
    normalization: Normalization = None,
    normalize_light: NormalizeLight = None,
    trust_code: bool = False,
) -> Classifier:
    """Load a classifier by name, on the CPU.

    The size and the normalization of its images are logged once, with what of
    them is assumed.

    Files of weights (safetensors, state dicts) and of ONNX may come from
    strangers. Files of TorchScript and of `torch.export` are programs that can
    run any code, and so are the functions that `python:` names.

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
        normalize_light: How the light of each image is normalized first: True
            for the defaults, or a mapping with fields of
            `NormalizedLightSettings`. This is independent of `normalization`.
        trust_code: Whether `name` may be a file of TorchScript or
            `torch.export`. Set it only if you made the file or trust its author.

    Returns:
        The classifier.

    Raises:
        InputError: If the name is unknown or is a program that is not trusted,
            if the weights are missing, damaged or of another network, if the
            classes are not as many as the network has, or if a package is not
            installed.

    Example:
        >>> import norm_balls as nb
        >>> nb.load_classifier("torchvision:squeezenet1_1", "absent.pt")
        Traceback (most recent call last):
        renderer.errors.InputError: absent.pt does not exist: give the path of a file of weights
    """
    require_kind("name", name, str, "the name of a classifier, such as 'torchvision:resnet50'")
    path = None if weights is None else as_path("weights", weights)
    facts = as_facts(classes, size, normalization)
    require_flag("trust_code", trust_code)
    classifier = load_source(name, path, facts, trust_code)
    say_inputs_of(classifier)
    return classifier.normalizing_light(normalize_light)


def load_source(name: str, path: Path | None, facts: NetworkFacts, trust_code: bool) -> Classifier:
    """Load a classifier by name, without the normalization of light, and without any message.

    `path` is a file of weights. None stands for the weights of the source.
    """
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
                f"weights={path} cannot be combined with {name}, a file that contains weights: "
                "leave weights out",
                "weights",
            )
        with progress_message(f"loading {name}"):
            return load_file(name, facts, trust_code)
    choices = [f"{known}NAME" if known.endswith(":") else known for known in SOURCES]
    choices.append(f"a file ({', '.join(SUFFIXES)})")
    raise InputError(f"name={name} is not known: choose one of {', '.join(choices)}", "name")


def build_classifier(
    name: str,
    size: int,
    classes: Sequence[str] | None = None,
    normalization: Normalization = None,
    trust_code: bool = False,
) -> Classifier:
    """Build a classifier with random weights.

    A Python function of the user chooses weights and size itself, and a file contains its weights.
    These classifiers are loaded as they are. Only the network of a file takes the normalization;
    all other sources have their own.
    """
    source, colon, model = name.partition(":")
    if source + colon not in SOURCES:
        facts = as_facts(classes, normalization=normalization)
        return build_file(name, size, facts, trust_code)
    known = SOURCES[source + colon]
    arguments: list[Any] = [model, size] if colon else [size]
    if known.takes_facts:
        arguments.append(as_facts(classes))
    return known.build(*arguments)
