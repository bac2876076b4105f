"""Error class for mistakes that a user can fix, and checks of arguments and memory.

Errors are one sentence that begins with the name of the argument, and says what
was given and what is expected. Commands check their settings with this module
before they import torch and NumPy. Functions that need them therefore import
them themselves.
"""

from __future__ import annotations

import importlib
import os
import re
import reprlib
import textwrap
import unicodedata
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    import numpy as np
    import torch
    from torch import Tensor

# Largest magnitude of numbers in arguments. The product of three such numbers
# does not overflow in float32. An overflow would give infinity, and then NaN.
MAX_MAGNITUDE = 1e12
# Largest factor for lights, albedo and lengths in settings.
# Products of two such factors stay below MAX_MAGNITUDE.
MAX_SCALE = 1e5
# Largest seed of random numbers, which is also the largest of other whole numbers.
MAX_SEED = 2**63 - 1
# Largest number of characters of a reason that `explained` quotes.
LONGEST_REASON = 300
# Values of `dtype.kind` for arrays of real numbers: "f" is floating-point, "i" is a signed
# integer, and "u" is an unsigned integer.
_NUMBERS = "fiu"
# Texts in the errors of torch, CUDA, cuDNN
# and cuBLAS that say that memory ran out.
OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "ALLOC", "unable to find an engine")


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


@contextmanager
def keyed(group: str = "", /, **keys: str) -> Iterator[None]:
    """Replace the names of Python arguments in error messages by keys of settings.

    A message of the library begins with the name of a Python argument, such as
    "name". The user of a command knows only the setting from which the command
    took the argument, such as "network". The key of "lighting" also holds for
    "lighting.radius" and "lighting[0]", and `group` is put before all other arguments.
    """
    try:
        yield
    except InputError as error:
        argument = error.argument
        if argument not in keys:
            # "light.turbidity" and "light[0]" are parts of the argument "light".
            argument = re.split(r"[.[]", argument)[0]
        message = str(error)
        if argument in keys:
            key = keys[argument]
            named = key + error.argument.removeprefix(argument)
            raise InputError(key + message.removeprefix(argument), named) from error
        if group and not message.startswith(group):
            raise InputError(f"{group}: {message}", group) from error
        raise


@contextmanager
def explained(
    fault: str, advice: str = "", argument: str = "", *kinds: type[BaseException]
) -> Iterator[None]:
    """Turn an error in a `with` block into an InputError: fault, reason in brackets, and advice.

    Without `kinds`, any Exception but an InputError is turned, since libraries raise errors of
    almost any type for a damaged file.
    """
    turned = kinds or (Exception,)
    try:
        yield
    except turned as error:
        if isinstance(error, InputError) and not kinds:
            raise
        reason = textwrap.shorten(single_line(error), LONGEST_REASON)
        text = f"{fault} ({reason})" + (f": {advice}" if advice else "")
        raise InputError(text, argument) from error


def keys_of(key: str, settings: object) -> dict[str, str]:
    """List the dotted key of each field of a group of settings, as `keyed` takes them."""
    return {name: f"{key}.{name}" for name in vars(settings)}


def single_line(error: BaseException) -> str:
    """Return the message of an error in one line, or the name of its class if it has none."""
    message = " ".join(str(error).split()) or type(error).__name__
    # The message of a missing key is only this key.
    return f"the entry {message} is missing or unknown" if isinstance(error, KeyError) else message


@contextmanager
def reading(path: str | Path, fault: str, advice: str = "", argument: str = "") -> Iterator[None]:
    """Name a file in the errors that its content raises, and in InputErrors, too."""
    try:
        with explained(f"{path} {fault}", advice, argument):
            yield
    except InputError as error:
        # The message may begin with the file, or with another one of its folder.
        if str(error).startswith((str(path), f"{Path(path).parent}{os.sep}")):
            raise
        raise InputError(f"{path}: {error}", argument) from error


def import_package(name: str, install: str) -> Any:
    """Import a package that the project needs only for some tasks."""
    with explained(f"{name} cannot be imported", f"pip install {install}", "", ImportError):
        return importlib.import_module(name)


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

    # torch raises AssertionError for "cuda" if it was built without CUDA.
    fault = f"device={_short_text(device)} is not available here"
    with explained(fault, "use cpu, or cuda on a machine with a GPU", "device"):
        return torch.empty(0, device=device).device


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
    """Check that a value is None or a number in a range, which NaN never is."""
    if value is not None:
        require_number(name, value, least, most)


