"""Success against radius as a table and as a figure."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from augment.attacks.evaluate import RadiusSweep
from train.report.plots import COLORS, LINES, MARKERS
from train.tables import aligned, format_fraction, fraction

METHODS = {"adversarial": "adversarial", "random": "random search, as many renders"}
TABLE, FIGURE = "sweep.csv", "sweep.png"
ALL = "all"


def curve(found: Mapping[str, RadiusSweep]) -> list[dict[str, Any]]:
    """A record for each mesh (and all of several), method and radius: the success rate on examples that were correct
    before, with its 95 % Wilson interval; radii by the name of the attacked parameter."""
    together = {}
    if len(found) > 1:
        pooled = (torch.cat([getattr(each, method) for each in found.values()], dim=1) for method in METHODS)
        together[ALL] = RadiusSweep(next(iter(found.values())).radii, *pooled)
    return [
        {"mesh": mesh, "method": method, **radii, **fraction(int(success.sum()), len(success))}
        for mesh, sweep in {**found, **together}.items()
        for method in METHODS
        for radii, success in zip(sweep.radii, getattr(sweep, method), strict=True)
    ]


def format_curve(sweep: RadiusSweep) -> str:
    """One mesh's, a line per radius."""
    if not sweep.adversarial.numel():
        return "no example was correct before, so that there is no success against radius"
    rows = [
        [_words(radii), *(format_fraction(fraction(int(each.sum()), len(each))) for each in (adversarial, random))]
        for radii, adversarial, random in zip(sweep.radii, sweep.adversarial, sweep.random, strict=True)
    ]
    return aligned(["radius", *METHODS.values()], rows)


def _words(radii: Mapping[str, float]) -> str:
    return " + ".join(f"{name} {radius:g}" for name, radius in radii.items())


def write_curve(records: Sequence[Mapping[str, Any]], norms: Mapping[str, str], out: Path) -> None:
    """sweep.csv and sweep.png, of the last mesh's or of all. norms: of what is attacked, by name."""
    with open(out / TABLE, "w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, list(records[0]))
        table.writeheader()
        table.writerows(records)
    _draw([each for each in records if each["mesh"] == records[-1]["mesh"] and each["n"]], norms, out / FIGURE)


def _draw(records: Sequence[Mapping[str, Any]], norms: Mapping[str, str], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.8), layout="constrained")
    panel, (first, *others) = figure.subplots(), norms
    for (method, name), color, line, marker in zip(METHODS.items(), COLORS, LINES[1::-1], MARKERS, strict=False):
        own = [each for each in records if each["method"] == method]
        radii, value = [each[first] for each in own], [each["value"] for each in own]
        panel.plot(radii, value, color=color, linestyle=line, marker=marker, label=name)
        panel.fill_between(
            radii, [each["low"] for each in own], [each["high"] for each in own], color=color, alpha=0.15
        )
    panel.set(xscale="log", ylim=(-0.03, 1.03), ylabel="success rate", xlabel=f"{norms[first]} radius of {first}")
    if others:
        panel.set_xlabel(f"{panel.get_xlabel()}; {' and '.join(others)} in proportion")
    ticks = sorted({each[first] for each in records})
    panel.set_xticks(ticks, [f"{radius:g}" for radius in ticks])
    panel.set_xticks([], minor=True)
    panel.spines[["top", "right"]].set_visible(False)
    if records:
        panel.set_title(f"{records[0]['n']} examples correct before, 95 % intervals", fontsize=10)
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, dpi=150)
