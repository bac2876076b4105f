"""Runs interrupted in every way, and what became of them."""

import signal
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.random import Generator

from renderer.errors import InputError, require_range
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file, writable_folder
from train.interruption import heed_interrupts
from train.studies.interruptions.bench import Bench, Outcome, prepare
from train.studies.interruptions.damages import DAMAGES, LIMITS, both_damaged, damaged, limited
from train.studies.interruptions.disturbances import ask, ask_then_kill, disk_filled, interrupted, kill
from train.studies.interruptions.page import failures, merged, page
from train.studies.interruptions.small_run import write_inputs
from train.studies.page import write

Case = Callable[[Bench, Generator], Outcome]


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
        bench = prepare(write_inputs(_empty(Path(folder).absolute()), settings.epochs))
        cases = all_cases(settings)
        with ThreadPoolExecutor(settings.jobs) as pool:
            started = [pool.submit(_conduct, case, bench, settings.seed, number) for number, case in enumerate(cases)]
        outcomes = merged([future.result() for future in started])
    text = page(outcomes, bench, command_line())
    write(out, text)
    return failures(outcomes)


def all_cases(settings: InterruptionSettings) -> list[Case]:
    """Kills in as many parts as there are jobs, signals of each kind, draws of each damage and each full disk."""
    kills, signals, draws, jobs = settings.kills, settings.signals, settings.draws, settings.jobs
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


def _conduct(case: Case, bench: Bench, seed: int, number: int) -> Outcome:
    """One case, in a folder of its own and with moments of its own."""
    outcome = case(replace(bench, runs=bench.runs / str(number)), np.random.default_rng([seed, number]))
    print(f"{outcome.case}: {len(failures([outcome]))} faults", file=sys.stderr)
    return outcome


def _empty(folder: Path) -> Path:
    writable_folder(folder, "keep").mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InputError(f"keep={folder} is not empty: choose another folder")
    return folder
