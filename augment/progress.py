"""Progress bars and messages for long work, and timers for its phases."""

import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import TypeVar

import torch
from tqdm import tqdm

from augment.distributed import rank

PATIENCE = 2.0  # Seconds before the first sign of progress.
LONGEST_WAIT = 30.0  # Seconds between two lines of progress.
Item = TypeVar("Item")


def progress(
    items: Iterable[Item],
    description: str,
    total: int | None = None,
    done: int = 0,
) -> Iterator[Item]:
    """Yield items, and show on the standard error stream how many of them are done.

    Progress is shown after `PATIENCE` seconds, even if no item is done by then.
    A terminal shows a bar. Other streams get a line with the number of items and
    the remaining time. The line is repeated after intervals that double up to
    `LONGEST_WAIT` seconds. If there are several processes, only the first one
    shows progress.

    Args:
        items: The items.
        description: What is done with the items, such as "saving".
        total: The number of items, if they have no length.
        done: The number of items that were done before.

    Yields:
        Each item.
    """
    is_terminal = sys.stderr.isatty()
    is_first = rank() == 0
    bar = tqdm(
        items,
        description,
        total,
        leave=False,
        delay=PATIENCE,
        disable=not (is_terminal and is_first),
        initial=done,
    )
    counted = _Progress(description, bar, done, is_terminal)
    if is_first:
        Thread(target=counted.show, daemon=True).start()
    try:
        for item in bar:
            yield item
            counted.done += 1
    finally:
        counted.ended.set()


class _Progress:
    """Shows progress from a thread of its own, also before the first item is done."""

    def __init__(self, description: str, bar: "tqdm[Item]", done: int, is_terminal: bool):
        self.done = done
        self.ended = Event()
        self._description = description
        self._bar = bar
        self._done_before = done
        self._is_terminal = is_terminal
        self._start = time.perf_counter()

    def show(self) -> None:
        """Show a bar or lines until the items end."""
        wait = PATIENCE
        while not self.ended.wait(wait):
            if self._is_terminal:
                # The bar updates itself after its first appearance.
                self._bar.delay = 0
                self._bar.refresh()
                return
            print(f"{self._description}{self._count()} ...", file=sys.stderr, flush=True)
            wait = min(2 * wait, LONGEST_WAIT)

    def _count(self) -> str:
        """Return how many items are done, and how much time is left, as far as is known."""
        total = self._bar.total
        done = self.done
        count = f": {done} of {total}" if done and total else ""
        if total and done > self._done_before:
            seconds_per_item = (time.perf_counter() - self._start) / (done - self._done_before)
            seconds_left = seconds_per_item * (total - done)
            count += f", {tqdm.format_interval(seconds_left)} left at this rate"
        return count


@contextmanager
def progress_message(description: str) -> Iterator[None]:
    """Show `progress` of a `with` block.

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
