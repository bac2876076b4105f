"""Progress bars for long computations, and timers for their phases."""

import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from threading import Timer
from typing import Any, TypeVar

import torch
from tqdm import tqdm

from augment.distributed import rank

PATIENCE = 2.0  # Seconds before a progress bar is shown.
Item = TypeVar("Item")


def progress(
    items: Iterable[Item], description: str, total: int | None = None, done: int = 0
) -> Iterator[Item]:
    """Yield items, and show on a terminal how many of them are done.

    A bar appears on the standard error stream after `PATIENCE` seconds, even if no item is done by
    then, and is removed at the end. Nothing is written if the stream is a file or a pipe. If there
    are several processes, only the first one shows the bar. `done` items were done before, and
    `total` is needed only if `items` has no length.
    """
    is_shown = sys.stderr.isatty() and rank() == 0
    bar = tqdm(
        items, description, total, leave=False, delay=PATIENCE, disable=not is_shown, initial=done
    )
    # tqdm itself shows no bar before the first item is done. This timer shows the bar.
    timer = Timer(PATIENCE, _show, [bar])
    timer.daemon = True
    if is_shown:
        timer.start()
    try:
        yield from bar
    finally:
        timer.cancel()


def _show(bar: "tqdm[Item]") -> None:
    """Show a progress bar of tqdm at once, even if no item is done."""
    bar.delay = 0
    bar.refresh()


@contextmanager
def progress_message(description: str) -> Iterator[None]:
    """Show a progress bar with a description during a `with` block."""
    for _ in progress([None], description):
        yield


class Phases:
    """Timer that adds up the seconds of named parts of a computation. Parts may nest.

    Args:
        device: Device of the computation. A GPU records when it reaches the beginning and the end
            of a part, so the CPU waits for it only in `take`.
    """

    def __init__(self, device: torch.device | str = "cpu"):
        self._device = torch.device(device)
        # Name, beginning and end of each part since the last `take`.
        self._parts: list[tuple[str, Any, Any]] = []

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Measure how long a `with` block takes, and add the seconds to those under a name."""
        start = self._now()
        try:
            yield
        finally:
            self._parts.append((name, start, self._now()))

    def take(self) -> dict[str, float]:
        """Return the seconds of each part since the last call, and start again from zero."""
        is_on_gpu = self._device.type == "cuda"
        if is_on_gpu:
            torch.cuda.synchronize(self._device)
        seconds: defaultdict[str, float] = defaultdict(float)
        for name, start, end in self._parts:
            seconds[name] += start.elapsed_time(end) / 1000 if is_on_gpu else end - start
        self._parts.clear()
        return dict(seconds)

    def _now(self) -> Any:
        """Return the time in seconds, or an event at which a GPU records it."""
        if self._device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        return torch.cuda.current_stream(self._device).record_event(event)
