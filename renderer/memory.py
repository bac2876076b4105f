"""Free memory of a GPU, the machine or the container."""

from pathlib import Path

import torch

from renderer.errors import InputError

MEMORY = Path("/proc/meminfo")  # Linux writes the free memory of the machine here.
GROUP = Path("/sys/fs/cgroup")  # Linux writes the memory limit of a container here (cgroup v2).
GIB = 2**30


def require_memory(name: str, needed: int, device: torch.device) -> None:
    """Check that enough memory is free, because Linux would otherwise kill the process.

    `name` is a plural such as "40 renders", and `needed` is in bytes.
    """
    if not has_memory(needed, device):
        free = free_memory(device) or 0
        raise InputError(
            f"{name} need {needed / GIB:.1f} GB of memory, but only {free / GIB:.1f} GB are free: "
            "reduce their number or size",
        )


def has_memory(needed: int, device: torch.device) -> bool:
    """Return whether a number of bytes is free on a device.

    It is True, too, if the amount of free memory is unknown.
    """
    free = free_memory(device)
    return free is None or needed <= free


def free_memory(device: torch.device) -> int | None:
    """Return the free bytes of a GPU, the machine or the container, or None if unknown."""
    if device.type == "cuda":
        # torch reserves memory that it does not use yet. This memory is free for torch.
        reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + reserved
    try:
        lines = dict(line.split(":") for line in MEMORY.read_text().splitlines())
        free = 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
    try:
        limit = int((GROUP / "memory.max").read_text())
        used = int((GROUP / "memory.current").read_text())
    # Outside of a container, the files do not exist. A container without a limit has the text
    # "max" in the first file, which is not a number.
    except (OSError, ValueError):
        return free
    return min(free, limit - used)
