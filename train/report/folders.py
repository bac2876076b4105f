"""What lies in folders: runs, whatever became of them, and attacks. Nothing in them breaks a report."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from augment.attacks.files import LINES
from augment.service import ARMS
from renderer.errors import InputError
from train.report.attacks import Attack, read_attack
from train.report.summary import RunSummary, is_finished, summarize
from train.run_folder import checkpoint
from train.run_folder.files import CONFIG, FAILURE, state
from train.run_folder.logs import METRICS, read_metrics

DEPTH = 4  # folders below the one that is named


@dataclass(frozen=True)
class UnfinishedRun:
    """The folder of a run without final scores. state: what became of it. epochs: its lines of metrics."""

    folder: Path
    state: str
    epochs: list[dict[str, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Found:
    """What lies in folders. runs: by arm, so that others are compared with none. problems: of damaged attacks."""

    runs: list[RunSummary] = field(default_factory=list)
    unfinished: list[UnfinishedRun] = field(default_factory=list)
    attacks: list[Attack] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def find(folders: Sequence[Path]) -> Found:
    """The runs and attacks in folders and below them, with a sentence on each that cannot be read.

    InputError for a folder that is missing, and where there is nothing, or nothing that can be read.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"runs: {folder} is no folder: give those of runs, of a sweep or of attacks")
    paths = list(dict.fromkeys(path for folder in folders for path in _walk(folder)))
    found, damaged = Found(), []
    for path in paths:
        try:
            _read(path, found)
        except InputError as error:
            damaged.append(error)
            if (path / LINES).is_file():
                found.problems.append(str(error))
            else:
                found.unfinished.append(UnfinishedRun(path, f"cannot be read: {error}"))
    if not paths:
        raise InputError(f"runs: {', '.join(map(str, folders))} holds no run and no attack: give other folders")
    if len(damaged) == len(paths):
        raise InputError(f"runs: nothing there can be read: {damaged[0]}")
    found.runs.sort(key=lambda run: ARMS.index(run.arm) if run.arm in ARMS else len(ARMS))
    return found


def _read(path: Path, found: Found) -> None:
    if (path / LINES).is_file():
        found.attacks.append(read_attack(path))
    elif is_finished(path):
        found.runs.append(summarize(path))
    else:
        try:
            become = state(path)
        except OSError as error:  # the lock, in a folder that others own
            become = f"not finished ({error.strerror})"
        epochs = [line for line in read_metrics(path) if "epoch" in line]
        found.unfinished.append(UnfinishedRun(path, become, epochs))


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
