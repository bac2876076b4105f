"""Runs and attacks, read from the files in their folders, and tables of runs."""

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from omegaconf import DictConfig

from augment.attacks.files import LINES
from augment.service import ARMS
from renderer.errors import InputError, in_one_line
from train import checkpoint
from train.photographs.metrics import METRICS, find_metric, metric_title
from train.photographs.scoring import SUMMARY
from train.run_folder import CONFIG, FAILURE, PHASES, decisive_settings, read_config, read_json, read_metrics, state
from train.run_folder import METRICS as METRICS_FILE
from train.tables import Table, format_interval

DEPTH = 4  # folders below the one that is named
LARGEST_ATTACK = 2**24  # bytes of attack.jsonl
MOST_NAMED, LONGEST_NAME = 30, 36  # arms named by their settings, and characters of such a name

# ------------------------------------------------------------------------------------- runs


@dataclass(frozen=True)
class RunSummary:
    """A finished run. epochs: the lines of metrics.jsonl. scores: its last line, of the final scores.

    seconds: the mean per epoch of each phase. photographs: METRICS by the name of each folder of photographs.
    """

    folder: Path
    config: DictConfig
    arm: str
    label: str
    seed: int
    epochs: list[dict[str, float]]
    scores: dict[str, float]
    seconds: dict[str, float]
    epoch_seconds: float
    settings: dict[str, object]
    photographs: dict[str, dict[str, dict[str, Any]]]

    @property
    def accuracy(self) -> float:
        """On the test set, of the selected network."""
        return self.scores["test/accuracy"]

    def metrics(self, name: str) -> dict[str, dict[str, Any]]:
        """METRICS on the photographs `name`; each empty if the run was not scored on them."""
        return self.photographs.get(name) or {metric: {} for metric in METRICS}


def is_finished(folder: Path) -> bool:
    """Whether the folder holds a run with its final scores."""
    lines = read_metrics(folder)
    return bool(lines) and "epoch" not in lines[-1]


def summarize(folder: Path) -> RunSummary:
    """Read a finished run; InputError for a folder without one, or where a file lacks an entry of the tables."""
    if not is_finished(folder):
        raise InputError(f"{folder} holds no finished run: let it finish, or resume it with train.resume=true")
    *epochs, scores = read_metrics(folder)
    config = read_config(folder / CONFIG)
    summaries = {path.parent.name: read_json(path) for path in sorted(folder.glob(f"*/{SUMMARY}"))}
    phases = sorted({name for line in epochs for name in line if name.startswith("seconds/")})
    try:
        arm, label, seed = config.augment.arm, config.label, config.seed
        for key, value, kind in (("augment.arm", arm, str), ("label", label, str), ("seed", seed, int)):
            if not isinstance(value, kind):
                raise TypeError(f"{key} is {value}")
        for name in ("test/accuracy", "test/accuracy_last"):
            if not 0 <= scores[name] <= 1:  # NaN is not
                raise ValueError(f"{name} is {scores[name]}")
        seconds = {name.partition("/")[2]: fmean(line[name] for line in epochs if name in line) for name in phases}
        photographs = {
            name: {metric: _read_metric(summary, metric) for metric in METRICS} for name, summary in summaries.items()
        }
        per_epoch, settings = sum(seconds[phase] for phase in PHASES), decisive_settings(config)
        return RunSummary(folder, config, arm, label, seed, epochs, scores, seconds, per_epoch, settings, photographs)
    except Exception as error:  # entries may be missing or of any type
        raise InputError(
            f"{folder}: {CONFIG}, {METRICS_FILE} or a {SUMMARY} is not as `python -m train` wrote it "
            f"({type(error).__name__}: {in_one_line(error)}): use another run"
        ) from error


def _read_metric(summary: dict[str, Any], name: str) -> dict[str, Any]:
    metric = find_metric(summary, name)
    format_interval(metric)  # or an error of a damaged file
    return metric


# ------------------------------------------------------------------------------------- arms

Arms = Mapping[str, Sequence[RunSummary]]


def group_by_settings(runs: Sequence[RunSummary]) -> list[list[RunSummary]]:
    """Runs that differ only in the seed, in the order of the first of each group."""
    groups: dict[str, list[RunSummary]] = {}
    for run in runs:
        groups.setdefault(repr({**run.settings, "seed": None}), []).append(run)
    return list(groups.values())


def varied_settings(runs: Sequence[RunSummary]) -> list[str]:
    """The settings in which runs differ, except for the arm and the seed, which tables always show."""
    keys = sorted({key for run in runs for key in run.settings} - {"augment.arm", "seed"})
    return [key for key in keys if any(run.settings.get(key) != runs[0].settings.get(key) for run in runs)]


