"""CUDA graphs of a network's passes, which spare a GPU the wait for Python; a CPU gains nothing from compiling."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment import processes
from train.batches import to_unit

COMPILE = ("auto", "always", "never")
SIZES = (16, 32, 64, 128, 512)  # of a batch in eval mode: attacks, whose examples leave when fooled, and evaluation
RECOMPILE_LIMIT = 16 * len(SIZES)  # of some runs in a process, each with and without gradients; torch's 8 are too few


def compiles(choice: str, device: torch.device) -> bool:
    """Whether to compile: "auto" does on one GPU; several processes wait for each other inside a pass."""
    return choice == "always" or (choice == "auto" and device.type == "cuda" and processes.count() == 1)


def training_pass(model: nn.Module, label_smoothing: float, compiled: bool) -> Callable[[Tensor, Tensor], tuple]:
    """A function of uint8 pictures (B, 3, H, W) and labels (B,): the mean cross entropy, and how many are right."""

    def loss_and_hits(images: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        logits = model(to_unit(images))
        loss = F.cross_entropy(logits, labels, label_smoothing=label_smoothing)
        return loss, (logits.detach().argmax(1) == labels).sum()

    return torch.compile(loss_and_hits, mode="reduce-overhead", dynamic=False) if compiled else loss_and_hits


class FixedSizes(nn.Module):
    """A model in eval mode at a few batch sizes, each a CUDA graph of its own; smaller batches are filled up.

    Rows do not influence each other in eval mode. In training mode, and for larger batches, the model as it is.
    """

    def __init__(self, model: nn.Module, backend: str = "cudagraphs"):
        super().__init__()
        self.model = model
        self._graphs = torch.compile(model.forward, backend=backend, dynamic=False)
        torch._dynamo.config.recompile_limit = RECOMPILE_LIMIT

    def forward(self, images: Tensor) -> Tensor:
        if self.training or len(images) > SIZES[-1]:
            return self.model(images)
        size = next(size for size in SIZES if len(images) <= size)
        filled = torch.cat([images, images.new_zeros(size - len(images), *images.shape[1:])])
        return self._graphs(filled)[: len(images)].clone()  # the next replay writes over a graph's result
