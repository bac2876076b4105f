"""The networks that are trained: a WideResNet, a classifier of torchvision, or what a Python function returns."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from augment.classifiers.adapter import Normalized
from augment.classifiers.imagenet import require_architecture
from augment.classifiers.python_function import call_python
from augment.utils import eval_mode
from renderer.errors import InputError, in_one_line
from train.wideresnet import WideResNet

WIDERESNET, TORCHVISION, PYTHON = "wideresnet", "torchvision:", "python:"
_WITHOUT_AUXILIARY = {"aux_logits": False, "init_weights": True}
_OPTIONS = {"googlenet": _WITHOUT_AUXILIARY, "inception_v3": _WITHOUT_AUXILIARY}


def build_network(
    classes: Sequence[str],
    size: int,
    name: str = WIDERESNET,
    mean: Sequence[float] = (0.5, 0.5, 0.5),
    std: Sequence[float] = (0.25, 0.25, 0.25),
    **shape: Any,
) -> nn.Module:
    """A network with fresh weights from images (N, 3, size, size), RGB in [0, 1], to logits of the classes.

    name: wideresnet, which alone has a shape (depth, width, dropout), torchvision:NAME, or
    python:package.module:function, a function that returns (module, size, classes) and whose module normalizes by
    itself. mean, std: the data's. InputError where there is no such network, or it does not take the data.
    """
    if name == WIDERESNET:
        return WideResNet(len(classes), **shape, mean=mean, std=std)
    if name.startswith(TORCHVISION):
        network: nn.Module = Normalized(_torchvision_network(name, len(classes), size), mean, std)
    elif name.startswith(PYTHON):
        network = _python_network(name, classes, size)
    else:
        raise InputError(
            f"model={name} is not known: choose {WIDERESNET}, {TORCHVISION}NAME or {PYTHON}MODULE:FUNCTION"
        )
    _require_logits(network, name, len(classes), size)
    return network


def _torchvision_network(name: str, classes: int, size: int) -> nn.Module:
    from torchvision import models

    architecture = name.removeprefix(TORCHVISION)
    require_architecture(architecture, f"model={name}")
    options = {"image_size": size} if architecture.startswith("vit_") else _OPTIONS.get(architecture, {})
    try:
        return models.get_model(architecture, weights=None, num_classes=classes, **options)
    except (ValueError, AssertionError) as error:  # a transformer whose patches do not fill the image
        raise InputError(f"model={name} takes no images of {size} pixels per side ({error}): choose another") from error


def _python_network(name: str, classes: Sequence[str], size: int) -> nn.Module:
    network, its_size, its_classes = call_python(name.removeprefix(PYTHON), f"model={name}")
    if its_size != size:
        raise InputError(f"model={name} is for images of {its_size} pixels per side, and the data has {size}")
    if list(its_classes) != list(classes):
        raise InputError(
            f"model={name} has other classes than the data, or in another order: return its {len(classes)}, "
            f"{classes[0]!r} first"
        )
    return network


def model_title(name: str = WIDERESNET, depth: int = 16, width: int = 4, dropout: float = 0.3) -> str:
    """A network's settings in words."""
    return f"WideResNet-{depth}-{width}, dropout {dropout}" if name == WIDERESNET else name


@torch.no_grad()
def _require_logits(network: nn.Module, name: str, classes: int, size: int) -> None:
    """InputError where images of this size do not come out as logits."""
    try:
        with eval_mode(network):
            logits = network(torch.zeros(2, 3, size, size))
    except (RuntimeError, ValueError, AssertionError, TypeError) as error:
        raise InputError(
            f"model={name} takes no images of {size} pixels per side ({in_one_line(error)}): choose another"
        ) from error
    if not isinstance(logits, Tensor) or logits.shape != (2, classes):
        found = tuple(logits.shape) if isinstance(logits, Tensor) else type(logits).__name__
        raise InputError(f"model={name} gives {found} for 2 images: make it return logits {(2, classes)}")
