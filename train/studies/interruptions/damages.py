"""What is found when half of a run is resumed: too little room, and files that are damaged."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from numpy.random import Generator

from train.run_folder import checkpoint
from train.run_folder.logs import METRICS
from train.studies.interruptions.bench import Bench, Outcome, conclude, full_disk_faults
from train.studies.interruptions.process import Ending, Process


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
        lambda run, rng: (run / METRICS).stat().st_size + int(rng.integers(1, 300)),
        lambda run, ending: not (run / METRICS).read_bytes().endswith(b"\n"),
    ),
    "no room for anything": Limit("start-up", lambda run, rng: int(rng.integers(1, 500)), lambda run, ending: True),
}


def limited(case: str, limit: Limit, count: int, bench: Bench, rng: Generator) -> Outcome:
    """Resume with too little room, then with enough."""
    outcome = Outcome(case)
    for _ in range(count):
        run = bench.copy_of_half(case)
        ending = Process(bench.small, run, int(limit.size(run, rng))).end()
        outcome.stops[limit.phase] += 1
        outcome.add("said", *(f"{run.name}: {fault}" for fault in full_disk_faults(ending, run)))
        if not ending.status or not limit.hit(run, ending):
            outcome.add("said", f"{run.name}: did not run out of room there: {ending.errors}")
        conclude(outcome, bench, run, Process(bench.small, run).end())
    return outcome


def flip_bytes(path: Path, rng: Generator) -> None:
    """Five of them, wherever: a byte of padding that nobody reads may be among them, but not five."""
    content = bytearray(path.read_bytes())
    for place in rng.integers(0, len(content), 5):
        content[place] ^= rng.integers(1, 256)
    path.write_bytes(content)


def truncate(path: Path, rng: Generator) -> None:
    os.truncate(path, int(rng.integers(1, path.stat().st_size)))


def cut_last_line(path: Path, rng: Generator) -> None:
    start = path.read_bytes()[:-1].rfind(b"\n") + 1
    os.truncate(path, int(rng.integers(start + 1, path.stat().st_size)))


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
        ending = Process(bench.small, run).end()
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
    ending = Process(bench.small, run).end()
    if not ending.is_one_sentence(str(run)):
        outcome.add("said", f"{run.name}: status {ending.status}: {ending.errors}")
    if [path.read_bytes() for path in files] != before:
        outcome.add("said", f"{run.name}: files were changed")
    return outcome