def require_number(name: str, value: Any, least: float, most: float) -> None:
    """Check that a value is a number in a range. Unlike `require_range`, it refuses None."""
    if not is_number(value):
        raise InputError(f"{name} is {describe(value)}: give a number", name)
    if not least <= value <= most:
        raise InputError(f"{name}={value} must be at least {least:g} and at most {most:g}", name)


def require_whole(name: str, value: object, least: float = 0, most: float = MAX_SEED) -> None:
    """Check that a value is a whole number, which True and 1.0 are not, in a range."""
    if not is_whole(value):
        raise InputError(f"{name} is {describe(value)}: give a whole number", name)
    require_number(name, value, least, most)


def require_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Check that a value is one of several names."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name}={_short_text(value)}: choose one of {', '.join(choices)}", name)


def require_finite(**tensors: Tensor) -> None:
    """Check that tensors have no NaN and no infinite values."""
    import torch

    for name, tensor in tensors.items():
        fault = f"{name} holds NaN or infinity: give finite values"
        _require_magnitude(name, tensor, torch.finfo(tensor.dtype).max, fault)


def require_bounded(**tensors: Tensor) -> None:
    """Check that tensors hold numbers with magnitudes of at most MAX_MAGNITUDE."""
    for name, tensor in tensors.items():
        fault = f"{name} holds NaN, infinity or values beyond {MAX_MAGNITUDE:g}"
        _require_magnitude(name, tensor, MAX_MAGNITUDE, fault)


def as_tensor(name: str, value: object) -> Tensor:
    """Convert an argument to a tensor of floating-point numbers.

    A floating-point tensor is returned unchanged. A floating-point NumPy array
    keeps its precision. Integers, numbers and lists become float32. Lists of
    tensors are stacked and stay differentiable. Strings, None, complex numbers and lists of
    unequal lengths raise `InputError`.
    """
    import numpy as np
    import torch

    is_sequence = isinstance(value, list | tuple) and bool(value)
    if isinstance(value, torch.Tensor):
        if value.is_floating_point():
            return value
        if not value.is_complex() and value.dtype != torch.bool:
            return value.to(torch.get_default_dtype())
    elif is_sequence and all(isinstance(item, torch.Tensor) for item in cast(Any, value)):
        # Tensors are stacked in the dtype and on the device of the first.
        rows = [as_tensor(name, item) for item in cast(Any, value)]
        if all(row.shape == rows[0].shape for row in rows):
            return torch.stack([row.to(rows[0]) for row in rows])
    else:
        array = _as_numbers(value)
        if array is not None:
            keeps_precision = isinstance(value, np.ndarray) and array.dtype.kind == "f"
            dtype = None if keeps_precision else torch.get_default_dtype()
            return torch.as_tensor(array, dtype=dtype)
    raise InputError(f"{name} is {describe(value)}: give a tensor, array or list of numbers", name)


def as_integers(name: str, value: object) -> Tensor:
    """Convert an argument, such as labels or indices, to an int64 tensor.

    Empty values may have any type.
    """
    import torch

    if isinstance(value, torch.Tensor) and value.dtype in (torch.int64, torch.int32, torch.uint8):
        return value.long()
    return torch.as_tensor(_as_numbers(as_array(name, value, "iu")), dtype=torch.int64)


def _as_numbers(value: object) -> np.ndarray | None:
    """Convert a value to a contiguous array of real numbers that torch can read, or to None."""
    import numpy as np

    # NumPy calls methods of the value, such as `__array__`. They can raise any exception.
    try:
        array = np.asarray(value)
    except Exception:
        return None
    if array.dtype.kind not in _NUMBERS:
        return None
    # NumPy also has larger numbers than those of 8 bytes, which torch cannot read.
    if array.dtype.kind == "f" and array.dtype.itemsize > 8:
        array = array.astype(np.float64)
    # `reshape` is needed because ascontiguousarray
    # changes the shape () to (1,).
    return np.ascontiguousarray(array, array.dtype.newbyteorder("=")).reshape(array.shape)


