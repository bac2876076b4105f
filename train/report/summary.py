"""Runs and attacks, read from the files in their folders, and tables of runs."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from omegaconf import DictConfig, OmegaConf

from augment.attacks.files import LINES
from augment.service import ARMS
from renderer.errors import InputError, in_one_line
from train import checkpoint
from train.networks import PUBLISHED, load_selected, published
from train.photographs.metrics import METRICS, find_metric, metric_title
from train.photographs.scoring import SUMMARY
from train.run_folder import (
    BEFORE,
    CONFIG,
    FAILURE,
    PHASES,
    decisive_settings,
    read_config,
    read_json,
    read_metrics,
    state,
)
from train.run_folder import METRICS as METRICS_FILE
from train.tables import Table, format_interval

DEPTH = 4  # folders below the one that is named
MOST_NAMED, LONGEST_NAME = 30, 56  # arms named by their settings, and characters of such a name

# ------------------------------------------------------------------------------------- runs


@dataclass(frozen=True)
class RunSummary:
    """A finished run, or a network with scores alone. epochs: the lines of metrics.jsonl. scores: its last line.

    seconds: the mean per epoch of each phase. settings: those that decide its result, by dotted key. photographs: by
    the name of each sub-folder, METRICS and `images`, which is equal where they were scored on the same images.
    before: the network that the run began with, None where it began with random weights.
    """

    folder: Path
    config: DictConfig
    arm: str
    label: str
    seed: int | None
    epochs: list[dict[str, float]]
    scores: dict[str, float]
    accuracy: float | None
    seconds: dict[str, float]
    settings: dict[str, object]
    photographs: dict[str, dict[str, Any]]
    before: "RunSummary | None" = None

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
    """Read a finished run, an evaluation of pnb-evaluate, or a published network.

    InputError for a folder without one, or where a file lacks an entry of the tables.
    """
    folder = published(folder)
    finished, scored = is_finished(folder), (folder / SUMMARY).is_file()
    if not (finished or scored or (folder / PUBLISHED).is_file()):
        raise InputError(f"{folder} holds no finished run: let it finish, or resume it with train.resume=true")
    whole = folder.absolute()
    name = str(Path(*whole.parts[-2:]))
    try:
        if finished:
            return _read_run(folder)
        if scored:
            return _network(
                whole.parent, name, {whole.name: read_json(folder / SUMMARY)}, None, {"network": str(whole)}
            )
        scores = load_selected(folder)[1].get("scores", {})
        photographs = {key: value for key, value in scores.items() if isinstance(value, dict)}
        return _network(folder, name, photographs, scores.get("test/accuracy"), {"network": str(whole)})
    except InputError:
        raise
    except Exception as error:  # entries may be missing or of any type
        raise InputError(
            f"{folder}: {CONFIG}, {METRICS_FILE} or a {SUMMARY} is not as `pnb-train` wrote it "
            f"({type(error).__name__}: {in_one_line(error)}): use another run"
        ) from error


def _read_run(folder: Path) -> RunSummary:
    *epochs, scores = read_metrics(folder)
    config, before = read_config(folder / CONFIG), None
    phases = sorted({name for line in epochs for name in line if name.startswith("seconds/")})
    seconds = {name.partition("/")[2]: fmean(line[name] for line in epochs if name in line) for name in phases}
    arm, label, seed = str(config.augment.arm), str(config.label), int(config.seed)
    if "test/accuracy_before" in scores:
        start = {"train.init_from": config.train.init_from}
        before = _network(folder / BEFORE, BEFORE, _summaries(folder / BEFORE), scores["test/accuracy_before"], start)
    settings, photographs = decisive_settings(config), _metrics(_summaries(folder))
    accuracy = scores["test/accuracy"]
    return RunSummary(
        folder, config, arm, label, seed, epochs, scores, accuracy, seconds, settings, photographs, before
    )


def _network(
    folder: Path, name: str, summaries: Mapping[str, Any], accuracy: float | None, settings: dict[str, object]
) -> RunSummary:
    """A network that no run of the tables trained."""
    label = next((str(summary.get("label", "")) for summary in summaries.values()), "")
    config, photographs = OmegaConf.create(), _metrics(summaries)
    return RunSummary(folder, config, name, label, None, [], {}, accuracy, {}, settings, photographs)


def _summaries(folder: Path) -> dict[str, dict[str, Any]]:
    return {path.parent.name: read_json(path) for path in sorted(folder.glob(f"*/{SUMMARY}"))}


def _metrics(summaries: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The part of summaries, or of published scores, that tables show."""
    return {
        name: {"images": str(summary.get("images") or summary), "label": str(summary.get("label", ""))}
        | {metric: _checked(find_metric(summary, metric) or summary.get(metric, {})) for metric in METRICS}
        for name, summary in summaries.items()
    }


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
    differ, or a number and the arm where those are many or long. The networks that they began with come first, once."""
    bases = [run.before for run in runs if run.before]
    before = {repr((base.settings, [part["images"] for part in base.photographs.values()])): base for base in bases}
    groups: dict[str, list[RunSummary]] = {}
    for run in (*before.values(), *runs):
        groups.setdefault(repr({**run.settings, "seed": None}), []).append(run)
    heads = [group[0] for group in groups.values()]
    names = [_name(head, heads) for head in heads] if len(heads) <= MOST_NAMED else []
    if len(set(names)) < len(heads) or max(map(len, names), default=0) > LONGEST_NAME:
        names = [f"{number}: {head.arm}" for number, head in enumerate(heads, 1)]
    return dict(zip(names, groups.values(), strict=True))


def pairs_of(arms: Arms) -> list[tuple[str, str]]:
    """Which arms to compare: each with the network that it began with, and with the first arm beside those networks."""
    given = [arm for arm, group in arms.items() if group[0].arm != BEFORE]
    starts = {arm: group[0].before.settings for arm, group in arms.items() if group[0].before}
    pairs = [(arm, base) for arm, start in starts.items() for base in arms if arms[base][0].settings == start]
    return pairs + [(arm, given[0]) for arm in given[1:]]


def by_images(arms: Arms) -> dict[str, dict[str, list[tuple[RunSummary, str]]]]:
    """By a title of the images that they were scored on, the runs of each arm, each with its sub-folder of scores."""
    groups: dict[str, dict[str, list[tuple[RunSummary, str]]]] = {}
    for arm, runs in arms.items():
        for run in runs:
            for name, scores in run.photographs.items():
                groups.setdefault(scores["images"], {}).setdefault(arm, []).append((run, name))
    titled: dict[str, dict[str, list[tuple[RunSummary, str]]]] = {}
    for group in groups.values():
        run, title = max((pair for scored in group.values() for pair in scored), key=lambda pair: bool(pair[0].epochs))
        auc, rendered = run.metric(title, "auc"), OmegaConf.select(run.config, "data.images")
        label = run.photographs[title]["label"]
        if rendered and OmegaConf.select(run.config, "evaluate.photos") == rendered:
            title = "held-out renders"
        if "positives" in auc:
            title += f", {auc['positives']:,} of {label} and {auc['negatives']:,} of other things"
        titled[f"{title} ({len(titled) + 1})" if title in titled else title] = group
    return titled


def _name(run: RunSummary, heads: Sequence[RunSummary]) -> str:
    varied = varied_settings([head for head in heads if head.arm == run.arm])
    return ", ".join([run.arm, *(f"{key}={run.settings.get(key)}" for key in varied)])


# ------------------------------------------------------------------------------------- tables


def run_tables(arms: Arms, photographs: bool = True) -> list[Table]:
    """Accuracy, METRICS on each folder of images (with photographs=True), and the settings in which the arms differ.

    A row per run; below several seeds of an arm one with their mean ± standard deviation.
    """
    accuracies = {
        arm: [(run.seed, [{"value": run.accuracy}, {"value": run.scores.get("test/accuracy_last")}]) for run in runs]
        for arm, runs in arms.items()
        if runs[0].accuracy is not None
    }
    tables = [run_table("", ["test accuracy", "of the last epoch"], accuracies)]
    for title, group in by_images(arms).items() if photographs else ():
        metrics = {
            arm: [(run.seed, [run.metric(name, metric) for metric in METRICS]) for run, name in scored]
            for arm, scored in group.items()
        }
        tables.append(run_table(title, [metric_title(name) for name in METRICS], metrics))
    heads = {arm: runs[0] for arm, runs in arms.items() if runs[0].seed is not None}
    if varied := varied_settings([*heads.values()]):
        rows = [[arm, *(str(head.settings.get(key)) for key in varied)] for arm, head in heads.items()]
        tables.append(Table("settings in which the arms differ", ["network", *varied], rows))
    return tables


def seconds_table(arms: Arms) -> Table:
    """Means per epoch of the first run of each arm; the classifier's part of the attack, and the operators, once."""
    titles = {phase: phase.replace("_", " and ") for phase in PHASES}
    titles |= {"attack_classifier": "attack: in the classifier", "operators": "operators, once"}
    rows = [
        [arm, f"{sum(runs[0].seconds.get(phase, 0) for phase in PHASES):.2f}"]
        + [f"{runs[0].seconds.get(phase, 0):.2f}" for phase in titles]
        for arm, runs in arms.items()
        if runs[0].seconds
    ]
    return Table("seconds per epoch", ["network", "all", *titles.values()], rows)