def name_among(run: RunSummary, runs: Sequence[RunSummary]) -> str:
    """The run's arm, and the settings in which runs of this arm differ."""
    same_arm = [other for other in runs if other.arm == run.arm]
    return ", ".join([run.arm, *(f"{key}={run.settings.get(key)}" for key in varied_settings(same_arm))])


def arms_of(runs: Sequence[RunSummary]) -> Arms:
    """Groups of runs under short names: arm and settings, or a number and the arm where those are many or long."""
    groups = group_by_settings(runs)
    heads = [group[0] for group in groups]
    names = [name_among(head, heads) for head in heads] if len(heads) <= MOST_NAMED else []
    if len(set(names)) < len(heads) or max(map(len, names), default=0) > LONGEST_NAME:
        names = [f"{number}: {head.arm}" for number, head in enumerate(heads, 1)]
    return dict(zip(names, groups, strict=True))


@dataclass(frozen=True)
class Score:
    """A metric of an arm: of one seed with its 95 % interval, of several the mean, the lowest and the highest."""

    value: float
    low: float
    high: float
    seeds: int

    def __str__(self) -> str:
        return format_interval(vars(self))


def score(metrics: Iterable[Mapping[str, Any]]) -> Score | None:
    """Of one metric of an arm's seeds, {value, low, high} where they are known."""
    known = [metric for metric in metrics if metric.get("value") is not None]
    if len(known) == 1:
        return Score(known[0]["value"], known[0]["low"], known[0]["high"], 1)
    values = [metric["value"] for metric in known]
    return Score(fmean(values), min(values), max(values), len(values)) if values else None


# ------------------------------------------------------------------------------------- tables of runs

Names = Sequence[Sequence[str]]  # the first cells of each row


def format_table(runs: Sequence[RunSummary]) -> str:
    """`run_tables` as Markdown, with the settings in which runs differ, and the paths of the contact sheets."""
    varied = varied_settings(runs)
    names = [[*_settings(run, varied), str(run.seed)] for run in runs]
    sheets = [f"image: {run.folder / name / 'contact_sheet.png'}" for run in runs for name in run.photographs]
    tables = _joined(run_tables(["augment", *varied, "seed"], names, runs))
    return "\n\n".join(filter(None, [tables, "\n".join(sheets)]))


def format_spread(runs: Sequence[RunSummary]) -> str:
    """`spread_tables` as Markdown, of groups of several runs that differ only in the seed; "" without one."""
    groups = [group for group in group_by_settings(runs) if len(group) > 1]
    varied = varied_settings(runs)
    names = [[*_settings(group[0], varied), str(len(group))] for group in groups]
    return _joined(spread_tables(["augment", *varied, "seeds"], names, groups)) if groups else ""


def run_tables(header: Sequence[str], names: Names, runs: Sequence[RunSummary]) -> Iterator[Table]:
    """A row per run: a table of accuracy and time, and one of METRICS for each folder of photographs."""
    named = [*zip(names, runs, strict=True)]
    rows = [[*name, f"{run.accuracy:.3f}", f"{run.epoch_seconds:.1f}"] for name, run in named]
    yield Table("", [*header, "test accuracy", "seconds per epoch"], rows)
    for folder in photograph_folders(runs):
        rows = [[*name, *map(format_interval, run.metrics(folder).values())] for name, run in named]
        yield Table(folder, [*header, *map(metric_title, METRICS)], rows)


def spread_tables(header: Sequence[str], names: Names, groups: Sequence[Sequence[RunSummary]]) -> Iterator[Table]:
    """Accuracy and METRICS with a row per group of runs: mean ± standard deviation."""
    named = [*zip(names, groups, strict=True)]
    yield Table(
        "", [*header, "test accuracy"], [[*name, _spread([run.accuracy for run in group])] for name, group in named]
    )
    for folder in photograph_folders([run for group in groups for run in group]):
        rows = [
            [*name, *(_spread([run.metrics(folder)[metric].get("value") for run in group]) for metric in METRICS)]
            for name, group in named
        ]
        yield Table(folder, [*header, *map(metric_title, METRICS)], rows)


def photograph_folders(runs: Iterable[RunSummary]) -> list[str]:
    """The names of the folders of photographs that any of the runs was scored on."""
    return sorted({folder for run in runs for folder in run.photographs})


def _settings(run: RunSummary, varied: Sequence[str]) -> list[str]:
    return [run.arm, *(str(run.settings.get(key)) for key in varied)]


