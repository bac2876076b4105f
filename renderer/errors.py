"""The exception for errors that a user can fix, and the checks that keep NaN and values out of range out.

Settings are checked here, too, before torch and NumPy are imported. Functions that need torch
therefore import it themselves.
"""

from __future__ import annotations

import os
import reprlib
from collections.abc import Collection, Sequence, Set
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch
    from torch import Tensor

FACTOR = 1e5  # the largest that multiplies a light or an albedo, so that it stays below LARGEST
OUT_OF_MEMORY = "out of memory", "can't allocate memory", "ALLOC", "unable to find an engine"
LARGEST = 1e12  # products of three such float32 values do not overflow; infinity minus infinity would be NaN


class InputError(ValueError):
    """Bad input. The message is one sentence that names what is wrong and says what to do.

    Commands print it without a traceback and exit with status 2.

    Args:
        message: The sentence.
        argument: Name of the Python argument or field with which the sentence begins. Commands put
            the key of the settings that hold it in front. Empty if the sentence begins otherwise.

    >>> require_range("samples", 0, 1, 64)
    Traceback (most recent call last):
    renderer.errors.InputError: samples=0 must be at least 1 and at most 64
    """

    def __init__(self, message: str, argument: str = ""):
        super().__init__(message)
        self.argument = argument

    def within(self, key: str, names: Collection[str]) -> InputError:
        """Name the settings that hold the argument.

        Args:
            key: Key of the settings, such as "scene". Empty for settings at the top.
            names: Names of their fields. A sentence about anything else gets the whole key in
                front.

        Returns:
            The same error with a sentence that begins with the key.

        >>> InputError("views=0 must be at least 1", "views").within("scene", ["views", "light"])
        InputError('scene.views=0 must be at least 1')
        """
        if not key:
            return self
        field = self.argument.partition(".")[0].partition("[")[0]
        if field and field in names:
            return InputError(f"{key}.{self}", f"{key}.{self.argument}")
        return InputError(f"{key}: {self}", key)


def in_one_line(error: Exception) -> str:
    """The message of an error in one line, or its type where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def is_out_of_memory(error: Exception) -> bool:
    """Whether memory ran out: a GPU's, as torch, CUDA, cuDNN and cuBLAS say it, torch's on the CPU, or Python's."""
    import torch

    recognized = any(words in str(error) for words in OUT_OF_MEMORY)
    return recognized or isinstance(error, torch.OutOfMemoryError | MemoryError)


def as_device(device: torch.device | str) -> torch.device:
    """InputError where it is not a device, or not one of this machine."""
    import torch

    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError) as error:  # torch without CUDA asserts
        raise InputError(
            f"device={_short(device)} is not available here: use cpu, or cuda where there is a GPU", "device"
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
        raise InputError(f"{name}={_short(value)} must be a number", name) from error
    if not inside:
        raise InputError(f"{name}={value} must be at least {least:g} and at most {most:g}", name)


def require_choice(name: str, value: object, choices: Collection[str]) -> None:
    """InputError naming a value that is not one of its choices."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name}={_short(value)}: choose one of {', '.join(choices)}", name)


def require_limits(name: str, limits: Sequence[float], least: float, most: float) -> None:
    """InputError naming limits that are not [low, high] with both in range."""
    try:
        low, high = limits
        inside = bool(least <= low <= high <= most)
    except (TypeError, ValueError, RuntimeError):  # no two numbers
        inside = False
    if not inside:
        raise InputError(f"{name}={_short(limits)}: give [least, most], both from {least:g} to {most:g}", name)


def require_finite(**tensors: Tensor) -> None:
    """InputError naming the first tensor that holds NaN or infinity."""
    import torch

    for name, tensor in tensors.items():
        if not _largest(tensor) <= torch.finfo(tensor.dtype).max:
            raise InputError(f"{name} holds NaN or infinity: give finite values", name)


def require_bounded(**tensors: Tensor) -> None:
    """InputError naming the first tensor that is not of floating-point numbers, or holds NaN, infinity or magnitudes
    beyond 1e12."""
    from torch import Tensor

    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise InputError(f"{name} is {kind}: give a tensor of floating-point numbers", name)
        if not _largest(tensor) <= LARGEST:
            raise InputError(f"{name} holds NaN, infinity or magnitudes beyond {LARGEST:g}: give finite values", name)


def is_whole(value: object) -> bool:
    """Tell whether a value is a whole number, of Python or NumPy; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Tell whether a value is one real number, of Python, NumPy or torch; True and False are none."""
    if getattr(value, "ndim", None) == 0:  # an array or a tensor without axes
        value = value.item()  # type: ignore[attr-defined]
    return isinstance(value, Real) and not isinstance(value, bool)


def is_flag(value: object) -> bool:
    """Tell whether a value is True or False, or 1 or 0 in their place."""
    if type(value).__module__ == "numpy" and getattr(value, "shape", None) == ():
        value = value.item()  # type: ignore[attr-defined]
    return isinstance(value, bool) or (is_whole(value) and value in (0, 1))


def describe(value: object) -> str:
    """Describe a value for an error.

    Returns:
        The shape of a tensor or an array, a short text of a plain value, otherwise its type.
    """
    if value is None or isinstance(value, str | bytes | bool | int | float | complex):
        return " ".join(reprlib.repr(value).split())
    if isinstance(value, list | tuple | dict | Set):
        return f"the {type(value).__name__} " + " ".join(reprlib.repr(value).split())
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        if not hasattr(value, "__setitem__"):  # a number of NumPy
            return " ".join(reprlib.repr(value).split())
        noun = "a tensor" if type(value).__module__.partition(".")[0] == "torch" else "an array"
        return f"{noun} of {value.dtype} and shape {tuple(value.shape)}"
    return f"of type {type(value).__name__}"


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
    low, high = values.aminmax()  # both are NaN where anything is
    return max(-low.item(), high.item())
