"""The exception for errors that a user can fix, and the checks that keep NaN and values out of range out."""

import os
import reprlib
from collections.abc import Collection, Sequence
from pathlib import Path

import torch
from torch import Tensor

FACTOR = 1e5  # the largest that multiplies a light or an albedo, so that it stays below LARGEST
OUT_OF_MEMORY = "out of memory", "can't allocate memory", "ALLOC", "unable to find an engine"
LARGEST = 1e12  # products of three such float32 values do not overflow; infinity minus infinity would be NaN


class InputError(ValueError):
    """Bad input. The message is one sentence that names the file or key at fault and says what to do.

    Entry points print it without a traceback and exit with status 2.

    >>> require_range("samples", 0, 1, 64)
    Traceback (most recent call last):
    renderer.errors.InputError: samples=0 must be at least 1 and at most 64
    """


def in_one_line(error: Exception) -> str:
    """The message of an error in one line, or its type where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def is_out_of_memory(error: Exception) -> bool:
    """Whether memory ran out: a GPU's, as torch, CUDA, cuDNN and cuBLAS say it, torch's on the CPU, or Python's."""
    recognized = any(words in str(error) for words in OUT_OF_MEMORY)
    return recognized or isinstance(error, torch.OutOfMemoryError | MemoryError)


def as_device(device: torch.device | str) -> torch.device:
    """InputError where it is not a device, or not one of this machine."""
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError) as error:  # torch without CUDA asserts
        raise InputError(
            f"device={_short(device)} is not available here: use cpu, or cuda where there is a GPU"
        ) from error


def require_file(path: str | Path, advice: str) -> None:
    """InputError naming a path that is not a regular file: a pipe would block."""
    if not os.path.isfile(path):  # False, too, for an invalid name or a folder without permission
        raise InputError(f"{path} {'is not a regular file' if os.path.exists(path) else 'does not exist'}: {advice}")


def require_range(name: str, value: float | None, least: float, most: float) -> None:
    """InputError naming a value outside of its range, NaN, or what is no number; None means not set."""
    if value is None:
        return
    try:
        inside = bool(least <= value <= most)
    except (TypeError, ValueError, RuntimeError) as error:  # strings, complex numbers, arrays of several numbers
        raise InputError(f"{name}={_short(value)} must be a number") from error
    if not inside:
        raise InputError(f"{name}={value} must be at least {least:g} and at most {most:g}")


def require_choice(name: str, value: object, choices: Collection[str]) -> None:
    """InputError naming a value that is not one of its choices."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name}={_short(value)}: choose one of {', '.join(choices)}")


def require_limits(name: str, limits: Sequence[float], least: float, most: float) -> None:
    """InputError naming limits that are not [low, high] with both in range."""
    try:
        low, high = limits
        inside = bool(least <= low <= high <= most)
    except (TypeError, ValueError, RuntimeError):  # no two numbers
        inside = False
    if not inside:
        raise InputError(f"{name}={_short(limits)}: give [least, most], both from {least:g} to {most:g}")


def require_finite(**tensors: Tensor) -> None:
    """InputError naming the first tensor that holds NaN or infinity."""
    for name, tensor in tensors.items():
        if not _largest(tensor) <= torch.finfo(tensor.dtype).max:
            raise InputError(f"{name} holds NaN or infinity: give finite values")


def require_bounded(**tensors: Tensor) -> None:
    """InputError naming the first tensor that is not of floating-point numbers, or holds NaN, infinity or magnitudes
    beyond 1e12."""
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise InputError(f"{name} is {kind}: give a tensor of floating-point numbers")
        if not _largest(tensor) <= LARGEST:
            raise InputError(f"{name} holds NaN, infinity or magnitudes beyond {LARGEST:g}: give finite values")


def _short(value: object) -> str:
    """The value as text of one short line."""
    text = str(value) if isinstance(value, str) else reprlib.repr(value)
    return " ".join(text.split())


def _largest(tensor: Tensor) -> float:
    if not tensor.numel():
        return 0.0
    values = tensor.detach()
    if values.ndim == 2 and not values.is_contiguous():
        values = values.T  # which aminmax would otherwise copy, where its columns lie side by side in memory
    low, high = torch.aminmax(values)  # both are NaN where anything is
    return max(-low.item(), high.item())
