"""Runs and attacks, read from the files in their folders, and tables of runs."""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from augment.attacks.files import LINES
from augment.classifiers.adapter import label_names
from augment.service import ARMS
from renderer.errors import InputError, in_one_line
from train import checkpoint, run_folder
from train.networks import PUBLISHED, load_selected, published
from train.photographs.metrics import (
    METRICS,
    AreaUnderCurve,
    Thresholds,
    metric_title,
    read_metric,
)
from train.photographs.scoring import COUNTED_EACH, SUMMARY, describe_point, operating_points
from train.run_folder import BEFORE, CONFIG, PHASES, read_config, read_json, read_metrics
from train.tables import Estimate, Table, format_interval

MOST_NAMED, LONGEST_NAME = 30, 56  # arms named by their settings, and characters of such a name
INITIAL = (
    "the initial network"  # in place of an arm, of a network that runs of the tables began with
)


@dataclass(frozen=True)
class PhotographScores:
    """Scores on one folder of photographs, as summary.json or a published network has them.

    Attributes:
        images: Hash of the photographs. It is equal where two networks were
            scored on the same ones.
        labels: Classes under study.
        metrics: Each metric in `METRICS` by name. None if it is not there.
        by_label: Such metrics of each label. Empty with a single label.
        thresholds: Operating point of each label. Empty without one.
        operating_point: How these were chosen, in words. Empty without one.
    """

    images: str
    labels: Sequence[str]
    metrics: Mapping[str, Estimate | None]
    by_label: Mapping[str, Mapping[str, Estimate | None]] = field(default_factory=dict)
    thresholds: Thresholds = field(default_factory=dict)
    operating_point: str = ""

    @classmethod
    def read(cls, summary: Mapping[str, Any]) -> "PhotographScores":
        """Read scores, of which files of older versions have a part.

        Args:
            summary: Contents of summary.json, or what `to_published` returned.

        Returns:
            Scores that tables show.

        Raises:
            Exception: Of any kind, if an entry is missing or damaged.
        """
        labels = label_names(summary.get("label", ""))
        points = operating_points(summary)
        by_label = {}
        if len(labels) > 1:
            by_label = {label: _read_metrics(summary["by_label"][label]) for label in labels}
        return cls(
            images=str(summary.get("images") or summary),
            labels=labels,
            metrics=_read_metrics(summary),
            by_label=by_label,
            thresholds={point["label"]: float(point["threshold"]) for point in points},
            operating_point=" or ".join(dict.fromkeys(map(describe_point, points))),
        )

    def to_published(self) -> dict[str, Any]:
        """Convert the scores to entries that a published network carries."""
        has_several = len(self.labels) > 1
        entries: dict[str, Any] = {
            "images": self.images,
            "label": [*self.labels] if has_several else self.labels[0],
        }
        entries |= _published(self.metrics)
        if self.thresholds:
            entries["thresholds"] = dict(self.thresholds)
            entries["operating_point"] = self.operating_point
        if has_several:
            entries["by_label"] = {
                label: _published(metrics) for label, metrics in self.by_label.items()
            }
        return entries


def _read_metrics(summary: Mapping[str, Any]) -> dict[str, Estimate | None]:
    """Read each metric in `METRICS` from an entry of summary.json."""
    return {name: read_metric(summary, name) for name in METRICS}


def _published(metrics: Mapping[str, Estimate | None]) -> dict[str, dict[str, Any]]:
    """Convert metrics to entries that a published network carries."""
    return {
        name: {} if estimate is None else asdict(estimate) for name, estimate in metrics.items()
    }


