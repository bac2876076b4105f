"""Markdown tables of what the paper's benchmarks measured: the last run in a file of JSON lines.

python -m benchmarks.paper.table docs/paper/norm_balls.jsonl --figure norm_balls.png

Brackets hold 95 % intervals: Wilson's, and of views, which share lights, a bootstrap over those of each mesh. A figure
is drawn of norm_balls alone.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import bootstrap

from benchmarks.common import Row
from benchmarks.paper.common import last_run
from train.evaluation import tables

Rows = Sequence[Row]
Table = Iterator[Sequence[object]]  # the header first


def fraction(outcomes: Iterable[bool]) -> str:
    outcomes = list(outcomes)
    return percentages(sum(outcomes), len(outcomes))


def percentages(hits: int, n: int) -> str:
    if n == 0:
        return "none of 0"
    rate = tables.fraction(hits, n)
    return f"{100 * rate.value:.0f} % [{100 * rate.low:.0f}, {100 * rate.high:.0f}] of {n}"


def groups(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by their values under some names."""
    result: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        result.setdefault(tuple(row.get(name) for name in names), []).append(row)
    return result


COUNTS = {"adversarial": "adversarial", "random": "one random draw", "search": "any of the draws"}
COUNTS |= {"clipped": "adversarial, negative radiance left out"}


def norm_balls(rows: Rows) -> Table:
    yield ["space", "radius", *COUNTS.values()]
    for ball in pooled(rows):
        cells = [percentages(ball[name], ball["n"]) if name in ball else None for name in COUNTS]
        yield [ball["space"], ball["radius"] or "none", *cells]


def pooled(rows: Rows) -> Rows:
    """A row per space and radius, with the sums of counts over all meshes."""
    return [
        group[0] | {name: sum(row[name] for row in group) for name in ("n", *COUNTS) if name in group[0]}
        for group in groups(rows, "space", "radius").values()
    ]


def networks(rows: Rows) -> Table:
    states = {"first": "as found", "first_random": "random, as large"}
    states |= {"further": "10 steps on", "further_random": "random, as large"}
    yield ["attack", "network", *states.values()]
    for (kind,), group in groups(rows, "kind").items():
        for name in group[0]["predictions"]:
            yield [kind, name, *(fraction(transferred(group, name, state)) for state in states)]


def transferred(group: Rows, network: str, state: str) -> Iterator[bool]:
    """Whether a network errs where it was right before: the attacked one, whose predictions come first, or another by
    what succeeds against the attacked one at that strength."""
    for row in group:
        source, predicted, label = next(iter(row["predictions"])), row["predictions"][network], row["label"]
        by_source = row["predictions"][source][state.removesuffix("_random")]
        for before, after, attacked in zip(predicted["before"], predicted[state], by_source, strict=True):
            if before == label and (network == source or attacked != label):
                yield after != label


def views(rows: Rows) -> Table:
    states = {"first": "as found", "further": "10 steps on", "random": "random, as large"}
    yield ["attack", "views attacked", *states.values()]
    for (kind, count), group in groups(rows, "kind", "attacked").items():
        yield [kind, count, *(by_set(group, state) for state in states)]


def by_set(group: Rows, state: str) -> str:
    """The fraction of views that fail, of lights that were found on several sets of views of each mesh."""
    meshes = [
        [np.mean([name != row["label"] for name in row["predictions"][state]]) for row in sets]
        for sets in groups(group, "mesh").values()
    ]
    low, high = bootstrap(meshes, pooled_mean, method="percentile", rng=0).confidence_interval
    return f"{100 * pooled_mean(*meshes):.0f} % [{100 * low:.0f}, {100 * high:.0f}] of {len(meshes)} × {len(meshes[0])}"


def pooled_mean(*samples: Sequence[float], axis: int = -1) -> np.ndarray:
    return np.mean([np.mean(sample, axis=axis) for sample in samples], axis=0)


def run_time(rows: Rows) -> Table:
    steps, times = ([row[name] for row in rows if row["success"]] or [np.nan] for name in ("steps", "seconds"))
    yield ["success", "median of these; 90 % quantile", "of these in fewer than 10 steps"]
    medians = f"{np.median(steps):.0f} steps, {np.median(times):.2f} s; 90 % within {np.quantile(times, 0.9):.2f} s"
    yield [fraction(row["success"] for row in rows), medians, fraction(number < 10 for number in steps)]


def rendering_quality(rows: Rows) -> Table:
    statistics = [name for name, value in rows[0].items() if isinstance(value, list)]
    yield ["mesh", "cameras", "renders", *statistics]
    for row in rows:
        cells = ("{:.3f} [{:.3f}, {:.3f}]".format(*row[name]) for name in statistics)
        yield [row["mesh"], row["cameras"], row["rendered"], *cells]


def survival(rows: Rows) -> Table:
    versions = list(dict.fromkeys(name for row in rows for name in row.get("versions", {})))
    yield ["attack", "refused", "success", *versions]
    for (attack,), group in groups(rows, "attack").items():
        made = [row for row in group if "versions" in row]
        successes = [row["versions"] for row in made if row["success"]]
        cells = [fraction(row[name]["success"] for row in successes) for name in versions]
        yield [attack, len(group) - len(made), fraction(row["success"] for row in made), *cells]


TABLES: dict[str, Callable[[Rows], Table]] = {
    function.__name__: function for function in (norm_balls, networks, views, run_time, rendering_quality, survival)
}


def draw_norm_balls(rows: Rows, path: Path) -> None:
    """Success against the radius with intervals, a set of axes per space."""
    spaces = groups((ball for ball in pooled(rows) if ball["radius"]), "space")
    figure = Figure(figsize=(3.7 * len(spaces), 3.4), layout="tight")
    axes = figure.subplots(1, len(spaces), squeeze=False)[0]
    for ax, ((space,), balls) in zip(axes, spaces.items(), strict=True):
        for method in ("adversarial", "random", "search"):
            results = [tables.fraction(ball[method], ball["n"]) for ball in balls]
            value = np.array([result.value for result in results])
            low = np.array([result.low for result in results])
            high = np.array([result.high for result in results])
            error = np.maximum([value - low, high - value], 0)  # below 0 by rounding alone
            ax.errorbar([ball["radius"] for ball in balls], value, error, label=method, marker="o", capsize=3)
        ax.set(title=space, xscale="log", xlabel="L∞ radius", ylabel="success", ylim=(-0.03, 1.03))
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main(argv: Sequence[str] | None = None) -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("records", type=Path, help="file of JSON lines")
    options.add_argument("--figure", type=Path, help="also draw norm_balls here")
    args = options.parse_args(argv)
    settings, rows = last_run(args.records)
    if args.figure is not None and settings["study"] != "norm_balls":
        options.error(f"--figure draws norm_balls, and {args.records} holds {settings['study']}")
    header, *cells = TABLES[settings["study"]](rows)
    print(tables.Table("", header, cells))
    if args.figure is not None:
        draw_norm_balls(rows, args.figure)


if __name__ == "__main__":
    main()
