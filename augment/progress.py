"""Progress bars for long work, and timers for its phases."""

import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from threading import Timer
from typing import TypeVar

import torch
from tqdm import tqdm

from augment.distributed import rank

PATIENCE = 2.0  # Seconds before the first sign of progress.
Item = TypeVar("Item")


def progress(
    items: Iterable[Item],
    description: str,
    total: int | None = None,
    done: int = 0,
) -> Iterator[Item]:
    """Yield items, and show a bar on a terminal that says how many of them are done.

    The bar stands on the standard error stream. It appears after `PATIENCE`
    seconds, even if no item is done by then, and is removed at the end. Nothing
    is written if the stream is a file or a pipe. If there are several processes,
    only the first one shows the bar.

    Args:
        items: The items.
        description: What is done with the items, such as "saving".
        total: The number of items, if they have no length.
        done: The number of items that were done before.

    Yields:
        Each item.
    """
    is_shown = sys.stderr.isatty() and rank() == 0
    bar = tqdm(
        items,
        description,
        total,
        leave=False,
        delay=PATIENCE,
        disable=not is_shown,
        initial=done,
    )
    # tqdm alone shows a bar only after the first item.
    timer = Timer(PATIENCE, _show, [bar])
    timer.daemon = True
    if is_shown:
        timer.start()
    try:
        yield from bar
    finally:
        timer.cancel()


def _show(bar: "tqdm[Item]") -> None:
    """Show a bar before its first item is done. It updates itself afterwards."""
    bar.delay = 0
    bar.refresh()


@contextmanager
def progress_message(description: str) -> Iterator[None]:
    """Show the bar of `progress` during a `with` block.

    Args:
        description: What the block does, such as "loading the network".
    """
    for _ in progress([None], description):
        yield


class Phases:
    """Timer that adds up wall-clock seconds per named phase. Phases may nest.

    Args:
        device: The device whose work is waited for at both ends of a phase.

    Example:
        >>> phases = Phases()
        >>> with phases("attack"):
        ...     pass
        >>> [*phases.take()]
        ['attack']
    """

    def __init__(self, device: torch.device | str = "cpu"):
        self._device = torch.device(device)
        self._seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the seconds of a `with` block to a phase.

        Args:
            name: The name of the phase.
        """
        start = self._now()
        try:
            yield
        finally:
            self._seconds[name] += self._now() - start

    def take(self) -> dict[str, float]:
        """Return the seconds of each phase since the last call, and start again from zero."""
        seconds = dict(self._seconds)
        self._seconds.clear()
        return seconds

    def _now(self) -> float:
        """Return the time in seconds, after the device has done its work."""
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()
