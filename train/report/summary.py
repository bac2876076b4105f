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

from augment.attacks.attack_files import LINES
from augment.settings import MODES
from renderer.errors import InputError, single_line
from train.evaluation.scores.metrics import (
    METRICS,
    AreaUnderCurve,
    Thresholds,
    metric_title,
    read_metric,
)
from train.evaluation.scores.scoring import COUNTED_EACH, SUMMARY, describe_point, operating_points
from train.evaluation.tables import Estimate, Table, format_interval
from train.runs import checkpoint, run_config, run_lock, run_log
from train.runs.run_config import CONFIG, read_config, read_json
from train.runs.run_log import BEFORE, PHASES, read_metrics
from train.runs.saved_networks import PUBLISHED, load_selected
from train.settings import label_names, published

# Number of methods up to which they are named by their settings.
MAX_NAMED = 30
# Characters of the longest such name.
LONGEST_NAME = 56
# Name of a network that runs began with, in place of that of a method.
INITIAL = "the initial network"
# Names of both networks if nothing but one method with renders is compared with
# the network that it began with.
BEFORE_HARDENING = "before hardening"
AFTER_HARDENING = "after hardening"


@dataclass(frozen=True)
class PhotographScores:
    """Scores on one folder of photographs, as summary.json or a published network has them.

    Attributes:
        images: Hash of the photographs. It is equal where two networks were
            scored on the same ones.
        labels: Classes under study.
        metrics: Each metric in `METRICS` by name. None if the scores lack it.
        by_label: The metrics of each label, by label and by name of the
            metric. Empty with a single label.
        thresholds: Threshold of the log-odds by label. Empty without an
            operating point.
        operating_point: How the thresholds were chosen, in words. Empty without
            an operating point.
    """

    images: str
    labels: Sequence[str]
    metrics: Mapping[str, Estimate | None]
    by_label: Mapping[str, Mapping[str, Estimate | None]] = field(default_factory=dict)
    thresholds: Thresholds = field(default_factory=dict)
    operating_point: str = ""

    @classmethod
    def read(cls, summary: Mapping[str, Any]) -> "PhotographScores":
        """Read scores from the entries of a file. Files of older versions lack some entries.

        Args:
            summary: Contents of summary.json, or the entries that
                `to_published` returned.

        Returns:
            Scores of one folder of photographs.

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
            by_label = {}
            for label, metrics in self.by_label.items():
                by_label[label] = _published(metrics)
            entries["by_label"] = by_label
        return entries


def _read_metrics(summary: Mapping[str, Any]) -> dict[str, Estimate | None]:
    """Read the metrics of summary.json, or of one label in it.

    Args:
        summary: Contents of summary.json, or an entry below "by_label".

    Returns:
        Each metric in `METRICS` by name. None if the entry lacks it.
    """
    return {name: read_metric(summary, name) for name in METRICS}


def _published(metrics: Mapping[str, Estimate | None]) -> dict[str, dict[str, Any]]:
    """Convert metrics to plain values for the file of a published network.

    Args:
        metrics: Metrics by name. None if a metric is unknown.

    Returns:
        The fields of each metric, such as "value", "low" and "high", by the
        name of the metric. An unknown metric has no fields.
    """
    published = {}
    for name, estimate in metrics.items():
        published[name] = {} if estimate is None else asdict(estimate)
    return published


@dataclass(frozen=True)
class RunSummary:
    """A finished run, or a network with scores alone.

    Attributes:
        folder: Folder of the run.
        method: Name of its renders, or of the network.
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
    method: str
    settings: Mapping[str, object]
    photographs: Mapping[str, PhotographScores]
    accuracy: float | None
    seed: int | None = None
    config: DictConfig = field(default_factory=lambda: OmegaConf.create())
    epochs: Sequence[dict[str, float]] = ()
    scores: Mapping[str, float] = field(default_factory=dict)
    before: "RunSummary | None" = None


# Runs by the name of their method.
Methods = Mapping[str, Sequence[RunSummary]]


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


# The scored runs of each method.
Scored = Mapping[str, Sequence[ScoredRun]]


