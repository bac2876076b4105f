"""Hostile inputs tried at every door, and what became of them."""

import json
import shutil
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tqdm import tqdm

from renderer.errors import InputError, require_range
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_file
from train.interruption import heed_interrupts
from train.report.tables import markdown
from train.studies.page import filled, joined, versions, wrapped, write
from train.studies.reliability.corpus import PUBLISHED, RUN, write_corpus
from train.studies.reliability.doors import BY_NAME
from train.studies.reliability.edits import CODE_RAN
from train.studies.reliability.process import PATIENCE, Runner, forked, started
from train.studies.reliability.trials import Trial, all_trials

KINDS = ("no file", "damaged", "forged", "odd names", "settings", "outputs")  # of trials
FATES = ("used", "refused", "mishandled")


@dataclass
class ReliabilitySettings:
    """conf/check_reliability.yaml."""

    out: str | None
    outcomes: str | None
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


@dataclass(frozen=True)
class Outcome:
    """status: see `Ending`. fault: None where all was as it should be. started: whether its process was not forked."""

    door: str
    kind: str
    name: str
    status: int | None
    fault: str | None
    started: bool = False

    @property
    def fate(self) -> str:
        return "mishandled" if self.fault else "refused" if self.status else "used"


def run(settings: ReliabilitySettings) -> list[str]:
    """Print the page, and write it where it is asked for; everything that was mishandled, in words.

    Ctrl-C ends the trials; the page tells of those that were conducted, the next call goes on with `outcomes`.
    """
    out = writable_file(settings.out, "out") if settings.out else None
    file = writable_file(settings.outcomes, "outcomes") if settings.outcomes else None
    trials = [trial for name in settings.doors or BY_NAME for trial in all_trials(BY_NAME[name])]
    drawn = np.random.default_rng(settings.seed).permutation(len(trials))[: settings.draws]
    heed_interrupts()
    outcomes = _kept(file, trials) if file and file.exists() else {}
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder, suppress(KeyboardInterrupt):
        corpus = prepare(Path(folder))
        for place, number in enumerate(tqdm(drawn, "trials", disable=not sys.stderr.isatty())):
            if number not in outcomes:
                runner = started if place < settings.started else forked
                outcomes[number] = outcome(trials[number], corpus, runner)
                _keep(file, outcomes[number])
    ordered = [outcomes[number] for number in sorted(outcomes)]
    write(out, page(ordered, command_line(), len(trials)))
    return failures(ordered)


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
    shutil.copytree(corpus, folder, symlinks=True)
    trial.prepare(folder)
    ending = run(trial.command, folder, trial.around, PATIENCE)
    fault = "code ran" if (folder / CODE_RAN).exists() else trial.fault(ending)
    shutil.rmtree(folder)
    if fault:
        print(f"{trial.door.name}: {trial.name!r}: {fault}", file=sys.stderr)
    return Outcome(trial.door.name, trial.kind, trial.name, ending.status, fault, run is started)


def page(outcomes: Sequence[Outcome], command: str, number: int) -> str:
    """Markdown. number: of the inputs there are."""
    introduction = filled(
        __file__,
        command=command,
        versions=versions(),
        tried=len(outcomes),
        all=number,
        started=sum(each.started for each in outcomes),
        patience=PATIENCE,
    )
    doors = dict.fromkeys(each.door for each in outcomes)
    rows = [_row(door, [each for each in outcomes if each.door == door]) for door in doors]
    table = markdown(["door", *KINDS, *FATES], [*rows, _row("all", outcomes)])
    listed = "\n".join(f"- {fault}" for fault in failures(outcomes))
    return joined([wrapped(introduction), table, listed])


def _row(door: str, outcomes: Sequence[Outcome]) -> list[str | int]:
    counts = Counter(word for each in outcomes for word in (each.kind, each.fate))
    return [door, *(f"{counts[word]:,}" for word in (*KINDS, *FATES))]


def failures(outcomes: Iterable[Outcome]) -> list[str]:
    return [f"{each.door}: {each.name!r}: {each.fault}" for each in outcomes if each.fault]


def _kept(file: Path, trials: Sequence[Trial]) -> dict[int, Outcome]:
    """The outcomes in a file, by the numbers of their trials; the last of each counts. InputError for other files."""
    numbers = {(trial.door.name, trial.kind, trial.name): number for number, trial in enumerate(trials)}
    try:
        outcomes = [Outcome(**json.loads(line)) for line in file.read_text().splitlines()]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"outcomes={file} holds something else: {error}: give a file of this command") from error
    places = [numbers.get((each.door, each.kind, each.name)) for each in outcomes]
    return {place: each for place, each in zip(places, outcomes, strict=True) if place is not None}


def _keep(file: Path | None, found: Outcome) -> None:
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a") as lines:
            print(json.dumps(asdict(found)), file=lines)
