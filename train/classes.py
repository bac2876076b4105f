"""Class names: found exactly, and a mistyped one answered with the nearest."""

from collections.abc import Sequence

from augment.classifiers.adapter import nearest
from renderer.errors import InputError


def class_index(classes: Sequence[str], name: str, key: str) -> int:
    """The label of a class name; InputError, naming the key that it came from, where the list lacks it."""
    if name not in classes:
        raise InputError(f"{key}: {name!r} is not a class of the model: choose one, such as {nearest(name, classes)}")
    return list(classes).index(name)
