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
from train.report.summary import RunSummary, arms_of, run_tables, seconds_table
from train.settings import PHOTOGRAPHS
from train.tables import Table, format_interval


@dataclass(frozen=True)
class Evaluation:
    """A run's predictions and their pools by source; OVERALL, the first, lacks excluded sources."""

    run: RunSummary
    predictions: list[Prediction]
    pools: dict[str, Pool]

    @cached_property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """By source, as `compute_metrics` returns them."""
        return {source: compute_metrics(group, self.run.label) for source, group in self.pools.items()}

    @cached_property
    def replicates(self) -> dict[str, dict[str, np.ndarray]]:
        """By source, as `replicate_metrics` returns them."""
        return {source: replicate_metrics(group, self.run.label) for source, group in self.pools.items()}


Evaluations = Mapping[str, Sequence[Evaluation]]  # by arm


def read_evaluation(run: RunSummary, photographs: str, exclude: Sequence[str] = ()) -> Evaluation:
    """The evaluation in the sub-folder `photographs` of a run; exclude: sources to leave out of OVERALL.

    InputError as of `read_predictions`, and for a source that does not exist.
    """
    predictions = read_predictions(run.folder / photographs / PREDICTIONS, run.label)
    pools = pool_by_source(predictions, run.label, exclude)
    if unknown := set(exclude).difference(pools):
        names = ", ".join(filter(None, pools))
        raise InputError(f"exclude: no photograph is of source {min(unknown)!r}; the sources are {names}")
    return Evaluation(run, predictions, pools)


def require_comparable(arms: Evaluations, photographs: str) -> None:
    """InputError where runs were scored on different photographs, or for different classes."""
    first, *others = (evaluation for group in arms.values() for evaluation in group)
    images = [item.photograph for item in first.predictions]
    for other in others:
        if [item.photograph for item in other.predictions] != images or other.run.label != first.run.label:
            raise InputError(
                f"{other.run.folder / photographs} has other photographs or sources than "
                f"{first.run.folder / photographs}: score both on one folder with pnb-evaluate"
            )


def mean_metric(metrics: Iterable[Mapping[str, Any]]) -> Mapping[str, Any]:
    """A metric of an arm: of one seed with its 95 % interval, of several the mean, the lowest and the highest."""
    known = [metric for metric in metrics if metric.get("value") is not None]
    values = [metric["value"] for metric in known]
    if len(known) < 2:
        return known[0] if known else {}
    return {"value": fmean(values), "low": min(values), "high": max(values)}


def source_table(arms: Evaluations, pooled: str) -> Table:
    """METRICS by source and arm, as of `mean_metric`. pooled: OVERALL's name."""
    sources = dict.fromkeys(source for group in arms.values() for run in group for source in run.pools)
    rows: list[list[str]] = []
    for source in sources:
        for arm, group in arms.items():
            results = [run.metrics.get(source, {}) for run in group]
            means = (mean_metric(find_metric(result, name) for result in results) for name in METRICS)
            rows.append([source or pooled, arm, *map(format_interval, means)])
    return Table("by source", ["source", "augment", *map(metric_title, METRICS)], rows)


def difference(group: Sequence[Evaluation], reference: Sequence[Evaluation], source: str, name: str) -> dict[str, Any]:
    """How far the mean of a metric over a group's seeds is from that over the reference's: value, low and high.

    The interval is a 95 % bootstrap interval over images, of which each replicate has the same ones for all runs, and
    over seeds, which are drawn in pairs if both groups have the same. Few seeds say little about their spread: with n,
    the bootstrap underestimates the variance by 1/n, and with one it finds none. Empty where a run lacks the metric.
    """
    groups = [sorted(runs, key=lambda evaluation: evaluation.run.seed) for runs in (group, reference)]
    if any(name not in evaluation.replicates[source] for runs in groups for evaluation in runs):
        return {}
    values = [fmean(find_metric(run.metrics[source], name)["value"] for run in runs) for runs in groups]
    replicates = [np.stack([run.replicates[source][name] for run in runs]) for runs in groups]
    differences = replicate_difference(replicates[0], replicates[1], paired=_seeds(group) == _seeds(reference))
    return {"value": values[0] - values[1], **interval(differences)}


def _seeds(group: Sequence[Evaluation]) -> list[int]:
    return sorted(evaluation.run.seed for evaluation in group)


def format_difference(metric: Mapping[str, Any]) -> str:
    """A result of `difference`, with its sign; "-" where it is unknown."""
    return "{value:+.3f} [{low:+.3f}, {high:+.3f}]".format(**metric) if metric else "-"


def difference_tables(arms: Evaluations, pooled: str) -> list[Table]:
    """A table for each other arm: its difference from the first, by source and metric. pooled: OVERALL's name."""
    (first, reference), *others = arms.items()
    tables = []
    for arm, group in others:
        rows = [
            [source or pooled, *(format_difference(difference(group, reference, source, name)) for name in METRICS)]
            for source in reference[0].pools
        ]
        paired = ", paired" if _seeds(group) == _seeds(reference) else ""
        title = f"{arm} minus {first} ({len(group)} and {len(reference)} seeds{paired})"
        tables.append(Table(title, ["source", *map(metric_title, METRICS)], rows))
    return tables


def format_comparison(runs: Sequence[RunSummary], exclude: Sequence[str], photographs: str = PHOTOGRAPHS) -> str:
    """Tables of runs as Markdown: accuracy, metrics on photographs by source and their differences, and seconds.

    Runs that differ only in the seed are a group; a table for each group shows how far it is from the first one.
    exclude: sources that the pooled metrics leave out; photographs: the sub-folder of each run with its scores.

    InputError as of `read_evaluation` and `require_comparable`, and for a sub-folder (but the usual one) that no run
    has.
    """
    tables, scored = run_tables(arms_of(runs)), [run for run in runs if photographs in run.photographs]
    if scored:
        pooled = f"all but {', '.join(exclude)}" if exclude else "all"
        arms = {
            arm: [read_evaluation(run, photographs, exclude) for run in group] for arm, group in arms_of(scored).items()
        }
        require_comparable(arms, photographs)
        tables += [source_table(arms, pooled), *difference_tables(arms, pooled)]
    elif photographs != PHOTOGRAPHS:
        raise InputError(f"photographs={photographs}: no run has a sub-folder of that name with an evaluation's files")
    return "\n\n".join(map(str, [*tables, seconds_table(arms_of(runs))]))
