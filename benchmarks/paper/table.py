"""Print Markdown tables of the last run in a file that a benchmark of the paper wrote.

python -m benchmarks.paper.table docs/paper/norm_balls.jsonl --figure norm_balls.png

Brackets hold 95% intervals. Those of counts are Wilson's. Those of views are from
a jackknife over the lights of each mesh, because the views share lights. A
figure is drawn of norm_balls alone.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.common import Row
from benchmarks.paper.common import last_run
from train.results import tables
from train.results.intervals import Units, leave_out, weighted_means

# Titles of the columns of norm_balls, by the counts in its records.
COUNTS = {
    "adversarial": "adversarial",
    "random": "one random draw",
    "search": "any of the draws",
    "clipped": "adversarial, negative radiance left out",
}
# Titles of the columns of networks, by the states in its records.
NETWORK_STATES = {
    "first": "as found",
    "first_random": "random, as large",
    "further": "10 steps on",
    "further_random": "random, as large",
}
# Titles of the columns of views, by the states in its records.
VIEW_STATES = {"first": "as found", "further": "10 steps on", "random": "random, as large"}


@dataclass(frozen=True)
class Cells:
    """Cells of a table.

    Attributes:
        header: Titles of the columns.
        rows: Cells of each row.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[object]]


# ---------------------------------------------------------------------------- cells


def format_rate(outcomes: Iterable[bool]) -> str:
    """Write the fraction of outcomes that are true, as `format_counts` does."""
    outcomes = list(outcomes)
    return format_counts(sum(outcomes), len(outcomes))


def format_counts(hits: int, n: int) -> str:
    """Write a fraction as text, such as "89 % [81, 94] of 100".

    Args:
        hits: Number of outcomes that are true.
        n: Number of all outcomes.

    Returns:
        Percentage with its Wilson interval and the number of outcomes.
    """
    if n == 0:
        return "none of 0"
    rate = tables.fraction(hits, n)
    return f"{format_percentages(rate.value, rate.low, rate.high)} of {n}"


