"""Finished runs side by side: metrics on photographs by source, and differences with intervals."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Any

import numpy as np

from renderer.errors import InputError
from train.photographs.metrics import (
    METRICS,
    OVERALL,
    Pool,
    compute_metrics,
    find_metric,
    interval,
    metric_title,
    pool_by_source,
    replicate_difference,
    replicate_metrics,
)
from train.photographs.predictions import PREDICTIONS, Prediction, read_predictions
from train.report.summary import RunSummary, arms_of, by_images, pairs_of, run_tables, seconds_table
from train.settings import PHOTOGRAPHS
from train.tables import Table, format_interval


@dataclass(frozen=True)
class Evaluation:
    """A run's predictions and their pools by source; OVERALL, the first, lacks excluded sources."""

    run: RunSummary
    predictions: list[Prediction]
    pools: dict[str, Pool]
    label: str

    @cached_property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """By source, as `compute_metrics` returns them."""
        return {source: compute_metrics(group, self.label) for source, group in self.pools.items()}

    @cached_property
    def replicates(self) -> dict[str, dict[str, np.ndarray]]:
        """By source, as `replicate_metrics` returns them."""
        return {source: replicate_metrics(group, self.label) for source, group in self.pools.items()}


Evaluations = Mapping[str, Sequence[Evaluation]]  # by arm


def read_evaluation(run: RunSummary, photographs: str, exclude: Sequence[str] = ()) -> Evaluation:
    """The evaluation in the sub-folder `photographs` of a run; exclude: sources to leave out of OVERALL.

    InputError as of `read_predictions`, and for a source that does not exist.
    """
    label = run.photographs[photographs]["label"]
    predictions = read_predictions(run.folder / photographs / PREDICTIONS, label)
    pools = pool_by_source(predictions, label, exclude)
    if unknown := set(exclude).difference(pools):
        names = ", ".join(filter(None, pools))
        raise InputError(f"exclude: no photograph is of source {min(unknown)!r}; the sources are {names}")
    return Evaluation(run, predictions, pools, label)


def mean_metric(metrics: Iterable[Mapping[str, Any]]) -> Mapping[str, Any]:
    """A metric of an arm: of one seed with its 95 % interval, of several the mean, the lowest and the highest."""
    known = [metric for metric in metrics if metric.get("value") is not None]
    values = [metric["value"] for metric in known]
    if len(known) < 2:
        return known[0] if known else {}
    return {"value": fmean(values), "low": min(values), "high": max(values)}


def source_table(arms: Evaluations, pooled: str | None = None) -> Table:
    """METRICS by source and arm, as of `mean_metric`. pooled: OVERALL's name; None leaves it out."""
    sources = dict.fromkeys(source for group in arms.values() for run in group for source in run.pools)
    if pooled is None:
        del sources[OVERALL]
    rows: list[list[str]] = []
    for source in sources:
        for arm, group in arms.items():
            results = [run.metrics.get(source, {}) for run in group]
            means = (mean_metric(find_metric(result, name) for result in results) for name in METRICS)
            rows.append([source or str(pooled), arm, *map(format_interval, means)])
    return Table("by source", ["source", "network", *map(metric_title, METRICS)], rows)


def difference(group: Sequence[Evaluation], reference: Sequence[Evaluation], source: str, name: str) -> dict[str, Any]:
    """How far the mean of a metric over a group's seeds is from that over the reference's: value, low and high.

    The interval is a 95 % bootstrap interval over images, of which each replicate has the same ones for all runs, and
    over seeds, which are drawn in pairs if both groups have the same. Few seeds say little about their spread: with n,
    the bootstrap underestimates the variance by 1/n, and with one it finds none. Empty where a run lacks the metric.
    """
    groups = [sorted(runs, key=lambda evaluation: evaluation.run.seed or 0) for runs in (group, reference)]
    if any(name not in evaluation.replicates[source] for runs in groups for evaluation in runs):
        return {}
    values = [fmean(find_metric(run.metrics[source], name)["value"] for run in runs) for runs in groups]
    replicates = [np.stack([run.replicates[source][name] for run in runs]) for runs in groups]
    differences = replicate_difference(replicates[0], replicates[1], paired=_seeds(group) == _seeds(reference))
    return {"value": values[0] - values[1], **interval(differences)}


