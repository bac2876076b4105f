"""Timing in turns, errors, and CSV files.

Run a benchmark as a module from the repository's root: python -m benchmarks.renderer
"""

import csv
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch.utils.benchmark import Timer

Key = TypeVar("Key")
Row = dict[str, Any]
BURST = 2e-3  # seconds: a shorter call is repeated for as long, since one call alone is within the clock's noise
LIMIT = 20.0  # seconds by the comparison's clock, after which a comparison stops at the end of its third round


def medians(calls: Mapping[Key, Callable[[], object]], rounds: int, device: str = "cpu") -> dict[Key, float]:
    """Return the median milliseconds of each call over the rounds of `times_in_turn`."""
    return {key: statistics.median(times) for key, times in times_in_turn(calls, rounds, device).items()}


def times_in_turn(
    calls: Mapping[Key, Callable[[], object]], rounds: int, device: str = "cpu"
) -> dict[Key, list[float]]:
    """Measure the milliseconds of each call in every round, on one thread.

    All calls take turns in every round, so that noise hits all alike. On a CPU the clock is the process's own time,
    which leaves out other processes on a shared machine; elsewhere it is wall time after synchronization.
    """
    now = time.process_time if device == "cpu" else time.perf_counter
    clock = {"timer": now} if device == "cpu" else {}
    timers = {key: Timer("call()", globals={"call": call}, **clock) for key, call in calls.items()}
    repeats = {key: max(1, round(BURST / timer.timeit(1).median)) for key, timer in timers.items()}
    times: dict[Key, list[float]] = {key: [] for key in calls}
    start = now()
    for past in range(rounds):
        if past >= 3 and now() - start > LIMIT:
            break
        for key, timer in timers.items():
            times[key].append(1e3 * timer.timeit(repeats[key]).median)  # warms up first
    return times


def quartiles_of_ratio(times: Sequence[float], others: Sequence[float]) -> tuple[float, float, float]:
    """Return the first quartile, the median and the third quartile of the rounds' ratios of two calls' times."""
    ratios = [time / other for time, other in zip(times, others, strict=True)]
    if len(ratios) == 1:
        return ratios[0], ratios[0], ratios[0]
    low, middle, high = statistics.quantiles(ratios, n=4, method="inclusive")
    return low, middle, high


def relative_error(value: torch.Tensor, reference: torch.Tensor) -> float:
    """Root mean square of the difference, over the root mean square of the reference."""
    value, reference = (tensor.cpu().double() for tensor in (value, reference))
    return float((value - reference).norm() / reference.norm())


def machine(device: str = "cpu") -> str:
    """One line: GPU, processor, threads, versions, and the load at the start."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []
    processor = next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.machine())
    gpu = "" if device == "cpu" else f"{torch.cuda.get_device_name(device)}; "
    versions = f"Python {platform.python_version()}, torch {torch.__version__}, NumPy {np.__version__}"
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores at the start"
    return f"{gpu}{processor}, {torch.get_num_threads()} thread(s); {versions}; {load}"


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """All rows, floats to four significant digits, nothing for None; the columns are those of all rows, in order."""
    rows = [{name: f"{v:.4g}" if isinstance(v, float) else v for name, v in row.items()} for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def record(rows: Iterable[Row], path: Path | None, device: str = "cpu") -> list[Row]:
    """Print the machine, and each row as it is measured; with a path, write what there is every time, to a .jsonl or
    CSV file."""
    print(machine(device))
    measured = []
    for row in rows:
        print(row, flush=True)
        measured.append(row)
        if path and path.suffix == ".jsonl":
            path.write_text("".join(json.dumps(row) + "\n" for row in measured), encoding="utf-8")
        elif path:
            write_csv(path, measured)
    return measured


def with_median(rows: Iterable[Row]) -> Iterator[Row]:
    """The rows of the rounds, and then one of the medians of their columns but "round"."""
    rounds = []
    for row in rows:
        rounds.append(row)
        yield row
    yield {name: statistics.median(row[name] for row in rounds) if name != "round" else "median" for name in rounds[0]}
