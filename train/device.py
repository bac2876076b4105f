"""What computes a run: its device, threads, precision, CUDA graphs and processes.

torchrun starts several processes for one run. Signals end them.
"""

import functools
import os
import platform
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from augment import distributed
from augment.network import Network, eval_mode, plain_outputs
from augment.progress import progress_message
from augment.settings import RendererSettings
from renderer.errors import InputError, as_device, keyed, keys_of, require_choice
from renderer.visibility import Rasterizer, choose
from train import console
from train.settings import TrainSettings

# File in which Linux stores how much time of the cores a container may use: a quota and a
# period. The quota divided by the period is the number of cores.
QUOTA = Path("/sys/fs/cgroup/cpu.max")
# Number of threads of torch when this module is imported. A training run may change it.
THREADS = torch.get_num_threads()
# Training uses one thread if the number of weights of the network times the number of
# pixels of a batch is below this. Such a batch takes one core a few milliseconds.
SMALL_WORK = 1e10
# Number type in which a network computes, by the name of the precision.
PRECISIONS = {"bfloat16": torch.bfloat16, "float16": torch.float16, "float32": torch.float32}
# Signal that submitit (a launcher of Slurm jobs) sends before the time of a job is over. None on
# Windows, which lacks this signal.
BATCH_SYSTEM = getattr(signal, "SIGUSR2", None)
# Signals at which a training run writes a checkpoint and stops.
SIGNALS = tuple(filter(None, (signal.SIGTERM, signal.SIGINT, BATCH_SYSTEM)))


