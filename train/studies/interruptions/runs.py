"""Small training runs to interrupt, each a process or several in turn, and an undisturbed one beside them."""

import signal
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path

from train.run_folder.logs import METRICS
from train.studies.commands import Ending, finish, start
from train.studies.reliability.corpus import write_inputs
from train.studies.reliability.doors import TRAINING, Door

PATIENCE = 300  # seconds after which a process that should have ended has hung
POLL = 0.002
DOOR = Door(
    "interrupted",
    "train",
    ("data=npz", *TRAINING),
    {"data.path={}": ("data.npz",), "evaluate.photos={}": ("photographs",)},
)
CHANGED = (
    *("train.resume=true", "train.learning_rate=0.02", "model.dropout=0.3", "augment.examples=4"),
    *("augment.warm_start=true", "augment.attack.max_steps=3", "augment.attack.step_size=0.3"),
    *("scene.backgrounds=[0.2,0.8]", "renderer.samples=2"),
)


class Process:
    """One that begins a run in a folder, or goes on with it. inputs: the folder of what it reads."""

    def __init__(self, inputs: Path, run: Path, epochs: int):
        self.run, self._epochs = run, epochs
        self._boards, self._lines = self._count_boards(), self._count_lines()  # of earlier processes
        command = DOOR.command(f"run={run}", f"train.epochs={epochs}", *CHANGED)
        self._process = start(command, inputs, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def reached(self, lines: int | None) -> bool:
        """Whether it trains, or has trained, and the run has that many lines of metrics. None: whether it has begun."""
        return lines is None or (self._count_boards() > self._boards and self._count_lines() >= lines)

    def is_fitting(self) -> bool:
        """For certain: it has ended an epoch, and more than one are to come."""
        return self._lines < self._count_lines() < self._epochs - 1

    def wait(self, lines: int | None, seconds: float = 0) -> bool:
        """Whether the process still runs so long after it has `reached` that."""
        while not self.reached(lines):
            if self._process.poll() is not None:
                return False
            time.sleep(POLL)
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return True
        return False

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def end(self) -> Ending:
        return finish(self._process, PATIENCE)

    def _count_boards(self) -> int:
        return len(list(self.run.glob("events.out.tfevents.*")))

    def _count_lines(self) -> int:
        path = self.run / METRICS
        return path.read_bytes().count(b"\n") if path.is_file() else 0


@dataclass(frozen=True)
class Bench:
    """inputs, runs: the folders of what all runs read and of those to come. half: a run that ended in its middle.

    seconds: from what `reached` tells in the undisturbed run, `reference`, to its end.
    """

    inputs: Path
    runs: Path
    reference: Path
    half: Path
    epochs: int
    seconds: dict[int | None, float]

    def process(self, run: Path) -> Process:
        return Process(self.inputs, run, self.epochs)


def prepare(folder: Path, epochs: int) -> Bench:
    """Run once undisturbed and once to the middle, in an empty folder. RuntimeError where that does not end well."""
    write_inputs(folder)
    runs, passed = folder / "runs", dict[int | None, float]()
    bench = Bench(folder, runs, runs / "reference", runs / "half", epochs, passed)
    process = bench.process(bench.reference)
    for lines in (None, 0, epochs, epochs + 1):
        process.wait(lines)
        passed[lines] = time.monotonic()
    _expect(0, process.end())
    process = bench.process(bench.half)
    process.wait(epochs // 2)
    process.send(signal.SIGTERM)
    _expect(128 + signal.SIGTERM, process.end())
    return replace(bench, seconds={lines: passed[epochs + 1] - then for lines, then in passed.items()})


def _expect(status: int, ending: Ending) -> None:
    if ending.status != status:
        raise RuntimeError(f"a run that should have ended with status {status} ended with {ending}")