def as_array(name: str, value: object, kinds: str = _NUMBERS) -> np.ndarray:
    """Convert an argument to a NumPy array of real numbers.

    `kinds` are letters of `dtype.kind`: "iu" allows only integers. An array is returned
    unchanged.
    """
    import numpy as np
    import torch

    array = _as_numbers(value.detach().cpu() if isinstance(value, torch.Tensor) else value)
    if array is None or (array.dtype.kind not in kinds and array.size):
        noun = "numbers" if "f" in kinds else "whole numbers"
        raise InputError(f"{name} is {describe(value)}: give an array or a list of {noun}", name)
    return value if isinstance(value, np.ndarray) else array


def as_path(name: str, value: object) -> Path:
    """Convert an argument to a `Path`."""
    if isinstance(value, str | os.PathLike) and isinstance(os.fspath(value), str):
        return Path(value)
    raise InputError(f"{name} is {describe(value)}: give a path as a string", name)


def as_folder(name: str, value: object) -> Path:
    """Convert an argument to the path of a folder that exists or can be created."""
    path = as_path(name, value)
    ancestors = (path, *path.absolute().parents)
    nearest = next(ancestor for ancestor in ancestors if os.path.lexists(ancestor))
    # `exists` is False for a symbolic link
    # without a target, which is no file.
    if nearest.exists() and not nearest.is_dir():
        raise InputError(f"{name}={path} cannot be a folder, because {nearest} is a file", name)
    return path


def as_list(name: str, value: object, kind: Any, expected: str) -> list[Any]:
    """Convert an argument to a list, and check the type of its items.

    Strings, mappings and sets are no lists. `expected` completes the error, such as "a list
    of cameras".
    """
    # Tensors and arrays are iterable, but a value of shape () has no items.
    is_scalar = getattr(value, "ndim", None) == 0
    is_unordered_or_text = isinstance(value, str | bytes | Mapping | Set)
    if is_scalar or is_unordered_or_text or not isinstance(value, Iterable):
        raise InputError(f"{name} is {describe(value)}: give {expected}", name)
    items = list(value)
    for index, item in enumerate(items):
        require_kind(f"{name}[{index}]", item, kind, expected)
    return items


def require_kind(name: str, value: object, kind: Any, expected: str) -> None:
    """Check the type of an argument."""
    if not isinstance(value, kind):
        raise InputError(f"{name} is {describe(value)}: give {expected}", name)


def require_shape(name: str, values: Any, *expected: int | str) -> None:
    """Check the shape of a tensor.

    A name stands for a dimension of any size, and a first "..." for any number of dimensions.
    """
    shape = tuple(values.shape)
    # With "...", only the last dimensions are compared.
    sizes = (*shape[: 1 - len(expected)], *expected[1:]) if expected[0] == "..." else expected
    if len(shape) != len(sizes) or any(
        isinstance(size, int) and size != given for size, given in zip(sizes, shape, strict=True)
    ):
        wanted = str(expected).replace("'", "")
        raise InputError(f"{name} has shape {shape}: give {wanted}", name)


def require_flag(name: str, value: object) -> None:
    """Check that an argument is True or False. The numbers 1 and 0 are accepted, too.

    Without this check, a string such as "no" would count as True.
    """
    if not is_flag(value):
        raise InputError(f"{name} is {describe(value)}: give True or False", name)


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
    # NumPy calls its class of flags `bool`, too.
    return type(value).__name__ == "bool" or (is_whole(value) and value in (0, 1))


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
    noun = "a tensor" if type(value).__module__.partition(".")[0] == "torch" else "an array"
    return f"{noun} of {value.dtype} and shape {tuple(value.shape)}"


def _short_text(value: object) -> str:
    """Convert a value to one line of text. Strings get no quotes, and long values are shortened."""
    return " ".join(value.split()) if isinstance(value, str) else _short_repr(value)


def _short_repr(value: object) -> str:
    """Convert a value to its `repr` in one line, shortened if it is long."""
    return " ".join(reprlib.repr(value).split())


class ShortRepr:
    """Base of a dataclass with `repr=False`, whose `repr` has the sizes of large fields."""

    def __repr__(self) -> str:
        kind = cast(Any, type(self))
        values = [f"{item.name}={_SIZES.repr(getattr(self, item.name))}" for item in fields(kind)]
        return f"{kind.__name__}({', '.join(values)})"