def choose_device(name: str) -> torch.device:
    """Choose the device that computes.

    "auto" is a GPU if there is one. With "cuda", each process of torchrun gets its own GPU.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and "LOCAL_RANK" in os.environ:
        name = f"cuda:{os.environ['LOCAL_RANK']}"
    return as_device(name)


def most_threads() -> int:
    """Return the largest useful number of threads of this process.

    It is the smallest of three numbers: the threads that torch chose at its start (the user can
    set OMP_NUM_THREADS), the cores to which the process is bound (by taskset or Slurm), and the
    cores that its container may use. More threads than cores would wait for each other.
    """
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    # Without a limit, the file of the container's quota is missing, or contains "max 100000".
    with suppress(OSError, ValueError):
        quota, period = QUOTA.read_text().split()
        cores = min(cores, max(1, int(quota) // int(period)))
    return min(THREADS, cores)


def choose_threads(network: nn.Module, batch_size: int, size: int) -> int:
    """Choose the number of threads of a training run.

    Small batches get one thread, because several threads would mostly wait for each other. All
    other batches get `most_threads()`. The number changes the last bits of the results, so it
    follows from the settings, and is not measured: the same command gives the same results.
    """
    weight_count = sum(parameter.numel() for parameter in network.parameters())
    return 1 if weight_count * batch_size * size**2 < SMALL_WORK else most_threads()


def set_deterministic(deterministic: bool) -> None:
    """Set whether a GPU gives exactly the same results in each run. A CPU always does."""
    if deterministic:
        # The deterministic algorithms of cuBLAS need this variable.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    # The call below imports the compiler of torch, which takes seconds. It is left out
    # if it would change nothing.
    if deterministic != torch.are_deterministic_algorithms_enabled():
        torch.use_deterministic_algorithms(deterministic)
    torch.backends.cudnn.benchmark = not deterministic


def choose_precision(precision: str, device: torch.device, trained: nn.Module | None = None) -> str:
    """Choose the precision in which a network computes.

    "auto" is bfloat16 if the hardware computes in it, or else float16 on a GPU and float32 on a
    CPU. Training of depthwise convolutions on a CPU also gets float32, because their gradients take
    3 times as long in bfloat16.
    """
    require_choice("precision", precision, ("auto", *PRECISIONS))
    is_gpu = device.type == "cuda"
    if is_gpu:
        is_native = torch.cuda.is_bf16_supported(including_emulation=False)
    elif device.type == "cpu" and platform.machine() in ("x86_64", "AMD64"):
        is_native = torch.cpu._is_avx512_bf16_supported()
    else:
        is_native = device.type == "cpu" and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    if precision == "bfloat16" and not is_native and not is_gpu:
        slow = "this CPU emulates bfloat16, some 10 times slower than float32"
        console.warning("%s: leave precision out", slow)
    if precision != "auto":
        return precision
    # Only the training on a CPU depends on the kinds of layers.
    modules = [] if is_gpu or trained is None else trained.modules()
    layers = [module for module in modules if isinstance(module, nn.Conv2d)]
    # A depthwise convolution has as many groups as input channels, and more than one.
    if is_native and not any(layer.groups == layer.in_channels > 1 for layer in layers):
        return "bfloat16"
    return "float16" if is_gpu else "float32"


class MixedPrecision(Network):
    """Network that computes in a chosen precision.

    Images and logits are float32. Between them, torch.autocast uses the chosen precision. Of a
    detector, all outputs are returned, and not only logits.
    """

    def __init__(self, network: nn.Module, precision: str, is_detector: bool = False):
        super().__init__(network)
        self.precision, self.is_detector = precision, is_detector

    def forward(self, images: Tensor, *targets: Any) -> Any:
        """Compute outputs or, if a detector gets targets in training mode, its losses."""
        images = images.contiguous(memory_format=torch.channels_last)
        dtype = PRECISIONS[self.precision]
        with torch.autocast(images.device.type, dtype, enabled=dtype != torch.float32):
            outputs = self.network(images, *targets)
        outputs = outputs if self.is_detector else plain_outputs(outputs)
        return outputs.float() if isinstance(outputs, Tensor) else outputs


def place(network: nn.Module, settings: TrainSettings, is_detector: bool) -> MixedPrecision:
    """Move a network to the device that trains it, and set the precision."""
    set_deterministic(settings.deterministic)
    device = choose_device(settings.device)
    precision = choose_precision(settings.precision, device, network)
    placed = network.to(device).to(memory_format=torch.channels_last)
    return MixedPrecision(placed, precision, is_detector)


@functools.cache
def compiles(choice: str, device: torch.device) -> bool:
    """Return whether to record the training step as CUDA graphs with torch.compile.

    "auto" means yes on a GPU if there is a C compiler and one process: several processes
    communicate within a pass.
    """
    if choice == "always" and device.type == "cpu":
        raise InputError("choice=always needs a GPU for CUDA graphs: use auto or never", "choice")
    if choice != "auto" or device.type != "cuda" or distributed.world_size() > 1:
        return choice == "always"
    try:
        torch.compile(torch.exp)(torch.zeros(2, device=device))
    except Exception as error:
        # torch, Triton and the C compiler raise errors of many types.
        reason = " ".join(str(error).splitlines()[:2])
        console.warning("compile: torch.compile fails here, so training is slower: %s", reason)
        return False
    return True


def choose_rasterizer(settings: RendererSettings) -> Rasterizer:
    """Start the rasterizer that the settings of the renderer choose."""
    keys = keys_of("renderer", settings)
    with keyed(**keys), keyed("rasterizer"), progress_message("starting the rasterizer"):
        return choose(settings.rasterizer)


@contextmanager
def process_group() -> Iterator[None]:
    """Connect the processes that torchrun started for one run, until the block ends.

    If torchrun did not start this process, nothing happens.
    """
    if int(os.environ.get("WORLD_SIZE", 1)) == 1:
        yield
        return
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    # Tensors on GPUs are exchanged by NCCL, and others by Gloo.
    dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


@contextmanager
def main_process_first() -> Iterator[None]:
    """Run the block in the first process, and then in the other processes of a run.

    If the block downloads or caches a file, the other processes find the complete file.
    """
    if distributed.rank() > 0:
        dist.barrier()
    yield
    if distributed.rank() == 0 and distributed.world_size() > 1:
        dist.barrier()


def broadcast(value: str) -> str:
    """Send a text from the first process of a run to all other processes."""
    values = [value]
    if distributed.world_size() > 1:
        dist.broadcast_object_list(values, src=0)
    return values[0]


def all_reduce_sum(values: Tensor) -> Tensor:
    """Replace a tensor by its sum over all processes of a run, in place."""
    if distributed.world_size() > 1:
        dist.all_reduce(values)
    return values


def wrap_ddp(model: nn.Module, size: int | None) -> nn.Module:
    """Wrap a model so that its gradients are averaged over all processes of a run.

    On GPUs, layers of batch normalization are replaced in `model` by layers that compute their
    statistics over the batch of all processes. On CPUs, each process has its own statistics. A
    single process returns the model itself. `size` is that of images, or None for a detector.
    """
    if distributed.world_size() == 1:
        return model
    if next(model.parameters()).is_cuda:
        nn.SyncBatchNorm.convert_sync_batchnorm(model)
    has_unused = size is not None and _has_unused_weights(model, size)
    return DistributedDataParallel(model, find_unused_parameters=has_unused)


def _has_unused_weights(model: nn.Module, size: int) -> bool:
    """Return whether the outputs for an image do not depend on some weights that learn.

    An example is the encoder of texts of CLIP.
    """
    weights = [weight for weight in model.parameters() if weight.requires_grad]
    if not weights:
        return False
    images = torch.full((1, 3, size, size), 0.5, device=weights[0].device)
    with eval_mode(model):
        outputs = plain_outputs(model(images))
    gradients = torch.autograd.grad(outputs.sum(), weights, allow_unused=True)
    return any(gradient is None for gradient in gradients)


class Interrupted(SystemExit):
    """Exit of the program after a signal, when the run has written its checkpoint.

    The exit status is 128 plus the number of the signal, as in a shell.

    Args:
        number: Number of the signal.
    """

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.signal = signal.Signals(number).name


class SignalHandler:
    """Context manager that lets a process write a checkpoint when a signal should end it.

    The first signal in the block is only noted. The block asks for it with `requested`, writes a
    checkpoint, and ends the process with `stop`. If it does not, the noted signal takes effect at
    the end of the block. Except under torchrun, a second signal ends the process at once. Signals
    that the process ignores stay ignored. Only the main thread can receive signals.
    """

    def __init__(self) -> None:
        """Create the context manager. It handles signals when its block begins."""
        # Number of the first signal. None if there was no signal yet.
        self._number: int | None = None
        # The last call of `requested` began to count the processes with a signal. These are the
        # operation, which may still run, and the tensor that receives the count.
        self._last_sum: tuple[dist.Work, Tensor] | None = None
        # Handlers that the signals had before the block.
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "SignalHandler":
        """Replace the handlers of all signals in SIGNALS, except of those that are ignored."""
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) != signal.SIG_IGN:
                    self._handlers[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, _: object, error: BaseException | None, *rest: object) -> None:
        """Restore the handlers, and let a noted signal take effect unless an error is raised."""
        self._restore()
        if error is None and self._number is not None:
            signal.raise_signal(self._number)
        # A job sends the signal to all its processes, also to those that read images.
        if self._number is not None and "DataLoader worker" in str(error):
            self.stop()

    def requested(self) -> bool:
        """Return whether the run should stop, because one of its processes got a signal.

        With several processes, each call starts to count the processes with a
        signal, and returns whether the count that the previous call started is
        above 0. Processes then hardly wait for each other, and all of them stop
        after the same number of calls.
        """
        has_signal = self._number is not None
        if distributed.world_size() == 1:
            return has_signal
        previous_sum = self._last_sum
        # A tensor on the CPU does not wait for computations on a GPU.
        count = torch.tensor(float(has_signal))
        self._last_sum = dist.all_reduce(count, async_op=True), count
        if previous_sum is None:
            return False
        work, previous_count = previous_sum
        return work.wait() and bool(previous_count)

    def stop(self) -> None:
        """Raise `Interrupted`, which ends the process with the status of the signal.

        If a batch system sent the signal and has installed a handler for it, this handler is
        called first. It may put the job into the queue again and end the process.
        """
        # `_number` is None if other processes of the run got a signal, but not this process.
        # This process then ends as if it got SIGTERM.
        self._restore()
        number = self._number or signal.SIGTERM
        if number == BATCH_SYSTEM and callable(signal.getsignal(number)):
            signal.raise_signal(number)
        raise Interrupted(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Note the first signal. Except under torchrun, the next one ends the process."""
        self._number = self._number or number
        # torchrun passes signals on, also to processes that got them from their job.
        if "TORCHELASTIC_RUN_ID" not in os.environ:
            self._restore()

    def _restore(self) -> None:
        """Restore the handlers that the signals had before the block."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}
