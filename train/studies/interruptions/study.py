"""Runs interrupted in every way, and what became of them."""

import platform
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.random import Generator

from renderer.errors import InputError, require_range
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file, writable_folder
from train.interruption import heed_interrupts
from train.report.tables import markdown
from train.studies.interruptions.cases import (
    DAMAGES,
    Outcome,
    ask,
    ask_then_kill,
    damaged,
    disk_filled,
    interrupted,
    kill,
)
from train.studies.interruptions.runs import Bench, prepare
from train.studies.page import filled, joined, wrapped, write

Case = Callable[[Bench, Generator], Outcome]
HEADER = ["case", "runs", "stops", "faults"]


@dataclass
class InterruptionSettings:
    """conf/check_interruptions.yaml. keep: an empty folder for all runs; None: one that is deleted at the end."""

    out: str | None
    kills: int
    signals: int
    draws: int
    epochs: int
    seed: int
    jobs: int
    keep: str | None

    def __post_init__(self) -> None:
        for name, least in [("kills", 0), ("signals", 0), ("draws", 0), ("epochs", 1), ("seed", 0), ("jobs", 1)]:
            require_range(name, getattr(self, name), least, 64 if name == "jobs" else 10**6)


def run(settings: InterruptionSettings) -> list[str]:
    """Print the page, and write it where it is asked for; everything that was not as it should be, in words."""
    heed_interrupts()
    out = writable_file(settings.out, "out") if settings.out else None
    with nullcontext(settings.keep) if settings.keep else TemporaryDirectory() as folder:
        bench = prepare(_empty(Path(folder).absolute()), settings.epochs)
        cases = all_cases(settings)
        seeds = np.random.default_rng(settings.seed).spawn(len(cases))
        with ThreadPoolExecutor(settings.jobs) as pool:
            outcomes = list(pool.map(partial(_conduct, bench), cases, seeds))
    write(out, page(outcomes, bench, command_line()))
    return [fault for outcome in outcomes for fault in outcome.faults]


def all_cases(settings: InterruptionSettings) -> list[Case]:
    kills, signals, draws = settings.kills, settings.signals, settings.draws
    return [
        partial(interrupted, "SIGKILL", kill, kills),
        partial(interrupted, "SIGKILL after the last epoch", kill, signals, since=(settings.epochs,)),
        *(partial(interrupted, n.name, partial(ask, n), signals) for n in (signal.SIGTERM, signal.SIGINT)),
        partial(interrupted, "SIGTERM, then SIGKILL", ask_then_kill, signals),
        partial(disk_filled, "disk filled", signals),
        *(partial(damaged, case, damage, draws) for case, damage in DAMAGES.items()),
    ]


def _conduct(bench: Bench, case: Case, rng: Generator) -> Outcome:
    outcome = case(bench, rng)
    print(f"{outcome.case}: {len(outcome.faults)} faults", file=sys.stderr)
    return outcome


def _empty(folder: Path) -> Path:
    writable_folder(folder, "keep").mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InputError(f"keep={folder} is not empty: choose another folder")
    return folder


def page(outcomes: Sequence[Outcome], bench: Bench, command: str) -> str:
    """Markdown."""
    introduction = filled(
        __file__,
        command=command,
        torch=torch.__version__,
        machine=platform.machine(),
        epochs=bench.epochs,
        epoch=1000 * (bench.seconds[0] - bench.seconds[bench.epochs]) / bench.epochs,
        start=bench.seconds[None] - bench.seconds[0],
    )
    faults = "\n".join(f"- {fault}" for outcome in outcomes for fault in outcome.faults)
    return joined([wrapped(introduction), markdown(HEADER, map(_row, outcomes)), faults])


def _row(outcome: Outcome) -> list[str]:
    faults = str(len(outcome.faults)) if outcome.runs else "not done: it needs a privilege"
    return [outcome.case, str(outcome.runs), str(outcome.stops or "-"), faults]
