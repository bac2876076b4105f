"""What befalls runs: signals and full disks at random moments, and damaged files in the folder of half a run."""

import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from numpy.random import Generator

from train.run_folder import checkpoint
from train.run_folder.logs import METRICS
from train.studies.commands import Ending
from train.studies.interruptions.comparison import differences
from train.studies.interruptions.runs import Bench, Process
from train.studies.reliability.edits import Edit, content, flipped, replaced

GRACE = 0.1  # seconds at most from SIGTERM to SIGKILL
DISK = "64m"
FELL_BACK = "going on from the one before"


@dataclass
class Outcome:
    """runs: brought to their end. stops: interruptions that found a process. faults: in words."""

    case: str
    runs: int = 0
    stops: int = 0
    faults: list[str] = field(default_factory=list)

    def folder(self, bench: Bench) -> Path:
        """Of the next run."""
        return bench.runs / f"{re.sub('[^a-z0-9]+', '_', self.case.lower())}_{self.runs}"

    def conclude(self, bench: Bench, run: Path, ending: Ending) -> None:
        """Note how the run ended and what is not as in the undisturbed one."""
        self.runs += 1
        if ending.status or ending.errors:
            self.add(run, [f"status {ending.status} at the end: {ending.errors}"])
        if ending.status == 0:
            self.add(run, differences(run, bench.reference))

    def add(self, run: Path, faults: Iterable[str]) -> None:
        self.faults += [f"{self.case}: {run.name}: {fault}" for fault in faults]


Interrupt = Callable[[Process, Generator], tuple[Ending, Iterable[str]]]  # and what is wrong with how the process ended


def interrupted(
    case: str,
    interrupt: Interrupt,
    count: int,
    bench: Bench,
    rng: Generator,
    since: tuple[int | None, ...] = (None, 0),
) -> Outcome:
    """Interrupt and resume that many times, in as many runs as it takes: each goes on until it ends by itself.

    The moments are uniform from one of what `Process.reached` tells to the end of an undisturbed run.
    """
    outcome = Outcome(case)
    while outcome.stops < count:
        run, ending = outcome.folder(bench), None
        for _ in range(count - outcome.stops):
            process, lines = bench.process(run), since[rng.integers(len(since))]
            if not process.wait(lines, rng.uniform(0, bench.seconds[lines])):
                ending = process.end()
                break
            stopped, faults = interrupt(process, rng)
            outcome.add(run, faults)
            outcome.stops += stopped.status != 0  # it may have come too late
            if process.reached(bench.epochs + 1):  # what is left could only be scored once more
                break
        outcome.conclude(bench, run, ending or bench.process(run).end())
    return outcome


def kill(process: Process, rng: Generator) -> tuple[Ending, list[str]]:
    """SIGKILL: the process can do nothing about it."""
    process.send(signal.SIGKILL)
    ending = process.end()
    return ending, [] if _is_terse(ending) else [f"said {ending.errors}"]


def ask(number: signal.Signals, process: Process, rng: Generator) -> tuple[Ending, list[str]]:
    """SIGTERM or SIGINT: within `fit` the process ends its step, writes and exits; else it dies as any other."""
    started, fitting, before = process.reached(0), process.is_fitting(), time.time_ns()
    process.send(number)
    ending, faults = process.end(), []
    if ending.status != 128 + number and (ending.status or fitting):
        faults.append(f"status {ending.status}: {ending.errors}")
    if not _is_terse(ending):
        faults.append(f"said {ending.errors}")
    if fitting and "; to go on: " not in ending.output:
        faults.append("did not say how to go on")
    if fitting and (process.run / checkpoint.LAST).stat().st_mtime_ns < before:
        faults.append("wrote no checkpoint")
    return ending, faults if started else []  # imports may turn a KeyboardInterrupt into an error of their own


def _is_terse(ending: Ending) -> bool:
    """Whether stderr holds nothing, or one line on how to go on or that there is nothing to go on with."""
    lines = ending.errors.splitlines()
    return not lines or (len(lines) == 1 and ("train.resume=true" in lines[0] or lines == ["ended by SIGINT"]))


def ask_then_kill(process: Process, rng: Generator) -> tuple[Ending, list[str]]:
    """SIGTERM and soon after SIGKILL, as schedulers do."""
    process.send(signal.SIGTERM)
    time.sleep(rng.uniform(0, GRACE))
    return kill(process, rng)


def disk_filled(case: str, count: int, bench: Bench, rng: Generator) -> Outcome:
    """With the runs on a small file system of their own; no run at all where the user may not mount one."""
    disk = bench.inputs / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", disk], capture_output=True).returncode:
        return Outcome(case)
    try:
        return interrupted(case, fill_disk, count, replace(bench, runs=disk), rng)
    finally:
        subprocess.run(["umount", disk], check=True)


def fill_disk(process: Process, rng: Generator) -> tuple[Ending, list[str]]:
    """Leave no room until the process has ended: with one sentence, if at all, and the newest checkpoint whole."""
    filler = process.run.parent / "filler"
    with open(filler, "wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(2**14))
    ending = process.end()
    filler.unlink()
    refused = ending.refusal and "make room" in ending.refusal
    faults = [f"status {ending.status}: {ending.errors}"] if ending.status and not refused else []
    if checkpoint.exists(process.run) and (problem := checkpoint.load_newest(process.run)[1]):
        faults.append(problem)
    return ending, faults


class Damage(NamedTuple):
    """says: what the run tells of it when it is resumed."""

    file: str
    edit: Callable[[Generator], Edit]
    says: str


def cut(rng: Generator, most: int | None = None) -> Edit:
    """Without its end, of `most` bytes at most."""
    return replaced(lambda whole: whole[: -int(rng.integers(1, most or len(whole)))])


DAMAGES = {
    "bytes flipped in the newest checkpoint": Damage(checkpoint.LAST, flipped, FELL_BACK),
    "newest checkpoint truncated": Damage(checkpoint.LAST, cut, FELL_BACK),
    "newest checkpoint empty": Damage(checkpoint.LAST, lambda rng: content(b""), FELL_BACK),
    "newest checkpoint deleted": Damage(checkpoint.LAST, lambda rng: Path.unlink, FELL_BACK),
    "checkpoint before the newest damaged": Damage(checkpoint.PREVIOUS, flipped, "resumed"),
    "last line of metrics cut short": Damage(METRICS, partial(cut, most=100), "resumed"),
    "metrics deleted": Damage(METRICS, lambda rng: Path.unlink, "resumed"),
}


def damaged(case: str, damage: Damage, count: int, bench: Bench, rng: Generator) -> Outcome:
    """Damage a file, and resume."""
    outcome = Outcome(case)
    for _ in range(count):
        run = shutil.copytree(bench.half, outcome.folder(bench))
        damage.edit(rng)(run / damage.file)
        ending = bench.process(run).end()
        if damage.says not in ending.output:
            outcome.add(run, [f"not {damage.says!r} but {ending.output}"])
        outcome.conclude(bench, run, ending)
    return outcome