@dataclass(frozen=True)
class RunSummary:
    """A finished run, or a network with scores alone.

    Attributes:
        folder: Folder of the run.
        arm: Name of its renders, or of the network.
        settings: Settings that decide its result, by dotted key.
        photographs: Scores by the name of their sub-folder.
        accuracy: Accuracy on the test images. None if it was not measured.
        seed: Seed of the run. None without a run.
        config: Configuration of the run.
        epochs: Lines of metrics.jsonl, one for each epoch.
        scores: Last line of metrics.jsonl.
        before: Network that the run began with. None if it began with random
            weights.
    """

    folder: Path
    arm: str
    settings: Mapping[str, object]
    photographs: Mapping[str, PhotographScores]
    accuracy: float | None
    seed: int | None = None
    config: DictConfig = field(default_factory=lambda: OmegaConf.create())
    epochs: Sequence[dict[str, float]] = ()
    scores: Mapping[str, float] = field(default_factory=dict)
    before: "RunSummary | None" = None


Arms = Mapping[str, Sequence[RunSummary]]


class ScoredRun(NamedTuple):
    """A run and one of its folders of scores.

    Attributes:
        run: Run that was scored.
        name: Name of the sub-folder.
    """

    run: RunSummary
    name: str

    @property
    def scores(self) -> PhotographScores:
        """Scores in this folder."""
        return self.run.photographs[self.name]

    @property
    def folder(self) -> Path:
        """Folder of the scores."""
        return self.run.folder / self.name


# The scored runs of each arm.
Scored = Mapping[str, Sequence[ScoredRun]]


def is_finished(folder: Path) -> bool:
    """Whether the folder holds a run with its final scores."""
    lines = read_metrics(folder)
    return bool(lines) and "epoch" not in lines[-1]


def summarize(folder: Path) -> RunSummary:
    """Read a finished run, an evaluation of pnb-evaluate, or a published network.

    InputError for a folder without one, or where a file lacks an entry of the tables.
    """
    folder = published(folder)
    whole = folder.absolute()
    name, settings = str(Path(*whole.parts[-2:])), {"network": str(whole)}
    try:
        if is_finished(folder):
            return _read_run(folder)
        if (folder / SUMMARY).is_file():
            scores = {whole.name: PhotographScores.read(read_json(folder / SUMMARY))}
            return RunSummary(whole.parent, name, settings, scores, None)
        if (folder / PUBLISHED).is_file():
            values = load_selected(folder)[1].get("scores", {})
            entries = {key: value for key, value in values.items() if isinstance(value, dict)}
            scores = {key: PhotographScores.read(entry) for key, entry in entries.items()}
            return RunSummary(folder, name, settings, scores, values.get("test/accuracy"))
        raise InputError(
            f"{folder} holds no finished run: let it finish, or resume it with train.resume=true"
        )
    except InputError:
        raise
    except Exception as error:  # entries may be missing or of any type
        files = f"{CONFIG}, {run_folder.METRICS} or a {SUMMARY}"
        reason = f"{type(error).__name__}: {in_one_line(error)}"
        raise InputError(
            f"{folder}: {files} is not as `pnb-train` wrote it ({reason}): use another run"
        ) from error


def _read_run(folder: Path) -> RunSummary:
    *epochs, scores = read_metrics(folder)
    config, before = read_config(folder / CONFIG), None
    if "test/accuracy_before" in scores:
        start = {"train.init_from": config.train.init_from}
        path, accuracy = folder / BEFORE, scores["test/accuracy_before"]
        before = RunSummary(path, INITIAL, start, read_summaries(path), accuracy)
    arm, settings, seed = (
        str(config.augment.arm),
        run_folder.decisive_settings(config),
        int(config.seed),
    )
    accuracy, photographs = scores["test/accuracy"], read_summaries(folder)
    return RunSummary(
        folder, arm, settings, photographs, accuracy, seed, config, epochs, scores, before
    )


def read_summaries(folder: Path) -> dict[str, PhotographScores]:
    """Read the scores in the sub-folders of a run's folder.

    Args:
        folder: Folder of a run.

    Returns:
        Scores by the name of their sub-folder.
    """
    summaries = {}
    for path in sorted(folder.glob(f"*/{SUMMARY}")):
        summaries[path.parent.name] = PhotographScores.read(read_json(path))
    return summaries


