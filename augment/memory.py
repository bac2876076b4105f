"""Batches that become smaller where the memory is too small for them."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import torch

from renderer.errors import is_out_of_memory

Result = TypeVar("Result")


@dataclass
class BatchSize:
    """Images per pass through a classifier; halved, for good, each time that memory runs out."""

    images: int

    def map(self, compute: Callable[[slice], Result], total: int) -> Iterator[Result]:
        """What comes of consecutive parts that are `total` long together. A part may be computed anew, in halves.

        Whatever `compute` raises, also where memory runs out on a single image.
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
                _say(self.images)
            else:
                yield result
                begin = part.stop
                continue
            if torch.cuda.is_available():
                torch.cuda.empty_cache()  # here, where the error no longer holds what was computed


@cache  # once, not in each epoch
def _say(images: int) -> None:
    logging.getLogger(__name__).warning("memory ran out: the attack goes on with %d images per pass", images)