def format_percentages(value: float, low: float, high: float) -> str:
    """Write a fraction and the ends of its interval in percent, such as "89 % [81, 94]".

    Args:
        value: Fraction in [0, 1].
        low: Lower end of its interval.
        high: Upper end of its interval.
    """
    return f"{100 * value:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def group_by(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Group rows by their values in some columns.

    Args:
        rows: Rows to group.
        *names: Names of the columns.

    Returns:
        Rows by the tuple of their values, in order of first appearance. A row
        that lacks a column has the value None.
    """
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = tuple(row.get(name) for name in names)
        groups.setdefault(key, []).append(row)
    return groups


# ---------------------------------------------------------------------------- tables


def norm_balls(records: Sequence[Row]) -> Cells:
    """Make the table of successes in norm-balls.

    Args:
        records: Records of `benchmarks.paper.norm_balls`.
    """
    rows = []
    for ball in pool_meshes(records):
        cells = [format_counts(ball[name], ball["n"]) if name in ball else None for name in COUNTS]
        rows.append([ball["space"], ball["radius"] or "none", *cells])
    return Cells(["space", "radius", *COUNTS.values()], rows)


def pool_meshes(records: Sequence[Row]) -> list[Row]:
    """Sum the counts of all meshes for each space and radius.

    Args:
        records: Records of `benchmarks.paper.norm_balls`.

    Returns:
        A row for each space and radius.
    """
    pooled = []
    for group in group_by(records, "space", "radius").values():
        first = group[0]
        sums = {name: sum(row[name] for row in group) for name in ("n", *COUNTS) if name in first}
        pooled.append(first | sums)
    return pooled


def networks(records: Sequence[Row]) -> Cells:
    """Make the table of successes against other networks.

    Args:
        records: Records of `benchmarks.paper.transfer networks`.
    """
    rows = []
    for (kind,), group in group_by(records, "kind").items():
        for network in group[0]["predictions"]:
            cells = [
                format_rate(transfer_outcomes(group, network, state)) for state in NETWORK_STATES
            ]
            rows.append([kind, network, *cells])
    return Cells(["attack", "network", *NETWORK_STATES.values()], rows)


def transfer_outcomes(group: Sequence[Row], network: str, state: str) -> Iterator[bool]:
    """Check whether a network misclassifies images that it classified correctly before.

    The first network of a record was attacked. For another network, images
    count only if the attack deceived the attacked network. A random state
    counts the images that the attack of the same strength deceived.

    Args:
        group: Records of one kind of attack.
        network: Name of the network.
        state: Key of NETWORK_STATES.

    Yields:
        Whether the network misclassifies an image.
    """
    attacked_state = state.removesuffix("_random")
    for row in group:
        label = row["label"]
        attacked_network = next(iter(row["predictions"]))
        predicted = row["predictions"][network]
        by_attacked_network = row["predictions"][attacked_network][attacked_state]
        images = zip(predicted["before"], predicted[state], by_attacked_network, strict=True)
        for before, after, of_attacked_network in images:
            is_deceived = network == attacked_network or of_attacked_network != label
            if before == label and is_deceived:
                yield after != label


def views(records: Sequence[Row]) -> Cells:
    """Make the table of successes in views that were not attacked.

    Args:
        records: Records of `benchmarks.paper.transfer views`.
    """
    rows = []
    for (kind, attacked), group in group_by(records, "kind", "attacked").items():
        cells = [format_failures(group, state) for state in VIEW_STATES]
        rows.append([kind, attacked, *cells])
    return Cells(["attack", "views attacked", *VIEW_STATES.values()], rows)


def format_failures(group: Sequence[Row], state: str) -> str:
    """Write the fraction of views that are misclassified, with its 95% interval.

    The interval is over the sets of views, because the views of a set share a light.

    Args:
        group: Records of one kind of attack and one number of attacked views.
        state: Key of VIEW_STATES.

    Returns:
        Text such as "27 % [21, 34] of 2 × 10" for 2 meshes with 10 sets each.
    """
    failures_of_meshes = []
    for sets in group_by(group, "mesh").values():
        failures = [
            np.mean([name != row["label"] for name in row["predictions"][state]]) for row in sets
        ]
        failures_of_meshes.append(failures)
    # The order of the values is that of the meshes, which have equally many sets.
    values = np.array([np.concatenate(failures_of_meshes)])
    (mean,) = leave_out(partial(weighted_means, values), Units([np.arange(values.size)], "lights"))
    interval = mean.estimate
    assert interval.low is not None and interval.high is not None
    percentages = format_percentages(mean.value, interval.low, interval.high)
    return f"{percentages} of {len(failures_of_meshes)} × {len(failures_of_meshes[0])}"


def run_time(records: Sequence[Row]) -> Cells:
    """Make the table of the steps and seconds of successful attacks.

    Args:
        records: Records of `benchmarks.paper.run_time`.
    """
    successes = [row for row in records if row["success"]]
    # If no attack succeeded, the table has NaN.
    steps = [row["steps"] for row in successes] or [np.nan]
    seconds = [row["seconds"] for row in successes] or [np.nan]
    medians = f"{np.median(steps):.0f} steps, {np.median(seconds):.2f} s"
    quantile = f"90 % within {np.quantile(seconds, 0.9):.2f} s"
    header = ["success", "median of these; 90 % quantile", "of these in fewer than 10 steps"]
    row = [
        format_rate(row["success"] for row in records),
        f"{medians}; {quantile}",
        format_rate(number < 10 for number in steps),
    ]
    return Cells(header, [row])


def rendering_quality(records: Sequence[Row]) -> Cells:
    """Make the table of the statistics of renders.

    Args:
        records: Records of `benchmarks.paper.rendering_quality`.
    """
    statistics = [name for name, value in records[0].items() if isinstance(value, list)]
    rows = []
    for record in records:
        cells = ["{:.3f} [{:.3f}, {:.3f}]".format(*record[name]) for name in statistics]
        rows.append([record["mesh"], record["cameras"], record["rendered"], *cells])
    return Cells(["mesh", "cameras", "renders", *statistics], rows)


def survival(records: Sequence[Row]) -> Cells:
    """Make the table of adversaries that survive conversions.

    Args:
        records: Records of `benchmarks.paper.survival`.
    """
    versions: dict[str, None] = {}
    for record in records:
        versions |= dict.fromkeys(record.get("versions", {}))
    rows = []
    for (attack,), group in group_by(records, "attack").items():
        attacked = [record for record in group if "versions" in record]
        successes = [record["versions"] for record in attacked if record["success"]]
        cells = [
            format_rate(success[version]["success"] for success in successes)
            for version in versions
        ]
        refused = len(group) - len(attacked)
        rows.append(
            [attack, refused, format_rate(record["success"] for record in attacked), *cells]
        )
    return Cells(["attack", "refused", "success", *versions], rows)


TABLES: dict[str, Callable[[Sequence[Row]], Cells]] = {
    "norm_balls": norm_balls,
    "networks": networks,
    "views": views,
    "run_time": run_time,
    "rendering_quality": rendering_quality,
    "survival": survival,
}


# ---------------------------------------------------------------------------- figure


def draw_norm_balls(records: Sequence[Row], path: Path) -> None:
    """Draw the success in norm-balls against the radius, with axes for each space.

    Args:
        records: Records of `benchmarks.paper.norm_balls`.
        path: File to write.
    """
    balls_with_radius = [ball for ball in pool_meshes(records) if ball["radius"]]
    spaces = group_by(balls_with_radius, "space")
    figure = Figure(figsize=(3.7 * len(spaces), 3.4), layout="tight")
    all_axes = figure.subplots(1, len(spaces), squeeze=False)[0]
    for axes, ((space,), balls) in zip(all_axes, spaces.items(), strict=True):
        draw_space(axes, space, balls)
    all_axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def draw_space(axes: Axes, space: str, balls: Sequence[Row]) -> None:
    """Draw the fraction of successes in the balls of a space with Wilson intervals.

    Args:
        axes: Axes to draw on.
        space: Name of the attacked space, such as "lighting".
        balls: One row for each radius.
    """
    radii = [ball["radius"] for ball in balls]
    for method in ("adversarial", "random", "search"):
        rates = [tables.fraction(ball[method], ball["n"]) for ball in balls]
        values = np.array([rate.value for rate in rates])
        lows = np.array([rate.low for rate in rates])
        highs = np.array([rate.high for rate in rates])
        # Rounding alone can make a length negative.
        lengths = np.maximum([values - lows, highs - values], 0)
        axes.errorbar(radii, values, lengths, label=method, marker="o", capsize=3)
    axes.set(title=space, xscale="log", xlabel="L∞ radius", ylabel="success", ylim=(-0.03, 1.03))


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table of a file of records, and draw its figure if asked to.

    Args:
        argv: Words of the command line. None takes those of the process.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("records", type=Path, help="file of JSON lines")
    parser.add_argument("--figure", type=Path, help="also draw norm_balls here")
    options = parser.parse_args(argv)
    settings, records = last_run(options.records)
    study = settings["study"]
    if options.figure is not None and study != "norm_balls":
        parser.error(f"--figure draws norm_balls, and {options.records} holds {study}")
    cells = TABLES[study](records)
    print(tables.Table("", cells.header, cells.rows))
    if options.figure is not None:
        draw_norm_balls(records, options.figure)


if __name__ == "__main__":
    main()
