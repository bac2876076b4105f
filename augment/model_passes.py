"""Choose the batch size of passes through a classifier, and restore the state of the classifier."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import torch
from torch import nn

from renderer.errors import is_out_of_memory

Result = TypeVar("Result")


@dataclass
class BatchSize:
    """Number of images that a classifier sees at a time. It is halved when memory runs out.

    Attributes:
        images: Number of images, at least 1. It does not grow again.
    """

    images: int

    def map(self, compute: Callable[[slice], Result], total: int) -> Iterator[Result]:
        """Call a function for one batch of images after the other.

        The function takes the slice of the images of a batch. If memory runs out, it is called
        again with half of it.
        """
        begin = 0
        while begin < total:
            part = slice(begin, begin + self.images)
            try:
                result = compute(part)
            except (RuntimeError, MemoryError) as error:
                if self.images == 1 or not is_out_of_memory(error):
                    raise
                self.images //= 2
                warn_once(self.images)
            else:
                yield result
                begin = part.stop
                continue
            # Empty the cache outside of the `except` block, because the error refers to tensors
            # there.
            torch.cuda.empty_cache()


@cache
def warn_once(images: int) -> None:
    """Warn that memory ran out and batches have fewer images, once for each number of images."""
    logger = logging.getLogger(__name__)
    logger.warning("memory ran out: the attack goes on with %d images per pass", images)


@contextmanager
def eval_mode(model: nn.Module) -> Iterator[None]:
    """Set a model to eval mode in a `with` block, and then restore the mode of each module."""
    training = [module for module in model.modules() if module.training]
    # `eval` of a large network takes as long as rendering an image, so call it only if needed.
    if training:
        model.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True


@contextmanager
def frozen_eval_mode(model: nn.Module) -> Iterator[None]:
    """Set a model to eval mode, without gradients of its parameters, in a `with` block.

    The mode of each module, `requires_grad` of each parameter and the state of
    the global random generators are restored after the block.
    """
    trainable = [parameter for parameter in model.parameters() if parameter.requires_grad]
    gpus = {parameter.device for parameter in model.parameters() if parameter.is_cuda}
    for parameter in trainable:
        parameter.requires_grad_(False)
    try:
        with eval_mode(model), torch.random.fork_rng(devices=sorted(gpus, key=str)):
            yield
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)
