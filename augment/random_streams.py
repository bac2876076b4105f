"""Independent sequences of random numbers, each of which is identified by a key."""

import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import torch


def stream_seed(*key: int | str) -> int:
    """Compute the seed of a sequence of random numbers from a key.

    A key tells what the numbers are for, such as the seed of a run, an epoch and "order". Different
    keys give independent numbers.
    """
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> 1)


def generator(*key: int | str) -> torch.Generator:
    """Return a new CPU generator of random numbers, whose seed is computed from a key."""
    return torch.Generator().manual_seed(stream_seed(*key))


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed torch's random numbers on the CPU in a block, and restore them after it."""
    with torch.random.fork_rng(devices=[]):
        # `torch.manual_seed` would also seed the generators of GPUs.
        torch.default_generator.manual_seed(seed)
        yield


@contextmanager
def usual_defaults() -> Iterator[None]:
    """Create tensors on the CPU in 32 bits, in a `with` block."""
    with ExitStack() as stack:
        made = torch.empty(0)  # Ten times as fast as `torch.get_default_device`.
        if made.device.type != "cpu":
            stack.enter_context(torch.device("cpu"))
        if made.dtype != torch.float32:
            stack.callback(torch.set_default_dtype, made.dtype)
            torch.set_default_dtype(torch.float32)
        yield
