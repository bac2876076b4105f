"""Interrupt training runs in many ways and show that they end as if nothing had happened: python scripts/torture.py

Linux only: processes tell by a signal where they are, and the size of their files is limited from outside.
"""

import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import hydra
import numpy as np
from omegaconf import DictConfig
from torture.bench import Bench, Outcome, prepare
from torture.cases import Case, all_cases
from torture.page import failures, merged, page
from torture.workshop import furnish

from renderer.errors import InputError, require_range
from train.cli import command_line, one_sentence_errors, with_suggestions
from train.outputs import save_page, writable_file, writable_folder
from train.settings import read_settings


@dataclass
class Settings:
    """conf/torture.yaml."""

    out: str | None
    kills: int
    signals: int
    draws: int
    epochs: int
    seed: int
    jobs: int
    keep: str | None

    def __post_init__(self):
        for name, least in [("kills", 0), ("signals", 0), ("draws", 0), ("epochs", 1), ("seed", 0), ("jobs", 1)]:
            require_range(name, getattr(self, name), least, 10**6)


@hydra.main(version_base="1.3", config_path="pkg://conf", config_name="torture")
@one_sentence_errors
def main(config: DictConfig) -> None:
    config = read_settings(Settings, config)
    if config.out:
        writable_file(config.out, "out")
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # inherited by processes that cannot answer yet
    with nullcontext(config.keep) if config.keep else TemporaryDirectory() as folder:
        bench = prepare(furnish(_empty(Path(folder).absolute()), config.epochs))
        cases = all_cases(config.kills, config.signals, config.draws, config.jobs)
        with ThreadPoolExecutor(config.jobs) as pool:
            started = [pool.submit(_conduct, case, bench, config.seed, number) for number, case in enumerate(cases)]
        outcomes = merged([future.result() for future in started])
    text = page(outcomes, bench, command_line(sys.argv[1:]))
    print(text)
    if config.out:
        save_page(Path(config.out), text)
    if failed := failures(outcomes):
        sys.exit("\n".join(failed))


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


if __name__ == "__main__":
    with_suggestions(main, "torture")
