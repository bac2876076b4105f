"""CUDA graphs of a network's passes, which spare a GPU the wait for Python; a CPU gains nothing from compiling."""

import functools
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from augment import processes
from train.batches import to_unit
from train.logs import console

COMPILE = ("auto", "always", "never")
SIZES = (16, 32, 64, 128, 512)  # of a batch in eval mode: attacks, whose examples leave when fooled, and evaluation
RECOMPILE_LIMIT = 4 * len(SIZES)  # each with and without gradients, which torch's 8 are too few for


def compiles(choice: str, device: torch.device) -> bool:
    """Whether to compile.

    "auto" does on one GPU where a trial succeeds; several processes wait for each other inside a pass.
    """
    if choice != "auto":
        return choice == "always"
    return device.type == "cuda" and processes.count() == 1 and compiler_works(device)


@functools.cache
def compiler_works(device: torch.device) -> bool:
    """Whether torch.compile can build here, which takes a C compiler and Python's headers; says so where it cannot."""
    try:
        torch.compile(torch.exp)(torch.zeros(2, device=device))
    except Exception as error:  # of torch's, of Triton's or of the compiler's
        reason = " ".join(str(error).splitlines()[:2])
        console.warning("compile: torch.compile fails here, so that training is slower: %s", reason)
        return False
    return True


def training_pass(model: nn.Module, label_smoothing: float, compiled: bool) -> Callable[[Tensor, Tensor], tuple]:
    """A function of uint8 pictures (B, 3, H, W) and labels (B,): the mean cross entropy, and how many are right.

    compiled: torch forgets what it compiled before, since its limit counts the graphs of all runs of a process.
    """

    def loss_and_hits(images: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        logits = model(to_unit(images))
        loss = F.cross_entropy(logits, labels, label_smoothing=label_smoothing)
        return loss, (logits.detach().argmax(1) == labels).sum()

    if not compiled:
        return loss_and_hits
    torch.compiler.reset()
    return torch.compile(loss_and_hits, mode="reduce-overhead", dynamic=False)


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
