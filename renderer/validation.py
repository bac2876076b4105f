"""Conversion and checks of the arguments of public functions.

Errors are one sentence that starts with the argument's name, says what was given and what is expected. Ranges of
numbers and choices of names are checked in `renderer.errors`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Set
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from renderer.errors import InputError, describe, is_flag, is_number

_NUMBERS = "fiu"  # NumPy's letters for the types of floating-point numbers and of integers


def as_tensor(name: str, value: object) -> Tensor:
    """Convert an argument to a tensor of floating-point numbers.

    A tensor of floating-point numbers comes back as it is. NumPy arrays of floating-point numbers keep their
    precision; integers, numbers and lists become float32. Lists of tensors are stacked and stay differentiable.

    Args:
        name: Name of the argument, for the error.
        value: Tensor, NumPy array, number, or nested lists of numbers.

    Returns:
        Tensor of the value's shape.

    Raises:
        InputError: If the value is anything else, such as complex numbers, strings, None or lists of unequal lengths.

    >>> as_tensor("light", [[1, 2, 3]])
    tensor([[1., 2., 3.]])
    >>> as_tensor("light", "grace")
    Traceback (most recent call last):
    renderer.errors.InputError: light is 'grace': give a tensor, an array or a list of numbers
    """
    if isinstance(value, Tensor):
        if value.is_floating_point():
            return value
        if not value.is_complex() and value.dtype != torch.bool:
            return value.to(torch.get_default_dtype())
    elif isinstance(value, list | tuple) and value and all(isinstance(item, Tensor) for item in value):
        rows = [as_tensor(name, item) for item in value]
        if len({row.shape for row in rows}) == 1:
            return torch.stack([row.to(rows[0]) for row in rows])
    else:
        array = _as_numbers(value)
        if array is not None:
            keeps_precision = isinstance(value, np.ndarray) and array.dtype.kind == "f"
            dtype = None if keeps_precision else torch.get_default_dtype()
            return torch.as_tensor(array, dtype=dtype)
    raise InputError(f"{name} is {describe(value)}: give a tensor, an array or a list of numbers", name)


def as_integers(name: str, value: object) -> Tensor:
    """Convert an argument, such as labels or indices, to a tensor int64.

    Args:
        name: Name of the argument, for the error.
        value: Tensor or NumPy array of integers, a whole number, or nested lists of them.

    Raises:
        InputError: If the value is anything else.
    """
    if isinstance(value, Tensor):
        integers = not (value.is_floating_point() or value.is_complex() or value.dtype == torch.bool)
        if integers or not value.numel():
            return value.long()
    else:
        array = _as_numbers(value)
        if array is not None and (array.dtype.kind in "iu" or not array.size):
            return torch.as_tensor(array, dtype=torch.int64)
    raise InputError(f"{name} is {describe(value)}: give a tensor, an array or a list of whole numbers", name)


def _as_numbers(value: object) -> np.ndarray | None:
    """Convert a value to an array of real numbers that torch can take; None if it has others, or unequal rows."""
    try:
        array = np.asarray(value)
    except Exception:  # NumPy calls methods of the value, which may raise anything
        return None
    if array.dtype.kind not in _NUMBERS:
        return None
    if array.dtype.kind == "f" and array.dtype.itemsize > 8:  # torch has no long double
        array = array.astype(np.float64)
    return np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("=")).reshape(array.shape)


def as_array(name: str, value: object, kinds: str = _NUMBERS) -> np.ndarray:
    """Convert an argument to a NumPy array of numbers, without a copy of an array that is one.

    Args:
        name: Name of the argument, for the error.
        value: NumPy array, tensor, number, or nested lists of numbers.
        kinds: NumPy's letters for the permitted types.

    Raises:
        InputError: If the value is anything else.
    """
    array = _as_numbers(value.detach().cpu() if isinstance(value, Tensor) else value)
    if array is None or (array.dtype.kind not in kinds and array.size):
        noun = "numbers" if "f" in kinds else "whole numbers"
        raise InputError(f"{name} is {describe(value)}: give an array or a list of {noun}", name)
    return value if isinstance(value, np.ndarray) else array


def as_path(name: str, value: object) -> Path:
    """Convert a path, given as a string or as a `Path`.

    Raises:
        InputError: If the value is anything else.
    """
    if isinstance(value, str | os.PathLike) and isinstance(os.fspath(value), str):
        return Path(value)
    raise InputError(f"{name} is {describe(value)}: give a path as a string", name)


def as_folder(name: str, value: object) -> Path:
    """Convert the path of a folder, which may be missing yet.

    Raises:
        InputError: If the value is no path, or if a file is in its place.
    """
    path = as_path(name, value)
    existing = next((parent for parent in (path, *path.absolute().parents) if os.path.lexists(parent)), path)
    if existing.exists() and not existing.is_dir():
        raise InputError(f"{name}={path}: {existing} is a file, give the path of a folder", name)
    return path


def as_list(name: str, value: object, kind: Any, expected: str) -> list[Any]:
    """Convert an argument to a list whose items are all of one kind.

    Args:
        name: Name of the argument, for the error.
        value: List, tuple or another ordered iterable, but no string, mapping or set.
        kind: Type of the items, or a tuple of types.
        expected: What to give, for the error.

    Raises:
        InputError: If the value is no list, or an item is of another type.
    """
    without_items = isinstance(value, Tensor | np.ndarray) and not value.ndim
    if without_items or isinstance(value, str | bytes | Mapping | Set) or not isinstance(value, Iterable):
        raise InputError(f"{name} is {describe(value)}: give {expected}", name)
    items = list(value)
    for index, item in enumerate(items):
        if not isinstance(item, kind):
            raise InputError(f"{name}[{index}] is {describe(item)}: give {expected}", name)
    return items


def require_kind(name: str, value: object, kind: Any, expected: str) -> None:
    """Check the type of an argument.

    Args:
        name: Name of the argument, for the error.
        value: The argument.
        kind: Its type, or a tuple of types.
        expected: What to give, for the error.

    Raises:
        InputError: If the value is of another type.
    """
    if not isinstance(value, kind):
        raise InputError(f"{name} is {describe(value)}: give {expected}", name)


def require_whole(name: str, value: object) -> None:
    """Check that an argument is a whole number.

    Raises:
        InputError: If it is of another type, such as a float or a bool.
    """
    require_kind(name, value, Integral, "a whole number")
    if isinstance(value, bool):
        raise InputError(f"{name} is {value}: give a whole number", name)


def require_number(name: str, value: object) -> None:
    """Check that an argument is one real number.

    Raises:
        InputError: If it is of another type, such as a string, a bool or None.
    """
    if not is_number(value):
        raise InputError(f"{name} is {describe(value)}: give a number", name)


def require_flag(name: str, value: object) -> None:
    """Check that an argument is True or False: a string such as "no" would count as True.

    Raises:
        InputError: If it is anything else.
    """
    if not is_flag(value):
        raise InputError(f"{name} is {describe(value)}: give True or False", name)


def require_seed(name: str, value: object) -> None:
    """Check that an argument can seed a random stream.

    Raises:
        InputError: If it is not a whole number from 0.
    """
    require_whole(name, value)
    if int(value) < 0:  # type: ignore[call-overload]
        raise InputError(f"{name}={value}: give a whole number from 0", name)
