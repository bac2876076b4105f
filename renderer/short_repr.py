"""Short texts of objects that hold arrays or many items."""

from __future__ import annotations

from collections.abc import Mapping, Sized
from dataclasses import fields, is_dataclass
from typing import Any, cast

# An array, a list or a mapping with more items is shown by its size.
MAX_ITEMS = 4
# A text with more characters is cut off.
MAX_LENGTH = 60


class ShortRepr:
    """Base of a dataclass with `repr=False`, whose `repr` has the sizes of large fields."""

    def __repr__(self) -> str:
        kind = cast(Any, type(self))
        values = [f"{item.name}={_short(getattr(self, item.name))}" for item in fields(kind)]
        return f"{kind.__name__}({', '.join(values)})"


def _short(value: Any) -> str:
    """Write a value in at most about MAX_LENGTH characters."""
    shape = getattr(value, "shape", None)
    if shape is not None and hasattr(value, "dtype"):
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(shape)}"
    if is_dataclass(value):
        return f"{type(value).__name__}(...)"
    if isinstance(value, Sized) and not isinstance(value, str | bytes):
        is_short = 0 < len(value) <= MAX_ITEMS
        items = _short_items(value) if is_short else f"{len(value)} items"
        return f"<{type(value).__name__} of {items}>"
    text = " ".join(repr(value).split())
    return text if len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}..."


def _short_items(value: Any) -> str:
    """Write the items of a short collection, one after the other."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key!r}: {_short(item)}" for key, item in value.items())
    return ", ".join(map(_short, value))
