"""Runs interrupted in every way, and what became of them."""

import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from renderer.errors import InputError
from train.cli import command_line
from train.studies.interruptions.bench import Bench, Outcome, prepare
from train.studies.interruptions.cases import Case, all_cases
from train.studies.interruptions.page import failures, merged, page
from train.studies.interruptions.small_run import write_inputs
from train.studies.page import write


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


def run(settings: InterruptionSettings) -> list[str]:
    """Print the page, and write it where it is asked for; everything that was not as it should be, in words."""
    with nullcontext(settings.keep) if settings.keep else TemporaryDirectory() as folder:
        bench = prepare(write_inputs(_empty(Path(folder).absolute()), settings.epochs))
        cases = all_cases(settings.kills, settings.signals, settings.draws, settings.jobs)
        with ThreadPoolExecutor(settings.jobs) as pool:
            started = [pool.submit(_conduct, case, bench, settings.seed, number) for number, case in enumerate(cases)]
        outcomes = merged([future.result() for future in started])
    text = page(outcomes, bench, command_line())
    print(text)
    if settings.out:
        write(Path(settings.out), text)
    return failures(outcomes)


def _conduct(case: Case, bench: Bench, seed: int, number: int) -> Outcome:
    """One case, in a folder of its own and with moments of its own."""
    outcome = case(replace(bench, runs=bench.runs / str(number)), np.random.default_rng([seed, number]))
    print(f"{outcome.case}: {len(failures([outcome]))} faults", file=sys.stderr)
    return outcome


def _empty(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InputError(f"keep={folder} is not empty: choose another folder")
    return folder
