"""Conversion of arguments of public functions, and checks of their types.

Errors are one sentence that begins with the name of the argument and says what
was given and what is expected. `renderer.errors` checks ranges of numbers and
choices of names.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence, Set
from numbers import Integral
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch
from torch import Tensor

from renderer.errors import InputError, describe, is_flag, is_number

# Values of `dtype.kind` for arrays of real numbers: "f" is
# floating-point, "i" is a signed integer, and "u" is an unsigned integer.
_NUMBERS = "fiu"
# Number of bytes of a float64 number. NumPy also has
# larger floating-point numbers, which torch cannot read.
_FLOAT64_BYTES = 8


def as_tensor(name: str, value: object) -> Tensor:
    """Convert an argument to a tensor of floating-point numbers.

    A floating-point tensor is returned unchanged. A floating-point NumPy array
    keeps its precision. Integers, numbers and lists become float32. Lists of
    tensors are stacked and stay differentiable. Strings, None, complex numbers and lists of
    unequal lengths raise `InputError`.
    """
    if isinstance(value, Tensor):
        if value.is_floating_point():
            return value
        if not value.is_complex() and value.dtype != torch.bool:
            return value.to(torch.get_default_dtype())
    elif _is_list_of_tensors(value):
        rows = [as_tensor(name, item) for item in value]
        first = rows[0]
        if all(row.shape == first.shape for row in rows):
            return torch.stack([row.to(first) for row in rows])
    else:
        array = _as_numbers(value)
        if array is not None:
            keeps_precision = isinstance(value, np.ndarray) and array.dtype.kind == "f"
            dtype = None if keeps_precision else torch.get_default_dtype()
            return torch.as_tensor(array, dtype=dtype)
    raise InputError(
        f"{name} is {describe(value)}: give a tensor, an array or a list of numbers", name
    )


def _is_list_of_tensors(value: object) -> TypeGuard[Sequence[Tensor]]:
    """Tell whether a value is a list or a tuple of one or more tensors, and nothing else."""
    if not isinstance(value, list | tuple) or not value:
        return False
    return all(isinstance(item, Tensor) for item in value)


def as_integers(name: str, value: object) -> Tensor:
    """Convert an argument, such as labels or indices, to an int64 tensor.

    Empty values may have any type.
    """
    if isinstance(value, Tensor):
        is_real = not value.is_complex() and value.dtype != torch.bool
        has_integers = is_real and not value.is_floating_point()
        if has_integers or not value.numel():
            return value.long()
    else:
        array = _as_numbers(value)
        if array is not None and (array.dtype.kind in "iu" or not array.size):
            return torch.as_tensor(array, dtype=torch.int64)
    raise InputError(
        f"{name} is {describe(value)}: give a tensor, an array or a list of whole numbers", name
    )


def _as_numbers(value: object) -> np.ndarray | None:
    """Convert a value to a contiguous array of real numbers that torch can read, or to None."""
    # NumPy calls methods of the value, such as
    # `__array__`. They can raise any exception.
    try:
        array = np.asarray(value)
    except Exception:
        return None
    if array.dtype.kind not in _NUMBERS:
        return None
    if array.dtype.kind == "f" and array.dtype.itemsize > _FLOAT64_BYTES:
        array = array.astype(np.float64)
    native_dtype = array.dtype.newbyteorder("=")
    # `reshape` is needed because ascontiguousarray
    # changes the shape () to (1,).
    return np.ascontiguousarray(array, dtype=native_dtype).reshape(array.shape)


def as_array(name: str, value: object, kinds: str = _NUMBERS) -> np.ndarray:
    """Convert an argument to a NumPy array of real numbers.

    `kinds` are letters of `dtype.kind`: "iu" allows only integers. An array is returned
    unchanged.
    """
    array = _as_numbers(value.detach().cpu() if isinstance(value, Tensor) else value)
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
    for ancestor in (path, *path.absolute().parents):
        if not os.path.lexists(ancestor):
            continue
        # `exists` is False for a symbolic link
        # without a target, which is no file.
        if ancestor.exists() and not ancestor.is_dir():
            raise InputError(
                f"{name}={path} cannot be a folder, because {ancestor} is a file: give the path of "
                "a folder",
                name,
            )
        break
    return path


def as_list(name: str, value: object, kind: Any, expected: str) -> list[Any]:
    """Convert an argument to a list, and check the type of its items.

    Strings, mappings and sets are no lists. `expected` completes the error, such as "a list
    of cameras".
    """
    # The types Tensor and np.ndarray are iterable,
    # but a value of shape () has no items.
    is_scalar = isinstance(value, Tensor | np.ndarray) and not value.ndim
    is_unordered_or_text = isinstance(value, str | bytes | Mapping | Set)
    if is_scalar or is_unordered_or_text or not isinstance(value, Iterable):
        raise InputError(f"{name} is {describe(value)}: give {expected}", name)
    items = list(value)
    for index, item in enumerate(items):
        if not isinstance(item, kind):
            raise InputError(f"{name}[{index}] is {describe(item)}: give {expected}", name)
    return items


def require_kind(name: str, value: object, kind: Any, expected: str) -> None:
    """Check the type of an argument."""
    if not isinstance(value, kind):
        raise InputError(f"{name} is {describe(value)}: give {expected}", name)


def require_whole(name: str, value: object) -> None:
    """Check that an argument is a whole number, which True and 1.0 are not."""
    require_kind(name, value, Integral, "a whole number")
    if isinstance(value, bool):
        raise InputError(f"{name} is {value}: give a whole number", name)


def require_number(name: str, value: object) -> None:
    """Check that an argument is one real number."""
    if not is_number(value):
        raise InputError(f"{name} is {describe(value)}: give a number", name)


def require_flag(name: str, value: object) -> None:
    """Check that an argument is True or False. The numbers 1 and 0 are accepted, too.

    Without this check, a string such as "no" would count as True.
    """
    if not is_flag(value):
        raise InputError(f"{name} is {describe(value)}: give True or False", name)


def require_seed(name: str, value: object) -> None:
    """Check that an argument can be the seed of random numbers."""
    require_whole(name, value)
    if int(value) < 0:  # type: ignore[call-overload]
        raise InputError(f"{name}={value} is negative: give a whole number of at least 0", name)
