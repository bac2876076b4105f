"""Device, number of threads, precision and CUDA graphs of the computations."""

import functools
import os
import platform
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from augment import distributed
from augment.progress import progress_message
from augment.settings import RendererSettings
from renderer.errors import InputError, as_device, require_choice
from renderer.visibility.rasterizers import Rasterizer, choose
from train import console
from train.system.user_errors import keyed

# Linux writes a container's quota of cores into this file.
QUOTA = Path("/sys/fs/cgroup/cpu.max")
# The threads that torch took at the start, before any run sets its own number.
THREADS = torch.get_num_threads()
# The work of a batch is the number of weights times the number of pixels of the
# batch. `choose_threads` chooses one thread for less work than this, which takes one
# core some milliseconds.
SMALL_WORK = 1e10
PRECISIONS = {"bfloat16": torch.bfloat16, "float16": torch.float16, "float32": torch.float32}
# The batch sizes for which `GraphedModel` records graphs. Validation has the largest. The batches
# of an attack shrink, since examples leave on success.
SIZES = (16, 32, 64, 128, 512)
# Number of times that torch may compile a function, instead of its default of 8.
# Each size is compiled with and without gradients.
RECOMPILE_LIMIT = 4 * len(SIZES)


def choose_device(name: str) -> torch.device:
    """Choose the device that computes.

    Args:
        name: "auto" takes a GPU if there is one, or else the CPU. Otherwise any name that torch
            knows. "cuda" is a GPU of its own for each process of torchrun.

    Returns:
        The device.

    Raises:
        InputError: If the device is not available.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and "LOCAL_RANK" in os.environ:
        name = f"cuda:{os.environ['LOCAL_RANK']}"
    return as_device(name)


def most_threads() -> int:
    """Count the cores that this process may use.

    Three things limit them: the threads that torch took at the start (OMP_NUM_THREADS sets them),
    the cores that the process is bound to (taskset, Slurm), and a container's quota of cores.
    Above the quota, threads wait for each other.

    Returns:
        The number of cores.
    """
    bound = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        bound = len(os.sched_getaffinity(0))
    try:
        quota, period = QUOTA.read_text().split()
        permitted = max(1, int(quota) // int(period))
    except (OSError, ValueError):
        # If there is no quota, the file is missing or contains "max 100000".
        permitted = bound
    return min(THREADS, bound, permitted)


def choose_threads(network: nn.Module, batch_size: int, size: int) -> int:
    """Choose the threads of a training by a rule.

    The same command then gives the same bits on a machine. Small batches take one thread, since
    several would wait for each other most of the time. All others take `most_threads`. A trial
    would choose better on a busy machine, but it would choose otherwise the next time.

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
    """Choose whether a GPU computes the same bits every time. A CPU always does.

    Args:
        deterministic: Whether to compute the same bits, which is slower.
    """
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS asks for it.
    # Setting the choice imports torch's compiler, which takes seconds.
    if deterministic != torch.are_deterministic_algorithms_enabled():
        torch.use_deterministic_algorithms(deterministic)
    torch.backends.cudnn.benchmark = not deterministic


def choose_precision(precision: str, device: torch.device, trained: nn.Module | None = None) -> str:
    """Choose the precision that a network computes in.

    Args:
        precision: One of PRECISIONS, or "auto". "auto" takes bfloat16 if the device computes in it
            rather than emulating it. Otherwise it takes float16 on a GPU and float32 on a CPU.
        device: The device that computes.
        trained: The network, if it is trained. On a CPU, "auto" takes float32 for one with
            depthwise convolutions, whose gradients in bfloat16 take 3 times as long.

    Returns:
        One of PRECISIONS. bfloat16 on a CPU that emulates it is warned of.

    Raises:
        InputError: If there is no such precision.
    """
    require_choice("precision", precision, ("auto", *PRECISIONS))
    if device.type == "cuda":
        if precision != "auto":
            return precision
        is_native = torch.cuda.is_bf16_supported(including_emulation=False)
        return "bfloat16" if is_native else "float16"
    is_native = device.type == "cpu" and _computes_in_bfloat16()
    if precision == "bfloat16" and not is_native:
        slow = "this CPU emulates bfloat16, some 10 times slower than float32"
        console.warning("%s: leave precision out", slow)
    if precision != "auto":
        return precision
    if is_native and not _has_depthwise_layer(trained):
        return "bfloat16"
    return "float32"


