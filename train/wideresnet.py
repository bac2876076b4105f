"""Wide residual networks (Zagoruyko and Komodakis 2016). WRN-16-4 for 100 classes has 2.77 M parameters."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment import utils
from renderer.errors import InputError

DEEPEST, MOST_PARAMETERS = 1000, 1e9  # 4 GB; a checkpoint from elsewhere may ask for anything
LEVELS = 2**16


class WideResNet(nn.Module):
    """WRN-depth-width for small images of any size.

    Takes (N, 3, H, W) RGB in [0, 1], normalizes with the data's own mean and std inside, gives logits (N, classes).
    depth is 6n + 4: n blocks of two convolutions in each of three groups.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        classes: int,
        depth: int = 16,
        width: int = 4,
        dropout: float = 0.3,
        mean: Sequence[float] = (0.5, 0.5, 0.5),
        std: Sequence[float] = (0.25, 0.25, 0.25),
    ):
        super().__init__()
        if not (isinstance(depth, int) and isinstance(width, int)) or depth < 10 or (depth - 4) % 6 or width < 1:
            raise InputError(
                f"model.depth={depth}, model.width={width}: depth is 10, 16, 22, 28, ... and width at least 1"
            )
        parameters = 9 * (depth - 4) // 3 * width**2 * 16**2 * (1 + 4 + 16)
        if depth > DEEPEST or parameters > MOST_PARAMETERS:
            raise InputError(
                f"model.depth={depth}, model.width={width} make {parameters:.1g} parameters: the largest depth is "
                f"{DEEPEST}, and {MOST_PARAMETERS:g} parameters"
            )
        if not 0 <= dropout < 1:
            raise InputError(f"model.dropout={dropout} must be at least 0 and below 1")
        channels = [16, 16 * width, 32 * width, 64 * width]
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1))
        self.stem = nn.Conv2d(3, channels[0], 3, padding=1, bias=False)
        self.groups = nn.Sequential(
            *(
                _group(channels[i], channels[i + 1], (depth - 4) // 6, stride=2 if i else 1, dropout=dropout)
                for i in range(3)
            )
        )
        self.norm = nn.BatchNorm2d(channels[3])
        self.head = nn.Linear(channels[3], classes)
        self.apply(_initialize)

    def forward(self, images: Tensor) -> Tensor:
        features = self.groups(self.stem((images - self.mean) / self.std))
        return self.head(F.relu(self.norm(features)).mean((2, 3)))


class _Block(nn.Module):
    """Pre-activation: norm, ReLU, convolution, twice, with dropout between; the shortcut starts after the ReLU."""

    def __init__(self, inputs: int, outputs: int, stride: int, dropout: float):
        super().__init__()
        self.norm1 = nn.BatchNorm2d(inputs)
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.norm2 = nn.BatchNorm2d(outputs)
        self.dropout = Dropout(dropout)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        same = inputs == outputs and stride == 1
        self.shortcut = None if same else nn.Conv2d(inputs, outputs, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        activated = F.relu(self.norm1(x))
        shortcut = x if self.shortcut is None else self.shortcut(activated)
        hidden = self.conv1(activated)
        return self.conv2(self.dropout(F.relu(self.norm2(hidden)))) + shortcut


def _group(inputs: int, outputs: int, blocks: int, stride: int, dropout: float) -> nn.Sequential:
    first = _Block(inputs, outputs, stride, dropout)
    return nn.Sequential(first, *(_Block(outputs, outputs, 1, dropout) for _ in range(blocks - 1)))


def _initialize(module: nn.Module) -> None:
    """He initialization (He et al. 2015)."""
    if isinstance(module, nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    elif isinstance(module, nn.Linear):
        nn.init.kaiming_normal_(module.weight, nonlinearity="linear")
        nn.init.zeros_(module.bias)


class Dropout(nn.Dropout):
    """`nn.Dropout`; on a CPU p is rounded to 2⁻¹⁶, since torch's own draws there take a third of a training step.

    Several processes draw for the whole batch, of which each has an equal share, and take their own part.
    """

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.p == 0:
            return x
        if x.device.type == "cpu":
            return x * self._drawn_by_numpy(x)
        if utils.world_size() == 1:
            return super().forward(x)
        everyone = torch.rand(utils.world_size(), *x.shape, device=x.device)
        return x * (everyone[utils.rank()] >= self.p) / (1 - self.p)

    def _drawn_by_numpy(self, x: Tensor) -> Tensor:
        """0 or 1 / (1 - p) for each value, in x's memory layout: 16 bits each, from a generator that torch seeds."""
        own, everyone = x.numel(), x.numel() * utils.world_size()
        generator = np.random.Generator(np.random.SFC64(int(torch.randint(2**63 - 1, (1,)))))
        words = generator.integers(0, 2**64 - 1, -(-everyone // 4), dtype=np.uint64, endpoint=True)
        bits = torch.from_numpy(words.view(np.int16))[utils.rank() * own :][:own]
        dropped = round(self.p * LEVELS)
        kept = bits.ge_(dropped - LEVELS // 2)  # in place: as int16 it converts five times faster than as bool
        factors = torch.empty_like(x)  # dense, so that its storage can be filled in order
        factors.as_strided((own,), (1,)).copy_(kept).mul_(LEVELS / (LEVELS - dropped))
        return factors
