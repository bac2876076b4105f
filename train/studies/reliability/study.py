"""Hostile inputs tried at every door, and what became of them."""

import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory

import numpy as np
from tqdm import tqdm

from renderer.errors import InputError, require_range
from train.cli import command_line
from train.interruption import heed_interrupts
from train.outputs import writable_file
from train.studies.page import write
from train.studies.reliability.corpus import PUBLISHED, RUN, write_corpus
from train.studies.reliability.doors import BY_NAME
from train.studies.reliability.page import Outcome, failures, page
from train.studies.reliability.process import PATIENCE, Runner, forked, started
from train.studies.reliability.trials import Trial, all_trials


@dataclass
class ReliabilitySettings:
    """conf/check_reliability.yaml."""

    out: str | None
    draws: int | None
    started: int
    seed: int
    doors: list[str]

    def __post_init__(self) -> None:
        require_range("draws", self.draws, 1, 10**6)
        require_range("started", self.started, 0, 10**6)
        require_range("seed", self.seed, 0, 10**6)
        if unknown := set(self.doors) - BY_NAME.keys():
            raise InputError(f"doors: {min(unknown)!r} is not known: choose from {', '.join(BY_NAME)}")


def run(settings: ReliabilitySettings) -> list[str]:
    """Print the page, and write it where it is asked for; everything that was mishandled, in words.

    Ctrl-C ends the trials; the page tells of those that were conducted.
    """
    out = writable_file(settings.out, "out") if settings.out else None
    trials = [trial for name in settings.doors or BY_NAME for trial in all_trials(BY_NAME[name])]
    drawn = np.random.default_rng(settings.seed).permutation(len(trials))[: settings.draws]
    heed_interrupts()
    outcomes: dict[int, Outcome] = {}
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder, suppress(KeyboardInterrupt):
        corpus = prepare(Path(folder))
        for number in tqdm(drawn, "trials", disable=not sys.stderr.isatty()):
            runner = started if len(outcomes) < settings.started else forked
            outcomes[number] = outcome(trials[number], corpus, runner)
    ordered = [outcomes[number] for number in sorted(outcomes)]
    text = page(ordered, command_line(), len(trials), min(settings.started, len(ordered)), PATIENCE)
    write(out, text)
    return failures(outcomes.values())


def prepare(folder: Path) -> Path:
    """The corpus in a folder, with a run and its published network. RuntimeError where a good input fails."""
    corpus = folder / "corpus"
    corpus.mkdir()
    write_corpus(corpus)
    training = BY_NAME["train data=npz"].command("train.init_from=null", f"run={RUN}")
    for command in (training, ["scripts/publish.py", f"run={RUN}", f"out={PUBLISHED}"]):
        if (ending := forked(command, corpus, patience=10 * PATIENCE)).status:
            raise RuntimeError(f"{command} ended with {ending}")
    return corpus


def outcome(trial: Trial, corpus: Path, run: Runner = forked) -> Outcome:
    """Of the trial in a copy of the corpus, which is removed."""
    folder = corpus.with_name("trial")
    ending, fault = trial.conduct(corpus, folder, run)
    rmtree(folder)
    if fault:
        print(f"{trial.door.name}: {trial.name!r}: {fault}", file=sys.stderr)
    return Outcome(trial.door.name, trial.kind, trial.name, ending.status, fault)
