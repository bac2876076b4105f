"""Where and how to compute."""

import os
from pathlib import Path

import torch

from renderer.errors import InputError

QUOTA = Path("/sys/fs/cgroup/cpu.max")


def choose_device(name: str) -> torch.device:
    """auto (CUDA where there is a GPU, else the CPU) or any name torch knows; InputError where it is not available.

    Each process that torchrun starts takes a GPU of its own for "auto" and "cuda".
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and "LOCAL_RANK" in os.environ:
        name = f"cuda:{os.environ['LOCAL_RANK']}"
    try:
        return torch.zeros(1, device=name).device
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        raise InputError(f"device={name} is not available here: use auto or cpu") from error


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