class _Sizes(reprlib.Repr):
    """Short `repr` in one line, in which arrays and dataclasses are shown without their values."""

    def repr_ndarray(self, value: Any, level: int) -> str:
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"

    repr_Tensor = repr_ndarray

    def repr_instance(self, value: Any, level: int) -> str:
        if is_dataclass(value):
            return f"{type(value).__name__}(...)"
        return " ".join(super().repr_instance(value, level).split())


_SIZES = _Sizes()
_SIZES.maxother = 60


def _require_magnitude(name: str, tensor: Tensor, limit: float, fault: str) -> None:
    """Check that no magnitude of the values of a tensor is above a limit, or NaN."""
    if not tensor.numel():
        return
    values = tensor.detach()
    # aminmax copies a tensor that is not contiguous. If a matrix is not
    # contiguous, its transpose usually is, and aminmax does not copy it.
    if values.ndim == 2 and not values.is_contiguous():
        values = values.T
    lowest, highest = values.aminmax()
    # A comparison with NaN is False, and the extremes of values with NaN are NaN.
    require((lowest >= -limit) & (highest <= limit), lambda: InputError(fault, name))


# A truth value on a device, and the error or the warning if it is false.
Check = tuple["Tensor", Callable[[], InputError | UserWarning]]
# Checks that are decided later. None decides each at once.
_LATE: ContextVar[list[Check] | None] = ContextVar("late checks", default=None)


def require(holds: Tensor, error: Callable[[], InputError | UserWarning]) -> None:
    """Check a truth value that was computed on a device, now or at the end of `late_checks`."""
    late = _LATE.get()
    if late is not None:
        late.append((holds, error))
    elif not holds:
        report(error())


def report(fault: InputError | UserWarning) -> None:
    """Raise an error, or issue a warning."""
    if isinstance(fault, InputError):
        raise fault
    warnings.warn(fault, stacklevel=3)


@contextmanager
def late_checks(checks: list[Check] | None) -> Iterator[None]:
    """Append the checks of `require` to a list, which `raise_first` decides: a CPU waits once."""
    token = _LATE.set(checks)
    try:
        yield
    finally:
        _LATE.reset(token)


@contextmanager
def joint_checks() -> Iterator[None]:
    """Decide the checks of `require` together at the end, unless `late_checks` collects them."""
    checks: list[Check] = []
    late = _LATE.get()
    with late_checks(checks if late is None else late):
        yield
    raise_first(checks)


def raise_first(checks: list[Check]) -> None:
    """Raise the error of the first check that failed, issue warnings, and empty the list."""
    import torch

    # Some truth values may be on the CPU, others on a GPU.
    held = [holds.to(checks[0][0].device, non_blocking=True) for holds, _ in checks]
    is_held = torch.stack(held).tolist() if held else []
    failed = [error for (_, error), holds in zip(checks, is_held, strict=True) if not holds]
    checks.clear()
    for error in failed:
        report(error())


MEMORY = Path("/proc/meminfo")  # Linux writes the free memory of the machine here.
GROUP = Path("/sys/fs/cgroup")  # Linux writes the memory limit of a container here (cgroup v2).
GIB = 2**30


def require_memory(name: str, needed: int, device: torch.device) -> None:
    """Check that enough memory is free, because Linux would otherwise kill the process.

    `name` is a plural such as "40 renders", and `needed` is in bytes.
    """
    free = free_memory(device)
    if free is not None and needed > free:
        fault = f"{name} need {needed / GIB:.1f} GB of memory, and {free / GIB:.1f} GB are free"
        raise InputError(f"{fault}: reduce them")


def free_memory(device: torch.device) -> int | None:
    """Return the free bytes of a GPU, the machine or the container, or None if unknown."""
    if device.type == "cuda":
        import torch

        # torch reserves memory that it does not use yet. This memory is free for torch.
        reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + reserved
    try:
        lines = dict(line.split(":") for line in MEMORY.read_text().splitlines())
        free = 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
    # Outside of a container, the files do not exist. A container without a limit has the text
    # "max" in the first file, which is not a number.
    with suppress(OSError, ValueError):
        limit, used = (int((GROUP / f"memory.{name}").read_text()) for name in ("max", "current"))
        free = min(free, limit - used)
    return free
