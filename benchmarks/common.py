"""Timing of calls in turns, relative errors, and files of measurements.

Run a benchmark as a module in the root of the repository:

    python -m benchmarks.renderer
"""

import argparse
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

# A row of measurements: the value of each column.
Row = dict[str, Any]

# A call that takes fewer seconds is repeated until the repeats take this long
# together, because a single short call drowns in the noise of the clock.
MIN_TIMED_SECONDS = 2e-3
# A comparison stops by default after this many seconds, but not before MIN_ROUNDS.
MAX_COMPARISON_SECONDS = 20.0
MIN_ROUNDS = 3


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """Make a parser with the options of the benchmarks of the renderer.

    Args:
        description: Text of --help.

    Returns:
        The parser, with --sizes and --rounds.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--sizes", type=int, nargs="+", default=[32, 224], help="pixels per side of the images")
    add("--rounds", type=int, default=21, help="number of rounds, in which all settings take turns")
    return parser


def medians(
    calls: Mapping[Key, Callable[[], object]], rounds: int, device: str = "cpu"
) -> dict[Key, float]:
    """Measure calls with `times_in_turn`, and take the median over the rounds.

    Args:
        calls: Calls to measure, by name.
        rounds: Largest number of rounds.
        device: Device that the calls use, "cpu" or "cuda".

    Returns:
        Median time of each call in milliseconds.
    """
    times = times_in_turn(calls, rounds, device)
    return {key: statistics.median(values) for key, values in times.items()}


def times_in_turn(
    calls: Mapping[Key, Callable[[], object]],
    rounds: int,
    device: str = "cpu",
    seconds: float = MAX_COMPARISON_SECONDS,
) -> dict[Key, list[float]]:
    """Measure every call once per round, on one thread.

    The calls take turns, so that noise affects all of them alike. A comparison
    ends before its last round if it takes too long.

    Args:
        calls: Calls to measure, by name.
        rounds: Largest number of rounds.
        device: Device that the calls use, "cpu" or "cuda". On the CPU, the
            clock is the time of this process, which leaves out other processes
            on a shared machine. On a GPU, it is the wall time after
            synchronization.
        seconds: Time after which no further round begins, except of the first
            MIN_ROUNDS.

    Returns:
        Time of each call in each round in milliseconds.
    """
    timers = {key: make_timer(call, device) for key, call in calls.items()}
    repeats = {key: repeats_for(timer) for key, timer in timers.items()}
    now = time.process_time if device == "cpu" else time.perf_counter
    start = now()
    times: dict[Key, list[float]] = {key: [] for key in calls}
    for finished_rounds in range(rounds):
        if finished_rounds >= MIN_ROUNDS and now() - start > seconds:
            break
        for key, timer in timers.items():
            # Each measurement begins with calls that warm up and do not count.
            times[key].append(1e3 * timer.timeit(repeats[key]).median)
    return times


def make_timer(call: Callable[[], object], device: str) -> Timer:
    """Return a timer of a call with the clock that suits the device.

    Args:
        call: Call to time.
        device: "cpu" for the processor time of this process. Any other device
            for wall-clock time, synchronized with the GPU.
    """
    names = {"call": call}
    if device == "cpu":
        return Timer("call()", globals=names, timer=time.process_time)
    # The default clock of torch's timer synchronizes with the GPU.
    return Timer("call()", globals=names)


def repeats_for(timer: Timer) -> int:
    """Return how many calls take MIN_TIMED_SECONDS together, at least 1."""
    seconds = timer.timeit(1).median
    return max(1, round(MIN_TIMED_SECONDS / seconds))


def quartiles_of_ratio(
    times: Sequence[float], reference_times: Sequence[float]
) -> tuple[float, float, float]:
    """Compute the quartiles, over the rounds, of the ratio of two calls' times.

    Args:
        times: Time of a call in each round.
        reference_times: Time of the reference call in the same rounds.

    Returns:
        First quartile, median and third quartile of `times / reference_times`.
    """
    pairs = zip(times, reference_times, strict=True)
    return quartiles([time / reference for time, reference in pairs])


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Compute the first quartile, the median and the third quartile of at least one value."""
    if len(values) == 1:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, middle, high


def relative_error(value: torch.Tensor, reference: torch.Tensor) -> float:
    """Compute the relative root mean square error of a tensor.

    Args:
        value: Tensor to check, of any shape and on any device.
        reference: Tensor with the correct values, of the same shape.

    Returns:
        Root mean square of the difference, divided by the root mean square of
        the reference.
    """
    value = value.cpu().double()
    reference = reference.cpu().double()
    return float((value - reference).norm() / reference.norm())


def machine(device: str = "cpu") -> str:
    """Describe the machine in one line.

    Args:
        device: Device that the benchmark uses, "cpu" or "cuda".

    Returns:
        The GPU if there is one in use, the processor, the number of threads,
        the versions of Python, torch and NumPy, and the load of the machine.
    """
    gpu = "" if device == "cpu" else f"{torch.cuda.get_device_name(device)}; "
    threads = f"{torch.get_num_threads()} thread(s)"
    python = f"Python {platform.python_version()}"
    versions = f"{python}, torch {torch.__version__}, NumPy {np.__version__}"
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores at the start"
    return f"{gpu}{processor_name()}, {threads}; {versions}; {load}"


def processor_name() -> str:
    """Return the model of the processor, or its architecture if Linux does not name it."""
    facts = Path("/proc/cpuinfo")
    if facts.is_file():
        for line in facts.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(": ")[2]
    return platform.machine()


def write_csv(path: Path, rows: Iterable[Row]) -> None:
    """Write rows of measurements to a CSV file.

    The columns are those of all rows, in order of first appearance. Floats get
    four significant digits. The cell of None, or of a column that a row lacks,
    is empty.

    Args:
        path: File to write. Missing folders are created.
        rows: Rows of the file.
    """
    formatted = [{name: format_cell(value) for name, value in row.items()} for row in rows]
    columns: dict[str, None] = {}
    for row in formatted:
        columns |= dict.fromkeys(row)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(formatted)


def format_cell(value: object) -> object:
    """Write a float with four significant digits, and return other values as they are."""
    return f"{value:.4g}" if isinstance(value, float) else value


def record(rows: Iterable[Row], path: Path | None, device: str = "cpu") -> list[Row]:
    """Print the machine and each row as soon as it is measured, and write a file.

    A benchmark that is stopped leaves the rows that it finished.

    Args:
        rows: Rows, which are measured while they are iterated over.
        path: A .jsonl file, to which a line of JSON is added for each row, or a
            CSV file, which is written anew. None writes no file.
        device: Device that the benchmark uses, "cpu" or "cuda".

    Returns:
        All rows.
    """
    print(machine(device))
    measured: list[Row] = []
    for row in rows:
        print(row, flush=True)
        measured.append(row)
        if path is None:
            continue
        if path.suffix == ".jsonl":
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        else:
            write_csv(path, measured)
    return measured


def with_median(rows: Iterable[Row]) -> Iterator[Row]:
    """Yield the rows of all rounds, and then a row with the median of each column.

    Args:
        rows: A row for each round, with equal columns. The column "round" has
            the number of the round.

    Yields:
        The rows, and a last one whose "round" is "median".
    """
    round_rows = []
    for row in rows:
        round_rows.append(row)
        yield row
    median_row: Row = {}
    for name in round_rows[0]:
        if name == "round":
            median_row[name] = "median"
        else:
            median_row[name] = statistics.median(row[name] for row in round_rows)
    yield median_row
