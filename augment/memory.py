"""Measures free memory, and estimates the memory that renders, operators and attacks need."""

from pathlib import Path

import torch

from renderer.errors import InputError

MEMORY = Path("/proc/meminfo")  # Linux writes the free memory of the machine here.
GROUP = Path("/sys/fs/cgroup")  # Linux writes the memory limit of a container here (cgroup v2).
GIB = 2**30

# An attack on the light keeps about so many numbers in memory for each coefficient of the light of
# each example.
NUMBERS_PER_LIGHT_VALUE = 12
# An attack on the light keeps about so many numbers in memory for each pixel of all images.
NUMBERS_PER_PIXEL = 10
# An attack on the light also keeps about so many numbers for each pixel of the images that are
# rendered at the same time.
NUMBERS_PER_RENDERED_PIXEL = 16
# If effects of a camera, such as blur and noise, are rendered, an attack on the light keeps about
# so many numbers for each pixel of the images that are rendered at the same time.
NUMBERS_PER_RENDERED_PIXEL_WITH_CAMERA = 48

# Bytes of the linear operator from light to image, for each pixel and each coefficient of the
# light: two channels of float32.
OPERATOR_BYTES = 8


def require_memory(name: str, needed: int, device: torch.device) -> None:
    """Check that enough memory is free, because Linux would otherwise kill the process.

    Args:
        name: Objects that need the memory, in the plural, such as "40 renders".
        needed: Number of bytes that they need.
        device: Device on which they are stored.

    Raises:
        InputError: If fewer bytes are free.
    """
    if not has_memory(needed, device):
        free = free_memory(device) or 0
        raise InputError(
            f"{name} need {needed / GIB:.1f} GB of memory, but only {free / GIB:.1f} GB are free: "
            "reduce their number or size",
        )


def has_memory(needed: int, device: torch.device) -> bool:
    """Return whether a number of bytes is free on a device.

    Args:
        needed: Number of bytes.
        device: Device on which they are needed.

    Returns:
        Whether enough bytes are free. True also if the amount of free memory is unknown.
    """
    free = free_memory(device)
    return free is None or needed <= free


def free_memory(device: torch.device) -> int | None:
    """Return the free memory of a GPU, the machine or the container.

    Args:
        device: The device.

    Returns:
        The number of bytes. None if it is unknown.
    """
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


def attack_bytes(
    pixels: int,
    pixels_at_once: int,
    lights: torch.Tensor,
    camera_effects: bool,
) -> int:
    """Estimate the memory that an attack on the light of a scene takes.

    The linear operators from light to image are not counted.

    Args:
        pixels: Number of pixels of all images.
        pixels_at_once: Number of pixels of the images that are rendered at the same time.
        lights: RGB coefficients of the light of each of E examples, shape (E, coefficients, 3).
        camera_effects: Whether effects of a camera, such as blur and noise, are rendered.

    Returns:
        The number of bytes.
    """
    per_rendered_pixel = NUMBERS_PER_RENDERED_PIXEL
    if camera_effects:
        per_rendered_pixel = NUMBERS_PER_RENDERED_PIXEL_WITH_CAMERA
    numbers = NUMBERS_PER_PIXEL * pixels
    numbers += per_rendered_pixel * pixels_at_once
    numbers += NUMBERS_PER_LIGHT_VALUE * lights.numel()
    return lights.element_size() * numbers


def operator_bytes(degree: int, pixels: int) -> int:
    """Estimate the memory of the linear operators that map light to images.

    Args:
        degree: Degree of the spherical harmonics of the light.
        pixels: Number of pixels of all images.

    Returns:
        The number of bytes.
    """
    coefficient_count = (degree + 1) ** 2
    return OPERATOR_BYTES * coefficient_count * pixels