def _seeds(group: Sequence[Evaluation]) -> list[int]:
    return sorted(evaluation.run.seed or 0 for evaluation in group)


def format_difference(metric: Mapping[str, Any]) -> str:
    """A result of `difference`, with its sign; "-" where it is unknown."""
    return "{value:+.3f} [{low:+.3f}, {high:+.3f}]".format(**metric) if metric else "-"


def read_evaluations(group: Mapping[str, Sequence[tuple[RunSummary, str]]], exclude: Sequence[str] = ()) -> Evaluations:
    """The evaluations of arms on the same images, of `by_images`, where they are more than published scores."""
    arms = {
        arm: [
            read_evaluation(run, name, exclude) for run, name in scored if (run.folder / name / PREDICTIONS).is_file()
        ]
        for arm, scored in group.items()
    }
    return {arm: evaluations for arm, evaluations in arms.items() if evaluations}


def difference_tables(arms: Evaluations, pooled: str, sources: Sequence[str] | None = None) -> list[Table]:
    """A table for each pair of `pairs_of`: the difference by source and metric. pooled: OVERALL's name. sources: None
    for all."""
    tables = []
    for arm, base in pairs_of({arm: [evaluation.run for evaluation in group] for arm, group in arms.items()}):
        group, reference = arms[arm], arms[base]
        rows = [
            [source or pooled, *(format_difference(difference(group, reference, source, name)) for name in METRICS)]
            for source in (reference[0].pools if sources is None else sources)
        ]
        paired = ", paired" if _seeds(group) == _seeds(reference) else ""
        title = f"{arm} minus {base} ({len(group)} and {len(reference)} seeds{paired})"
        tables.append(Table(title, ["source", *map(metric_title, METRICS)], rows))
    return tables


def overall_differences(arms: Evaluations) -> Table:
    """The rows for all images of `difference_tables`."""
    tables = difference_tables(arms, "all", [OVERALL])
    rows = [[table.title, *table.rows[0][1:]] for table in tables]
    return Table("differences on the same images", ["networks", *map(metric_title, METRICS)], rows)


def format_table(runs: Sequence[RunSummary]) -> str:
    """`run_tables` and `overall_differences` by images as Markdown, and the paths of the contact sheets."""
    arms = arms_of(runs)
    tables = run_tables(arms) + [overall_differences(read_evaluations(group)) for group in by_images(arms).values()]
    sheets = [f"image: {run.folder / name / 'contact_sheet.png'}" for run in runs for name in run.photographs]
    return "\n\n".join(filter(None, [*(str(table) for table in tables if table.rows), "\n".join(sheets)]))


def format_comparison(runs: Sequence[RunSummary], exclude: Sequence[str], photographs: str = PHOTOGRAPHS) -> str:
    """Tables of runs as Markdown: accuracy, metrics on photographs by source and their differences, and seconds.

    Runs that differ only in the seed are a group; a table for each group shows how far it is from another (`pairs_of`).
    exclude: sources that the pooled metrics leave out; photographs: the sub-folder of each run with its scores.

    InputError as of `read_evaluation`, for runs whose sub-folders are of different images or classes, and for a
    sub-folder (but the usual one) that no run has.
    """
    arms = arms_of(runs)
    tables = run_tables(arms)
    groups = [
        group
        for group in by_images(arms).values()
        if any(name == photographs or run.seed is None for scored in group.values() for run, name in scored)
    ]
    named = [next(iter(group.values()))[0] for group in groups]
    if len(groups) > 1:
        (other, second), (first, name) = named[1], named[0]
        raise InputError(
            f"{other.folder / second} has other photographs or sources than {first.folder / name}: score both "
            "networks on the same folder with pnb-evaluate"
        )
    if not groups and photographs != PHOTOGRAPHS:
        raise InputError(f"photographs={photographs}: no run has a sub-folder of that name with an evaluation's files")
    for group in groups:
        pooled = f"all but {', '.join(exclude)}" if exclude else "all"
        evaluations = read_evaluations(group, exclude)
        tables += [source_table(evaluations, pooled), *difference_tables(evaluations, pooled)]
    return "\n\n".join(str(table) for table in [*tables, seconds_table(arms)] if table.rows)
