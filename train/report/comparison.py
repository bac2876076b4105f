"""Finished runs side by side: metrics on photographs by source, and differences with intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from augment.progress import progress
from augment.settings import ARMS
from renderer.errors import InputError
from train.evaluation.scores.metrics import METRICS, Metrics, Pool, Pooled, estimate, metric_title, replicate_difference
from train.evaluation.scores.predictions import PREDICTIONS, Prediction, read_predictions
from train.evaluation.scores.scoring import CONTACT_SHEET
from train.evaluation.tables import Estimate, Table, format_interval
from train.report.summary import (
    INITIAL,
    RunSummary,
    Scored,
    arms_of,
    by_images,
    label_title,
    run_tables,
    seconds_table,
)
from train.settings import PHOTOGRAPHS

TITLES = [metric_title(name) for name in METRICS]


@dataclass(frozen=True)
class Part:
    """A part of the images of an evaluation, to which a row of a table belongs.

    Attributes:
        by: "all" for the images of all sources that are not excluded, or the
            property that they share: "label", "source" or "mesh".
        name: Name of the label, the source or the mesh. Empty for all images.
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
        return label_title(self.name) if self.by == "label" else self.name

    @property
    def is_overall(self) -> bool:
        """Whether the part has the images of all sources, about one label or all."""
        return self.by in ("all", "label")


ALL = Part()


@dataclass(frozen=True)
class Evaluation:
    """A run with the pools of its predictions on one folder of photographs.

    Attributes:
        run: Run that made the predictions.
        pools: Pool of each part of the images. `ALL` is the first.
    """

    run: RunSummary
    pools: Mapping[Part, Pool]


# The evaluations of each arm, in the order of their seeds.
Evaluations = Mapping[str, Sequence[Evaluation]]


def pools_of(pooled: Pooled, *properties: str) -> dict[Part, Pool]:
    """Return the pools of all images and of parts of them.

    Args:
        pooled: Predictions of one evaluation.
        *properties: "label", "source" or "mesh", in the order of the pools.

    Returns:
        Pools by part. `ALL` is the first.
    """
    groups = {"label": "by_label", "source": "by_source", "mesh": "by_mesh"}
    pools = {ALL: pooled.all}
    for by in properties:
        for name, pool in getattr(pooled, groups[by]).items():
            pools[Part(by, name)] = pool
    return pools


def read_evaluations(group: Scored, exclude: Sequence[str] = (), by: str = "source") -> Evaluations:
    """Read the predictions of runs that were scored on the same images.

    Args:
        group: Scored runs of each arm, as `by_images` groups them.
        exclude: Sources that the pool of all images leaves out.
        by: "source" or "mesh", of which each has a pool.

    Returns:
        Evaluations of each arm. Runs with published scores alone are left out.

    Raises:
        InputError: As of `read_predictions`, for a source to exclude that does
            not exist, and for meshes if none is known.
    """
    arms: dict[str, list[Evaluation]] = {}
    for arm, scored_runs in group.items():
        for scored in sorted(scored_runs, key=lambda item: item.run.seed or 0):
            path = scored.folder / PREDICTIONS
            if not path.is_file():
                continue
            scores = scored.scores
            predictions = read_predictions(path, scores.labels)
            pooled = Pooled(predictions, exclude, scores.thresholds)
            if by == "mesh" and not pooled.by_mesh:
                raise InputError(f"by=mesh: {path} names no mesh: leave it out")
            properties = ("label", by) if scores.by_label else (by,)
            pools = pools_of(pooled, *properties)
            arms.setdefault(arm, []).append(Evaluation(scored.run, pools))
            _require_sources(exclude, predictions)
    return arms


def _require_sources(names: Sequence[str], predictions: Sequence[Prediction]) -> None:
    """Raise InputError for the name of a source that no photograph has."""
    sources = {item.photograph.source for item in predictions}
    unknown = set(names) - sources
    if unknown:
        known = ", ".join(sorted(filter(None, sources)))
        problem = f"exclude: no photograph is of source {min(unknown)!r}"
        raise InputError(f"{problem}; the sources are {known}")


def mean_metric(group: Sequence[Evaluation], part: Part, name: str) -> Estimate | None:
    """Average a metric over the seeds of an arm.

    Args:
        group: Evaluations of the seeds.
        part: Part of the images.
        name: Name in `METRICS`.

    Returns:
        Metric of one seed with its 95% interval, or the mean of several with
        the lowest and the highest in place of the interval. None if no seed has
        it.
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


def group_table(arms: Evaluations, overall: str = "all", by: str = "source") -> Table:
    """Make a table of the metrics of each part of the images and each arm.

    Args:
        arms: Evaluations of each arm.
        overall: Title of the rows of all images.
        by: "source" or "mesh", the title of the first column.

    Returns:
        Table of the metrics as `mean_metric` averages them.
    """
    evaluations = [evaluation for group in arms.values() for evaluation in group]
    parts = dict.fromkeys(part for evaluation in evaluations for part in evaluation.pools)
    rows: list[list[str]] = []
    for part in progress(parts, "intervals"):
        for arm, group in arms.items():
            cells = [format_interval(mean_metric(group, part, name)) for name in METRICS]
            rows.append([part.title(overall), arm, *cells])
    return Table(f"by {by}", [by, "network", *TITLES], rows)


def pairs_of(arms: Evaluations) -> list[tuple[str, str]]:
    """Which arms to compare: each with the network that it began with, and with the first arm beside those networks."""
    heads = {arm: group[0].run for arm, group in arms.items()}
    given = [arm for arm, run in heads.items() if run.arm != INITIAL]
    starts = {arm: run.before.settings for arm, run in heads.items() if run.before}
    pairs = [(arm, base) for arm, start in starts.items() for base in arms if heads[base].settings == start]
    return pairs + [(arm, given[0]) for arm in given[1:]]


@dataclass(frozen=True)
class Difference(Estimate):
    """Difference of a metric between two arms, with its 95% interval.

    Attributes:
        before: Mean of the metric over the seeds of the reference.
        after: Mean of the metric over the seeds of the arm.
    """

    before: float = 0.0
    after: float = 0.0


def difference(
    group: Sequence[Evaluation], reference: Sequence[Evaluation], part: Part, name: str
) -> Difference | None:
    """Compute how far the mean of a metric over seeds is from that of a reference.

    The interval is a 95% bootstrap interval over objects and images, the same
    ones for all runs, and over seeds, which are drawn in pairs if both arms
    have the same. Few seeds say little about their spread: with n, the
    bootstrap underestimates the variance by 1/n, and with one it finds none.

    Args:
        group: Evaluations of the seeds of an arm.
        reference: Evaluations of the seeds of the arm that it is compared with.
        part: Part of the images.
        name: Name in `METRICS`.

    Returns:
        Difference of the means. None if a run lacks the metric.
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
        _paired(group, reference),
    )
    ends = estimate(after - before, replicates)
    return Difference(value=ends.value, low=ends.low, high=ends.high, before=before, after=after)


