"""Clocks and scales: medians of interleaved repeats, and peak memory."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

Key = TypeVar("Key")
BURST = 2e-3  # seconds: shorter calls are repeated for as long, since one call alone is the clock's noise
MOST_ROUNDS = 1000
LIMIT = 20.0  # seconds by the wall, after which a comparison goes no further than its third round


@dataclass(frozen=True)
class Clock:
    """Times calls on one device, each in `rounds` rounds, or fewer where they are slow.

    On a CPU it counts the process's own time on it, over all threads: on one thread of an idle machine that is the
    wall's, and on a shared one it leaves out what others took.
    """

    device: torch.device
    rounds: int

    def medians(self, calls: Mapping[Key, Callable[[], object]], rounds: int | None = None) -> dict[Key, float]:
        """Median milliseconds of each call.

        All take turns in every round, so that noise hits all alike. A turn begins with a burst that is not timed, which
        leaves the caches as they are in a loop and lets the threads of the one before come to rest.
        """
        bursts = {key: self._burst(call) for key, call in calls.items()}
        times: dict[Key, list[float]] = {key: [] for key in calls}
        start = time.perf_counter()
        for past in range(rounds or self.rounds):
            if past >= 3 and time.perf_counter() - start > LIMIT:
                break
            for key, call in calls.items():
                self._seconds(call, bursts[key])
                times[key].append(self._seconds(call, bursts[key]) / bursts[key])
        return {key: 1e3 * float(np.median(samples)) for key, samples in times.items()}

    def _burst(self, call: Callable[[], object]) -> int:
        self._seconds(call, 1)  # warms up
        return max(1, round(BURST / self._seconds(call, 1)))

    def _seconds(self, call: Callable[[], object], count: int) -> float:
        self._wait()
        start = self._now()
        for _ in range(count):
            call()
        self._wait()
        return self._now() - start

    def _now(self) -> float:
        return time.perf_counter() if self.device.type == "cuda" else time.process_time()

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def seconds(call: Callable[[], object]) -> float:
    """That a call takes of the processor, over all threads."""
    start = time.process_time()
    call()
    return time.process_time() - start


def peak_bytes(call: Callable[[], object], device: torch.device) -> int:
    """The most that torch's allocator held at once during the call, beyond what it held before."""
    call()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        call()
        return torch.cuda.max_memory_allocated(device) - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled:
        call()
    with TemporaryDirectory() as folder:
        trace = Path(folder) / "trace.json"
        profiled.export_chrome_trace(str(trace))
        events = json.loads(trace.read_text())["traceEvents"]
    changes = sorted((event["ts"], event["args"]["Bytes"]) for event in events if event["name"] == "[memory]")
    return int(np.cumsum([0] + [change for _, change in changes]).max())


def relative_error(value: torch.Tensor, reference: torch.Tensor) -> float:
    """Root mean square of the difference, over the reference's own root mean square."""
    value, reference = (tensor.cpu().double() for tensor in (value, reference))
    return float((value - reference).norm() / reference.norm())
