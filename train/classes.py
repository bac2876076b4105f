"""Class names: found exactly, and a mistyped one answered with the nearest."""

import difflib
from collections.abc import Sequence

from renderer.errors import InputError


def class_index(classes: Sequence[str], name: str, key: str) -> int:
    """The label of a class name; InputError, naming the key that it came from, where the list lacks it."""
    if name not in classes:
        raise InputError(f"{key}: {name!r} is not a class of the model: did you mean {nearest_class(classes, name)!r}?")
    return list(classes).index(name)


def nearest_class(classes: Sequence[str], name: str) -> str:
    """The class whose name is most like this one, upper and lower case aside."""
    by_lower_case = {each.lower(): each for each in classes}
    return by_lower_case[difflib.get_close_matches(name.lower(), by_lower_case, n=1, cutoff=0)[0]]