def is_finished(folder: Path) -> bool:
    """Return whether a folder holds a run with its final scores.

    Args:
        folder: Folder of a run.

    Returns:
        Whether the last line of metrics.jsonl has the scores.
    """
    lines = read_metrics(folder)
    return bool(lines) and "epoch" not in lines[-1]


def summarize(folder: Path) -> RunSummary:
    """Read a finished run, an evaluation of pnb-evaluate, or a published network.

    Args:
        folder: Folder that one of these commands wrote.

    Returns:
        Settings and scores.

    Raises:
        InputError: If the folder lacks these, or if a file lacks an entry of
            the tables.
    """
    folder = published(folder)
    try:
        summary = _read(folder)
    except InputError:
        raise
    except Exception as error:
        # Entries may be missing or of any type.
        files = f"{CONFIG}, {run_log.METRICS} or a {SUMMARY}"
        reason = f"{type(error).__name__}: {single_line(error)}"
        raise InputError(
            f"{folder}: {files} is not as `pnb-train` wrote it ({reason}): use another run",
        ) from error
    if summary is None:
        raise InputError(
            f"{folder} holds no finished run: let it finish, or resume it",
        )
    return summary


def _read(folder: Path) -> RunSummary | None:
    """Read a finished run, an evaluation or a published network.

    Args:
        folder: Folder that may hold one of the three.

    Returns:
        The settings and scores. None if the folder holds none of the three.
    """
    whole = folder.absolute()
    # An evaluation and a published network have no settings of a training.
    # The last two parts of the path are the name of the method.
    name = str(Path(*whole.parts[-2:]))
    settings = {"network": str(whole)}
    if is_finished(folder):
        return _read_run(folder)
    if (folder / SUMMARY).is_file():
        scores = {whole.name: PhotographScores.read(read_json(folder / SUMMARY))}
        return RunSummary(whole.parent, name, settings, scores, accuracy=None)
    if (folder / PUBLISHED).is_file():
        values = load_selected(folder)[1].get("scores", {})
        # The other values are single numbers, such as "test/accuracy".
        entries = {key: value for key, value in values.items() if isinstance(value, dict)}
        scores = {key: PhotographScores.read(entry) for key, entry in entries.items()}
        return RunSummary(folder, name, settings, scores, values.get("test/accuracy"))
    return None


