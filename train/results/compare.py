"""Comparison of finished training runs: tables of their accuracy, scores and gains.

A method is a way to train a network. Runs that differ only in their seed are
runs of the same method. An `Evaluation` holds the predictions of one run for one
folder of photographs. `difference` compares a metric of two methods, with a 95%
interval.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from statistics import fmean, stdev
from typing import NamedTuple

from train.results import store, tables
from train.results.intervals import Jackknife, change
from train.results.metrics import COUNTED_EACH, METRICS, TITLES, TOP_RANKS, Pool
from train.results.predictions import PREDICTIONS
from train.results.store import INITIAL, Methods, RunSummary, Scored, ScoredRun
from train.results.tables import Estimate, Table, format_interval, table_of
from train.settings import PHOTOGRAPHS, UNLABELED

# Titles of the columns of tables that have a column for each metric in `METRICS`.
HEADER = [TITLES[name] for name in METRICS]
# Metrics in the table that commands print without --verbose.
SHORT_METRICS = ("recall", "false_positive_rate", "auc", "class_top1")


class Subset(NamedTuple):
    """Subset of the images of an evaluation, such as the images of one source.

    Attributes:
        by: Property that the images of the subset have in common: "label",
            "source", "mesh" or "class". "all" for the set of all images.
        name: Value of the property, such as the name of the source. Empty for
            the set of all images.
    """

    by: str = "all"
    name: str = ""

    @property
    def title(self) -> str:
        """Title of the row of this subset in a table."""
        return {"all": "all", "label": f"label={self.name}"}.get(self.by, self.name)


# All images.
ALL = Subset()


class Evaluation(NamedTuple):
    """Predictions of the network of a run for one folder of photographs, in groups."""

    run: RunSummary
    pooled: Pool

    def rows(self, *properties: str) -> list[Subset]:
        """List the rows of a table: all images, several positive classes, and subsets."""
        kinds = ("label", *properties) if len(self.pooled.by_label) > 1 else properties
        return [ALL, *(Subset(by, name) for by in kinds for name in self.pooled.groups(by))]

    def find(self, subset: Subset) -> Pool | None:
        """Predictions for a subset. None if there are none."""
        return self.pooled.groups(subset.by).get(subset.name)


# Evaluations of the runs of each method, in the order of their seeds.
Evaluations = Mapping[str, Sequence[Evaluation]]


def group_by_images(methods: Methods) -> dict[str, Scored]:
    """Group runs by the images on which they were scored, and write a title for each group."""
    groups: dict[str, dict[str, list[ScoredRun]]] = {}
    for method, runs in methods.items():
        for run in runs:
            for name, scores in run.photographs.items():
                # `scores.images` is the hash of the images, which is the same wherever they lie.
                group = groups.setdefault(scores.images, {})
                group.setdefault(method, []).append(ScoredRun(run, name))
    titled: dict[str, Scored] = {}
    for group in groups.values():
        members = [scored for scored_runs in group.values() for scored in scored_runs]
        # The name of the sub-folder comes from a training run if there is one, because the user
        # has chosen this name. Only a training run has epochs.
        first = next((scored for scored in members if scored.run.epochs), members[0])
        title = first.name
        auc = first.scores.overall.auc
        labels = first.scores.labels
        if auc.positives + auc.negatives:
            title += f": {auc.positives:,} images of {' or '.join(labels)}, "
            title += f"{auc.negatives:,} images of other objects"
            title += COUNTED_EACH if len(labels) > 1 else ""
            title += f"; {tables.describe_intervals([auc])}" if auc.low is not None else ""
        # Two groups can have the same folder name and the same numbers.
        if title in titled:
            title = f"{title} ({len(titled) + 1})"
        titled[title] = group
    return titled


def read_evaluations(group: Scored) -> Evaluations:
    """Read the predictions of runs that were scored on the same images.

    A published network has no file of predictions, and is left out.
    """
    methods: dict[str, list[Evaluation]] = {}
    for method, scored_runs in group.items():
        for scored in sorted(scored_runs, key=lambda item: item.run.seed or 0):
            if (scored.folder / PREDICTIONS).is_file():
                methods.setdefault(method, []).append(Evaluation(scored.run, scored.pooled()))
    return methods


def mean_metric(evaluations: Sequence[Evaluation], subset: Subset, name: str) -> Estimate | None:
    """Average a metric over the seeds of a method.

    The interval is that of the only seed, or goes from the lowest to the highest of several. None
    if no seed has the metric.
    """
    pools = [evaluation.find(subset) for evaluation in evaluations]
    return _mean([pool.metrics.find(name) for pool in pools if pool is not None])


def _mean(estimates: Iterable[Estimate | None]) -> Estimate | None:
    """Return the mean of the known values, with the lowest and highest of several as interval."""
    known = [item for item in estimates if item is not None and item.value is not None]
    if len(known) < 2:
        return known[0] if known else None
    values = [item.value for item in known if item.value is not None]
    over = f"{tables.RANGE} of {len(values)} seeds"
    return Estimate(fmean(values), min(values), max(values), over)


def group_table(methods: Evaluations, by: str) -> Table:
    """Make a table of the metrics, means over seeds, of each method on each subset of images."""
    every_evaluation = [item for evaluations in methods.values() for item in evaluations]
    # A dictionary has each subset once, in order.
    subsets = dict.fromkeys(subset for item in every_evaluation for subset in item.rows(by))
    rows = [
        [subset.title, method, *(mean_metric(items, subset, name) for name in METRICS)]
        for subset in subsets
        for method, items in methods.items()
    ]
    return table_of(f"by {by}, ", [by, "network", *HEADER], rows)


def choose_pairs(methods: Evaluations) -> list[tuple[str, str]]:
    """Choose which methods are compared.

    Each method is compared with its initial network, the network with whose weights its runs began.
    It is also compared with the first method. A pair is a method and its reference.
    """
    first_runs = {method: evaluations[0].run for method, evaluations in methods.items()}
    # The initial network is the method whose settings name the same network.
    pairs = [
        (method, reference)
        for method, run in first_runs.items()
        for reference, reference_run in first_runs.items()
        if run.before is not None and reference_run.settings == run.before.settings
    ]
    trained = [method for method, run in first_runs.items() if run.mode != INITIAL]
    return pairs + [(method, trained[0]) for method in trained[1:]]


@dataclass(frozen=True)
class Difference(Estimate):
    """Difference of a metric between a method and a reference, with its 95% interval.

    Attributes:
        before: Mean of the metric over the seeds of the reference.
        after: Mean of the metric over the seeds of the method.
    """

    value: float = 0.0
    low: float = 0.0
    high: float = 0.0
    before: float = 0.0
    after: float = 0.0

    @property
    def direction(self) -> int:
        """Sign of the difference, or 0 if its 95% interval contains 0."""
        return int(self.low > 0) - int(self.high < 0)


def difference(
    evaluations: Sequence[Evaluation], reference: Sequence[Evaluation], subset: Subset, name: str
) -> Difference | None:
    """Compare a metric of a method with that of a reference: mean minus mean over the seeds.

    The 95% interval is paired: both methods are measured without the same objects. With several
    seeds, it is also over seeds. With one seed, it says nothing about other seeds. The value is
    `evaluations` minus `reference`. None if a run has no such metric, or has it for other images.
    """
    if name in TOP_RANKS:
        # The accuracies of networks with different classes can be of different images.
        pools = [pool for item in (*evaluations, *reference) if (pool := item.find(subset))]
        if len({tuple(item.path for item in pool.classified.photograph) for pool in pools}) > 1:
            return None
    after = _jackknives(evaluations, subset, name)
    before = _jackknives(reference, subset, name)
    # A run whose metric is unknown has no jackknife.
    if len(after) < len(evaluations) or len(before) < len(reference):
        return None
    gain = change(after, before, _seeds(evaluations) == _seeds(reference))
    was, is_now = (fmean(run.value for run in runs) for runs in (before, after))
    return Difference(**asdict(gain), before=was, after=is_now)


def _jackknives(evaluations: Sequence[Evaluation], subset: Subset, name: str) -> list[Jackknife]:
    """Collect the values of a metric without each unit, from the runs in which it is known."""
    pools = [evaluation.find(subset) for evaluation in evaluations]
    return [pool.jackknives[name] for pool in pools if pool and name in pool.jackknives]


def _seeds(evaluations: Sequence[Evaluation]) -> list[int]:
    """List the seeds of the runs of a method."""
    return [item.run.seed or 0 for item in evaluations]


def difference_table(methods: Evaluations, *properties: str) -> Table:
    """Make a table of the differences of the metrics for each pair of methods.

    The rows are all images, those of each positive class, and subsets by other properties.
    """
    rows = []
    for method, base in choose_pairs(methods):
        evaluations, reference = methods[method], methods[base]
        # Runs with the same seeds are compared in pairs.
        paired = ", paired" if _seeds(evaluations) == _seeds(reference) else ""
        counts = f"{len(evaluations)} and {len(reference)} seeds{paired}"
        for subset in reference[0].rows(*properties):
            differences = [difference(evaluations, reference, subset, name) for name in METRICS]
            rows.append([f"{method} minus {base} ({counts})", subset.title, *differences])
    with_sign = partial(format_interval, sign="+")
    header = ["networks", "images", *HEADER]
    return table_of("differences on the same images, ", header, rows, with_sign)


def run_tables(methods: Methods) -> list[Table]:
    """Make tables of the accuracy and the settings of runs."""
    title_of_accuracies, methods = _accuracies(methods)
    every_run = [run for runs in methods.values() for run in runs]
    lines: dict[str, list[Line]] = {
        method: [(run.seed, [Estimate(run.accuracy)]) for run in runs]
        for method, runs in methods.items()
        if runs[0].accuracy is not None
    }
    # A dictionary has each name once, in the order of the runs.
    names = dict.fromkeys(run.config.get("test_images", "") for run in every_run)
    title = " or ".join(f"accuracy on {name}" for name in names if name)
    accuracies = _run_table(title, [title_of_accuracies], lines)
    # The first run of each method. Networks without a run have no settings of a training.
    heads = {method: runs[0] for method, runs in methods.items() if runs[0].seed is not None}
    # Titles of the settings in which the runs differ, by their keys.
    varied = store.varied_settings([*heads.values()])
    rows = []
    for method, head in heads.items() if varied else ():
        rows.append([method, *(str(head.settings.get(key)) for key in varied)])
    header = ["network", *varied.values()]
    return [accuracies, Table("settings in which the methods differ", header, rows)]


def _accuracies(methods: Methods) -> tuple[str, Methods]:
    """Return the title of the column of accuracies on test images, and runs that have only these.

    Images without labels are labeled with the predictions of the network before the training.
    Their runs lose the accuracy beside runs of images with labels.
    """

    def images(run: RunSummary) -> str | None:
        return run.config.get("data", {}).get("name")

    if {images(run) for runs in methods.values() for run in runs if run.config} == {UNLABELED}:
        return "agreement with the original", methods
    return "test accuracy", {
        method: [replace(run, accuracy=None) if images(run) == UNLABELED else run for run in runs]
        for method, runs in methods.items()
    }


def score_table(title: str, group: Scored) -> Table:
    """Make a table of the metrics of runs on the same images."""
    lines: dict[str, list[Line]] = {}
    points = set()
    for method, scored_runs in group.items():
        # How the threshold was chosen, in words. Empty without a threshold.
        points |= {scored.scores.operating_point for scored in scored_runs}
        lines[method] = [
            (scored.run.seed, [*map(scored.scores.overall.find, METRICS)]) for scored in scored_runs
        ]
    chosen = " or ".join(sorted(points - {""}))
    if chosen:
        title += f"; threshold for {chosen}"
    return _run_table(title, HEADER, lines)


# A row of a table: the seed of a run, and the metric of each column.
Line = tuple[int | None, Sequence[Estimate | None]]


def _run_table(title: str, header: Sequence[str], lines: Mapping[str, Sequence[Line]]) -> Table:
    """Make a table with a row for each run.

    A line is a seed and the metrics in the order of `header`. Several seeds get a row of their mean
    ± standard deviation, or "-" if a value is unknown.
    """
    rows = []
    for method, runs in lines.items():
        for seed, metrics in runs:
            rows.append([method, "" if seed is None else str(seed), *map(format_interval, metrics)])
        if len({seed for seed, _ in runs}) > 1:
            spreads = []
            # A column has the values of one metric in all runs of the method.
            for column in zip(*(metrics for _, metrics in runs), strict=True):
                values = [item.value for item in column if item and item.value is not None]
                is_known = len(values) == len(runs)
                spreads.append(f"{fmean(values):.3f} ± {stdev(values):.3f}" if is_known else "-")
            rows.append([method, f"{len(runs)} seeds", *spreads])
    return Table(title, ["network", "seed", *header], rows)


def format_comparison(runs: Sequence[RunSummary], by: str = "source") -> str:
    """Compare runs in the tables that pnb-train and pnb-compare print with --verbose."""
    methods = store.group_by_method(runs)
    shown = run_tables(methods)
    for title, group in group_by_images(methods).items():
        shown.append(score_table(title, group))
        evaluations = read_evaluations(group)
        for table in (group_table(evaluations, by), difference_table(evaluations, by)):
            shown.append(replace(table, title=f"{title.partition(':')[0]}: {table.title}"))
    return "\n\n".join(str(table.without_unknown_columns) for table in shown if table.rows)


def format_short_comparison(runs: Sequence[RunSummary], by: str = "source") -> str:
    """Compare runs in one table, which pnb-train and pnb-compare print without --verbose.

    It is about the images on which most methods were scored, and of several such images, about
    the usual sub-folder "photographs" of the runs. The gain in AUC is over the first method.
    """
    methods = store.group_by_method(runs)
    groups = group_by_images(methods)
    # Titles of the groups begin with the sub-folder of the scored images.
    title = max(groups, key=lambda one: (len(groups[one]), one.startswith(PHOTOGRAPHS)), default="")
    group = groups.get(title, {})
    evaluations = read_evaluations(group)
    if by != "source" and evaluations:
        return str(group_table(evaluations, by).without_unknown_columns)
    first = next(iter(evaluations), None)
    rows = []
    title_of_accuracies, with_accuracies = _accuracies(methods)
    for method, runs_of_method in with_accuracies.items():
        shown = [_mean(Estimate(run.accuracy) for run in runs_of_method)]
        of_method = [item.scores.overall for item in group.get(method, ())]
        shown += [_mean(metrics.find(name) for metrics in of_method) for name in SHORT_METRICS]
        gain = None
        if first is not None and method in evaluations and method != first:
            gain = difference(evaluations[method], evaluations[first], ALL, "auc")
        # The short table has no intervals, except for the gain.
        values = [format_interval(item and Estimate(item.value)) for item in shown]
        count = str(len(runs_of_method))
        if 0 < len(of_method) < len(runs_of_method):
            count = f"{len(of_method)} scored of {count}"
        rows.append([method, count, *values, format_interval(gain, sign="+")])
    titles = [TITLES[name] for name in SHORT_METRICS]
    header = ["network", "runs", title_of_accuracies, *titles, "gain in AUC [95%]"]
    return str(Table(title, header, rows).without_unknown_columns)
