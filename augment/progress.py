"""Progress bars of what may take long."""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from tqdm import tqdm

PATIENCE = 5  # seconds without one
Item = TypeVar("Item")


def progress(items: Iterable[Item], description: str, total: int | None = None, done: int = 0) -> Iterable[Item]:
    """The items, with a bar on a terminal once they have taken some seconds; nothing elsewhere.

    total: how many there are, where they have no length. done: before these.
    """
    hidden = not sys.stderr.isatty()
    return tqdm(items, description, total, delay=PATIENCE, leave=False, disable=hidden, initial=done)


@contextmanager
def underway(description: str) -> Iterator[None]:
    """A bar at 0 % on a terminal, at once, for as long as what has no parts to count takes; nothing elsewhere."""
    with tqdm(total=1, desc=description, leave=False, disable=not sys.stderr.isatty()):
        yield
