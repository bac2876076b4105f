"""Runs and attacks, read from the files in their folders, and tables of runs."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

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
MOST_NAMED, LONGEST_NAME = 30, 56  # arms named by their settings, and characters of such a name

# ------------------------------------------------------------------------------------- runs


@dataclass(frozen=True)
class RunSummary:
    """A finished run. epochs: the lines of metrics.jsonl. scores: its last line, of the final scores.

    seconds: the mean per epoch of each phase. settings: those that decide its result, by dotted key. photographs:
    METRICS by the name of each folder of photographs.
    """

    folder: Path
    config: DictConfig
    arm: str
    label: str
    seed: int
    epochs: list[dict[str, float]]
    scores: dict[str, float]
    accuracy: float
    seconds: dict[str, float]
    settings: dict[str, object]
    photographs: dict[str, dict[str, dict[str, Any]]]

    def metric(self, folder: str, name: str) -> dict[str, Any]:
        """One of METRICS on a folder of photographs; empty if the run was not scored on it."""
        return self.photographs.get(folder, {}).get(name, {})


Arms = Mapping[str, Sequence[RunSummary]]
Metric = Mapping[str, Any]  # its value and, where they are known, the ends of its interval, low and high


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
    try:
        phases = sorted({name for line in epochs for name in line if name.startswith("seconds/")})
        seconds = {name.partition("/")[2]: fmean(line[name] for line in epochs if name in line) for name in phases}
        photographs = {
            name: {metric: _checked(find_metric(summary, metric)) for metric in METRICS}
            for name, summary in summaries.items()
        }
        arm, label, seed = str(config.augment.arm), str(config.label), int(config.seed)
        accuracy, settings = scores["test/accuracy"], decisive_settings(config)
        return RunSummary(folder, config, arm, label, seed, epochs, scores, accuracy, seconds, settings, photographs)
    except Exception as error:  # entries may be missing or of any type
        raise InputError(
            f"{folder}: {CONFIG}, {METRICS_FILE} or a {SUMMARY} is not as `pnb-train` wrote it "
            f"({type(error).__name__}: {in_one_line(error)}): use another run"
        ) from error


def _checked(metric: dict[str, Any]) -> dict[str, Any]:
    """The metric, or an error of a damaged file."""
    known = metric.get("value") is not None
    return metric | {name: float(metric[name]) for name in ("value", "low", "high") if known}


# ------------------------------------------------------------------------------------- arms


def varied_settings(runs: Sequence[RunSummary]) -> list[str]:
    """The settings in which runs differ, except for the arm and the seed, which tables always show."""
    keys = sorted({key for run in runs for key in run.settings} - {"augment.arm", "seed"})
    return [key for key in keys if any(run.settings.get(key) != runs[0].settings.get(key) for run in runs)]


def arms_of(runs: Sequence[RunSummary]) -> Arms:
    """Groups of runs that differ only in the seed, under short names: the arm and the settings in which its groups
    differ, or a number and the arm where those are many or long."""
    groups: dict[str, list[RunSummary]] = {}
    for run in runs:
        groups.setdefault(repr({**run.settings, "seed": None}), []).append(run)
    heads = [group[0] for group in groups.values()]
    names = [_name(head, heads) for head in heads] if len(heads) <= MOST_NAMED else []
    if len(set(names)) < len(heads) or max(map(len, names), default=0) > LONGEST_NAME:
        names = [f"{number}: {head.arm}" for number, head in enumerate(heads, 1)]
    return dict(zip(names, groups.values(), strict=True))


def _name(run: RunSummary, heads: Sequence[RunSummary]) -> str:
    varied = varied_settings([head for head in heads if head.arm == run.arm])
    return ", ".join([run.arm, *(f"{key}={run.settings.get(key)}" for key in varied)])


# ------------------------------------------------------------------------------------- tables


def format_table(runs: Sequence[RunSummary]) -> str:
    """`run_tables` as Markdown, and the paths of the contact sheets."""
    sheets = [f"image: {run.folder / name / 'contact_sheet.png'}" for run in runs for name in run.photographs]
    return "\n\n".join(filter(None, [*map(str, run_tables(arms_of(runs))), "\n".join(sheets)]))


def run_tables(arms: Arms) -> list[Table]:
    """Accuracy and time, METRICS on each folder of photographs, and the settings in which the arms differ.

    A row per run; below several seeds of an arm one with their mean ± standard deviation.
    """
    heads, all_runs = {arm: runs[0] for arm, runs in arms.items()}, [run for runs in arms.values() for run in runs]
    header = ["test accuracy", "of the last epoch", "seconds per epoch"]
    tables = [_run_table("", header, arms, {run.folder: _accuracy_and_time(run) for run in all_runs})]
    for folder in sorted({name for run in all_runs for name in run.photographs}):
        metrics = {run.folder: [run.metric(folder, name) for name in METRICS] for run in all_runs}
        tables.append(_run_table(folder, [metric_title(name) for name in METRICS], arms, metrics))
    if varied := varied_settings([*heads.values()]):
        rows = [[arm, *(str(head.settings.get(key)) for key in varied)] for arm, head in heads.items()]
        tables.append(Table("settings in which the arms differ", ["augment", *varied], rows))
    return tables


def seconds_table(arms: Arms) -> Table:
    """Means per epoch of the first run of each arm; the classifier's part of the attack, and the operators, once."""
    phases = [*PHASES, "attack_classifier", "operators"]
    rows = [[arm, *(f"{runs[0].seconds.get(phase, 0):.2f}" for phase in phases)] for arm, runs in arms.items()]
    return Table("seconds per epoch, and once for the operators", ["augment", *phases], rows)