def run_table(
    title: str, header: Sequence[str], arms: Mapping[str, Sequence[tuple[int | None, Sequence[Metric]]]]
) -> Table:
    """arms: by name, the seed of each run and its metrics, one per column."""
    rows = []
    for arm, lines in arms.items():
        rows += [[arm, "" if seed is None else str(seed), *map(format_interval, line)] for seed, line in lines]
        if len({seed for seed, _ in lines}) > 1:
            spreads = map(_spread, zip(*(line for _, line in lines), strict=True))
            rows.append([arm, f"{len(lines)} seeds", *spreads])
    return Table(title, ["network", "seed", *header], rows)


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
    """The content of folders. runs: ordered by arm, so that the others are compared with `none`, or with a network that
    no run trained.

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
            scored = (path / SUMMARY).is_file() or (path / PUBLISHED).is_file()
            if (path / LINES).is_file():
                findings.attacks.append(read_attack(path))
            elif scored or is_finished(path):
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
    findings.runs.sort(key=lambda run: ARMS.index(run.arm) if run.arm in ARMS else -1)
    return findings


def _walk(folder: Path) -> Iterator[Path]:
    for root, below, files in os.walk(folder):
        path = Path(root)
        below.sort()
        if len(path.relative_to(folder).parts) >= DEPTH:
            below.clear()
        is_run = not {METRICS_FILE, FAILURE, checkpoint.LAST, checkpoint.BEST}.isdisjoint(files)
        parts_of_run = path / BEFORE, *((path / name) for name in below if (path / name / SUMMARY).is_file())
        if is_run:  # its own evaluations are shown with it
            below[:] = [name for name in below if path / name not in parts_of_run]
        if LINES in files or {SUMMARY, PUBLISHED} & set(files) or is_run or {CONFIG, "train.log"} <= set(files):
            yield path
