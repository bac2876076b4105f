"""Tables that compare finished runs: metrics on photographs by source, and differences.

Runs that differ only in their seed are the runs of one method. An `Evaluation`
holds the predictions of one run for one folder of photographs. `difference`
compares a metric of two methods, with a 95% interval.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from augment.progress import progress
from augment.settings import MODES
from renderer.errors import InputError
from train.evaluation.scores.metrics import (
    METRICS,
    TOP_RANKS,
    Metrics,
    Pool,
    Pooled,
    estimate,
    metric_title,
    replicate_difference,
)
from train.evaluation.scores.predictions import PREDICTIONS, Prediction, read_predictions
from train.evaluation.scores.scoring import CONTACT_SHEET
from train.evaluation.tables import Estimate, Table, format_interval, fraction
from train.report.summary import (
    INITIAL,
    RunSummary,
    Scored,
    ScoredRun,
    group_by_images,
    group_by_method,
    label_title,
    run_tables,
    seconds_table,
)
from train.settings import PHOTOGRAPHS

# `class_table` has no rows if there are more classes than this.
MAX_CLASSES = 30
# Titles of the columns of metrics.
TITLES = [metric_title(name) for name in METRICS]
# Metrics of the table that is printed without --verbose.
SHORT_METRICS = ("recall", "false_positive_rate", "auc", "class_top1")


@dataclass(frozen=True)
class Part:
    """Part of the images of an evaluation. Tables have a row for each part.

    Attributes:
        by: "all" for the images of all sources that are not excluded.
            Otherwise the property that the images of the part share: "label",
            "source", "mesh" or "class".
        name: Name of the label, source, mesh or class. Empty for all images.
    """

    by: str = "all"
    name: str = ""

    def title(self, overall: str = "all") -> str:
        """Return the title of the row.

        Args:
            overall: Title of the row of all images.

        Returns:
            Title such as "all", "label=orange" or "studio".
        """
        if self == ALL:
            return overall
        if self.by == "label":
            return label_title(self.name)
        return self.name

    @property
    def is_overall(self) -> bool:
        """Whether the part has the images of all sources, for one label or for all labels."""
        return self.by in ("all", "label")


# The images of all sources that are not excluded.
ALL = Part()


@dataclass(frozen=True)
class Evaluation:
    """Predictions of a run for one folder of photographs, pooled by parts of the images.

    Attributes:
        run: Run that made the predictions.
        pools: Pool of each part of the images. `ALL` is the first.
    """

    run: RunSummary
    pools: Mapping[Part, Pool]


# Evaluations by method, in the order of their seeds.
Evaluations = Mapping[str, Sequence[Evaluation]]


def pools_of(pooled: Pooled, *properties: str) -> dict[Part, Pool]:
    """Return the pool of all images, and a pool for each value of some properties.

    Args:
        pooled: Pools of one evaluation.
        *properties: "label", "source", "mesh" or "class", in the order of the
            pools.

    Returns:
        Pools by part. `ALL` is the first.
    """
    pools_of_property = {
        "label": pooled.by_label,
        "source": pooled.by_source,
        "mesh": pooled.by_mesh,
        "class": pooled.by_class,
    }
    pools = {ALL: pooled.all}
    for by in properties:
        for name, pool in pools_of_property[by].items():
            pools[Part(by, name)] = pool
    return pools


def read_evaluations(group: Scored, exclude: Sequence[str] = (), by: str = "source") -> Evaluations:
    """Read the predictions of runs that were scored on the same images.

    Args:
        group: Scored runs of each method, from `group_by_images`.
        exclude: Sources that the pool of all images leaves out.
        by: "source", "mesh" or "class" for a pool of each of them.

    Returns:
        Evaluations by method. Published networks have no predictions and are
        left out.

    Raises:
        InputError: If predictions.csv cannot be read, if a source to exclude
            does not exist, or if `by` is "mesh" and no mesh is known.
    """
    methods: dict[str, list[Evaluation]] = {}
    for method, scored_runs in group.items():
        for scored in sorted(scored_runs, key=lambda item: item.run.seed or 0):
            path = scored.folder / PREDICTIONS
            if not path.is_file():
                continue
            scores = scored.scores
            predictions = read_predictions(path, scores.labels)
            pooled = Pooled(predictions, exclude, scores.thresholds)
            _require_sources(exclude, predictions)
            if by == "mesh" and not pooled.by_mesh:
                raise InputError(f"by=mesh: {path} names no mesh: leave by=mesh out")
            properties = ("label", by) if scores.by_label else (by,)
            pools = pools_of(pooled, *properties)
            methods.setdefault(method, []).append(Evaluation(scored.run, pools))
    return methods


def _require_sources(names: Sequence[str], predictions: Sequence[Prediction]) -> None:
    """Raise InputError if no photograph has a source of one of these names."""
    sources = {item.photograph.source for item in predictions}
    unknown = set(names) - sources
    if unknown:
        known = ", ".join(sorted(filter(None, sources)))
        raise InputError(
            f"exclude: no photograph is of source {min(unknown)!r}; the sources are {known}",
        )


def mean_metric(group: Sequence[Evaluation], part: Part, name: str) -> Estimate | None:
    """Average a metric over the seeds of a method.

    Args:
        group: Evaluations of the method, one for each seed.
        part: Part of the images.
        name: Name in `METRICS`.

    Returns:
        With one seed, the metric and its 95% interval. With several seeds, the
        mean, with the lowest and the highest value as the ends of the interval.
        None if the metric is unknown for every seed.
    """
    known: list[Estimate] = []
    values: list[float] = []
    for evaluation in group:
        pool = evaluation.pools.get(part)
        metric = pool.metrics.find(name) if pool is not None else None
        if metric is not None and metric.value is not None:
            known.append(metric)
            values.append(metric.value)
    if not known:
        return None
    if len(known) == 1:
        return known[0]
    return Estimate(value=fmean(values), low=min(values), high=max(values))


def group_table(methods: Evaluations, overall: str = "all", by: str = "source") -> Table:
    """Make a table of the metrics of each part of the images and each method.

    Args:
        methods: Evaluations of each method.
        overall: Title of the rows of all images.
        by: "source", "mesh" or "class": the title of the first column.

    Returns:
        Table with a row for each part and each method. Cells hold the means
        over the seeds (see `mean_metric`).
    """
    evaluations = [evaluation for group in methods.values() for evaluation in group]
    parts = dict.fromkeys(part for evaluation in evaluations for part in evaluation.pools)
    rows: list[list[str]] = []
    for part in progress(parts, "intervals"):
        for method, group in methods.items():
            cells = [format_interval(mean_metric(group, part, name)) for name in METRICS]
            rows.append([part.title(overall), method, *cells])
    return Table(f"by {by}", [by, "network", *TITLES], rows)


def choose_pairs(methods: Evaluations) -> list[tuple[str, str]]:
    """Choose which methods are compared with which reference.

    Each method is compared with the network that its runs began with, and with
    the first of the methods.

    Args:
        methods: Evaluations of each method. Initial networks count as methods.

    Returns:
        Pairs of a method and its reference.
    """
    first_runs = {method: evaluations[0].run for method, evaluations in methods.items()}
    pairs = []
    for method, run in first_runs.items():
        # A run that began with random weights has no initial network.
        if run.before is None:
            continue
        for reference, reference_run in first_runs.items():
            if reference_run.settings == run.before.settings:
                pairs.append((method, reference))
    trained = [method for method, run in first_runs.items() if run.method != INITIAL]
    return pairs + [(method, trained[0]) for method in trained[1:]]


def class_table(group: Scored) -> Table:
    """Make a table of top-1 and top-5 by class, among all classes of the network.

    Args:
        group: Scored runs of each method, from `group_by_images`.

    Returns:
        Table with a row for each class that the networks have, and each method. It has no rows
        if there is one such class, or if there are more than MAX_CLASSES.
    """
    methods = read_evaluations(group, by="class")
    header = ["class", "images", "network", "top-1", "top-5"]
    rows: list[list[str]] = []
    # Number of images of each class.
    classes: dict[Part, int] = {}
    for evaluations in methods.values():
        for part, pool in evaluations[0].pools.items():
            if part.by == "class" and pool.classified:
                classes[part] = len(pool.classified)
    if 1 < len(classes) <= MAX_CLASSES:
        for part, image_count in classes.items():
            for method, evaluations in methods.items():
                metrics = (mean_metric(evaluations, part, name) for name in TOP_RANKS)
                cells = map(format_interval, metrics)
                rows.append([part.name, str(image_count), method, *cells])
    return Table("by class, among all classes of the network", header, rows)


@dataclass(frozen=True)
class Difference(Estimate):
    """Difference of a metric between two methods, with its 95% interval.

    Attributes:
        before: Mean of the metric over the seeds of the reference.
        after: Mean of the metric over the seeds of the method.
    """

    before: float = 0.0
    after: float = 0.0


def difference(
    group: Sequence[Evaluation],
    reference: Sequence[Evaluation],
    part: Part,
    name: str,
) -> Difference | None:
    """Subtract the mean of a metric over the seeds of a reference from the mean of a method.

    The 95% interval comes from a bootstrap over objects, images and seeds. Each
    replicate draws the same objects and images for all runs. If both methods
    have the same seeds, a seed is drawn for both of them at once. The bootstrap
    over n seeds underestimates the variance between seeds by a factor of
    1 - 1/n. With one seed, this variance is missing altogether.

    Args:
        group: Evaluations of the method, one for each seed.
        reference: Evaluations of the reference, one for each seed.
        part: Part of the images.
        name: Name in `METRICS`.

    Returns:
        Difference of the means. None if the metric of a run has no replicates.
    """
    pools = [evaluation.pools[part] for evaluation in group]
    reference_pools = [evaluation.pools[part] for evaluation in reference]
    if any(name not in pool.replicates for pool in (*pools, *reference_pools)):
        return None
    after = fmean(_known_value(pool.metrics, name) for pool in pools)
    before = fmean(_known_value(pool.metrics, name) for pool in reference_pools)
    replicates = replicate_difference(
        np.stack([pool.replicates[name] for pool in pools]),
        np.stack([pool.replicates[name] for pool in reference_pools]),
        _have_equal_seeds(group, reference),
    )
    change = estimate(after - before, replicates)
    assert change.low is not None and change.high is not None
    margin = 0.0
    if change.low == change.high:
        # All replicates are equal, as if both methods agree on every image. Then
        # the interval has the images that may differ unseen (Wilson 1927).
        image_count = min(len(pools[0].positives), len(pools[0].negatives))
        margin = fraction(0, max(1, image_count)).high or 0.0
    return Difference(
        value=change.value,
        low=max(-1.0, change.low - margin),
        high=min(1.0, change.high + margin),
        before=before,
        after=after,
    )


def _known_value(metrics: Metrics, name: str) -> float:
    """Return the value of a metric that is known, because it has bootstrap replicates."""
    metric = metrics.find(name)
    assert metric is not None and metric.value is not None
    return metric.value


def _have_equal_seeds(group: Sequence[Evaluation], reference: Sequence[Evaluation]) -> bool:
    """Return whether the runs of two methods have the same seeds, in the same order.

    Args:
        group: Evaluations of a method, one for each seed.
        reference: Evaluations of the other method, one for each seed.
    """
    seeds = [evaluation.run.seed or 0 for evaluation in group]
    reference_seeds = [evaluation.run.seed or 0 for evaluation in reference]
    return seeds == reference_seeds


def difference_tables(
    methods: Evaluations,
    overall: str = "all",
    by: str = "source",
    overall_only: bool = False,
) -> list[Table]:
    """Make a table of the differences for each pair of methods that is compared.

    Args:
        methods: Evaluations of each method.
        overall: Title of the row of all images.
        by: "source", "mesh" or "class": the title of the first column.
        overall_only: Whether to leave out the rows of single sources, meshes or classes.

    Returns:
        A table for each pair from `choose_pairs`, with a row for each part of
        the images.
    """
    tables = []
    for method, base in progress(choose_pairs(methods), "differences"):
        group = methods[method]
        reference = methods[base]
        rows = []
        for part in reference[0].pools:
            if overall_only and not part.is_overall:
                continue
            differences = [difference(group, reference, part, name) for name in METRICS]
            cells = [format_interval(item, sign="+") for item in differences]
            rows.append([part.title(overall), *cells])
        paired = ", paired" if _have_equal_seeds(group, reference) else ""
        title = f"{method} minus {base} ({len(group)} and {len(reference)} seeds{paired})"
        tables.append(Table(title, [by, *TITLES], rows))
    return tables


def overall_differences(methods: Evaluations) -> Table:
    """Make one table of the differences on the images of all sources.

    Args:
        methods: Evaluations of each method.

    Returns:
        Table with a row for each pair from `choose_pairs` and, with several
        labels, for each label.
    """
    rows = []
    for table in difference_tables(methods, overall="", overall_only=True):
        for name, *cells in table.rows:
            title = f"{table.title}, {name}" if name else table.title
            rows.append([title, *cells])
    return Table("differences on the same images", ["networks", *TITLES], rows)


def format_table(runs: Sequence[RunSummary]) -> str:
    """Compare runs in the tables that pnb-train prints at its end.

    Args:
        runs: Finished runs.

    Returns:
        Markdown tables of the accuracy, the metrics and their differences, a
        line about the renders of each method, and the paths of the contact
        sheets.
    """
    methods = group_by_method(runs)
    groups = group_by_images(methods)
    tables = run_tables(methods, groups)
    for group in groups.values():
        tables.append(overall_differences(read_evaluations(group)))

    used_modes = {run.method for run in runs}
    captions = [f"{mode}: {caption}" for mode, caption in MODES.items() if mode in used_modes]
    sheets = []
    for run in runs:
        sheets += [f"image: {run.folder / name / CONTACT_SHEET}" for name in run.photographs]
    parts = [_format_tables(tables), "; ".join(captions), "\n".join(sheets)]
    return "\n\n".join(part for part in parts if part)


def _format_tables(tables: Sequence[Table]) -> str:
    """Write tables as Markdown, with an empty line between them.

    Tables without rows and columns without known values are left out.
    """
    return "\n\n".join(str(table.known) for table in tables if table.rows)


def format_comparison(
    runs: Sequence[RunSummary],
    exclude: Sequence[str],
    photographs: str = PHOTOGRAPHS,
    by: str = "source",
) -> str:
    """Compare runs in the tables that pnb-compare prints.

    Args:
        runs: Finished runs and scored networks.
        exclude: Sources that the metrics on all images leave out.
        photographs: Name of the sub-folder of each run with its scores on
            photographs.
        by: "source", "mesh" or "class" for metrics of each of them.

    Returns:
        Markdown tables of the accuracy, the metrics, their differences, and the
        seconds of an epoch.

    Raises:
        InputError: If the runs were scored on different photographs or classes,
            if no run has the sub-folder and its name is not the usual one, or
            if predictions cannot be read (see `read_evaluations`).
    """
    methods = group_by_method(runs)
    groups = group_by_images(methods)
    tables = run_tables(methods, groups)
    overall = _title_of_all(exclude)
    group = _find_group(list(groups.values()), photographs)
    if group is not None:
        evaluations = read_evaluations(group, exclude, by)
        tables.append(group_table(evaluations, overall, by))
        tables += difference_tables(evaluations, overall, by)
    tables.append(seconds_table(methods))
    return _format_tables(tables)


def format_short_comparison(
    runs: Sequence[RunSummary],
    exclude: Sequence[str] = (),
    photographs: str = PHOTOGRAPHS,
    by: str = "source",
) -> str:
    """Compare runs in one table, which pnb-train and pnb-compare print without --verbose.

    Args:
        runs: Finished runs and scored networks.
        exclude: See `format_comparison`.
        photographs: See `format_comparison`. If no run has a sub-folder of the
            usual name, the first scored photographs of the runs are compared.
        by: "source" for the metrics on all images, or "mesh" for the metrics of
            each mesh.

    Returns:
        Markdown table. If `by` is "source", it has a row for each method, with
        means over its runs. The gain in AUC over the first network has a 95%
        interval.

    Raises:
        InputError: See `format_comparison`.
    """
    methods = group_by_method(runs)
    groups = group_by_images(methods)
    group = _find_group(list(groups.values()), photographs)
    if group is None and groups:
        group = next(iter(groups.values()))
    evaluations = read_evaluations(group, exclude, by) if group else {}
    if by != "source" and evaluations:
        return str(group_table(evaluations, _title_of_all(exclude), by).known)
    titles = [title for title, members in groups.items() if members is group]
    rows = []
    for method, members in methods.items():
        scored = group.get(method, ()) if group else ()
        found = evaluations.get(method)
        if found is None and not exclude:
            metrics = [_mean_score(scored, name) for name in SHORT_METRICS]
        else:
            metrics = [mean_metric(found or (), ALL, name) for name in SHORT_METRICS]
        accuracies = [run.accuracy for run in members if run.accuracy is not None]
        accuracy = Estimate(fmean(accuracies)) if accuracies else None
        values = [_format_value(metric) for metric in (accuracy, *metrics)]
        rows.append([method, len(members), *values, _format_gain(evaluations, method)])
    header = ["network", "runs", "test accuracy", *map(metric_title, SHORT_METRICS)]
    return str(Table("".join(titles), [*header, "gain in AUC [95%]"], rows).known)


def _title_of_all(exclude: Sequence[str]) -> str:
    """Return the title of all images: "all", or "all but A, B" if sources are excluded."""
    return f"all but {', '.join(exclude)}" if exclude else "all"


def _mean_score(scored: Sequence[ScoredRun], name: str) -> Estimate | None:
    """Average a metric over the scores of runs, for runs without predictions.csv.

    Args:
        scored: Runs of one method with their scores on the same images.
        name: Name in `METRICS`.

    Returns:
        Mean without an interval. None if no run knows the metric.
    """
    values = []
    for item in scored:
        metric = item.scores.metrics[name]
        if metric is not None and metric.value is not None:
            values.append(metric.value)
    return Estimate(fmean(values)) if values else None


def _format_value(metric: Estimate | None) -> str:
    """Write the value of a metric without its interval, or "-" if it is unknown."""
    return format_interval(None if metric is None else Estimate(metric.value))


def _format_gain(methods: Evaluations, method: str) -> str:
    """Write the AUC of a method minus the AUC of the first method.

    Args:
        methods: Evaluations of each method.
        method: Name of the method.

    Returns:
        The difference with its 95% interval. "-" for the first method itself,
        and for a method without predictions.
    """
    first = next(iter(methods), method)
    if method == first or method not in methods:
        return "-"
    gain = difference(methods[method], methods[first], ALL, "auc")
    return format_interval(gain, sign="+")


def _find_group(groups: Sequence[Scored], photographs: str) -> Scored | None:
    """Find the runs that were scored on the photographs of a given name.

    Args:
        groups: Groups of scored runs. All runs of a group were scored on the
            same images.
        photographs: Name of the sub-folder of each run with the scores.

    Returns:
        The group. None if no run has scores of the usual name `PHOTOGRAPHS`.

    Raises:
        InputError: If several groups have this name, or if no run has scores
            of another name than the usual one.
    """
    found = [group for group in groups if _is_scored_on(group, photographs)]
    if len(found) > 1:
        first, second = (next(iter(group.values()))[0].folder for group in found[:2])
        raise InputError(
            f"{second} has other photographs or sources than {first}: "
            "score both networks on the same folder with pnb-evaluate",
        )
    if not found and photographs != PHOTOGRAPHS:
        raise InputError(
            f"photographs={photographs}: no run has a sub-folder of that name "
            "with the files of an evaluation",
        )
    return found[0] if found else None


def _is_scored_on(group: Scored, photographs: str) -> bool:
    """Return whether a group of scored networks belongs to photographs of a given name.

    The scores of a run lie in a sub-folder that has the name of the
    photographs. A network that is not a run, such as a published network, has
    no seed and no such sub-folder. It belongs to photographs of every name.

    Args:
        group: Scored networks by method.
        photographs: Name of the photographs: the sub-folder with the scores in
            the folder of each run.
    """
    members = [scored for scored_runs in group.values() for scored in scored_runs]
    return any(scored.name == photographs or scored.run.seed is None for scored in members)
