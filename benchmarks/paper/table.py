"""Markdown tables of what the paper's benchmarks measured: the last run in a file of JSON lines.

python -m benchmarks.paper.table docs/paper/norm_balls.jsonl --figure norm_balls.png

Brackets hold 95 % Wilson intervals, or the quartiles of times. A figure is drawn of norm_balls alone.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.common import last_run
from train import tables

Row = dict[str, Any]
Table = Iterator[Sequence[object]]  # the header first


def fraction(outcomes: Iterable[bool]) -> str:
    values = list(outcomes)
    if not values:
        return "none of 0"
    low, high = interval(values)
    return f"{100 * np.mean(values):.0f} % [{100 * low:.0f}, {100 * high:.0f}] of {len(values)}"


def interval(outcomes: Sequence[bool]) -> tuple[float, float]:
    """95 %, by Wilson's score."""
    result = tables.fraction(int(sum(outcomes)), len(outcomes))
    return result["low"], result["high"]


def quartiles(values: Sequence[float] | np.ndarray, digits: int = 1) -> str:
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def groups(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by the values that they have under some names."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row.get(name) for name in names), []).append(row)
    return found


def hits(group: Sequence[Row], name: str) -> list[bool]:
    """Outcomes of counts, of all meshes together."""
    count, total = sum(row[name] for row in group), sum(row["n"] for row in group)
    return [index < count for index in range(total)]


# ---------------------------------------------------------------------------------------- tables


def norm_balls(rows: Sequence[Row]) -> Table:
    counts = {"adversarial": "adversarial", "random": "one random draw", "search": "any of the draws"}
    counts |= {"clipped": "adversarial, negative radiance left out"}
    means = {"reach": "L∞ on the image", "changed_pixels": "pixels beyond half of it"}
    yield ["space", "radius", *counts.values(), *means.values()]
    for (space, radius), group in groups(rows, "space", "radius").items():
        cells = [fraction(hits(group, name)) if name in group[0] else "" for name in counts]
        group = [row for row in group if row["n"]]
        weights = [row["n"] for row in group]
        for name in means:
            known = group and name in group[0]
            cells.append(f"{np.average([row[name] for row in group], weights=weights):.2g}" if known else "")
        yield [space, "none" if radius is None else f"{radius:g}", *cells]


def networks(rows: Sequence[Row]) -> Table:
    states = {"first": "as found", "first_random": "random, as large"}
    states |= {"further": "10 steps on", "further_random": "random, as large"}
    yield ["attack", "network", *states.values()]
    for (kind,), group in groups(rows, "kind").items():
        for name in group[0]["answers"]:
            yield [kind, name, *(fraction(transferred(group, name, state)) for state in states)]


def transferred(group: Sequence[Row], network: str, state: str) -> Iterator[bool]:
    """Whether a network errs where it recognized the original: the attacked one, the first of the answers, or another
    by what fools the attacked one at that strength."""
    for row in group:
        source, answers, label = next(iter(row["answers"])), row["answers"][network], row["label"]
        fooling = row["answers"][source][state.removesuffix("_random")]
        for before, answer, by_source in zip(answers["before"], answers[state], fooling, strict=True):
            if before == label and (network == source or by_source != label):
                yield answer != label


def views(rows: Sequence[Row]) -> Table:
    states = {"first": "as found", "further": "10 steps on", "random": "random, as large"}
    yield ["attack", "views attacked", *states.values(), "sets", "10 steps on, within 90°", "and beyond"]
    for (kind, count), group in groups(rows, "kind", "attacked").items():
        cells = [fraction(chain(*(errors(row, state) for row in group))) for state in states]
        sets = [100 * np.mean(errors(row, "further")) for row in group]
        near, far = (fraction(within(group, low, low + 90)) for low in (0, 90))
        yield [kind, count, *cells, f"{min(sets):.0f} to {max(sets):.0f} %", near, far]


def errors(row: Row, state: str) -> list[bool]:
    return [answer != row["label"] for answer in row["answers"][state]]


def within(group: Sequence[Row], low: float, high: float) -> list[bool]:
    """Whether the stronger adversaries fool each unseen view so many degrees from the nearest attacked one."""
    found = ((angle, error) for row in group for angle, error in zip(row["angle"], errors(row, "further"), strict=True))
    return [error for angle, error in found if low < angle <= high or angle == low == 0]


def run_time(rows: Sequence[Row]) -> Table:
    yield ["attack", "on", "pixels", "classifier's pass, ms", "renderer, ms", "1 + renderer / pass"]
    for row in rows:
        if "setup" in row:
            renderer = np.subtract(row["whole"], row["inside"])
            ratio = quartiles(1 + renderer / np.array(row["bare"]), 3)
            yield [row["kind"], row["setup"], row["pixels"], quartiles(row["bare"]), quartiles(renderer), ratio]
    done = [row for row in rows if "seconds" in row]
    for name in ("steps", "seconds"):
        middle = quartiles([row[name] for row in done if row["success"]] or [np.nan], 2)
        yield ["lighting", f"{name} of {fraction(row['success'] for row in done)} that fool", "", "", "", middle]


def rendering_quality(rows: Sequence[Row]) -> Table:
    statistics = [name for name, value in rows[0].items() if isinstance(value, list) and name != "histogram"]
    yield ["mesh", "cameras", "renders", *statistics]
    for row in rows:
        cells = ("{:.3f} [{:.3f}, {:.3f}]".format(*row[name]) for name in statistics)
        yield [row["mesh"], row["cameras"], row["rendered"], *cells]


def survival(rows: Sequence[Row]) -> Table:
    versions = list(dict.fromkeys(name for row in rows for name in row.get("versions", {})))
    yield ["attack", "refused", "fooled", *versions]
    for (attack,), group in groups(rows, "attack").items():
        made = [row for row in group if "versions" in row]
        kept = ([row["versions"][name]["success"] for row in made if row["success"]] for name in versions)
        yield [attack, len(group) - len(made), fraction(row["success"] for row in made), *map(fraction, kept)]


TABLES: dict[str, Callable[[Sequence[Row]], Table]] = {
    "norm_balls": norm_balls,
    "networks": networks,
    "views": views,
    "run_time": run_time,
    "rendering_quality": rendering_quality,
    "survival": survival,
}


def draw_norm_balls(rows: Sequence[Row], path: Path) -> None:
    """Success against the radius with intervals, a set of axes per space."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    spaces = groups((row for row in rows if row["radius"] is not None), "space")
    figure, axes = plt.subplots(1, len(spaces), figsize=(3.7 * len(spaces), 3.4), squeeze=False, layout="tight")
    for ax, ((space,), group) in zip(axes[0], spaces.items(), strict=True):
        for method in ("adversarial", "random", "search"):
            balls = {radius: hits(ball, method) for (radius,), ball in groups(group, "radius").items()}
            values = np.array([np.mean(outcomes) for outcomes in balls.values()])
            low, high = np.array([interval(outcomes) for outcomes in balls.values()]).T
            error = np.maximum([values - low, high - values], 0)  # below 0 by rounding alone
            ax.errorbar(list(balls), values, error, label=method, marker="o", capsize=3)
        ax.set(title=space, xscale="log", xlabel="L∞ radius", ylabel="success", ylim=(-0.03, 1.03))
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("records", type=Path, help="file of JSON lines")
    options.add_argument("--figure", type=Path, help="also draw norm_balls here")
    args = options.parse_args(argv)
    settings, rows = last_run(args.records)
    if args.figure is not None and settings["study"] != "norm_balls":
        options.error(f"--figure draws norm_balls, and {args.records} holds {settings['study']}")
    header, *cells = TABLES[settings["study"]](rows)
    for line in (header, ["---"] * len(header), *cells):
        print(f"| {' | '.join(map(str, line))} |")
    if args.figure is not None:
        draw_norm_balls(rows, args.figure)


if __name__ == "__main__":
    main()