def _known_value(metrics: Metrics, name: str) -> float:
    """Return the value of a metric that is known, as all metrics with replicates are."""
    metric = metrics.find(name)
    assert metric is not None and metric.value is not None
    return metric.value


def _paired(group: Sequence[Evaluation], reference: Sequence[Evaluation]) -> bool:
    """Return whether both arms have the same seeds."""
    seeds = [evaluation.run.seed or 0 for evaluation in group]
    return seeds == [evaluation.run.seed or 0 for evaluation in reference]


def difference_tables(
    arms: Evaluations, overall: str = "all", by: str = "source", overall_only: bool = False
) -> list[Table]:
    """Make a table of the differences between each two arms that are compared.

    Args:
        arms: Evaluations of each arm.
        overall: Title of the row of all images.
        by: "source" or "mesh", the title of the first column.
        overall_only: Whether to leave out single sources or meshes.

    Returns:
        A table for each of `pairs_of`, with a row for each part of the images.
    """
    tables = []
    for arm, base in progress(pairs_of(arms), "differences"):
        group = arms[arm]
        reference = arms[base]
        rows = []
        for part in reference[0].pools:
            if overall_only and not part.is_overall:
                continue
            differences = [difference(group, reference, part, name) for name in METRICS]
            cells = [format_interval(item, sign="+") for item in differences]
            rows.append([part.title(overall), *cells])
        paired = ", paired" if _paired(group, reference) else ""
        title = f"{arm} minus {base} ({len(group)} and {len(reference)} seeds{paired})"
        tables.append(Table(title, [by, *TITLES], rows))
    return tables


def overall_differences(arms: Evaluations) -> Table:
    """Make one table of the differences over all images.

    Args:
        arms: Evaluations of each arm.

    Returns:
        Table with a row for each of `pairs_of` and, with several labels, for
        each label.
    """
    rows = []
    for table in difference_tables(arms, overall="", overall_only=True):
        for name, *cells in table.rows:
            title = f"{table.title}, {name}" if name else table.title
            rows.append([title, *cells])
    return Table("differences on the same images", ["networks", *TITLES], rows)


def format_table(runs: Sequence[RunSummary]) -> str:
    """`run_tables` and `overall_differences` by images as Markdown, and the paths of the contact sheets."""
    arms = arms_of(runs)
    groups = by_images(arms)
    tables = run_tables(arms, groups) + [overall_differences(read_evaluations(group)) for group in groups.values()]
    sheets = [f"image: {run.folder / name / CONTACT_SHEET}" for run in runs for name in run.photographs]
    legend = "; ".join(f"{arm}: {renders}" for arm, renders in ARMS.items() if arm in {run.arm for run in runs})
    return "\n\n".join(filter(None, [*(str(table.known) for table in tables if table.rows), legend, "\n".join(sheets)]))


def format_comparison(
    runs: Sequence[RunSummary],
    exclude: Sequence[str],
    photographs: str = PHOTOGRAPHS,
    by: str = "source",
) -> str:
    """Tables of runs as Markdown: accuracy, metrics on photographs by source or mesh, differences, and seconds.

    Runs that differ only in the seed are a group; a table for each group shows how far it is from another (`pairs_of`).
    exclude: sources that the pooled metrics leave out; photographs: the sub-folder of each run with its scores.

    InputError as of `read_evaluations`, for runs whose sub-folders are of different images or classes, and for a
    sub-folder (but the usual one) that no run has.
    """
    arms = arms_of(runs)
    groups = by_images(arms)
    tables = run_tables(arms, groups)
    compared = [
        group
        for group in groups.values()
        if any(
            scored.name == photographs or scored.run.seed is None
            for scored_runs in group.values()
            for scored in scored_runs
        )
    ]
    folders = [next(iter(group.values()))[0].folder for group in compared]
    if len(folders) > 1:
        advice = "score both networks on the same folder with pnb-evaluate"
        raise InputError(f"{folders[1]} has other photographs or sources than {folders[0]}: {advice}")
    if not folders and photographs != PHOTOGRAPHS:
        raise InputError(f"photographs={photographs}: no run has a sub-folder of that name with an evaluation's files")
    for group in compared:
        overall = f"all but {', '.join(exclude)}" if exclude else "all"
        evaluations = read_evaluations(group, exclude, by)
        tables.append(group_table(evaluations, overall, by))
        tables += difference_tables(evaluations, overall, by)
    return "\n\n".join(str(table.known) for table in [*tables, seconds_table(arms)] if table.rows)
