"""Independent random streams, each a pure function of its key, so that a resumed run repeats its draws."""

import math
import zlib

import numpy as np
import torch

from renderer.errors import require_range


def stream_seed(*key: int | str) -> int:
    """A 63-bit seed from a key such as (run seed, epoch, "order"); different keys give independent streams."""
    for part in key:
        require_range("seed", None if isinstance(part, str) else part, 0, math.inf)
    words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> 1)


def generator(*key: int | str) -> torch.Generator:
    """A CPU generator for the stream of this key."""
    return torch.Generator().manual_seed(stream_seed(*key))
