"""Mixed precision: bfloat16 arithmetic where the machine is faster at it, float32 weights and logits always."""

import functools
import time

import torch
from torch import Tensor, nn

from renderer.errors import InputError
from train.logs import console

PRECISIONS = ("auto", "bfloat16", "float32")
MEASUREMENTS = 8


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
    candidates = ("bfloat16", "float32")
    seconds = {precision: [] for precision in candidates}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # threads that wait for a busy core would blur the comparison
    try:
        for precision in candidates * MEASUREMENTS:  # in turn; the least counts, so a busy machine disturbs both alike
            seconds[precision].append(_step_time(layer, images, precision))
    finally:
        torch.set_num_threads(threads)
    best = {precision: min(times) for precision, times in seconds.items()}
    measured = ", ".join(f"{1000 * best[precision]:.1f} ms in {precision}" for precision in candidates)
    console.info("precision: a convolution's training step takes %s", measured)
    return min(candidates, key=best.get)


def _step_time(layer: MixedPrecision, images: Tensor, precision: str) -> float:
    layer.precision = precision
    start = time.perf_counter()
    layer(images).sum().backward()
    return time.perf_counter() - start
