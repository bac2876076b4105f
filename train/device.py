"""Where and how to compute: device, threads, precision, and CUDA graphs."""

import functools
import os
import platform
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from augment import utils
from renderer.errors import InputError, as_device, require_choice
from train import console

QUOTA = Path("/sys/fs/cgroup/cpu.max")
THREADS = torch.get_num_threads()  # before any run sets its own
SMALL_WORK = 1e10  # weights × pixels of a batch, some milliseconds of one core: less is trained by one thread
PRECISIONS = {"bfloat16": torch.bfloat16, "float16": torch.float16, "float32": torch.float32}
COMPILE = ("auto", "always", "never")
SIZES = (16, 32, 64, 128, 512)  # of a batch in eval mode: attacks, whose examples leave on success, and validation
RECOMPILE_LIMIT = 4 * len(SIZES)  # each with and without gradients, which torch's 8 are too few for


def choose_device(name: str) -> torch.device:
    """auto (CUDA where there is a GPU, else the CPU) or any name torch knows; "cuda" is a GPU for each process of
    torchrun. InputError where it is not available."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and "LOCAL_RANK" in os.environ:
        name = f"cuda:{os.environ['LOCAL_RANK']}"
    return as_device(name)


def most_threads() -> int:
    """Count the cores that this process may use.

    These are no more than the threads that torch took at the start (OMP_NUM_THREADS sets them), the cores that the
    process is bound to (taskset, Slurm), and a container's quota of cores, above which threads wait for each other.
    """
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = QUOTA.read_text().split()
        permitted = max(1, int(quota) // int(period))
    except (OSError, ValueError):  # no such file (it is Linux's, cgroup v2), or "max 100000"
        permitted = bound
    return min(THREADS, bound, permitted)


def choose_threads(network: nn.Module, batch_size: int, size: int) -> int:
    """Choose the threads of a training by a rule, so that the same command gives the same bits on a machine.

    Small batches take one thread, since several would wait for each other most of the time. All others take
    `most_threads`. A trial would choose better on a busy machine, and would choose otherwise the next time.

    Args:
        network: The network that is trained.
        batch_size: The images of a batch.
        size: The pixels per side of an image.

    Returns:
        The number of threads.
    """
    weights = sum(parameter.numel() for parameter in network.parameters())
    return most_threads() if weights * batch_size * size**2 >= SMALL_WORK else 1


def set_deterministic(deterministic: bool) -> None:
    """Whether a GPU's results repeat bit for bit, at some cost in time; a CPU's always do."""
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS asks for it
    if deterministic != torch.are_deterministic_algorithms_enabled():  # asking torch imports its compiler: seconds
        torch.use_deterministic_algorithms(deterministic)
    torch.backends.cudnn.benchmark = not deterministic


def choose_precision(precision: str, device: torch.device, trained: nn.Module | None = None) -> str:
    """One of PRECISIONS; "auto" takes bfloat16 where the device computes in it rather than emulate it, otherwise
    float16 on a GPU and float32 on a CPU. There it takes float32, too, to train a network of depthwise convolutions,
    whose gradients in bfloat16 take 3 times as long; and warns of bfloat16 by name where that is emulated."""
    require_choice("train.precision", precision, ("auto", *PRECISIONS))
    if device.type == "cuda":
        known = torch.cuda.is_bf16_supported(including_emulation=False)
        return precision if precision != "auto" else "bfloat16" if known else "float16"
    if platform.machine() in ("x86_64", "AMD64"):
        known = device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()
    else:
        known = device.type == "cpu" and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    if precision == "bfloat16" and not known:
        console.warning("this CPU emulates bfloat16, some 10 times slower than float32: leave train.precision out")
    if precision != "auto":
        return precision
    layers = [] if trained is None else [layer for layer in trained.modules() if isinstance(layer, nn.Conv2d)]
    depthwise = any(layer.groups == layer.in_channels > 1 for layer in layers)
    return "bfloat16" if known and not depthwise else "float32"


class MixedPrecision(nn.Module):
    """A network in channels-last layout under autocast: float32 images in, float32 logits out."""

    def __init__(self, network: nn.Module, precision: str):
        super().__init__()
        self.network = network.to(memory_format=torch.channels_last)
        self.precision = precision

    def forward(self, images: Tensor) -> Tensor:
        images = images.contiguous(memory_format=torch.channels_last)
        with torch.autocast(images.device.type, PRECISIONS[self.precision], enabled=self.precision != "float32"):
            return self.network(images).float()


@functools.cache
def compiles(choice: str, device: torch.device) -> bool:
    """Whether to compile: for "auto" on one GPU where torch.compile works, which needs a C compiler; several processes
    wait for each other inside a pass. InputError for "always" on a CPU, which has no graphs to replay."""
    if choice == "always" and device.type == "cpu":
        raise InputError("train.compile=always is for a GPU, whose graphs it replays: use auto or never")
    if choice != "auto" or device.type != "cuda" or utils.world_size() > 1:
        return choice == "always"
    try:
        torch.compile(torch.exp)(torch.zeros(2, device=device))
    except Exception as error:  # of torch, Triton or the compiler
        reason = " ".join(str(error).splitlines()[:2])
        console.warning("compile: torch.compile fails here, so training is slower: %s", reason)
        return False
    return True


class GraphedModel(nn.Module):
    """A model in eval mode as CUDA graphs, one for each of a few batch sizes; smaller batches are filled up with zeros.

    Rows do not influence each other in eval mode. In training mode, and for larger batches, the model as it is.
    """

    def __init__(self, model: nn.Module, compiler: Any = "cudagraphs"):
        super().__init__()
        self.model = model
        self._graphs = torch.compile(model.forward, backend=compiler, dynamic=False)
        torch._dynamo.config.recompile_limit = RECOMPILE_LIMIT

    def forward(self, images: Tensor) -> Tensor:
        if self.training or len(images) > SIZES[-1]:
            return self.model(images)
        size = next(size for size in SIZES if len(images) <= size)
        filled = torch.cat([images, images.new_zeros(size - len(images), *images.shape[1:])])
        return self._graphs(filled)[: len(images)].clone()  # the next replay writes over a graph's result