def _read_run(folder: Path) -> RunSummary:
    """Read a finished run and, if there is one, the network that it began with.

    Args:
        folder: Folder of the run, with config.yaml and metrics.jsonl.

    Returns:
        The run. Its field `before` has the scores of the initial network.
    """
    # Each line of metrics.jsonl is an epoch. The last line has the final scores.
    *epochs, scores = read_metrics(folder)
    config = read_config(folder / CONFIG)
    before = None
    if "test/accuracy_before" in scores:
        path = folder / BEFORE
        before = RunSummary(
            folder=path,
            method=INITIAL,
            settings={"train.init_from": config.train.init_from},
            photographs=read_summaries(path),
            accuracy=scores["test/accuracy_before"],
        )
    return RunSummary(
        folder=folder,
        method=str(config.augment.mode),
        settings=run_config.decisive_settings(config),
        photographs=read_summaries(folder),
        accuracy=scores["test/accuracy"],
        seed=int(config.seed),
        config=config,
        epochs=epochs,
        scores=scores,
        before=before,
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
    """Find the settings in which runs differ.

    Args:
        runs: Runs that are compared.

    Returns:
        The setting in words by its key, without the method and the seed, which
        tables always show.
    """
    keys = {key for run in runs for key in run.settings} - {"augment.mode", "seed"}
    varied = {}
    for key in sorted(keys):
        if any(run.settings.get(key) != runs[0].settings.get(key) for run in runs):
            words = re.sub(r"^(augment|train|scene|renderer|evaluate)\.|[._]", " ", key)
            varied[key] = words.strip()
    return varied


def group_by_method(runs: Sequence[RunSummary]) -> Methods:
    """Group runs that differ only in the seed.

    Args:
        runs: Runs, which may have begun with other networks.

    Returns:
        Runs by the name of their method. The networks that they began with come
        first, once. A name has the method and the settings in which its groups
        differ, or a number and the method if those are many or long.
    """
    # The key of a group is the text of the settings without the seed.
    groups: dict[str, list[RunSummary]] = {}
    for run in (*_initial_networks(runs), *runs):
        groups.setdefault(repr({**run.settings, "seed": None}), []).append(run)
    heads = [group[0] for group in groups.values()]
    if len(heads) == 2 and heads[0].method == INITIAL and heads[1].method != "none":
        return dict(zip((BEFORE_HARDENING, AFTER_HARDENING), groups.values(), strict=True))
    varied = {}
    for method in {head.method for head in heads}:
        varied[method] = varied_settings([head for head in heads if head.method == method])
    named: dict[str, list[RunSummary]] = {}
    for number, group in enumerate(groups.values(), 1):
        head = group[0]
        parts = [f"{words}={head.settings.get(key)}" for key, words in varied[head.method].items()]
        name = ", ".join([head.method, *parts])
        is_short = len(heads) <= MAX_NAMED and len(name) <= LONGEST_NAME
        if not is_short or name in named:
            name = f"{number}: {head.method}"
        named[name] = group
    return named


def _initial_networks(runs: Sequence[RunSummary]) -> list[RunSummary]:
    """List the networks that runs began with.

    Args:
        runs: Runs, several of which may have begun with the same network.

    Returns:
        The initial networks in the order of the runs. Two initial networks are
        the same if their settings and the images that they were scored on are
        equal. Runs that began with random weights have none.
    """
    networks = {}
    for run in runs:
        if run.before:
            images = [scores.images for scores in run.before.photographs.values()]
            networks[repr((run.before.settings, images))] = run.before
    return [*networks.values()]


def group_by_images(methods: Methods) -> dict[str, Scored]:
    """Group runs by the images that they were scored on.

    Args:
        methods: Runs of each method.

    Returns:
        Scored runs of each method, by a title of the images.
    """
    groups: dict[str, dict[str, list[ScoredRun]]] = {}
    for method, runs in methods.items():
        for run in runs:
            for name, scores in run.photographs.items():
                group = groups.setdefault(scores.images, {})
                group.setdefault(method, []).append(ScoredRun(run, name))
    titled: dict[str, Scored] = {}
    for group in groups.values():
        title = _title_of(group)
        if title in titled:
            title = f"{title} ({len(titled) + 1})"
        titled[title] = group
    return titled


def _title_of(group: Scored) -> str:
    """Name the images that a group of networks was scored on.

    Args:
        group: Scored runs of each method, all on the same images.

    Returns:
        Name of the sub-folder of the scores. The numbers of positive and
        negative images follow if the AUC of the first run records the numbers.
    """
    members = [scored for scored_runs in group.values() for scored in scored_runs]
    # A trained run is preferred, because its settings name the sub-folder.
    # Only a trained run has epochs.
    first = next((scored for scored in members if scored.run.epochs), members[0])
    auc = first.scores.metrics["auc"]
    if not isinstance(auc, AreaUnderCurve):
        return first.name
    labels = first.scores.labels
    title = (
        f"{first.name}: {auc.positives:,} images of {' or '.join(labels)}, "
        f"{auc.negatives:,} images of other objects"
    )
    if len(labels) > 1:
        title += COUNTED_EACH
    if auc.has_repeated_objects:
        title += "; intervals of AUC are over objects and images"
    return title


def run_tables(methods: Methods, groups: Mapping[str, Scored]) -> list[Table]:
    """Make tables of the accuracy, the scores and the settings of runs.

    Args:
        methods: Runs of each method.
        groups: Scored runs by a title of the images, as `group_by_images` groups them.

    Returns:
        Table of the accuracy, a table for each group, and a table of the
        settings in which the methods differ, if there are any. They have a row per
        run and, below several seeds of a method, one with their mean ± standard
        deviation.
    """
    tables = [_accuracy_table(methods)]
    tables += [score_table(title, group) for title, group in groups.items()]
    heads = {method: runs[0] for method, runs in methods.items() if runs[0].seed is not None}
    varied = varied_settings([*heads.values()])
    if varied:
        header = ["network", *varied.values()]
        rows = []
        for method, head in heads.items():
            rows.append([method, *(str(head.settings.get(key)) for key in varied)])
        tables.append(Table("settings in which the methods differ", header, rows))
    return tables


def _accuracy_table(methods: Methods) -> Table:
    """Make the table of the accuracy on the test images.

    Args:
        methods: Runs of each method.

    Returns:
        Table with two columns: the accuracy of the selected epoch, and the
        accuracy of the last epoch. Methods without an accuracy have no row.
    """
    lines: dict[str, list[Line]] = {}
    test_images = []
    for method, runs in methods.items():
        for run in runs:
            test_images.append(run.config.get("test_images", ""))
            if runs[0].accuracy is not None:
                last = run.scores.get("test/accuracy_last")
                line = (run.seed, [Estimate(run.accuracy), Estimate(last)])
                lines.setdefault(method, []).append(line)
    # A dictionary keeps each name once, in order.
    names = dict.fromkeys(name for name in test_images if name)
    title = " or ".join(f"accuracy on {name}" for name in names)
    return _run_table(title, ["test accuracy", "of the last epoch"], lines)


def score_table(title: str, group: Scored) -> Table:
    """Make a table of the metrics of runs on the same images.

    Args:
        title: Title of the table.
        group: Scored runs of each method, as `group_by_images` groups them.

    Returns:
        Table with a row for each run and, with several labels, for each label.
    """
    lines: dict[str, list[Line]] = {}
    for method, scored_runs in group.items():
        for scored in scored_runs:
            parts = {method: scored.scores.metrics}
            for label, metrics in scored.scores.by_label.items():
                parts[f"{method}, {label_title(label)}"] = metrics
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


def seconds_table(methods: Methods) -> Table:
    """Make a table of the seconds of an epoch.

    Args:
        methods: Runs of each method.

    Returns:
        Table with a row for the first run of each method. A cell is a mean over
        the epochs of this run. The columns are all phases together, each phase,
        the time of the classifier within the attack, and the operators, which
        are computed once in a run.
    """
    titles = {phase: phase.replace("_", " and ") for phase in PHASES}
    titles["attack_classifier"] = "attack: in the classifier"
    titles["operators"] = "operators, once"
    rows = []
    for method, (run, *_) in methods.items():
        means = {phase: _mean_seconds(run, phase) for phase in titles}
        if all(mean is None for mean in means.values()):
            continue
        total = sum(means[phase] or 0 for phase in PHASES)
        rows.append([method, *(f"{mean or 0:.2f}" for mean in (total, *means.values()))])
    return Table("seconds per epoch", ["network", "all", *titles.values()], rows)


def _mean_seconds(run: RunSummary, phase: str) -> float | None:
    """Average the seconds of a phase over the epochs of a run.

    Args:
        run: Run with a mapping of metrics for each epoch.
        phase: Name of the phase. The metric "seconds/PHASE" holds its seconds.

    Returns:
        Mean over the epochs that record this phase. None if no epoch does.
    """
    name = f"seconds/{phase}"
    seconds = [line[name] for line in run.epochs if name in line]
    return fmean(seconds) if seconds else None


# A row of a table: the seed of a run, and the metric of each column.
Line = tuple[int | None, Sequence[Estimate | None]]


def _run_table(title: str, header: Sequence[str], lines: Mapping[str, Sequence[Line]]) -> Table:
    """Make a table with a row for each run.

    Args:
        title: Title of the table.
        header: Titles of the columns of metrics.
        lines: For each method, the seed and the metrics of each of its runs.
            The metrics have the order of `header`.

    Returns:
        Table with the columns "network", "seed" and those of `header`. Below
        several seeds of a method, one more row has the mean ± standard
        deviation of each metric.
    """
    rows = []
    for method, runs in lines.items():
        for seed, metrics in runs:
            cells = map(format_interval, metrics)
            rows.append([method, "" if seed is None else str(seed), *cells])
        if len({seed for seed, _ in runs}) > 1:
            # Each entry of `columns` has one metric of all runs.
            columns = zip(*(metrics for _, metrics in runs), strict=True)
            rows.append([method, f"{len(runs)} seeds", *map(_spread, columns)])
    return Table(title, ["network", "seed", *header], rows)


def _spread(metrics: Sequence[Estimate | None]) -> str:
    """Write the mean and the standard deviation of a metric over runs.

    Args:
        metrics: The same metric of each run. None if a run lacks it.

    Returns:
        Text such as "0.912 ± 0.004", or "-" if a run lacks the metric.
    """
    values = [metric.value for metric in metrics if metric is not None and metric.value is not None]
    if len(values) < len(metrics):
        return "-"
    return f"{fmean(values):.3f} ± {stdev(values):.3f}"


class ExampleRow(NamedTuple):
    """Row of a table about an example of an attack.

    Attributes:
        number: Number of the example.
        label: Class of the example, or the classes of its views.
        before: Predicted class of each view before the attack, with its
            probability.
        after: The same after the attack.
        outcome: Success or failure in words, such as "success in 12 steps".
    """

    number: int
    label: str
    before: str
    after: str
    outcome: str


@dataclass(frozen=True)
class AttackSummary:
    """Outcome of an attack, read from its folder.

    Attributes:
        folder: Folder of the attack.
        rows: A row for each attacked example.
        successes: Number of examples that are misclassified after the attack,
            also with a sensor's noise. Attacks of earlier versions counted
            without noise.
        without_noise: The same number for images without noise.
        correct: Number of examples that were classified correctly before the
            attack. Only these examples can be successes.
        checks: Results of `nb.check` by name.
    """

    folder: Path
    rows: Sequence[ExampleRow]
    successes: int
    without_noise: int
    correct: int
    checks: Mapping[str, Any]


def read_attack(folder: Path) -> AttackSummary:
    """Read the folder of an attack.

    Args:
        folder: Folder with attack.jsonl.

    Returns:
        Its examples and the number of successes.

    Raises:
        InputError: If no attack wrote the file.
    """
    path = folder / LINES
    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        # A line describes an example or, with the key "checks", the whole attack.
        examples = [line for line in lines if "example" in line]
        correct = [line for line in examples if not line["success_before"]]
        return AttackSummary(
            folder=folder,
            rows=[_example_row(line) for line in examples],
            successes=sum(bool(line["success"]) for line in correct),
            without_noise=sum(_is_success_without_noise(line) for line in correct),
            correct=len(correct),
            checks=next((dict(line["checks"]) for line in lines if "checks" in line), {}),
        )
    except Exception as error:
        # JSON of any depth and type raises errors of many kinds.
        raise InputError(
            f"{path} is damaged or was written by no attack ({single_line(error)})",
        ) from error


def _is_success_without_noise(line: Mapping[str, Any]) -> bool:
    """Return whether the attack on an example succeeds in images without noise.

    Args:
        line: Line of attack.jsonl. Earlier versions have only the key
            "success", which was measured without noise.
    """
    return bool(line.get("success_without_noise", line["success"]))


def _example_row(line: Mapping[str, Any]) -> ExampleRow:
    """Make the table row of an example from its line in attack.jsonl.

    Args:
        line: Line of the example. "label", "predicted" and "confidence" hold
            a list with one entry for each view.
    """
    return ExampleRow(
        number=int(line["example"]),
        # A class that several views share is named once.
        label=", ".join(dict.fromkeys(map(str, line["label"]))),
        before=_predicted(line["predicted_before"], line["confidence_before"]),
        after=_predicted(line["predicted"], line["confidence"]),
        outcome=_outcome(line),
    )


def _predicted(names: Sequence[str], probabilities: Sequence[float]) -> str:
    """Write the predicted class of each view with its probability.

    Args:
        names: Predicted class of each view.
        probabilities: Probability of this class for each view, in [0, 1].

    Returns:
        Text such as "81.0% orange, 55.3% lemon".
    """
    pairs = zip(names, probabilities, strict=True)
    return ", ".join(f"{probability:.1%} {name}" for name, probability in pairs)


def _outcome(line: Mapping[str, Any]) -> str:
    """Say whether the attack on an example succeeded, and in how many steps.

    Args:
        line: Line of the example in attack.jsonl.

    Returns:
        Text such as "success in 12 steps".
    """
    if line["success_before"]:
        return "wrong before any step"
    success = "no success"
    if line["success"]:
        success = "success"
    elif _is_success_without_noise(line):
        success = "success only without noise"
    return f"{success} in {int(line['steps'])} steps"


class Unfinished(NamedTuple):
    """A run that is not finished, or a folder that cannot be read.

    Attributes:
        folder: Its folder.
        state: Its state in words, or why it cannot be read.
        epochs: Lines of its epochs in metrics.jsonl.
    """

    folder: Path
    state: str
    epochs: Sequence[dict[str, float]]


@dataclass(frozen=True)
class Findings:
    """Runs and attacks that were found in folders.

    Attributes:
        runs: Finished runs and scored networks, ordered by method, so that the
            others are compared with `none`, or with a network that no run
            trained.
        attacks: Attacks.
        unfinished: Other runs.
    """

    runs: list[RunSummary] = field(default_factory=list)
    attacks: list[AttackSummary] = field(default_factory=list)
    unfinished: list[Unfinished] = field(default_factory=list)


def find(folders: Sequence[Path]) -> Findings:
    """Find runs and attacks.

    Args:
        folders: Folders of runs and attacks, or folders that hold them.

    Returns:
        What is in the folders and below them.

    Raises:
        InputError: If the folder is missing, or if nothing is found.
    """
    for folder in folders:
        if not folder.is_dir():
            raise InputError(
                f"runs: {folder} is not a folder: give those of runs, of a sweep or of attacks",
            )
    paths = list(dict.fromkeys(path for folder in folders for path in _walk(folder)))
    if not paths:
        names = ", ".join(map(str, folders))
        raise InputError(f"runs: {names} holds no run and no attack: give other folders")
    found = Findings()
    for path in paths:
        try:
            _add(found, path)
        except (InputError, OSError) as error:
            # The lock in another user's folder raises OSError.
            found.unfinished.append(Unfinished(path, f"cannot be read: {error}", []))
    methods = [*MODES]
    found.runs.sort(key=lambda run: methods.index(run.method) if run.method in methods else -1)
    return found


def _add(found: Findings, path: Path) -> None:
    """Read a folder, and append its content to a list of the findings.

    Args:
        found: Findings, which are changed.
        path: Folder of an attack, a scored network, or a run. A run that is not
            finished goes to `found.unfinished`.
    """
    if (path / LINES).is_file():
        found.attacks.append(read_attack(path))
    elif (path / SUMMARY).is_file() or (path / PUBLISHED).is_file() or is_finished(path):
        found.runs.append(summarize(path))
    else:
        epochs = [line for line in read_metrics(path) if "epoch" in line]
        found.unfinished.append(Unfinished(path, run_lock.state(path), epochs))


def _walk(folder: Path) -> Iterator[Path]:
    """Yield the folders of runs, attacks and evaluations in a folder and below it.

    The sub-folders of a run that hold its own scores are left out, because the
    run is shown with these scores.
    """
    of_run = {run_log.METRICS, run_lock.FAILURE, checkpoint.LAST, checkpoint.BEST}
    of_others = {LINES, SUMMARY, PUBLISHED}
    for root, below, files in os.walk(folder):
        path = Path(root)
        names = set(files)
        below.sort()
        is_run = bool(names & of_run)
        if is_run:
            evaluations = {name for name in below if (path / name / SUMMARY).is_file()}
            # os.walk visits the folders that stay in this list.
            below[:] = [name for name in below if name != BEFORE and name not in evaluations]
        if is_run or names & of_others or names >= {CONFIG, "train.log"}:
            yield path
