"""Markdown tables, and figures, of what the paper's benchmarks measured: the last run in a file of JSON lines.

python -m benchmarks.paper.table docs/paper/norm_balls.jsonl --figure norm_balls.png

Brackets hold 95 % Wilson intervals, or the quartiles of times.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.paper.common import last_run

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
    bounds = binomtest(int(sum(outcomes)), len(outcomes)).proportion_ci(method="wilson")
    return bounds.low, bounds.high


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


# ---------------------------------------------------------------------------------------- figures


def draw_norm_balls(panel: Any, rows: Sequence[Row]) -> None:
    rows = [row for row in rows if row["radius"] is not None]
    for method in ("adversarial", "random", "search"):
        balls = {radius: hits(group, method) for (radius,), group in groups(rows, "radius").items()}
        errorbars(panel, balls, method)
    panel.set(xscale="log", xlabel="L∞ radius", ylabel="fraction fooled", ylim=(-0.03, 1.03))


def draw_views(panel: Any, rows: Sequence[Row]) -> None:
    for (count,), group in groups(rows, "attacked").items():
        bins = {(low + high) / 2: within(group, low, high) for low, high in pairwise((0, 15, 30, 60, 90, 180))}
        errorbars(panel, {middle: outcomes for middle, outcomes in bins.items() if outcomes}, f"{count} attacked")
    panel.set(xlabel="degrees to the nearest attacked view", ylabel="fraction fooled", ylim=(-0.03, 1.03))


def draw_run_time(panel: Any, rows: Sequence[Row]) -> None:
    """One image at a time: the classifier's time below the renderer's, against pixels."""
    first = next(iter(groups(rows, "setup")))[0]
    rows = sorted((row for row in rows if row["setup"] == first), key=lambda row: row["pixels"])
    inside, whole = ([np.median(row[name]) for row in rows] for name in ("inside", "whole"))
    labels = ["classifier", "renderer"]
    panel.stackplot([row["pixels"] for row in rows], inside, np.subtract(whole, inside), labels=labels)
    panel.set(xlabel="covered pixels", ylabel="ms per iteration")


def draw_rendering_quality(panel: Any, rows: Sequence[Row]) -> None:
    counts = rows[0]["histogram"]
    panel.stairs(counts, np.linspace(0, 1, len(counts) + 1), fill=True, label="recognized")
    panel.set(xlabel="confidence in the correct label", ylabel="renders")


def errorbars(panel: Any, outcomes: Mapping[float, Sequence[bool]], label: str) -> None:
    """Fractions with their intervals, by where they are drawn."""
    values = np.array([np.mean(each) for each in outcomes.values()])
    low, high = np.array([interval(each) for each in outcomes.values()]).T
    error = np.maximum([values - low, high - values], 0)  # below 0 by rounding alone
    panel.errorbar(list(outcomes), values, error, label=label, marker="o", capsize=3)


TABLES: dict[str, Callable[[Sequence[Row]], Table]] = {
    "norm_balls": norm_balls,
    "networks": networks,
    "views": views,
    "run_time": run_time,
    "rendering_quality": rendering_quality,
    "survival": survival,
}
FIGURES: dict[str, tuple[str, Callable[[Any, Sequence[Row]], None]]] = {  # a panel per value of a name
    "norm_balls": ("space", draw_norm_balls),
    "views": ("kind", draw_views),
    "run_time": ("kind", draw_run_time),
    "rendering_quality": ("mesh", draw_rendering_quality),
}


def draw(study: str, rows: Sequence[Row], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    name, draw_panel = FIGURES[study]
    parts = groups((row for row in rows if name in row), name)
    figure, panels = plt.subplots(1, len(parts), figsize=(3.7 * len(parts), 3.4), squeeze=False, layout="tight")
    for panel, ((title,), group) in zip(panels[0], parts.items(), strict=True):
        panel.set_title(title)
        draw_panel(panel, group)
    panels[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("records", type=Path, help="file of JSON lines")
    options.add_argument("--figure", type=Path, help="also draw the numbers here")
    args = options.parse_args(argv)
    settings, rows = last_run(args.records)
    header, *cells = TABLES[settings["study"]](rows)
    for line in (header, ["---"] * len(header), *cells):
        print(f"| {' | '.join(map(str, line))} |")
    if args.figure is not None:
        draw(settings["study"], rows, args.figure)


if __name__ == "__main__":
    main()
