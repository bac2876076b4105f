"""What befalls a process at a random moment: signals, and a disk that is full."""

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from numpy.random import Generator

from train.run_folder import checkpoint
from train.studies.interruptions.bench import Bench, Outcome, conclude, full_disk_faults
from train.studies.interruptions.process import FIT, START, Ending, Process

GRACE = 0.1  # seconds at most from SIGTERM to SIGKILL
DISK = "64m"


class Stop(NamedTuple):
    """phase: in which it found the process. faults: of how the process took it."""

    phase: str
    ending: Ending
    faults: list[str]


Interrupt = Callable[[Process, Generator], Stop]


def interrupted(
    case: str,
    interrupt: Interrupt,
    count: int,
    bench: Bench,
    rng: Generator,
    since: tuple[str, ...] = ("start", "training"),
) -> Outcome:
    """Interrupt and resume that many times, in as many runs as it takes: each goes on until it ends by itself."""
    outcome = Outcome(case)
    while (left := count - outcome.stops.total()) > 0:
        run, ending = bench.folder(case), None
        for _ in range(left):
            process = Process(bench.small, run)
            if not process.wait(bench.moment(rng, since)):
                ending = process.end()
                break
            stop = interrupt(process, rng)
            outcome.add("said", *(f"{run.name}, {stop.phase}: {fault}" for fault in stop.faults))
            outcome.stops[stop.phase] += bool(stop.ending.status)  # it may have come too late
            if process.reached("end"):  # what is left could only be scored once more
                break
        conclude(outcome, bench, run, ending or Process(bench.small, run).end())
    return outcome


def kill(process: Process, rng: Generator) -> Stop:
    """SIGKILL: the process can do nothing about it."""
    phase = process.send(signal.SIGKILL)
    ending = process.end()
    return Stop(phase, ending, [] if ending.terse else [f"said {ending.errors}"])


def ask(number: signal.Signals, process: Process, rng: Generator) -> Stop:
    """SIGTERM or SIGINT: within `fit` the process ends its step, writes and exits; else it dies as any other."""
    before, phase = time.time_ns(), process.send(number)
    ending = process.end()
    return Stop(phase, ending, list(_answer_faults(ending, 128 + number, phase, process.run, before)))


def _answer_faults(ending: Ending, status: int, phase: str, run: Path, before: int) -> Iterator[str]:
    if phase == START:  # imports may turn a KeyboardInterrupt into an error of their own
        return
    if ending.status != status and (ending.status or phase in FIT):
        yield f"status {ending.status} instead of {status}: {ending.errors}"
    elif phase in FIT and not ending.caught:
        yield "died of the signal"
    elif ending.caught and ending.status:
        if not ending.terse:
            yield f"said {ending.errors}"
        newest = run / checkpoint.LAST
        if phase in FIT and not (newest.is_file() and newest.stat().st_mtime_ns >= before):
            yield "wrote no checkpoint"


def ask_then_kill(process: Process, rng: Generator) -> Stop:
    """SIGTERM and soon after SIGKILL, as schedulers do; the phase is the one that SIGKILL found."""
    process.send(signal.SIGTERM)
    time.sleep(rng.uniform(0, GRACE))
    return kill(process, rng)


def fill_disk(process: Process, rng: Generator) -> Stop:
    """Leave no room on the run's file system until the process has ended."""
    phase, filler = process.phase(), process.run.parent / "filler"
    with open(filler, "wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(2**14))
    ending = process.end()
    filler.unlink()
    return Stop(phase, ending, list(full_disk_faults(ending, process.run)))


@contextmanager
def small_disk(bench: Bench) -> Iterator[Bench | None]:
    """The bench with its runs on a small file system of their own; None where the user may not mount one."""
    folder = bench.small.folder / "disk"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", folder], capture_output=True).returncode:
        yield None
        return
    try:
        yield replace(bench, runs=folder)
    finally:
        subprocess.run(["umount", folder], check=True)


def disk_filled(case: str, count: int, bench: Bench, rng: Generator) -> Outcome:
    with small_disk(bench) as small:
        return interrupted(case, fill_disk, count, small, rng) if small else Outcome(case)
