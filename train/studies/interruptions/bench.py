"""An undisturbed run and half of one, which all others are made like, and what came of those."""

import re
import shutil
import signal
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from numpy.random import Generator

from train.run_folder import checkpoint
from train.studies.interruptions.comparison import compare
from train.studies.interruptions.process import Ending, Moment, Process
from train.studies.interruptions.small_run import SmallRun


@dataclass
class Outcome:
    """runs: brought to their end. stops: interruptions by the phase that they found. faults: by what they concern."""

    case: str
    runs: int = 0
    stops: Counter[str] = field(default_factory=Counter)
    faults: dict[str, list[str]] = field(default_factory=dict)

    def add(self, concern: str, *faults: str) -> None:
        self.faults.setdefault(concern, []).extend(faults)


@dataclass(frozen=True)
class Bench:
    """runs: the folder of those to come. seconds: see `run_undisturbed`."""

    small: SmallRun
    runs: Path
    reference: Path
    half: Path
    seconds: dict[str, float]

    def folder(self, case: str) -> Path:
        """Of the next run."""
        return self.runs / f"{re.sub('[^a-z0-9]+', '_', case.lower())}_{len(list(self.runs.glob('*_*')))}"

    def copy_of_half(self, case: str) -> Path:
        return shutil.copytree(self.half, self.folder(case))

    def moment(self, rng: Generator, since: tuple[str, ...]) -> Moment:
        """Uniform from one of the beginnings to the end of an undisturbed run."""
        kind = str(rng.choice(since))
        return Moment(kind, rng.uniform(0, self.seconds[kind]))


def prepare(small: SmallRun) -> Bench:
    """Run once undisturbed and once to the middle. RuntimeError where that does not end well."""
    runs = small.folder / "runs"
    reference, half = runs / "reference", runs / "half"
    seconds = run_undisturbed(small, reference)
    process = Process(small, half)
    process.wait(Moment("half", 0))
    process.send(signal.SIGTERM)
    _expect(128 + signal.SIGTERM, process.end())
    return Bench(small, runs, reference, half, seconds)


def run_undisturbed(small: SmallRun, folder: Path) -> dict[str, float]:
    """The seconds from each kind of moment to the final scores."""
    passed, process = {}, Process(small, folder)
    for kind in ("start", "training", "scoring", "end"):
        process.wait(Moment(kind, 0))
        passed[kind] = time.monotonic()
    _expect(0, process.end())
    return {kind: passed["end"] - then for kind, then in passed.items()}


def _expect(status: int, ending: Ending) -> None:
    if ending.status != status:
        raise RuntimeError(f"a run that should have ended with status {status} ended with {ending}")


def conclude(outcome: Outcome, bench: Bench, run: Path, ending: Ending) -> None:
    """Note how the run ended and what is not as in the undisturbed one."""
    outcome.runs += 1
    if ending.status or ending.errors:
        outcome.add("said", f"{run.name}: status {ending.status} at the end: {ending.errors}")
    if not ending.status:
        for concern, faults in compare(run, bench.reference).items():
            outcome.add(concern, *(f"{run.name}: {fault}" for fault in faults))


def full_disk_faults(ending: Ending, run: Path) -> Iterator[str]:
    """A full disk ends a run with one sentence, if at all, and leaves the newest checkpoint whole."""
    if ending.status and not ending.is_one_sentence("make room"):
        yield f"status {ending.status}: {ending.errors}"
    if checkpoint.exists(run) and (problem := checkpoint.load_newest(run)[1]):
        yield problem
