"""Chooses the batch size of passes through a classifier, and restores the classifier's state."""

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
    """Number of images per pass through a classifier. It is halved when memory runs out.

    Attributes:
        images: The number of images, at least 1. It does not grow again.
    """

    images: int

    def map(self, compute: Callable[[slice], Result], total: int) -> Iterator[Result]:
        """Compute results for consecutive slices of some images.

        Args:
            compute: A function of a slice of the images. Where memory runs out,
                it is called again with half of the slice.
            total: The number of images.

        Yields:
            The result of each slice, in order.

        Raises:
            Exception: Whatever `compute` raises, also if memory runs out on a
                single image.

        Example:
            >>> list(BatchSize(2).map(lambda part: "abc"[part], 3))
            ['ab', 'c']
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
            # The cache is emptied only after the error is gone, because the
            # error keeps the tensors of the slice.
            torch.cuda.empty_cache()


@cache
def warn_once(images: int) -> None:
    """Warn that passes have fewer images, once for each number of images."""
    logger = logging.getLogger(__name__)
    logger.warning("memory ran out: the attack goes on with %d images per pass", images)


@contextmanager
def eval_mode(model: nn.Module) -> Iterator[None]:
    """Set a model to eval mode inside a `with` block, and restore the mode of each module after it.

    Args:
        model: The model. A frozen layer of it may have another mode than the
            rest.
    """
    training = [module for module in model.modules() if module.training]
    # Setting the mode of a large network takes as long as rendering an image.
    if training:
        model.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True


@contextmanager
def frozen_eval_mode(model: nn.Module) -> Iterator[None]:
    """Set a model to eval mode, without gradients of its parameters, inside a `with` block.

    The mode of each module, `requires_grad` of each parameter and the state of
    the global random generators are restored after the block.

    Args:
        model: The model, such as a classifier that is attacked.
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
