"""A user's own network, returned by a function of a Python module."""

import importlib
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from torch import nn

from augment.classifiers.adapter import Classifier
from renderer.errors import InputError, in_one_line


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
    module, _, function = name.partition(":")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        network, size, classes = getattr(importlib.import_module(module), function)()
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # of the user's code, or where there is none
        at = traceback.extract_tb(error.__traceback__)[-1]
        reason = f"{type(error).__name__}: {in_one_line(error)}, in line {at.lineno} of {at.filename}"  # type: ignore[arg-type]
        raise InputError(
            f"{setting} fails ({reason}): give python:package.module:function, which returns (module, size, classes)"
        ) from error
    ordered = isinstance(classes, Sequence) and not isinstance(classes, str)
    if not (isinstance(network, nn.Module) and type(size) is int and ordered and all(type(c) is str for c in classes)):
        kinds = ", ".join(type(item).__name__ for item in (network, size, classes))
        raise InputError(f"{setting} returns ({kinds}): return (torch.nn.Module, pixels per side, class names)")
    return network, size, classes
