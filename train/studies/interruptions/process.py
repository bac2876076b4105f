"""One process of a training run: where it is, and how it ends by itself, by a signal or by an error."""

import resource
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import NamedTemporaryFile

from train.command_line.entry_points import USER_ERROR
from train.run_folder.logs import METRICS
from train.studies.interruptions.observed import NAMES
from train.studies.interruptions.small_run import SmallRun

PATIENCE = 300  # seconds after which a process that should have ended has hung
POLL = 0.002
START, END = "start-up", "exit"
FIT = ("attack", "training", "evaluation")
ORDER = (START, *FIT, "log", "checkpoint", "scoring", END)
LINES = {
    "training": lambda epochs: 0,
    "half": lambda epochs: epochs // 2,
    "scoring": lambda epochs: epochs,
    "end": lambda epochs: epochs + 1,
}


@dataclass(frozen=True)
class Moment:
    """seconds: after the process's "start", or after it began to train and logged as many lines as LINES says."""

    since: str
    seconds: float


@dataclass(frozen=True)
class Ending:
    """status: as a shell says it. caught: whether the process itself ended, and no signal ended it."""

    status: int
    caught: bool
    output: str
    errors: str

    @property
    def terse(self) -> bool:
        """Whether stderr holds nothing, or one line on how to go on or that there is nothing to go on with."""
        lines = self.errors.splitlines()
        return not lines or (len(lines) == 1 and ("train.resume=true" in lines[0] or lines == ["ended by SIGINT"]))

    def is_one_sentence(self, advice: str) -> bool:
        """Whether the process ended with an error that its user can mend, which says this."""
        lines = self.errors.splitlines()
        return self.status == USER_ERROR and len(lines) == 1 and lines[0].startswith("error: ") and advice in lines[0]


class Process:
    """One that begins or resumes the run in a folder. limit: bytes that none of its files may exceed."""

    def __init__(self, small: SmallRun, run: Path, limit: int | None = None):
        self.run = run
        self._epochs = small.epochs
        self._boards = self._count_boards()  # of earlier processes
        with NamedTemporaryFile(dir=small.folder, prefix="phase_", delete=False) as file:
            file.write(bytes(1))
        self._phase = Path(file.name)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "train.studies.interruptions.observed", self._phase, *small.overrides(run)],
            cwd=small.folder,
            env=small.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        if limit is not None:
            resource.prlimit(self._process.pid, resource.RLIMIT_FSIZE, (limit, limit))

    def wait(self, moment: Moment) -> bool:
        """Whether the process still runs when the moment comes."""
        while not self.reached(moment.since):
            if self._process.poll() is not None:
                return False
            time.sleep(POLL)
        try:
            self._process.wait(moment.seconds)
        except subprocess.TimeoutExpired:
            return True
        return False

    def reached(self, since: str) -> bool:
        """Whether a kind of moment is past."""
        if since == "start":
            return True
        return self._count_boards() > self._boards and self._count_lines() >= LINES[since](self._epochs)

    def send(self, number: signal.Signals) -> str:
        """The phase in which the signal found the process."""
        phase = self.phase()
        self._process.send_signal(number)
        return phase

    def phase(self) -> str:
        """Where the process is, as it says itself."""
        return NAMES[self._phase.read_bytes()[0]] or (END if self.reached("training") else START)

    def end(self) -> Ending:
        """Wait for the end; a process that hangs is killed and says so."""
        try:
            output, errors = self._process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            output, errors = self._process.communicate()
            errors += f"hung for {PATIENCE} s"
        self._phase.unlink()
        code = self._process.returncode
        return Ending(abs(code) + 128 * (code < 0), code >= 0, output, errors)

    def _count_boards(self) -> int:
        return len(list(self.run.glob("events.out.tfevents.*")))

    def _count_lines(self) -> int:
        path = self.run / METRICS
        return path.read_bytes().count(b"\n") if path.is_file() else 0
