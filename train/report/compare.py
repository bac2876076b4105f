"""Finished runs side by side: accuracy, time, metrics on photographs by source, and differences with intervals."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
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
    pool,
    pool_by_source,
    replicate_difference,
    replicate_metrics,
)
from train.photographs.predictions import PREDICTIONS, Prediction, read_predictions
from train.report.summary import RunSummary, name_among
from train.run_folder import PHASES
from train.settings import PHOTOGRAPHS
from train.tables import Table, format_interval


@dataclass(frozen=True)
class Evaluation:
    """A run's predictions and their pools by source; OVERALL, the last, lacks excluded sources."""

    run: RunSummary
    label: str
    predictions: list[Prediction]
    pools: dict[str, Pool]

    @cached_property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """By source, as `compute_metrics` returns them."""
        return {source: compute_metrics(group, self.label) for source, group in self.pools.items()}

    @cached_property
    def replicates(self) -> dict[str, dict[str, np.ndarray]]:
        """By source, as `replicate_metrics` returns them."""
        return {source: replicate_metrics(group, self.label) for source, group in self.pools.items()}


def read_evaluation(run: RunSummary, photographs: str, label: str, exclude: Sequence[str] = ()) -> Evaluation:
    """The evaluation in the sub-folder `photographs` of a run; exclude: sources to leave out of OVERALL.

    InputError as of `read_predictions`, and for a source that does not exist.
    """
    predictions = read_predictions(run.folder / photographs / PREDICTIONS, label)
    by_source = pool_by_source(predictions, label)
    del by_source[OVERALL]
    if unknown := set(exclude).difference(by_source):
        raise InputError(
            f"exclude: no photograph is of source {min(unknown)!r}; the sources are {', '.join(by_source)}"
        )
    kept = [item for item in predictions if item.photograph.source not in exclude]
    return Evaluation(run, label, predictions, by_source | {OVERALL: pool(kept, label)})


def require_comparable(evaluations: Sequence[Evaluation], photographs: str) -> None:
    """InputError where runs were scored on different photographs."""
    first, *others = evaluations
    for other in others:
        if [item.photograph for item in other.predictions] != [item.photograph for item in first.predictions]:
            raise InputError(
                f"{other.run.folder / photographs} has other photographs or sources than "
                f"{first.run.folder / photographs}: score both networks on the same folder with "
                "scripts/evaluate_photos.py"
            )


def difference(group: Sequence[Evaluation], reference: Sequence[Evaluation], source: str, name: str) -> dict[str, Any]:
    """How far the mean of a metric over a group's seeds is from that over the reference's: value, low and high.

    The interval is a 95 % bootstrap interval over images, of which each replicate has the same ones for all runs, and
    over seeds, which are drawn in pairs if both groups have the same. Few seeds say little about their spread: with n,
    the bootstrap underestimates the variance by 1/n, and with one it finds none. Empty where a run lacks the metric.
    """
    groups = [sorted(runs, key=lambda evaluation: evaluation.run.seed) for runs in (group, reference)]
    if any(name not in evaluation.replicates[source] for runs in groups for evaluation in runs):
        return {}
    values = [np.mean([find_metric(run.metrics[source], name)["value"] for run in runs]) for runs in groups]
    replicates = [np.stack([run.replicates[source][name] for run in runs]) for runs in groups]
    differences = replicate_difference(replicates[0], replicates[1], paired=_have_same_seeds(group, reference))
    return {"value": float(values[0] - values[1]), **interval(differences)}


def _have_same_seeds(group: Sequence[Evaluation], reference: Sequence[Evaluation]) -> bool:
    seeds = [sorted(evaluation.run.seed for evaluation in runs) for runs in (group, reference)]
    return seeds[0] == seeds[1]


def format_difference(metric: Mapping[str, Any]) -> str:
    """A result of `difference`, with its sign; "-" where it is unknown."""
    return "{value:+.3f} [{low:+.3f}, {high:+.3f}]".format(**metric) if metric else "-"


