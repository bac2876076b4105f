"""Using a model without leaving a trace: its mode, gradients and random state come back, also after an error."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import nn


@contextmanager
def eval_mode(model: nn.Module) -> Iterator[None]:
    """Eval mode inside; each module's own mode restored after, since a frozen layer may differ from the whole."""
    training = [module for module in model.modules() if module.training]
    if training:  # setting the mode of a large network takes as long as rendering an image
        model.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True


@contextmanager
def as_found(model: nn.Module) -> Iterator[None]:
    """Eval mode and no gradients for parameters inside; mode, requires_grad and random state restored after."""
    parameters = list(model.parameters())
    trainable = [parameter for parameter in parameters if parameter.requires_grad]
    devices = {parameter.device for parameter in parameters if parameter.is_cuda}
    for parameter in trainable:
        parameter.requires_grad_(False)
    try:
        with eval_mode(model), torch.random.fork_rng(devices=sorted(devices, key=str)):
            yield
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)