def varied_settings(runs: Sequence[RunSummary]) -> dict[str, str]:
    """The settings in which runs differ, by key, in words; without the arm and the seed, which tables always show."""
    keys = sorted({key for run in runs for key in run.settings} - {"augment.arm", "seed"})
    varied = [
        key
        for key in keys
        if any(run.settings.get(key) != runs[0].settings.get(key) for run in runs)
    ]
    return {
        key: re.sub(r"^(augment|train|scene|renderer|evaluate)\.|[._]", " ", key).strip()
        for key in varied
    }


def arms_of(runs: Sequence[RunSummary]) -> Arms:
    """Groups of runs that differ only in the seed, under short names: the arm and the settings in which its groups
    differ, or a number and the arm where those are many or long. The networks that they began with come first, once."""
    bases = [run.before for run in runs if run.before]
    before = {
        repr((base.settings, [part.images for part in base.photographs.values()])): base
        for base in bases
    }
    groups: dict[str, list[RunSummary]] = {}
    for run in (*before.values(), *runs):
        groups.setdefault(repr({**run.settings, "seed": None}), []).append(run)
    heads = [group[0] for group in groups.values()]
    varied = {
        arm: varied_settings([head for head in heads if head.arm == arm])
        for arm in {head.arm for head in heads}
    }
    named: dict[str, list[RunSummary]] = {}
    for number, (head, group) in enumerate(zip(heads, groups.values(), strict=True), 1):
        parts = [
            head.arm,
            *(f"{words}={head.settings.get(key)}" for key, words in varied[head.arm].items()),
        ]
        name = ", ".join(parts)
        is_short = len(heads) <= MOST_NAMED and len(name) <= LONGEST_NAME and name not in named
        named[name if is_short else f"{number}: {head.arm}"] = group
    return named


def by_images(arms: Arms) -> dict[str, Scored]:
    """Group runs by the images that they were scored on.

    Args:
        arms: Runs of each arm.

    Returns:
        Scored runs of each arm, by a title of the images.
    """
    groups: dict[str, dict[str, list[ScoredRun]]] = {}
    for arm, runs in arms.items():
        for run in runs:
            for name, scores in run.photographs.items():
                group = groups.setdefault(scores.images, {})
                group.setdefault(arm, []).append(ScoredRun(run, name))
    titled: dict[str, Scored] = {}
    for group in groups.values():
        title = _title_of(group)
        if title in titled:
            title = f"{title} ({len(titled) + 1})"
        titled[title] = group
    return titled


def _title_of(group: Scored) -> str:
    """Name the images of a group, with their numbers if the scores have them."""
    members = [scored for scored_runs in group.values() for scored in scored_runs]
    # A run with epochs names the folder as its settings do.
    first = next((scored for scored in members if scored.run.epochs), members[0])
    auc = first.scores.metrics["auc"]
    if not isinstance(auc, AreaUnderCurve):
        return first.name
    labels = first.scores.labels
    title = f"{first.name}, {auc.positives:,} of {' or '.join(labels)}"
    title += f" and {auc.negatives:,} of other things"
    if len(labels) > 1:
        title += COUNTED_EACH
    if auc.has_repeated_objects:
        title += "; AUC and recall at FPR over objects, too"
    return title


def run_tables(arms: Arms, groups: Mapping[str, Scored]) -> list[Table]:
    """Accuracy, scores of the groups of `by_images`, and the settings in which the arms differ.

    A row per run; below several seeds of an arm one with their mean ± standard deviation.
    """
    accuracies = {
        arm: [
            (run.seed, [Estimate(run.accuracy), Estimate(run.scores.get("test/accuracy_last"))])
            for run in runs
        ]
        for arm, runs in arms.items()
        if runs[0].accuracy is not None
    }
    tested = dict.fromkeys(
        run.config.get("test_images", "") for runs in arms.values() for run in runs
    )
    title = " or ".join(f"accuracy on {images}" for images in tested if images)
    tables = [_run_table(title, ["test accuracy", "of the last epoch"], accuracies)]
    tables += [score_table(title, group) for title, group in groups.items()]
    heads = {arm: runs[0] for arm, runs in arms.items() if runs[0].seed is not None}
    if varied := varied_settings([*heads.values()]):
        rows = [
            [arm, *(str(head.settings.get(key)) for key in varied)] for arm, head in heads.items()
        ]
        tables.append(
            Table("settings in which the arms differ", ["network", *varied.values()], rows)
        )
    return tables