def _has_depthwise_layer(network: nn.Module | None) -> bool:
    """Return whether a network has a depthwise convolution.

    A depthwise convolution has several input channels and a group for each.
    """
    modules = network.modules() if network is not None else []
    convolutions = [module for module in modules if isinstance(module, nn.Conv2d)]
    return any(layer.groups == layer.in_channels > 1 for layer in convolutions)


def _computes_in_bfloat16() -> bool:
    """Return whether this CPU has instructions for bfloat16."""
    if platform.machine() in ("x86_64", "AMD64"):
        return torch.cpu._is_avx512_bf16_supported()
    return torch.ops.mkldnn._is_mkldnn_bf16_supported()


class MixedPrecision(nn.Module):
    """A network that computes in a chosen precision, from float32 images to float32 logits.

    Args:
        network: The network, whose weights are put into the channels-last layout.
        precision: One of PRECISIONS.
    """

    def __init__(self, network: nn.Module, precision: str):
        super().__init__()
        self.network = network.to(memory_format=torch.channels_last)
        self.precision = precision

    def forward(self, images: Tensor) -> Tensor:
        images = images.contiguous(memory_format=torch.channels_last)
        dtype = PRECISIONS[self.precision]
        is_mixed = dtype != torch.float32
        with torch.autocast(images.device.type, dtype, enabled=is_mixed):
            return self.network(images).float()


@functools.cache
def compiles(choice: str, device: torch.device) -> bool:
    """Return whether to compile the passes of a network.

    Args:
        choice: "always", "never", or "auto". "auto" compiles on one GPU if torch.compile works
            there, which needs a C compiler. It does not compile for several processes, which wait
            for each other inside a pass.
        device: The device that computes.

    Returns:
        Whether to compile.

    Raises:
        InputError: If the choice is "always" on a CPU, which has no graphs to replay.
    """
    if choice == "always" and device.type == "cpu":
        raise InputError(
            "choice=always is for a GPU, whose graphs it replays: use auto or never",
            "choice",
        )
    if choice != "auto" or device.type != "cuda" or distributed.world_size() > 1:
        return choice == "always"
    try:
        torch.compile(torch.exp)(torch.zeros(2, device=device))
    except Exception as error:  # torch, Triton and the compiler raise errors of their own.
        reason = " ".join(str(error).splitlines()[:2])
        console.warning("compile: torch.compile fails here, so training is slower: %s", reason)
        return False
    return True


class GraphedModel(nn.Module):
    """A model in eval mode as CUDA graphs, one for each of a few batch sizes.

    Smaller batches are filled up with zeros, since rows do not influence each other in eval mode.
    In training mode, and for larger batches, the model computes as it is.

    Args:
        model: The model.
        compiler: The backend of torch.compile.
    """

    def __init__(self, model: nn.Module, compiler: Any = "cudagraphs"):
        super().__init__()
        self.model = model
        self._graphs = torch.compile(model.forward, backend=compiler, dynamic=False)
        torch._dynamo.config.recompile_limit = RECOMPILE_LIMIT

    def forward(self, images: Tensor) -> Tensor:
        if self.training or len(images) > SIZES[-1]:
            return self.model(images)
        # The smallest recorded size that holds the batch.
        size = next(size for size in SIZES if len(images) <= size)
        padding = images.new_zeros(size - len(images), *images.shape[1:])
        logits = self._graphs(torch.cat([images, padding]))
        # The next replay writes over the result of a graph, so the result is copied.
        return logits[: len(images)].clone()


def choose_rasterizer(settings: RendererSettings) -> Rasterizer:
    """Start the rasterizer.

    Args:
        settings: Settings of the renderer.

    Returns:
        The rasterizer.

    Raises:
        InputError: If it does not start on this machine. The sentence begins with the
            field `rasterizer`.
    """
    with keyed("rasterizer"), progress_message("starting the rasterizer"):
        return choose(settings.rasterizer)
