"""Tell the user which images a network takes, and what of it is assumed."""

import logging
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from augment.classifiers.adapter import Classifier
from augment.distributed import rank


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
    say_inputs(classifier.name, classifier.function, classifier.size, classifier.assumed)


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
