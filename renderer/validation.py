"""Conversion and checks of the arguments of public functions.

Errors are one sentence that starts with the argument's name, says what was given and what is expected. Ranges of
numbers and choices of names are checked in `renderer.errors`.
"""

from __future__ import annotations

import os
import reprlib
import types
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor

from renderer.errors import InputError

_NUMBERS = "fiu"  # NumPy's letters for the types of floating-point numbers and of integers
_NOUNS: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "True or False",
    str: "a string",
    list: "a list",
    type(None): "None",
}


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
    raise InputError(f"{name} is {describe(value)}: give a tensor, an array or a list of numbers")


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
    raise InputError(f"{name} is {describe(value)}: give a tensor, an array or a list of whole numbers")


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
        raise InputError(f"{name} is {describe(value)}: give an array or a list of {noun}")
    return value if isinstance(value, np.ndarray) else array


def as_path(name: str, value: object) -> Path:
    """Convert a path, given as a string or as a `Path`.

    Raises:
        InputError: If the value is anything else.
    """
    if isinstance(value, str | os.PathLike) and isinstance(os.fspath(value), str):
        return Path(value)
    raise InputError(f"{name} is {describe(value)}: give a path as a string")


def as_folder(name: str, value: object) -> Path:
    """Convert the path of a folder, which may be missing yet.

    Raises:
        InputError: If the value is no path, or if a file is in its place.
    """
    path = as_path(name, value)
    existing = next((parent for parent in (path, *path.absolute().parents) if os.path.lexists(parent)), path)
    if existing.exists() and not existing.is_dir():
        raise InputError(f"{name}={path}: {existing} is a file, give the path of a folder")
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
        raise InputError(f"{name} is {describe(value)}: give {expected}")
    items = list(value)
    for index, item in enumerate(items):
        if not isinstance(item, kind):
            raise InputError(f"{name}[{index}] is {describe(item)}: give {expected}")
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
        raise InputError(f"{name} is {describe(value)}: give {expected}")


def is_whole(value: object) -> bool:
    """Tell whether a value is a whole number, of Python or NumPy; True and False are none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Tell whether a value is one real number, of Python, NumPy or torch; True and False are none."""
    if isinstance(value, Tensor | np.ndarray):
        real = not value.is_complex() if isinstance(value, Tensor) else value.dtype.kind in _NUMBERS
        return real and value.ndim == 0 and value.dtype not in (torch.bool, np.bool_)
    return isinstance(value, Real) and not isinstance(value, bool)


def is_flag(value: object) -> bool:
    """Tell whether a value is True or False, or 1 or 0 in their place."""
    return isinstance(value, bool | np.bool_) or (is_whole(value) and value in (0, 1))


def require_whole(name: str, value: object) -> None:
    """Check that an argument is a whole number.

    Raises:
        InputError: If it is of another type, such as a float or a bool.
    """
    require_kind(name, value, Integral, "a whole number")
    if isinstance(value, bool):
        raise InputError(f"{name} is {value}: give a whole number")


def require_number(name: str, value: object) -> None:
    """Check that an argument is one real number.

    Raises:
        InputError: If it is of another type, such as a string, a bool or None.
    """
    if not is_number(value):
        raise InputError(f"{name} is {describe(value)}: give a number")


def require_flag(name: str, value: object) -> None:
    """Check that an argument is True or False: a string such as "no" would count as True.

    Raises:
        InputError: If it is anything else.
    """
    if not is_flag(value):
        raise InputError(f"{name} is {describe(value)}: give True or False")


def require_seed(name: str, value: object) -> None:
    """Check that an argument can seed a random stream.

    Raises:
        InputError: If it is not a whole number from 0.
    """
    require_whole(name, value)
    if int(value) < 0:  # type: ignore[call-overload]
        raise InputError(f"{name}={value}: give a whole number from 0")


def require_field_types(settings: Any, *unchecked: str) -> None:
    """Check the fields of a dataclass against their annotations.

    Numbers, names, flags, lists, unions and other dataclasses are checked, whole numbers pass as numbers.

    Args:
        settings: Instance of a dataclass.
        unchecked: Names of fields that take more than their annotation says.

    Raises:
        InputError: If a field holds a value of another type.
    """
    for name, hint in _field_hints(type(settings)).items():  # type: ignore[arg-type]  # types are hashable
        value = getattr(settings, name)
        if name not in unchecked and not _fits(value, hint):
            raise InputError(f"{name} is {describe(value)}: give {_expected(hint)}")


@cache
def _field_hints(kind: type) -> dict[str, Any]:
    """Return the annotations of a dataclass's fields by name."""
    hints = get_type_hints(kind)
    return {name: hints[name] for name in kind.__dataclass_fields__}  # type: ignore[attr-defined]


def _fits(value: object, hint: Any) -> bool:
    """Tell whether a value is of an annotated type."""
    check = _PLAIN.get(hint)
    if check is not None:
        return check(value)
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, option) for option in get_args(hint))
    if origin is list:
        (item_hint,) = get_args(hint)
        has_items = isinstance(value, Tensor | np.ndarray) and value.ndim > 0
        if isinstance(value, str) or not (has_items or isinstance(value, Sequence)):
            return False
        return item_hint is Any or all(_fits(item, item_hint) for item in cast(Iterable[Any], value))
    return isinstance(value, origin or hint)


_PLAIN: dict[Any, Callable[[object], bool]] = {
    Any: lambda value: True,
    int: is_whole,
    float: is_number,
    bool: is_flag,
    str: lambda value: isinstance(value, str),
    type(None): lambda value: value is None,
}


def _expected(hint: Any) -> str:
    """Describe an annotated type for an error."""
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(_expected(option) for option in get_args(hint))
    if get_origin(hint) is list:
        (item_hint,) = get_args(hint)
        plural = {float: " of numbers", int: " of whole numbers", str: " of strings"}
        return "a list" + plural.get(item_hint, "")
    kind = get_origin(hint) or hint
    return _NOUNS.get(kind) or f"{kind.__name__}(...)"


def describe(value: object) -> str:
    """Describe a value for an error: its shape if it has one, a short text if it is plain, its type otherwise."""
    if isinstance(value, Tensor | np.ndarray):
        noun = "a tensor" if isinstance(value, Tensor) else "an array"
        return f"{noun} of {value.dtype} and shape {tuple(value.shape)}"
    if value is None or isinstance(value, str | bytes | bool | int | float | complex | np.generic):
        return " ".join(reprlib.repr(value).split())
    if isinstance(value, list | tuple | dict | Set):
        return f"the {type(value).__name__} " + " ".join(reprlib.repr(value).split())
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"of type {type(value).__name__}"