def difference_tables(arms: Mapping[str, Sequence[Evaluation]], pooled: str) -> Iterator[Table]:
    """A table for each other arm: its difference from the first, by source and metric. pooled: OVERALL's name."""
    (first, reference), *others = arms.items()
    for arm, group in others:
        rows = [
            [source or pooled, *(format_difference(difference(group, reference, source, name)) for name in METRICS)]
            for source in reference[0].pools
        ]
        seeds = f"different seeds ({len(group)} and {len(reference)})"
        if _have_same_seeds(group, reference):
            seeds = f"{len(group)} seeds in pairs" if len(group) > 1 else "one seed"
        yield Table(f"{arm} minus {first}, {seeds}", ["source", *map(metric_title, METRICS)], rows)


def format_comparison(runs: Sequence[RunSummary], exclude: Sequence[str], photographs: str = PHOTOGRAPHS) -> str:
    """Tables of runs as Markdown: accuracy, metrics on photographs by source, and seconds per epoch and phase.

    Runs that differ only in the seed are a group; a table for each group shows how far it is from the first one.
    exclude: sources that the pooled metrics leave out; photographs: the sub-folder of each run with its scores.

    InputError as of `read_evaluation` and `require_comparable`, and for a sub-folder (but the usual one) that no run
    has.
    """
    header = ["augment", "seed", "selected on validation", "at epoch", "last epoch"]
    rows = [
        [run.arm, str(run.seed), f"{run.accuracy:.4f}", str(run.scores["test/epoch"]), f"{last:.4f}"]
        for run, last in ((run, run.scores["test/accuracy_last"]) for run in runs)
    ]
    tables = [Table("Accuracy on the test set", header, rows)]
    scored = [run for run in runs if photographs in run.photographs]
    if not scored and photographs != PHOTOGRAPHS:
        raise InputError(f"photographs={photographs}: no run has a sub-folder of that name with an evaluation's files")
    if scored:
        evaluations = [read_evaluation(run, photographs, runs[0].label, exclude) for run in scored]
        require_comparable(evaluations, photographs)
        pooled = f"all but {', '.join(exclude)}" if exclude else "all"
        arms: dict[str, list[Evaluation]] = {}
        for evaluation in evaluations:
            arms.setdefault(name_among(evaluation.run, scored), []).append(evaluation)
        names = [f"{name_among(run, scored)}, seed {run.seed}" for run in scored]
        tables += [*_metric_tables(evaluations, names, pooled), *difference_tables(arms, pooled)]
    header = ["augment", *PHASES, "attack without classifier", "attack / epoch", "operators, once"]
    tables.append(Table("Seconds per epoch", header, [[run.arm, *_seconds(run)] for run in runs]))
    return "\n\n".join(f"### {table.title}\n\n{table}" for table in tables)


def _metric_tables(evaluations: Sequence[Evaluation], names: Sequence[str], pooled: str) -> Iterator[Table]:
    """Each metric by source, a column per run; without the sources that lack it."""
    for metric in METRICS:
        rows = [
            [source or pooled, *(format_interval(find_metric(run.metrics[source], metric)) for run in evaluations)]
            for source in evaluations[0].pools
        ]
        title = f"Photographs: {metric_title(metric)} of {evaluations[0].label}"
        yield Table(title, ["source", *names], [row for row in rows if set(row[1:]) != {"-"}])


def _seconds(run: RunSummary) -> list[str]:
    """Means per epoch, and the fractions of the attack outside the classifier and of the attack in the epoch."""
    seconds = run.seconds
    phases = [f"{seconds[phase]:.2f}" for phase in PHASES]
    if not {"attack_classifier", "operators"} <= seconds.keys() or not seconds["attack"]:
        return [*phases, "-", "-", "-"]
    outside = 1 - seconds["attack_classifier"] / seconds["attack"]
    return [*phases, f"{outside:.1%}", f"{seconds['attack'] / run.epoch_seconds:.1%}", f"{seconds['operators']:.2f}"]
