"""A user's own network, returned by a function of a Python module."""

import importlib
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch import nn

from augment.classifiers.adapter import Classifier
from renderer.errors import InputError

FORM = "python:package.module:function"


def load_python(name: str, weights: str | Path | None = None) -> Classifier:
    """`package.module:function`, found from the current folder or installed, called without arguments.

    The function returns (module, size, classes): a torch.nn.Module from images (N, 3, size, size), RGB in [0, 1], to
    logits, and the names of its classes in order. InputError where there is no such function, where it or its module
    raises or returns something else, and for weights=, since the function loads its own.
    """
    if weights is not None:
        raise InputError(f"weights={weights} is not for classifier=python:{name}, which loads its own: leave it out")
    return Classifier(*call_python(name, f"classifier=python:{name}"), f"python:{name}")


def call_python(name: str, setting: str) -> tuple[nn.Module, int, Sequence[str]]:
    """The result of `package.module:function`; errors name the setting that it came from."""
    module, _, attribute = name.partition(":")
    if not module or not attribute:
        raise InputError(f"{setting} names no function: give {FORM}")
    result = _result(module, attribute, setting)
    if not (isinstance(result, tuple | list) and len(result) == 3):
        raise InputError(f"{setting} returns {type(result).__name__}: return (module, size, classes)")
    network, size, classes = result
    if not isinstance(network, nn.Module):
        raise InputError(f"{setting} returns {type(network).__name__} first: return a torch.nn.Module")
    if not isinstance(size, int) or isinstance(size, bool) or size < 1:
        raise InputError(f"{setting} returns the size {size!r}: return its images' pixels per side")
    if isinstance(classes, str) or not isinstance(classes, Sequence) or not all(isinstance(c, str) for c in classes):
        raise InputError(f"{setting} returns no list of class names: return one name per logit")
    return network, size, classes


def _result(module_name: str, attribute: str, setting: str) -> Any:
    """The function's result. InputError that says where the function or its module raised another error."""
    try:
        return _function(module_name, attribute, setting)()
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        message = " ".join(str(error).split())
        raise InputError(
            f"{setting} raises {type(error).__name__} ({message}) in line {at.lineno} of {at.filename}: fix it"
        ) from error


def _function(module_name: str, attribute: str, setting: str) -> Callable[[], Any]:
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise  # the module is there and lacks something that it imports itself
        raise InputError(f"{setting}: there is no module {error.name} in the current folder or installed") from error
    function = getattr(module, attribute, None)
    if not callable(function):
        raise InputError(f"{setting}: {module_name} has no function {attribute}: name one")
    return function
