"""How many multiply-adds a network needs, and how many the device does at best, in square matrix products."""

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from augment.utils import Phases, eval_mode

SIZES = {"cpu": (512, 1024, 2048, 3072), "cuda": (2048, 4096, 8192, 16384)}
PRECISIONS = {"bfloat16": torch.bfloat16, "float32": torch.float32}
BURST = 0.2  # seconds: the least that a product is repeated for
TRAINING = 3  # forward passes that a training step costs: forward, and backward by activations and by weights


def forward_multiply_adds(network: nn.Module, size: int) -> int:
    """Of one image's forward pass, in convolutions and matrix products, counted as they are called."""
    image = torch.zeros(1, 3, size, size, device=next(network.parameters()).device)
    with FlopCounterMode(display=False) as counter, torch.no_grad(), eval_mode(network):
        network(image)
    return counter.get_total_flops() // 2


def products(device: torch.device) -> dict[tuple[str, int], float]:
    """Operations per second (two per multiply-add) of square matrix products, by precision and size."""
    phases = Phases(device)

    def seconds(left: Tensor, right: Tensor, out: Tensor) -> float:
        """Of one product: the mean of a burst, after one that warms up."""
        torch.mm(left, right, out=out)
        count, taken = 0, 0.0
        while taken < BURST:
            with phases("product"):
                torch.mm(left, right, out=out)
            taken += phases.take()["product"]
            count += 1
        return taken / count

    return {
        (name, size): 2 * size**3 / seconds(*torch.randn(3, size, size, device=device).to(dtype))
        for name, dtype in PRECISIONS.items()
        for size in SIZES[device.type]
    }
