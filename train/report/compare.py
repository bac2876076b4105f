"""Finished runs side by side: metrics on photographs by source, and differences with intervals."""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np

from augment.progress import progress
from augment.service import ARMS
from renderer.errors import InputError
from train.photographs import metrics
from train.photographs.metrics import LABEL, METRICS, OVERALL, Pool, find_metric, metric_title
from train.photographs.predictions import PREDICTIONS, read_predictions
from train.report.summary import INITIAL, RunSummary, Scored, arms_of, by_images, run_tables, seconds_table
from train.settings import PHOTOGRAPHS
from train.tables import Table, format_interval

TITLES = [metric_title(name) for name in METRICS]


class Evaluation(NamedTuple):
    """Pools of a run's predictions by source or mesh, after that of each of several labels (LABEL with its name);
    OVERALL, the first, and these lack excluded sources."""

    run: RunSummary
    pools: dict[str, Pool]


Evaluations = Mapping[str, Sequence[Evaluation]]  # by arm, in the order of their seeds


def read_evaluations(group: Scored, exclude: Sequence[str] = (), by: str = "source") -> Evaluations:
    """The evaluations of arms on the same images, of `by_images`, where they are more than published scores.

    exclude: sources to leave out of OVERALL. by: source or mesh. InputError as of `read_predictions`, for a source that
    does not exist, and for meshes where none is known.
    """
    arms: dict[str, list[Evaluation]] = {}
    for arm, scored in group.items():
        for run, name in sorted(scored, key=lambda pair: pair[0].seed or 0):
            path, scores = run.folder / name / PREDICTIONS, run.photographs[name]
            if path.is_file():
                predictions = read_predictions(path, scores["label"])
                chosen = exclude, scores.get("thresholds")
                pools = metrics.pool_by(predictions, by, *chosen)
                if by == "mesh" and len(pools) == 1:
                    raise InputError(f"by=mesh: {path} names no mesh: leave it out")
                if "by_label" in scores:
                    labels = metrics.pool_by(predictions, "label", *chosen)
                    named = {f"{LABEL}{label}": labels[label] for label in labels if label != OVERALL}
                    pools = {OVERALL: pools.pop(OVERALL), **named, **pools}
                arms.setdefault(arm, []).append(Evaluation(run, pools))
                sources = {item.photograph.source for item in predictions} - {None}
                if unknown := set(exclude) - sources:
                    names = ", ".join(sorted(filter(None, sources)))
                    raise InputError(f"exclude: no photograph is of source {min(unknown)!r}; the sources are {names}")
    return arms


def mean_metric(group: Sequence[Evaluation], source: str, name: str) -> Mapping[str, Any]:
    """A metric of an arm: of one seed with its 95 % interval, of several the mean, the lowest and the highest."""
    results = [find_metric(run.pools[source].metrics, name) for run in group if source in run.pools]
    known = [metric for metric in results if metric.get("value") is not None]
    values = [metric["value"] for metric in known]
    if len(known) < 2:
        return known[0] if known else {}
    return {"value": fmean(values), "low": min(values), "high": max(values)}


def group_table(arms: Evaluations, pooled: str = "all", by: str = "source") -> Table:
    """METRICS by source or mesh and arm, as of `mean_metric`. pooled: OVERALL's name."""
    sources = dict.fromkeys(source for group in arms.values() for run in group for source in run.pools)
    rows: list[list[str]] = []
    for source in progress(sources, "intervals"):
        for arm, group in arms.items():
            means = (format_interval(mean_metric(group, source, name)) for name in METRICS)
            rows.append([source or pooled, arm, *means])
    return Table(f"by {by}", [by, "network", *TITLES], rows)


def pairs_of(arms: Evaluations) -> list[tuple[str, str]]:
    """Which arms to compare: each with the network that it began with, and with the first arm beside those networks."""
    heads = {arm: group[0].run for arm, group in arms.items()}
    given = [arm for arm, run in heads.items() if run.arm != INITIAL]
    starts = {arm: run.before.settings for arm, run in heads.items() if run.before}
    pairs = [(arm, base) for arm, start in starts.items() for base in arms if heads[base].settings == start]
    return pairs + [(arm, given[0]) for arm in given[1:]]


