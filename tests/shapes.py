"""Each annotation of an array's shape is checked when a test calls its function.

The check follows the call, so that a function which refuses a wrong shape is not disturbed.
"""

import functools
import inspect
import itertools
import sys
import types
from collections.abc import Callable
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any, Union, get_args, get_origin

from jaxtyping import AbstractArray, jaxtyped
from torch import Tensor

PACKAGES = ("renderer", "augment", "train")
# Calls of a function that each test process checks. Loops call it thousands of times alike.
CHECKED_CALLS = 20


def install() -> None:
    """Check the functions of modules that are imported from now on."""
    sys.meta_path.insert(0, _Finder())


class _Finder(MetaPathFinder):
    """Wraps the functions of each module of the packages after its import."""

    def find_spec(self, name, path=None, target=None) -> ModuleSpec | None:
        if name.partition(".")[0] not in PACKAGES:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is None or spec.loader is None or not (spec.origin or "").endswith(".py"):
            return spec
        execute = spec.loader.exec_module

        def exec_module(module: types.ModuleType) -> None:
            execute(module)
            _wrap_members(module, module.__name__)

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _wrap_members(owner: Any, module: str) -> None:
    for name, value in list(vars(owner).items()):
        if isinstance(value, (staticmethod, classmethod)):
            setattr(owner, name, type(value)(_checked(value.__func__)))
        elif isinstance(value, types.FunctionType) and value.__module__ == module:
            setattr(owner, name, _checked(value))
        elif inspect.isclass(value) and value.__module__ == module and value is not owner:
            _wrap_members(value, module)


def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function itself if it annotates no shape."""
    if not any(_names_shape(hint) for hint in function.__annotations__.values()):
        return function
    signature = inspect.signature(function)
    is_constructor = function.__name__ == "__init__"
    calls = itertools.count()

    @functools.cache
    def hints() -> dict[str, Any]:
        namespace = inspect.unwrap(function).__globals__
        return {
            name: eval(hint, {"Tensor": Tensor} | namespace) if isinstance(hint, str) else hint
            for name, hint in function.__annotations__.items()
            if _names_shape(hint)
        }

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        if next(calls) >= CHECKED_CALLS:
            return result
        # Tests make wrong objects on purpose: their user refuses them.
        if is_constructor and "tests" in sys._getframe(1).f_globals["__name__"]:
            return result
        values = signature.bind(*args, **kwargs).arguments | {"return": result}
        with jaxtyped("context"):
            for name, hint in hints().items():
                if name in values and not _holds(values[name], hint):
                    where = f"{function.__module__}.{function.__qualname__}, {name}"
                    given = type(values[name]), getattr(values[name], "shape", values[name])
                    raise AssertionError(f"{where}: {hint} is annotated, {given} given")
        return result

    return checked


def _names_shape(hint: Any) -> bool:
    text = hint if isinstance(hint, str) else repr(hint)
    return any(
        f"{kind}[" in text for kind in ("Float", "Int", "Integer", "Bool", "UInt8", "Num", "Shaped")
    )


def _holds(value: Any, hint: Any) -> bool:
    """Compare arrays, and those of tuples; other types are left to mypy."""
    if get_origin(hint) in (Union, types.UnionType):
        return any(_holds(value, part) for part in get_args(hint))
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        # Functions also take other arrays and lists where they convert them.
        return not isinstance(value, hint.array_type) or isinstance(value, hint)
    if get_origin(hint) is tuple and isinstance(value, tuple) and Ellipsis not in get_args(hint):
        return all(map(_holds, value, get_args(hint)))
    return hint is not type(None) or value is None
