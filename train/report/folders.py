"""What lies in folders: runs, whatever became of them, and attacks. Nothing in them breaks a report."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from augment.attacks.files import LINES
from augment.service_settings import ARMS
from renderer.errors import InputError
from train.report.attacks import Attack, read_attack
from train.report.summary import RunSummary, is_finished, summarise
from train.run_folder import checkpoint
from train.run_folder.files import CONFIG, FAILURE, state
from train.run_folder.logs import METRICS, read_metrics

DEPTH = 4  # folders below the one that is named


@dataclass(frozen=True)
class Run:
    """A run's folder. summary: of a `FinishedRun`; else state says what became of it. epochs: its lines of metrics."""

    folder: Path
    state: str
    summary: RunSummary | None = None
    epochs: list[dict[str, float]] = field(default_factory=list)


@dataclass(frozen=True)
class FinishedRun(Run):
    """One that has its final scores."""

    summary: RunSummary


def find(folders: Sequence[Path]) -> tuple[list[Run], list[Attack], list[str]]:
    """The runs and attacks in folders and below them, and a sentence on each that cannot be read.

    InputError for a folder that is missing, and where there is nothing.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"runs: {folder} is no folder: give those of runs, of a sweep or of attacks")
    found = list(dict.fromkeys(path for folder in folders for path in _walk(folder)))
    runs = sorted((_read_run(path) for path in found if not (path / LINES).is_file()), key=_arm)
    attacks, problems = [], []
    for path in found:
        if (path / LINES).is_file():
            try:
                attacks.append(read_attack(path))
            except InputError as error:
                problems.append(str(error))
    if not (runs or attacks or problems):
        raise InputError(f"runs: {', '.join(map(str, folders))} holds no run and no attack: give other folders")
    return runs, attacks, problems


def _arm(run: Run) -> int:
    """The place of its arm, so that others are compared with none."""
    return ARMS.index(run.summary.arm) if run.summary and run.summary.arm in ARMS else len(ARMS)


def _walk(folder: Path) -> Iterator[Path]:
    for root, below, files in os.walk(folder):
        path = Path(root)
        below.sort()
        if len(path.relative_to(folder).parts) >= DEPTH:
            below.clear()
        is_run = not {METRICS, FAILURE, checkpoint.LAST, checkpoint.BEST}.isdisjoint(files)
        is_begun = CONFIG in files and "train.log" in files
        if LINES in files or is_run or is_begun:
            yield path


def _read_run(folder: Path) -> Run:
    try:
        epochs = [line for line in read_metrics(folder) if "epoch" in line]
        if is_finished(folder):
            return FinishedRun(folder, "finished", summarise(folder), epochs)
        return Run(folder, state(folder), None, epochs)
    except InputError as error:
        return Run(folder, f"cannot be read: {error}")
    except OSError as error:  # the lock, in a folder that others own
        return Run(folder, f"not finished ({error.strerror})")
