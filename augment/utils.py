"""Random streams, memory, progress bars, seconds per phase, a model's state, and shards of processes."""

import logging
import sys
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Event, Thread
from typing import TypeVar

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from tqdm import tqdm

from renderer.errors import InputError, is_out_of_memory

MEMORY, GROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")  # of Linux, and of a container (cgroup v2)
PATIENCE = 2.0  # seconds without a word
Item = TypeVar("Item")
Result = TypeVar("Result")


def stream_seed(*key: int | str) -> int:
    """A 63-bit seed from a key such as (run seed, epoch, "order"); different keys give independent streams."""
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> 1)


def generator(*key: int | str) -> torch.Generator:
    """A CPU generator for the stream of this key."""
    return torch.Generator().manual_seed(stream_seed(*key))


@dataclass
class BatchSize:
    """Images per pass through a classifier; halved, for good, each time that memory runs out."""

    images: int

    def map(self, compute: Callable[[slice], Result], total: int) -> Iterator[Result]:
        """The results of consecutive slices that are `total` long together; a slice may be computed again, in halves.

        Raises whatever `compute` raises, also where memory runs out on a single image.
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
                _warn_once(self.images)
            else:
                yield result
                begin = part.stop
                continue
            torch.cuda.empty_cache()  # here, where the error no longer keeps the tensors of the slice


@cache
def _warn_once(images: int) -> None:
    logging.getLogger(__name__).warning("memory ran out: the attack goes on with %d images per pass", images)


def require_memory(name: str, needed: int, device: torch.device) -> None:
    """InputError naming what needs more bytes than are free, before the system ends the process for it."""
    if not has_memory(needed, device):
        free = _free(device) or 0
        sizes = f"{needed / 2**30:.1f} GB of memory and {free / 2**30:.1f} GB are free"
        raise InputError(f"{name} need {sizes}: ask for fewer or smaller ones")


def has_memory(needed: int, device: torch.device) -> bool:
    """Tell whether as many bytes are free, or the system does not say."""
    free = _free(device)
    return free is None or needed <= free


def _free(device: torch.device) -> int | None:
    """Free bytes of a GPU, the machine or the container; None where the system does not say."""
    if device.type == "cuda":
        cached = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)  # by torch, for what comes
        return torch.cuda.mem_get_info(device)[0] + cached
    try:
        free = 1024 * int(dict(line.split(":") for line in MEMORY.read_text().splitlines())["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
    try:
        limit, used = (int((GROUP / file).read_text()) for file in ("memory.max", "memory.current"))
    except (OSError, ValueError):  # no such file, or "max"
        return free
    return min(free, limit - used)


def progress(items: Iterable[Item], description: str, total: int | None = None, done: int = 0) -> Iterator[Item]:
    """The items; after 2 seconds, with a bar on a terminal, or else a line, which comes again with the number of items
    that are done and the time that is left, each time after twice as long, up to 30 seconds; by the first process.

    total: their number, where they have no length. done: how many came before.
    """
    terminal, first, before, start = sys.stderr.isatty(), rank() == 0, done, time.perf_counter()
    bar = tqdm(items, description, total, leave=False, delay=PATIENCE, disable=not (terminal and first), initial=done)
    ended, wait = Event(), PATIENCE

    def show() -> None:  # also before the first item is done
        nonlocal wait
        while not ended.wait(wait):
            if terminal:
                bar.delay = 0
                bar.refresh()
                return
            counted = f": {done} of {bar.total}" if done and bar.total else ""
            if bar.total and done > before:
                left = (time.perf_counter() - start) / (done - before) * (bar.total - done)
                counted += f", {tqdm.format_interval(left)} left at this rate"
            print(f"{description}{counted} ...", file=sys.stderr, flush=True)
            wait = min(2 * wait, 30.0)

    if first:
        Thread(target=show, daemon=True).start()
    try:
        for item in bar:
            yield item
            done += 1
    finally:
        ended.set()


@contextmanager
def announced(description: str) -> Iterator[None]:
    """`progress` of a block that is no loop."""
    for _ in progress([None], description):
        yield


class Phases:
    """Adds up wall-clock seconds per named phase: `with phases("attack"): ...`. Phases may nest."""

    def __init__(self, device: torch.device | str = "cpu"):
        self._device = torch.device(device)
        self._seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = self._now()
        try:
            yield
        finally:
            self._seconds[name] += self._now() - start

    def take(self) -> dict[str, float]:
        """The seconds since the last call, by phase; starts again from zero."""
        seconds, self._seconds = dict(self._seconds), defaultdict(float)
        return seconds

    def _now(self) -> float:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()


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
    trainable = [parameter for parameter in model.parameters() if parameter.requires_grad]
    devices = {parameter.device for parameter in model.parameters() if parameter.is_cuda}
    for parameter in trainable:
        parameter.requires_grad_(False)
    try:
        with eval_mode(model), torch.random.fork_rng(devices=sorted(devices, key=str)):
            yield
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)


def world_size() -> int:
    """The number of processes that train together; 1 without `torchrun`."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """This process's number, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def shard(total: int, rank: int, world_size: int) -> Tensor:
    """Ascending indices of a process's examples: every `world_size`-th, and at least one, even if another has it."""
    return torch.arange(rank % total, total, world_size)


def merged(part: Tensor, examples: Tensor, total: int, world_size: int) -> Tensor:
    """All `total` rows, gathered from every process's part with its examples; the same in every process."""
    if world_size == 1:
        return part
    parts = [(part, examples)] * world_size  # to be overwritten
    dist.all_gather_object(parts, (part.cpu(), examples.cpu()))
    whole = part.new_empty(total, *part.shape[1:])
    for rows, indices in parts:
        whole[indices.to(whole.device)] = rows.to(whole.device)
    return whole


def rotation_matrices(vectors: Tensor) -> Tensor:
    """(..., 3, 3) of rotation vectors (..., 3): by their length, in radians, about their direction; differentiable."""
    axes = torch.eye(3).to(vectors).expand(*vectors.shape, 3)
    return torch.matrix_exp(torch.linalg.cross(vectors[..., None, :].expand_as(axes), axes).mT)
