"""Where and how to compute: device, precision, CUDA graphs, the processes of torchrun, and signals that end a run."""

import functools
import os
import platform
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from augment import utils
from renderer.errors import InputError, as_device, require_choice
from train import console

QUOTA = Path("/sys/fs/cgroup/cpu.max")
PRECISIONS = ("auto", "bfloat16", "float32")
COMPILE = ("auto", "always", "never")
SIZES = (16, 32, 64, 128, 512)  # of a batch in eval mode: attacks, whose examples leave on success, and validation
RECOMPILE_LIMIT = 4 * len(SIZES)  # each with and without gradients, which torch's 8 are too few for
BATCH_SYSTEM = getattr(signal, "SIGUSR2", None)  # submitit's, before a job's time is over; Windows has none
SIGNALS = tuple(filter(None, (signal.SIGTERM, signal.SIGINT, BATCH_SYSTEM)))

# ------------------------------------------------------------------------------------- device, threads, precision


def choose_device(name: str) -> torch.device:
    """auto (CUDA where there is a GPU, else the CPU) or any name torch knows; InputError where it is not available.

    Each process that torchrun starts takes a GPU of its own for "auto" and "cuda".
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and "LOCAL_RANK" in os.environ:
        name = f"cuda:{os.environ['LOCAL_RANK']}"
    device = as_device(name)
    if device.type == "meta":
        raise InputError("device=meta is not available here: it computes nothing, use auto or cpu")
    return device


def set_threads(threads: int | None) -> None:
    """Threads of an operation on the CPU; None leaves torch's choice, but no more than a container's quota of cores.

    torch counts the machine's cores, and threads above the quota wait for each other.
    """
    try:
        quota, period = QUOTA.read_text().split()
        cores = max(1, int(quota) // int(period))
    except (OSError, ValueError):  # no such file (it is Linux's, cgroup v2), or "max 100000"
        cores = os.cpu_count() or 1
    torch.set_num_threads(threads or min(torch.get_num_threads(), cores))


def set_deterministic(deterministic: bool) -> None:
    """Whether a GPU's results repeat bit for bit, at some cost in time; a CPU's always do."""
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS asks for it
    torch.use_deterministic_algorithms(deterministic)
    torch.backends.cudnn.benchmark = not deterministic


def choose_precision(precision: str, device: torch.device) -> str:
    """ "bfloat16" or "float32"; "auto" takes bfloat16 where the device computes in it rather than emulate it."""
    require_choice("train.precision", precision, PRECISIONS)
    if precision != "auto":
        return precision
    match device.type:
        case "cuda":
            supported = torch.cuda.is_bf16_supported(including_emulation=False)
        case "cpu" if platform.machine() in ("x86_64", "AMD64"):
            supported = torch.cpu._is_avx512_bf16_supported()
        case "cpu":
            supported = torch.ops.mkldnn._is_mkldnn_bf16_supported()
        case _:
            supported = False
    return "bfloat16" if supported else "float32"


class MixedPrecision(nn.Module):
    """A network run in channels-last layout under autocast: float32 images in, float32 logits out.

    Only the network computes in the precision; the renderer's products and the loss stay in float32.
    """

    def __init__(self, network: nn.Module, precision: str):
        super().__init__()
        self.network = network.to(memory_format=torch.channels_last)
        self.precision = precision

    def forward(self, images: Tensor) -> Tensor:
        images = images.contiguous(memory_format=torch.channels_last)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
            return self.network(images).float()


# ------------------------------------------------------------------------------------- compiled passes on a GPU


def compiles(choice: str, device: torch.device) -> bool:
    """Whether to compile.

    "auto" does on one GPU where a trial succeeds; several processes wait for each other inside a pass. InputError for
    "always" on a CPU, which has no graphs to replay.
    """
    if choice == "always" and device.type == "cpu":
        raise InputError("train.compile=always is for a GPU, whose graphs it replays: use auto or never")
    if choice != "auto":
        return choice == "always"
    return device.type == "cuda" and utils.world_size() == 1 and compiler_works(device)


@functools.cache
def compiler_works(device: torch.device) -> bool:
    """Whether torch.compile works here; it needs a C compiler and Python's headers. Logs the reason where it fails."""
    try:
        torch.compile(torch.exp)(torch.zeros(2, device=device))
    except Exception as error:  # of torch's, of Triton's or of the compiler's
        reason = " ".join(str(error).splitlines()[:2])
        console.warning("compile: torch.compile fails here, so training is slower: %s", reason)
        return False
    return True


def compiled_pass(function: Callable[..., Any]) -> Callable[..., Any]:
    """A training pass as CUDA graphs. Forgets earlier graphs, since torch limits those of all runs of a process."""
    torch.compiler.reset()
    return torch.compile(function, mode="reduce-overhead", dynamic=False)


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


