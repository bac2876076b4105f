"""Error class for mistakes that a user can fix, and checks of numbers, names, files and tensors.

`renderer.validation` converts arguments and checks their types.

Commands check their settings with this module before they import torch and
NumPy. Functions that need torch therefore import it themselves.
"""

from __future__ import annotations

import os
import reprlib
import unicodedata
from collections.abc import Collection, Set
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch
    from torch import Tensor

# Largest magnitude of numbers in arguments. The product of three such numbers
# does not overflow in float32. An overflow would give infinity, and then NaN.
MAX_MAGNITUDE = 1e12
# Largest factor for lights, albedo and lengths in settings.
# Products of two such factors stay below MAX_MAGNITUDE.
MAX_SCALE = 1e5
# Texts in the errors of torch, CUDA, cuDNN
# and cuBLAS that say that memory ran out.
OUT_OF_MEMORY = (
    "out of memory",
    "can't allocate memory",
    "ALLOC",
    "unable to find an engine",
)


class InputError(ValueError):
    """Error that a user can fix by other arguments, settings or files.

    The message is one sentence. It names the argument or file, says what is
    wrong, and says what to do. Commands print it without a traceback and exit
    with status 2.

    Args:
        message: The sentence.
        argument: Name of the Python argument with which the sentence begins.
            Commands extend it to the key of a setting, such as "scene.views".
            Empty if the sentence begins with something else.

    Attributes:
        argument: Name of the Python argument with which the sentence begins, or an
            empty string.

    >>> import norm_balls as nb
    >>> nb.ImageSettings(size=32, samples=0)
    Traceback (most recent call last):
    renderer.errors.InputError: samples=0 must be at least 1 and at most 64
    """

    def __init__(self, message: str, argument: str = "") -> None:
        super().__init__(message)
        self.argument = argument

    def within(self, key: str, names: Collection[str]) -> InputError:
        """Return a copy of the error whose sentence begins with the key of some settings.

        Args:
            key: Key of the settings, such as "scene". If it is empty, the error
                itself is returned.
            names: Names of the fields of the settings. If the argument of the error
                is one of them, the key is put before the argument, with a period.
                Otherwise it is put before the sentence, with a colon.

        Returns:
            Error whose sentence begins with the key.

        >>> import norm_balls as nb
        >>> error = nb.InputError("views=0 must be at least 1", "views")
        >>> error.within("scene", ["views", "light"])
        InputError('scene.views=0 must be at least 1')
        """
        if not key:
            return self
        # An argument such as "light.turbidity" or
        # "light[0]" belongs to the field "light".
        field = self.argument.partition(".")[0].partition("[")[0]
        if field and field in names:
            return InputError(f"{key}.{self}", f"{key}.{self.argument}")
        return InputError(f"{key}: {self}", key)