def score_table(title: str, group: Scored) -> Table:
    """Make a table of the metrics of runs on the same images.

    Args:
        title: Title of the table.
        group: Scored runs of each arm, as `by_images` groups them.

    Returns:
        Table with a row for each run and, with several labels, for each label.
    """
    lines: dict[str, list[Line]] = {}
    for arm, scored_runs in group.items():
        for scored in scored_runs:
            parts = {arm: scored.scores.metrics}
            for label, metrics in scored.scores.by_label.items():
                parts[f"{arm}, {label_title(label)}"] = metrics
            for name, metrics in parts.items():
                line = (scored.run.seed, [metrics[metric] for metric in METRICS])
                lines.setdefault(name, []).append(line)
    points = {scored.scores.operating_point for runs in group.values() for scored in runs}
    chosen = " or ".join(sorted(points - {""}))
    if chosen:
        title += f"; threshold for {chosen}"
    return _run_table(title, [metric_title(name) for name in METRICS], lines)


def label_title(label: str) -> str:
    """Return the title of the row of a label in tables.

    Args:
        label: Class under study.

    Returns:
        Title such as "label=orange".
    """
    return f"label={label}"


def seconds_table(arms: Arms) -> Table:
    """Means per epoch of the first run of each arm; the classifier's part of the attack, and the operators, once."""
    titles = {phase: phase.replace("_", " and ") for phase in PHASES}
    titles |= {"attack_classifier": "attack: in the classifier", "operators": "operators, once"}
    rows = []
    for arm, (run, *_) in arms.items():
        times = {
            phase: [line[key] for line in run.epochs if (key := f"seconds/{phase}") in line]
            for phase in titles
        }
        means = {phase: fmean(seconds or [0]) for phase, seconds in times.items()}
        if any(times.values()):
            total = sum(means[phase] for phase in PHASES)
            rows.append([arm, *(f"{seconds:.2f}" for seconds in (total, *means.values()))])
    return Table("seconds per epoch", ["network", "all", *titles.values()], rows)


# The seed of a run, and its metrics, one per column.
Line = tuple[int | None, Sequence[Estimate | None]]


def _run_table(title: str, header: Sequence[str], lines: Mapping[str, Sequence[Line]]) -> Table:
    """Make a table with a row per run, and one with the mean of several seeds of an arm."""
    rows = []
    for arm, runs in lines.items():
        for seed, metrics in runs:
            cells = map(format_interval, metrics)
            rows.append([arm, "" if seed is None else str(seed), *cells])
        if len({seed for seed, _ in runs}) > 1:
            columns = zip(*(metrics for _, metrics in runs), strict=True)
            rows.append([arm, f"{len(runs)} seeds", *map(_spread, columns)])
    return Table(title, ["network", "seed", *header], rows)


def _spread(metrics: Sequence[Estimate | None]) -> str:
    """Return the mean ± standard deviation of a metric, or "-" if a run lacks it."""
    values = [metric.value for metric in metrics if metric is not None and metric.value is not None]
    if len(values) < len(metrics):
        return "-"
    return f"{fmean(values):.3f} ± {stdev(values):.3f}"


