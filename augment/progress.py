"""Progress bars of what may take long."""

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from tqdm import tqdm

PATIENCE = 5  # seconds without one
Item = TypeVar("Item")


def progress(items: Sequence[Item], description: str) -> Iterable[Item]:
    """The items, with a bar on a terminal once they have taken some seconds; nothing elsewhere."""
    return tqdm(items, description, delay=PATIENCE, leave=False, disable=not sys.stderr.isatty())


@contextmanager
def underway(description: str) -> Iterator[None]:
    """A bar at 0 % on a terminal, at once, for as long as what has no parts to count takes; nothing elsewhere."""
    with tqdm(total=1, desc=description, leave=False, disable=not sys.stderr.isatty()):
        yield