def _run_table(title: str, header: Sequence[str], arms: Arms, metrics: Mapping[Path, Sequence[Metric]]) -> Table:
    """metrics: by a run's folder, one per column."""
    rows = []
    for arm, runs in arms.items():
        lines = [metrics[run.folder] for run in runs]
        rows += [[arm, str(run.seed), *map(format_interval, line)] for run, line in zip(runs, lines, strict=True)]
        if len(runs) > 1:
            rows.append([arm, f"{len(runs)} seeds", *map(_spread, zip(*lines, strict=True))])
    return Table(title, ["augment", "seed", *header], rows)


def _accuracy_and_time(run: RunSummary) -> list[Metric]:
    values = run.accuracy, run.scores.get("test/accuracy_last"), sum(run.seconds.get(phase, 0) for phase in PHASES)
    return [{"value": value} for value in values]


def _spread(metrics: Sequence[Metric]) -> str:
    values = [metric["value"] for metric in metrics if metric.get("value") is not None]
    return f"{fmean(values):.3f} ± {stdev(values):.3f}" if len(values) == len(metrics) else "-"


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
class Findings:
    """The content of folders. runs: ordered by arm, so that the others are compared with `none`.

    unfinished: the folder, the state in words and the epochs' metrics of each run that is not finished, and the folder
    and the reason of each run and attack that cannot be read.
    """

    runs: list[RunSummary] = field(default_factory=list)
    attacks: list[AttackSummary] = field(default_factory=list)
    unfinished: list[tuple[Path, str, list[dict[str, float]]]] = field(default_factory=list)


def find(folders: Sequence[Path]) -> Findings:
    """The runs and attacks in folders and below them.

    InputError for a folder that is missing, and where there is nothing that can be read.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"runs: {folder} is not a folder: give those of runs, of a sweep or of attacks")
    paths = list(dict.fromkeys(path for folder in folders for path in _walk(folder)))
    findings, errors = Findings(), []
    for path in paths:
        try:
            if (path / LINES).is_file():
                findings.attacks.append(read_attack(path))
            elif is_finished(path):
                findings.runs.append(summarize(path))
            else:
                epochs = [line for line in read_metrics(path) if "epoch" in line]
                findings.unfinished.append((path, state(path), epochs))
        except (InputError, OSError) as error:  # the latter of the lock in another user's folder
            errors.append(error)
            findings.unfinished.append((path, f"cannot be read: {error}", []))
    if not paths:
        raise InputError(f"runs: {', '.join(map(str, folders))} holds no run and no attack: give other folders")
    if len(errors) == len(paths):
        raise InputError(f"runs: nothing there can be read: {errors[0]}")
    findings.runs.sort(key=lambda run: ARMS.index(run.arm) if run.arm in ARMS else len(ARMS))
    return findings


def _walk(folder: Path) -> Iterator[Path]:
    for root, below, files in os.walk(folder):
        path = Path(root)
        below.sort()
        if len(path.relative_to(folder).parts) >= DEPTH:
            below.clear()
        is_run = not {METRICS_FILE, FAILURE, checkpoint.LAST, checkpoint.BEST}.isdisjoint(files)
        if LINES in files or is_run or {CONFIG, "train.log"} <= set(files):
            yield path
