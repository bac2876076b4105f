"""Mixed precision: bfloat16 arithmetic where the machine is faster at it, float32 weights and logits always."""

import functools
import statistics
import time

import torch
from torch import Tensor, nn

from renderer.errors import InputError

PRECISIONS = ("auto", "bfloat16", "float32")


class MixedPrecision(nn.Module):
    """A network run in channels-last layout under autocast: float32 images in, float32 logits out.

    The precision stays inside, so that nothing else (the renderer's products, the loss) is rounded to bfloat16.
    """

    def __init__(self, network: nn.Module, precision: str):
        super().__init__()
        self.network = network.to(memory_format=torch.channels_last)
        self.precision = precision

    def forward(self, images: Tensor) -> Tensor:
        images = images.contiguous(memory_format=torch.channels_last)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
            return self.network(images).float()


def choose_precision(precision: str, device: torch.device) -> str:
    """ "bfloat16" or "float32"; "auto" takes the faster on this device by a short measurement."""
    if precision not in PRECISIONS:
        raise InputError(f"train.precision={precision}: choose one of {', '.join(PRECISIONS)}")
    return _faster_precision(device) if precision == "auto" else precision


@functools.cache
def _faster_precision(device: torch.device) -> str:
    """The faster of the two for a training step of a typical convolution; measured once per process."""
    if device.type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    with torch.random.fork_rng(devices=[]):
        layer = MixedPrecision(nn.Conv2d(64, 64, 3, padding=1, bias=False), "float32")
        images = torch.rand(32, 64, 32, 32)
    return min(("bfloat16", "float32"), key=lambda precision: _step_time(layer, images, precision))


def _step_time(layer: MixedPrecision, images: Tensor, precision: str) -> float:
    layer.precision = precision
    seconds = []
    for _ in range(7):
        start = time.perf_counter()
        layer(images).sum().backward()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[2:])
