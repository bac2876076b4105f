"""What is done to runs: signals at random moments, damaged files, full disks. Each run then ends, and is compared."""

import os
import re
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from numpy.random import Generator

from torture.comparison import compare
from torture.life import FIT, START, Ending, Life, Moment
from torture.workshop import Workshop
from train import checkpoint
from train.cli import USER_ERROR
from train.logs import METRICS

GRACE = 0.1  # seconds at most from SIGTERM to SIGKILL
DISK = "64m"


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

    workshop: Workshop
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


def prepare(workshop: Workshop) -> Bench:
    """Run once undisturbed and once to the middle. RuntimeError where that does not end well."""
    runs = workshop.folder / "runs"
    reference, half = runs / "reference", runs / "half"
    seconds = run_undisturbed(workshop, reference)
    life = Life(workshop, half)
    life.wait(Moment("half", 0))
    life.send(signal.SIGTERM)
    _expect(128 + signal.SIGTERM, life.end())
    return Bench(workshop, runs, reference, half, seconds)


def run_undisturbed(workshop: Workshop, folder: Path) -> dict[str, float]:
    """The seconds from each kind of moment to the final scores."""
    passed, life = {}, Life(workshop, folder)
    for kind in ("start", "training", "scoring", "end"):
        life.wait(Moment(kind, 0))
        passed[kind] = time.monotonic()
    _expect(0, life.end())
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


# ---------------------------------------------------------------------------------------- at random moments


class Stop(NamedTuple):
    """phase: in which it found the process. faults: of how the process took it."""

    phase: str
    ending: Ending
    faults: list[str]


Interrupt = Callable[[Life, Generator], Stop]


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
            life = Life(bench.workshop, run)
            if not life.wait(bench.moment(rng, since)):
                ending = life.end()
                break
            stop = interrupt(life, rng)
            outcome.add("said", *(f"{run.name}, {stop.phase}: {fault}" for fault in stop.faults))
            outcome.stops[stop.phase] += bool(stop.ending.status)  # it may have come too late
            if life.reached("end"):  # what is left could only be scored once more
                break
        conclude(outcome, bench, run, ending or Life(bench.workshop, run).end())
    return outcome


def kill(life: Life, rng: Generator) -> Stop:
    """SIGKILL: the process can do nothing about it."""
    phase = life.send(signal.SIGKILL)
    ending = life.end()
    return Stop(phase, ending, [] if _terse(ending) else [f"said {ending.errors}"])


def ask(number: signal.Signals, life: Life, rng: Generator) -> Stop:
    """SIGTERM or SIGINT: within `fit` the process ends its step, writes and exits; else it dies as any other."""
    phase = life.send(number)
    sent = time.time_ns()
    ending = life.end()
    return Stop(phase, ending, list(_answer_faults(ending, 128 + number, phase, life.run, sent)))


def _answer_faults(ending: Ending, status: int, phase: str, run: Path, sent: int) -> Iterator[str]:
    if phase == START:  # imports may turn a KeyboardInterrupt into an error of their own
        return
    if ending.status != status and (ending.status or phase in FIT):
        yield f"status {ending.status} instead of {status}: {ending.errors}"
    elif phase in FIT and not ending.caught:
        yield "died of the signal"
    elif ending.caught and ending.status:
        if not _terse(ending):
            yield f"said {ending.errors}"
        if phase in FIT and (run / checkpoint.LAST).stat().st_mtime_ns < sent:
            yield "wrote no checkpoint"


def _terse(ending: Ending) -> bool:
    """Whether stderr holds nothing, or a line on how to go on."""
    lines = ending.errors.splitlines()
    return not lines or (len(lines) == 1 and "train.resume=true" in lines[0])


def ask_then_kill(life: Life, rng: Generator) -> Stop:
    """SIGTERM and soon after SIGKILL, as schedulers do; the phase is the one that SIGKILL found."""
    life.send(signal.SIGTERM)
    time.sleep(rng.uniform(0, GRACE))
    return kill(life, rng)


