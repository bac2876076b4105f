"""Progress bars of what may take long."""

import sys
from collections.abc import Iterable, Sequence
from typing import TypeVar

from tqdm import tqdm

PATIENCE = 5  # seconds without one
Item = TypeVar("Item")


def progress(items: Sequence[Item], description: str) -> Iterable[Item]:
    """The items, with a bar on a terminal once they have taken some seconds; nothing elsewhere."""
    return tqdm(items, description, delay=PATIENCE, leave=False, disable=not sys.stderr.isatty())