def difference(group: Sequence[Evaluation], reference: Sequence[Evaluation], source: str, name: str) -> dict[str, Any]:
    """How far the mean of a metric over a group's seeds is from that over the reference's: value, low, high, means.

    The interval is a 95 % bootstrap interval over objects and images, the same ones for all runs, and over seeds,
    which are drawn in pairs if both groups have the same. Few seeds say little about their spread: with n, the
    bootstrap underestimates the variance by 1/n, and with one it finds none. Empty where a run lacks the metric.
    """
    pools = [[evaluation.pools[source] for evaluation in evaluations] for evaluations in (group, reference)]
    if any(name not in pool.replicates for pool in (*pools[0], *pools[1])):
        return {}
    value, base = (fmean(find_metric(pool.metrics, name)["value"] for pool in seeds) for seeds in pools)
    one, other = (np.stack([pool.replicates[name] for pool in seeds]) for seeds in pools)
    replicates = metrics.replicate_difference(one, other, _paired(group, reference))
    return {"value": value - base, "means": (base, value), **metrics.interval(replicates)}


def _paired(group: Sequence[Evaluation], reference: Sequence[Evaluation]) -> bool:
    return [evaluation.run.seed or 0 for evaluation in group] == [evaluation.run.seed or 0 for evaluation in reference]


def difference_tables(arms: Evaluations, pooled: str = "all", by: str = "source") -> list[Table]:
    """The differences by source or mesh ("": of all and of each label alone) and metric of each of `pairs_of`. pooled:
    OVERALL's name."""
    tables = []
    for arm, base in progress(pairs_of(arms), "differences"):
        group, reference = arms[arm], arms[base]
        rows = [
            [source or pooled, *(format_interval(difference(group, reference, source, name), "+") for name in METRICS)]
            for source in reference[0].pools
            if by or source == OVERALL or source.startswith(LABEL)
        ]
        paired = ", paired" if _paired(group, reference) else ""
        title = f"{arm} minus {base} ({len(group)} and {len(reference)} seeds{paired})"
        tables.append(Table(title, [by, *TITLES], rows))
    return tables


def overall_differences(arms: Evaluations) -> Table:
    """The rows for all images of `difference_tables`."""
    tables = difference_tables(arms, pooled="", by="")
    rows = [[f"{table.title}, {name}".removesuffix(", "), *row] for table in tables for name, *row in table.rows]
    return Table("differences on the same images", ["networks", *TITLES], rows)


def format_table(runs: Sequence[RunSummary]) -> str:
    """`run_tables` and `overall_differences` by images as Markdown, and the paths of the contact sheets."""
    arms = arms_of(runs)
    groups = by_images(arms)
    tables = run_tables(arms, groups) + [overall_differences(read_evaluations(group)) for group in groups.values()]
    sheets = [f"image: {run.folder / name / 'contact_sheet.png'}" for run in runs for name in run.photographs]
    legend = "; ".join(f"{arm}: {renders}" for arm, renders in ARMS.items() if arm in {run.arm for run in runs})
    return "\n\n".join(filter(None, [*(str(table.known) for table in tables if table.rows), legend, "\n".join(sheets)]))


def format_comparison(
    runs: Sequence[RunSummary], exclude: Sequence[str], photographs: str = PHOTOGRAPHS, by: str = "source"
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
        if any(name == photographs or run.seed is None for scored in group.values() for run, name in scored)
    ]
    folders = [run.folder / name for group in compared for run, name in next(iter(group.values()))[:1]]
    if len(folders) > 1:
        advice = "score both networks on the same folder with pnb-evaluate"
        raise InputError(f"{folders[1]} has other photographs or sources than {folders[0]}: {advice}")
    if not folders and photographs != PHOTOGRAPHS:
        raise InputError(f"photographs={photographs}: no run has a sub-folder of that name with an evaluation's files")
    for group in compared:
        pooled = f"all but {', '.join(exclude)}" if exclude else "all"
        evaluations = read_evaluations(group, exclude, by)
        tables += [group_table(evaluations, pooled, by), *difference_tables(evaluations, pooled, by=by)]
    return "\n\n".join(str(table.known) for table in [*tables, seconds_table(arms)] if table.rows)
