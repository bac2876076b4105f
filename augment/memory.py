"""Batches that become smaller where the memory is too small for them, and what is too large for it from the start."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar

import torch

from renderer.errors import InputError, is_out_of_memory

MEMORY, GROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")  # Linux's, and a container's share of it (cgroup v2)
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


def require_memory(name: str, needed: int, device: torch.device) -> None:
    """InputError naming what needs more bytes than are free, rather than an end by the system half an hour later."""
    free = _free(device)
    if free is not None and needed > free:
        raise InputError(
            f"{name} need {needed / 2**30:.1f} GB of memory and {free / 2**30:.1f} GB are free: ask for fewer or "
            "smaller ones"
        )


def _free(device: torch.device) -> int | None:
    """Bytes on a GPU, or in the machine or the container; None where the system does not say."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        free = 1024 * int(dict(line.split(":") for line in MEMORY.read_text().splitlines())["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
    try:
        most, used = (int((GROUP / file).read_text()) for file in ("memory.max", "memory.current"))
    except (OSError, ValueError):  # no such file, or "max"
        return free
    return min(free, most - used)
