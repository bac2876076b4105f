"""Dropout that costs a CPU little, and whose draws do not depend on how many processes share a batch."""

import numpy as np
import torch
from torch import Tensor, nn

from augment import processes

LEVELS = 2**16


class Dropout(nn.Dropout):
    """`nn.Dropout`; on a CPU p is rounded to 2⁻¹⁶, since torch's own draws there take a third of a training step.

    Several processes draw for the whole batch, of which each has an equal share, and take their own part.
    """

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.p == 0:
            return x
        if x.device.type == "cpu":
            return x * self._drawn_by_numpy(x)
        if processes.count() == 1:
            return super().forward(x)
        everyone = torch.rand(processes.count(), *x.shape, device=x.device)
        return x * (everyone[processes.index()] >= self.p) / (1 - self.p)

    def _drawn_by_numpy(self, x: Tensor) -> Tensor:
        """0 or 1 / (1 - p) for each value, in x's memory layout: 16 bits each, from a generator that torch seeds."""
        own, everyone = x.numel(), x.numel() * processes.count()
        generator = np.random.Generator(np.random.SFC64(int(torch.randint(2**63 - 1, (1,)))))
        words = generator.integers(0, 2**64 - 1, -(-everyone // 4), dtype=np.uint64, endpoint=True)
        bits = torch.from_numpy(words.view(np.int16))[processes.index() * own :][:own]
        dropped = round(self.p * LEVELS)
        kept = bits.ge_(dropped - LEVELS // 2)  # in place: as int16 it converts five times faster than as bool
        factors = torch.empty_like(x)  # dense, so that its storage can be filled in order
        factors.as_strided((own,), (1,)).copy_(kept).mul_(LEVELS / (LEVELS - dropped))
        return factors
