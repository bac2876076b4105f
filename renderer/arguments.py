"""Arguments held against their annotations at the library's doors, so that a wrong one is named there."""

import re
import reprlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import cache, wraps
from inspect import Parameter, formatannotation, get_annotations, signature
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, ParamSpec, TypeVar, Union, get_args, get_origin

import numpy as np
import torch
from torch import Tensor

from renderer.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")
NUMBERS: dict[object, type] = {int: Integral, float: Real}  # NumPy's are numbers, too


class _OfKind:
    """Stands for one of jaxtyping's names, which only type checkers import: a tensor of these dtypes, of any shape."""

    def __init__(self, accepts: Callable[[torch.dtype], bool]):
        self.accepts = accepts

    def __getitem__(self, kind_and_shape: tuple[type, str]) -> object:
        return Annotated[kind_and_shape[0], self.accepts]


SHAPED = {
    "Float": _OfKind(lambda dtype: dtype.is_floating_point),
    "Int": _OfKind(lambda dtype: not (dtype.is_floating_point or dtype.is_complex)),
}


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which raises InputError for the first argument that is not of its annotated type.

    What sequences hold is looked at, shapes of tensors are not.
    """
    parameters = signature(function).parameters

    @wraps(function)
    def call(*arguments: P.args, **keywords: P.kwargs) -> R:
        positional = zip(parameters, arguments)  # noqa: B905 - too many or too few are Python's to refuse
        for name, value in (*positional, *keywords.items()):
            if name in parameters and parameters[name].kind is not Parameter.VAR_KEYWORD:
                _require(name, value, parameters[name].annotation, function.__module__)
        return function(*arguments, **keywords)

    return call


def require_fields(instance: Any) -> None:
    """The same of the fields of a dataclass."""
    homes = {name: home.__module__ for home in reversed(type(instance).__mro__) for name in get_annotations(home)}
    for field in fields(instance):
        _require(field.name, getattr(instance, field.name), field.type, homes[field.name])


def as_device(device: torch.device | str) -> torch.device:
    """InputError where it is none, or none that is here."""
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        raise InputError(f"device={device} is not available here: use cpu, or cuda where there is a GPU") from error


def _require(name: str, value: object, annotation: Any, module: str) -> None:
    hint = _evaluated(annotation, module) if isinstance(annotation, str) else annotation
    if hint is not Parameter.empty and not _fits(value, hint):
        raise InputError(f"{name} is {_described(value)}: give {_words(annotation)}")


@cache
def _evaluated(annotation: str, module: str) -> object:
    try:
        return eval(annotation, {**SHAPED, **vars(sys.modules[module])})
    except NameError:  # a name that only type checkers import
        return Any


def _fits(value: object, hint: Any) -> bool:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, each) for each in inner)
    if origin is Annotated:
        return isinstance(value, Tensor) and hint.__metadata__[0](value.dtype)
    if origin is tuple and inner[-1] is not Ellipsis:
        return isinstance(value, tuple) and len(value) == len(inner) and all(map(_fits, value, inner))
    if origin in (Sequence, list, tuple):
        return isinstance(value, origin) and not isinstance(value, str) and all(_fits(each, inner[0]) for each in value)
    if hint in NUMBERS:
        within = not isinstance(value, Integral) or abs(int(value)) < 2**63  # what tensors hold
        return isinstance(value, NUMBERS[hint]) and not isinstance(value, bool) and within
    kind = origin or (NoneType if hint is None else hint)
    if hint is Any or not isinstance(kind, type):
        return True
    if isinstance(value, str | Path) and "\0" in str(value):  # of which no system makes a name
        return False
    return isinstance(value, kind) and (origin is not None or not isinstance(value, type))  # its class is no criterion


def _described(value: object) -> str:
    if isinstance(value, Tensor | np.ndarray):
        return f"{type(value).__name__} of {value.dtype} {tuple(value.shape)}"
    told = reprlib.repr(value)
    return told if told.isprintable() else type(value).__name__


def _words(annotation: Any) -> str:
    told = annotation if isinstance(annotation, str) else formatannotation(annotation)
    return re.sub(r"\b(?:\w+\.)+(?=\w)", "", told)  # without the modules
