"""Where and how to compute: device and threads, mixed precision, CUDA graphs."""

import functools
import os
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from augment import utils
from augment.labels import divergence, is_right, label_loss, ranking_loss
from renderer.errors import InputError, as_device, require_choice
from renderer.image import to_unit
from train.run_folder.logs import console

QUOTA = Path("/sys/fs/cgroup/cpu.max")
PRECISIONS = ("auto", "bfloat16", "float32")
MEASUREMENTS = 8
COMPILE = ("auto", "always", "never")
SIZES = (16, 32, 64, 128, 512)  # of a batch in eval mode: attacks, whose examples leave when fooled, and evaluation
RECOMPILE_LIMIT = 4 * len(SIZES)  # each with and without gradients, which torch's 8 are too few for


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
    torch.set_num_threads(threads or min(torch.get_num_threads(), _quota()))


def set_deterministic(deterministic: bool) -> None:
    """Whether a GPU's results repeat bit for bit, at some cost in time; a CPU's always do."""
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS asks for it
    torch.use_deterministic_algorithms(deterministic)
    torch.backends.cudnn.benchmark = not deterministic


def _quota() -> int:
    """Cores that the container may use, at least 1; the machine's where nothing limits them (cgroup v2, Linux)."""
    try:
        quota, period = QUOTA.read_text().split()
        return max(1, int(quota) // int(period))
    except (OSError, ValueError):  # no such file, or "max 100000"
        return os.cpu_count() or 1


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
    require_choice("train.precision", precision, PRECISIONS)
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
    seconds: dict[str, list[float]] = {precision: [] for precision in candidates}
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
    return min(candidates, key=best.__getitem__)


def _step_time(layer: MixedPrecision, images: Tensor, precision: str) -> float:
    layer.precision = precision
    start = time.perf_counter()
    layer(images).sum().backward()
    return time.perf_counter() - start


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
    """Whether torch.compile can build here, which takes a C compiler and Python's headers; says so where it cannot."""
    try:
        torch.compile(torch.exp)(torch.zeros(2, device=device))
    except Exception as error:  # of torch's, of Triton's or of the compiler's
        reason = " ".join(str(error).splitlines()[:2])
        console.warning("compile: torch.compile fails here, so that training is slower: %s", reason)
        return False
    return True


def training_pass(
    model: nn.Module,
    label_smoothing: float,
    compiled: bool,
    ranking: float = 0.0,
    label: int | None = None,
    distillation: float = 0.0,
    teacher: nn.Module | None = None,
) -> Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]:
    """A function of uint8 images (B, 3, H, W), labels (B,) and which are renders, (B,) bool: the mean `label_loss`, and
    how many are right.

    Beside the loss stand, by their weights, the class `label`'s `ranking_loss` and, for images that are no renders, the
    `divergence` from the teacher's answers. compiled: torch forgets what it compiled before, since its limit counts the
    graphs of all runs of a process.
    """

    def loss_and_hits(images: Tensor, labels: Tensor, rendered: Tensor) -> tuple[Tensor, Tensor]:
        logits = model(to_unit(images))
        loss = label_loss(logits, labels, label_smoothing).mean()
        if teacher is not None:
            with torch.no_grad():
                answers = teacher(to_unit(images))
            loss = loss + distillation * (divergence(logits, answers) * ~rendered).mean()
        if label is not None and ranking:
            loss = loss + ranking * ranking_loss(logits, labels, label)
        return loss, is_right(logits.detach().argmax(1), labels).sum()

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