def single_line(error: Exception) -> str:
    """Return the message of an error in one line, or the name of its class if it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def composed(name: str) -> str:
    """Return a name in Unicode's form NFC, so that equal names compare equal.

    macOS writes the names of files in the form NFD, in which an accent is a
    character of its own.
    """
    return unicodedata.normalize("NFC", name)


def is_out_of_memory(error: Exception) -> bool:
    """Return whether an error reports that the memory of a GPU or of the CPU ran out."""
    import torch

    has_known_message = any(words in str(error) for words in OUT_OF_MEMORY)
    return has_known_message or isinstance(error, torch.OutOfMemoryError | MemoryError)


def as_device(device: torch.device | str) -> torch.device:
    """Convert a device name to a device of this machine."""
    import torch

    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError) as error:
        # torch raises AssertionError for "cuda" if it was built without CUDA.
        raise InputError(
            f"device={_short_text(device)} is not available here: "
            "use cpu, or cuda on a machine with a GPU",
            "device",
        ) from error


def require_file(path: str | Path, advice: str) -> None:
    """Check that a path is a regular file.

    A named pipe is not accepted, because reading it might never end.
    """
    # isfile returns False for an invalid name,
    # and in a folder without permission.
    if os.path.isfile(path):
        return
    problem = "is not a regular file" if os.path.exists(path) else "does not exist"
    raise InputError(f"{path} {problem}: {advice}")


def require_range(name: str, value: float | None, least: float, most: float) -> None:
    """Check that a number, if it is not None, lies in a range, which NaN never does."""
    if value is None:
        return
    try:
        is_inside = bool(least <= value <= most)
    except (TypeError, ValueError, RuntimeError) as error:
        # The comparison fails for a string, a complex
        # number or an array of several numbers.
        raise InputError(f"{name}={_short_text(value)} must be a number", name) from error
    if not is_inside:
        raise InputError(f"{name}={value} must be at least {least:g} and at most {most:g}", name)


def require_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Check that a value is one of several names."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name}={_short_text(value)}: choose one of {', '.join(choices)}", name)


def require_finite(**tensors: Tensor) -> None:
    """Check that tensors have no NaN and no infinite values."""
    import torch

    for name, tensor in tensors.items():
        # A comparison with NaN is False, so `not` also finds NaN.
        if not _largest_magnitude(tensor) <= torch.finfo(tensor.dtype).max:
            raise InputError(f"{name} holds NaN or infinity: give finite values", name)


def require_bounded(**tensors: Tensor) -> None:
    """Check that tensors hold floating-point numbers with magnitudes of at most MAX_MAGNITUDE.

    Other types raise `InputError`, too.
    """
    from torch import Tensor

    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise InputError(f"{name} is {kind}: give a tensor of floating-point numbers", name)
        # A comparison with NaN is False, so `not` also finds NaN.
        if not _largest_magnitude(tensor) <= MAX_MAGNITUDE:
            raise InputError(
                f"{name} holds NaN, infinity or magnitudes beyond {MAX_MAGNITUDE:g}: "
                "give finite values",
                name,
            )


def is_whole(value: object) -> bool:
    """Return whether a value is a whole number of Python or NumPy, but not True or False."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Return whether a value is one real number of Python, NumPy or torch, and not a flag."""
    if getattr(value, "ndim", None) == 0:
        # The value is a tensor or an array of shape (), or a number of NumPy.
        value = value.item()  # type: ignore[attr-defined]
    return isinstance(value, Real) and not isinstance(value, bool)


def is_flag(value: object) -> bool:
    """Tell whether a value is True, False, 1 or 0."""
    if type(value).__module__ == "numpy" and getattr(value, "shape", None) == ():
        value = value.item()  # type: ignore[attr-defined]
    return isinstance(value, bool) or (is_whole(value) and value in (0, 1))


def describe(value: Any) -> str:
    """Describe a value for an error message."""
    if value is None or isinstance(value, str | bytes | bool | int | float | complex):
        return _short_repr(value)
    if isinstance(value, list | tuple | dict | Set):
        return f"the {type(value).__name__} {_short_repr(value)}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if not hasattr(value, "dtype") or not hasattr(value, "shape"):
        return f"of type {type(value).__name__}"
    # Unlike an array, a number of NumPy has no method `__setitem__`.
    if not hasattr(value, "__setitem__"):
        return _short_repr(value)
    is_tensor = type(value).__module__.partition(".")[0] == "torch"
    noun = "a tensor" if is_tensor else "an array"
    return f"{noun} of {value.dtype} and shape {tuple(value.shape)}"


def _short_text(value: object) -> str:
    """Convert a value to one line of text. Strings get no quotes, and long values are shortened."""
    return " ".join(value.split()) if isinstance(value, str) else _short_repr(value)


def _short_repr(value: object) -> str:
    """Convert a value to its `repr` in one line, shortened if it is long."""
    return " ".join(reprlib.repr(value).split())


def _largest_magnitude(tensor: Tensor) -> float:
    """Compute the largest magnitude of the values of a tensor. It is NaN if a value is NaN."""
    if not tensor.numel():
        return 0.0
    values = tensor.detach()
    # aminmax copies a tensor that is not contiguous. If a matrix is not
    # contiguous, its transpose usually is, and aminmax does not copy it.
    if values.ndim == 2 and not values.is_contiguous():
        values = values.T
    lowest, highest = values.aminmax()
    return max(-lowest.item(), highest.item())