def _joined(tables: Iterable[Table]) -> str:
    return "\n\n".join(f"{table.title}:\n{table}" if table.title else str(table) for table in tables)


def _spread(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.3f} ± {np.std(known, ddof=1):.3f}" if len(known) == len(values) else "-"


# ------------------------------------------------------------------------------------- attacks


@dataclass(frozen=True)
class AttackSummary:
    """An attack's folder. rows: number, label, predictions before and after, and outcome of each example.

    successes: of the `correct` examples, those that were right before any step. checks: their results by name.
    """

    folder: Path
    rows: list[tuple[int, str, str, str, str]]
    successes: int
    correct: int
    checks: dict[str, Any]


def read_attack(folder: Path) -> AttackSummary:
    """Read an attack's folder; InputError naming a file that no attack wrote."""
    path = folder / LINES
    try:
        if path.stat().st_size > LARGEST_ATTACK:
            raise ValueError("it is too large")
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        examples = [line for line in lines if "example" in line]
        rows = [_example_row(line) for line in examples]
        correct = [bool(line["success"]) for line in examples if not line["success_before"]]
        checks = next((dict(line["checks"]) for line in lines if "checks" in line), {})
        return AttackSummary(folder, rows, sum(correct), len(correct), checks)
    except Exception as error:  # JSON of any depth and type raises many kinds
        raise InputError(f"{path} is damaged or was written by no attack ({in_one_line(error)})") from error


def _example_row(line: dict[str, Any]) -> tuple[int, str, str, str, str]:
    label = ", ".join(dict.fromkeys(map(str, line["label"])))
    before, after = (
        ", ".join(f"{p:.1%} {name}" for name, p in zip(line[f"predicted{w}"], line[f"confidence{w}"], strict=True))
        for w in ("_before", "")
    )
    outcome = f"{'success' if line['success'] else 'no success'} in {int(line['steps'])} steps"
    return int(line["example"]), label, before, after, "wrong before any step" if line["success_before"] else outcome


# ------------------------------------------------------------------------------------- folders


@dataclass(frozen=True)
class UnfinishedRun:
    """The folder of a run without final scores. state: in words. epochs: its lines of metrics."""

    folder: Path
    state: str
    epochs: list[dict[str, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Findings:
    """The content of folders. runs: ordered by arm, so that the others are compared with `none`.

    problems: a sentence for each attack that cannot be read.
    """

    runs: list[RunSummary] = field(default_factory=list)
    unfinished: list[UnfinishedRun] = field(default_factory=list)
    attacks: list[AttackSummary] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def find(folders: Sequence[Path]) -> Findings:
    """The runs and attacks in folders and below them, with a sentence on each that cannot be read.

    InputError for a folder that is missing, and where there is nothing that can be read.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"runs: {folder} is not a folder: give those of runs, of a sweep or of attacks")
    paths = list(dict.fromkeys(path for folder in folders for path in _walk(folder)))
    findings, errors = Findings(), []
    for path in paths:
        try:
            _read(path, findings)
        except InputError as error:
            errors.append(error)
            if (path / LINES).is_file():
                findings.problems.append(str(error))
            else:
                findings.unfinished.append(UnfinishedRun(path, f"cannot be read: {error}"))
    if not paths:
        raise InputError(f"runs: {', '.join(map(str, folders))} holds no run and no attack: give other folders")
    if len(errors) == len(paths):
        raise InputError(f"runs: nothing there can be read: {errors[0]}")
    findings.runs.sort(key=lambda run: ARMS.index(run.arm) if run.arm in ARMS else len(ARMS))
    return findings


def _read(path: Path, findings: Findings) -> None:
    if (path / LINES).is_file():
        findings.attacks.append(read_attack(path))
    elif is_finished(path):
        findings.runs.append(summarize(path))
    else:
        try:
            status = state(path)
        except OSError as error:  # of the lock, in another user's folder
            status = f"not finished ({error.strerror})"
        epochs = [line for line in read_metrics(path) if "epoch" in line]
        findings.unfinished.append(UnfinishedRun(path, status, epochs))


def _walk(folder: Path) -> Iterator[Path]:
    for root, below, files in os.walk(folder):
        path = Path(root)
        below.sort()
        if len(path.relative_to(folder).parts) >= DEPTH:
            below.clear()
        is_run = not {METRICS_FILE, FAILURE, checkpoint.LAST, checkpoint.BEST}.isdisjoint(files)
        if LINES in files or is_run or {CONFIG, "train.log"} <= set(files):
            yield path