def fill_disk(life: Life, rng: Generator) -> Stop:
    """Leave no room on the run's file system until the process has ended."""
    phase, filler = life.phase(), life.run.parent / "filler"
    with open(filler, "wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(2**14))
    ending = life.end()
    filler.unlink()
    return Stop(phase, ending, list(_full_disk_faults(ending, life.run)))


def _full_disk_faults(ending: Ending, run: Path) -> Iterator[str]:
    if ending.status and not _one_sentence(ending, "make room"):
        yield f"status {ending.status}: {ending.errors}"
    if checkpoint.exists(run) and (problem := checkpoint.load_newest(run)[1]):
        yield problem


def _one_sentence(ending: Ending, advice: str) -> bool:
    lines = ending.errors.splitlines()
    return ending.status == USER_ERROR and len(lines) == 1 and lines[0].startswith("error: ") and advice in lines[0]


@contextmanager
def small_disk(bench: Bench) -> Iterator[Bench | None]:
    """The bench with its runs on a small file system of their own; None where the user may not mount one."""
    folder = bench.workshop.folder / "disk"
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


# ---------------------------------------------------------------------------------------- from half a run


class Limit(NamedTuple):
    """size: of the largest file that the run may write. hit: whether it is what should not have fitted that did not."""

    phase: str
    size: Callable[[Path, Generator], float]
    hit: Callable[[Path, Ending], bool]


LIMITS = {
    "no room for a checkpoint": Limit(
        "checkpoint",
        lambda run, rng: rng.uniform(0.3, 0.9) * (run / checkpoint.LAST).stat().st_size,
        lambda run, ending: ".pt cannot be written" in ending.errors,
    ),
    "no room for a line of metrics": Limit(
        "log",
        lambda run, rng: (run / METRICS).stat().st_size + rng.integers(1, 300),
        lambda run, ending: not (run / METRICS).read_bytes().endswith(b"\n"),
    ),
    "no room for anything": Limit(
        "start-up",
        lambda run, rng: rng.integers(1, 500),
        lambda run, ending: True,
    ),
}


def limited(case: str, limit: Limit, count: int, bench: Bench, rng: Generator) -> Outcome:
    """Resume with too little room, then with enough."""
    outcome = Outcome(case)
    for _ in range(count):
        run = bench.copy_of_half(case)
        ending = Life(bench.workshop, run, int(limit.size(run, rng))).end()
        outcome.stops[limit.phase] += 1
        outcome.add("said", *(f"{run.name}: {fault}" for fault in _full_disk_faults(ending, run)))
        if not ending.status or not limit.hit(run, ending):
            outcome.add("said", f"{run.name}: did not run out of room there: {ending.errors}")
        conclude(outcome, bench, run, Life(bench.workshop, run).end())
    return outcome


def flip_bytes(path: Path, rng: Generator) -> None:
    """Five of them, wherever: a byte of padding that nobody reads may be among them, but not five."""
    content = bytearray(path.read_bytes())
    for place in rng.integers(0, len(content), 5):
        content[place] ^= rng.integers(1, 256)
    path.write_bytes(content)


def truncate(path: Path, rng: Generator) -> None:
    os.truncate(path, rng.integers(1, path.stat().st_size))


def cut_last_line(path: Path, rng: Generator) -> None:
    start = path.read_bytes()[:-1].rfind(b"\n") + 1
    os.truncate(path, rng.integers(start + 1, path.stat().st_size))


class Damage(NamedTuple):
    """says: what the run tells of it when it is resumed."""

    file: str
    spoil: Callable[[Path, Generator], object]
    says: str


FELL_BACK = "going on from the one before"
DAMAGES = {
    "bytes flipped in the newest checkpoint": Damage(checkpoint.LAST, flip_bytes, FELL_BACK),
    "newest checkpoint truncated": Damage(checkpoint.LAST, truncate, FELL_BACK),
    "newest checkpoint empty": Damage(checkpoint.LAST, lambda path, rng: path.write_bytes(b""), FELL_BACK),
    "newest checkpoint deleted": Damage(checkpoint.LAST, lambda path, rng: path.unlink(), FELL_BACK),
    "checkpoint before the newest damaged": Damage(checkpoint.PREVIOUS, flip_bytes, "resumed"),
    "last line of metrics cut short": Damage(METRICS, cut_last_line, "resumed"),
    "metrics deleted": Damage(METRICS, lambda path, rng: path.unlink(), "resumed"),
}


def damaged(case: str, damage: Damage, count: int, bench: Bench, rng: Generator) -> Outcome:
    """Damage a file, and resume."""
    outcome = Outcome(case)
    for _ in range(count):
        run = bench.copy_of_half(case)
        damage.spoil(run / damage.file, rng)
        ending = Life(bench.workshop, run).end()
        if damage.says not in ending.output:
            outcome.add("said", f"{run.name}: not {damage.says!r} but {ending.output}")
        conclude(outcome, bench, run, ending)
    return outcome


def both_damaged(case: str, bench: Bench, rng: Generator) -> Outcome:
    """There is nothing to go on with: one sentence, and nothing is written over."""
    outcome, run = Outcome(case, runs=1), bench.copy_of_half(case)
    for name in (checkpoint.LAST, checkpoint.PREVIOUS):
        flip_bytes(run / name, rng)
    files = [run / name for name in (checkpoint.LAST, checkpoint.PREVIOUS, checkpoint.BEST, METRICS)]
    before = [path.read_bytes() for path in files]
    ending = Life(bench.workshop, run).end()
    if not _one_sentence(ending, str(run)):
        outcome.add("said", f"{run.name}: status {ending.status}: {ending.errors}")
    if [path.read_bytes() for path in files] != before:
        outcome.add("said", f"{run.name}: files were changed")
    return outcome


# ---------------------------------------------------------------------------------------- all of them

Case = Callable[[Bench, Generator], Outcome]


def all_cases(kills: int, signals: int, draws: int, jobs: int) -> list[Case]:
    """kills: in as many parts as there are jobs. signals: of each kind. draws: of each damage and each full disk."""
    shares = [kills // jobs + (job < kills % jobs) for job in range(jobs)]
    return [
        *(partial(interrupted, "SIGKILL", kill, share) for share in shares),
        partial(interrupted, "SIGKILL after the last epoch", kill, signals, since=("scoring",)),
        *(partial(interrupted, n.name, partial(ask, n), signals) for n in (signal.SIGTERM, signal.SIGINT)),
        partial(interrupted, "SIGTERM, then SIGKILL", ask_then_kill, signals),
        partial(disk_filled, "disk filled", signals),
        *(partial(limited, case, limit, draws) for case, limit in LIMITS.items()),
        *(partial(damaged, case, damage, draws) for case, damage in DAMAGES.items()),
        partial(both_damaged, "both checkpoints damaged"),
    ]