# ------------------------------------------------------------------------------------- processes of torchrun


@contextmanager
def process_group() -> Iterator[None]:
    """Join the processes that torchrun started; a run by itself has none to join."""
    if int(os.environ.get("WORLD_SIZE", 1)) == 1:
        yield
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def is_process_lost(error: Exception) -> bool:
    """Whether another process, which this one waited for, has ended: NCCL's error, or gloo's, known by its file."""
    return isinstance(error, dist.DistError) or "/gloo/" in str(error)


@contextmanager
def first_process_first() -> Iterator[None]:
    """Let the first process do alone what the others then find done, such as a download."""
    if utils.rank() > 0:
        dist.barrier()
    yield
    if utils.rank() == 0 and utils.world_size() > 1:
        dist.barrier()


def broadcast(value: str = "") -> str:
    """The first process's value, which the others wait for."""
    values = [value]
    if utils.world_size() > 1:
        dist.broadcast_object_list(values, src=0)
    return values[0]


def any_process(flag: bool) -> bool:
    """Whether the flag is set in any process."""
    if utils.world_size() == 1:
        return flag
    flags = torch.tensor([float(flag)])  # on the CPU, so that no device has to catch up
    dist.all_reduce(flags, dist.ReduceOp.MAX)
    return bool(flags)


def summed(values: Tensor) -> Tensor:
    """The sum over all processes, in place."""
    if utils.world_size() > 1:
        dist.all_reduce(values)
    return values


def replicated(model: nn.Module) -> nn.Module:
    """The model whose gradients are averaged over all processes; itself where there is but one.

    Batch normalization takes its statistics over the global batch (`nn.SyncBatchNorm`), so that the result does not
    depend on the number of processes.
    """
    if utils.world_size() == 1:
        return model
    if next(model.parameters()).is_cuda:
        nn.SyncBatchNorm.convert_sync_batchnorm(model)  # replaces the norms inside
    else:
        for module in model.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.__class__ = SyncBatchNormCPU
    return DistributedDataParallel(model)


class SyncBatchNormCPU(nn.BatchNorm2d):
    """`nn.SyncBatchNorm`, which is for GPUs alone, in elementary operations; every process has as many rows."""

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return super().forward(x)
        values, shape = x.to(torch.promote_types(x.dtype, torch.float32)), (1, -1, 1, 1)
        mean = _Sum.apply(values.mean((0, 2, 3))) / utils.world_size()
        centered = values - mean.view(shape)
        variance = _Sum.apply(centered.square().mean((0, 2, 3))) / utils.world_size()
        count = utils.world_size() * x.numel() // x.shape[1]
        if self.running_mean is not None and self.running_var is not None and self.num_batches_tracked is not None:
            self.num_batches_tracked += 1
            momentum = 1 / float(self.num_batches_tracked) if self.momentum is None else self.momentum
            self.running_mean.lerp_(mean.detach(), momentum)
            self.running_var.lerp_(variance.detach() * count / (count - 1), momentum)
        normalized = centered * (variance + self.eps).rsqrt().view(shape)
        if self.affine:
            normalized = normalized * self.weight.view(shape) + self.bias.view(shape)
        return normalized.to(x.dtype)


class _Sum(torch.autograd.Function):
    """The sum over all processes; so is its gradient, since each process's loss depends on the values of all."""

    @staticmethod
    def forward(context: Any, values: Tensor) -> Tensor:
        return summed(values.clone())

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> Tensor:
        return summed(gradient.clone())


# ------------------------------------------------------------------------------------- signals


class Interrupted(SystemExit):
    """A run ended early by a signal, with its checkpoint written; its exit status is the shell's: 128 + number."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class Interruption:
    """Notes the first of `SIGNALS` while it is entered; a second one acts as it would without.

    So does the first where nobody asks for it until it is left. Signals that the process was started to ignore stay
    ignored, and they reach its main thread alone: in another one, none is noted.
    """

    def __init__(self) -> None:
        self._number: int | None = None
        self._handlers: dict[int, Any] = {}  # before it was entered

    def __enter__(self) -> "Interruption":
        if threading.current_thread() is threading.main_thread():
            heeded = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
            self._handlers = {number: signal.signal(number, self._note) for number in heeded}
        return self

    def __exit__(self, error: type[BaseException] | None, *rest: object) -> None:
        self._restore()
        if error is None and self._number is not None:
            signal.raise_signal(self._number)

    def requested(self) -> bool:
        """Whether to stop now; the same in all processes of a run."""
        return any_process(self._number is not None)

    def stop(self) -> None:
        """Raise `Interrupted`, after a batch system's own handler, which may queue the job again and exit."""
        number = self._number or signal.SIGTERM  # the signal may have reached another process alone
        if number == BATCH_SYSTEM and callable(signal.getsignal(number)):
            signal.raise_signal(number)
        raise Interrupted(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._number = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}