def read_attack(folder: Path) -> dict[str, Any]:
    """An attack's folder; rows: number, label, predictions before and after, and outcome of each example; the numbers
    of successes, with a sensor's noise and without, and of examples that were correct before any step; and its checks
    by name. Attacks of earlier versions counted without noise.

    InputError naming a file that no attack wrote.
    """
    path = folder / LINES
    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        examples = [line for line in lines if "example" in line]
        correct = [line for line in examples if not line["success_before"]]
        successes = sum(bool(line["success"]) for line in correct)
        without_noise = sum(_without_noise(line) for line in correct)
        checks = next((dict(line["checks"]) for line in lines if "checks" in line), {})
        rows = [_example_row(line) for line in examples]
    except Exception as error:  # JSON of any depth and type raises many kinds
        raise InputError(
            f"{path} is damaged or was written by no attack ({in_one_line(error)})"
        ) from error
    counts = {"successes": successes, "without_noise": without_noise, "correct": len(correct)}
    return {"folder": folder, "rows": rows, **counts, "checks": checks}


def _without_noise(line: dict[str, Any]) -> bool:
    """Whether an example's line is of a success without noise; lines of earlier versions have no other."""
    return bool(line.get("success_without_noise", line["success"]))


def _example_row(line: dict[str, Any]) -> tuple[int, str, str, str, str]:
    label = ", ".join(dict.fromkeys(map(str, line["label"])))
    before, after = (
        ", ".join(
            f"{p:.1%} {name}"
            for name, p in zip(line[f"predicted{w}"], line[f"confidence{w}"], strict=True)
        )
        for w in ("_before", "")
    )
    success = (
        "success"
        if line["success"]
        else "success only without noise"
        if _without_noise(line)
        else "no success"
    )
    outcome = f"{success} in {int(line['steps'])} steps"
    return (
        int(line["example"]),
        label,
        before,
        after,
        "wrong before any step" if line["success_before"] else outcome,
    )


Findings = tuple[
    list[RunSummary], list[dict[str, Any]], list[tuple[Path, str, list[dict[str, float]]]]
]


def find(folders: Sequence[Path]) -> Findings:
    """The runs, the attacks as of `read_attack`, and what is not finished or cannot be read in folders and below them.

    Runs are ordered by arm, so that the others are compared with `none`, or with a network that no run trained. The
    third part holds folders, their states in words or why they cannot be read, and the lines of their epochs.
    InputError for a folder that is missing, and where nothing is found.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError(
                f"runs: {folder} is not a folder: give those of runs, of a sweep or of attacks"
            )
    paths = list(dict.fromkeys(path for folder in folders for path in _walk(folder)))
    if not paths:
        raise InputError(
            f"runs: {', '.join(map(str, folders))} holds no run and no attack: give other folders"
        )
    runs, attacks, unfinished = [], [], []
    for path in paths:
        try:
            if (path / LINES).is_file():
                attacks.append(read_attack(path))
            elif (path / SUMMARY).is_file() or (path / PUBLISHED).is_file() or is_finished(path):
                runs.append(summarize(path))
            else:
                epochs = [line for line in read_metrics(path) if "epoch" in line]
                unfinished.append((path, run_folder.state(path), epochs))
        except (InputError, OSError) as error:  # the latter of the lock in another user's folder
            unfinished.append((path, f"cannot be read: {error}", []))
    runs.sort(key=lambda run: [*ARMS].index(run.arm) if run.arm in ARMS else -1)
    return runs, attacks, unfinished


def _walk(folder: Path) -> Iterator[Path]:
    """The folders of runs and attacks; a run's own evaluations are shown with it."""
    for root, below, files in os.walk(folder):
        path, names = Path(root), set(files)
        below.sort()
        is_run = not names.isdisjoint(
            {run_folder.METRICS, run_folder.FAILURE, checkpoint.LAST, checkpoint.BEST}
        )
        if is_run:
            below[:] = [
                name for name in below if name != BEFORE and not (path / name / SUMMARY).is_file()
            ]
        if is_run or names & {LINES, SUMMARY, PUBLISHED} or names >= {CONFIG, "train.log"}:
            yield path
