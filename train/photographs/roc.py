"""ROC curves of an evaluation, overall and by source: as a table and as a figure."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from train.photographs.answers import as_cell
from train.photographs.figures import OVERALL, Pool
from train.photographs.ranking import RATES, Ranking

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def rank_pools(pools: Mapping[str, Pool]) -> dict[str, Ranking]:
    """The rankings of the pools that hold both kinds of images, by source."""
    return {source: Ranking(*pool.scores) for source, pool in pools.items() if all(pool.scores)}


def write_roc_csv(path: Path, rankings: Mapping[str, Ranking]) -> None:
    """source, false_alarm_rate, recall and threshold: a row per point, where what exceeds the threshold is called."""
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["source", "false_alarm_rate", "recall", "threshold"])
        for source, ranking in rankings.items():
            writer.writerows((as_cell(source), *map(float, point)) for point in zip(*ranking.curve(), strict=True))


def draw_roc(rankings: Mapping[str, Ranking], label: str) -> "Figure":
    """The curves over each other, their AUC in the legend, and lines at RATES; needs no display."""
    from matplotlib.figure import Figure  # half a second that only this takes

    figure = Figure(figsize=(7, 7), layout="constrained")
    axes = figure.subplots()
    axes.axline((0, 0), slope=1, color="0.8", linewidth=1)  # chance
    for rate in map(float, RATES):
        axes.axvline(rate, color="0.6", linewidth=1, linestyle=":")
        axes.annotate(f"{rate:.0%}", (rate, 1.015), ha="center", color="0.4", fontsize=8, annotation_clip=False)
    for source, ranking in rankings.items():
        style = {"color": "black", "linewidth": 2.5, "zorder": 3} if source == OVERALL else {"linewidth": 1.5}
        alarms, recall, _ = ranking.curve()
        axes.plot(alarms, recall, label=f"{source or 'all'}: AUC {ranking.values()['auc']:.3f}", **style)
    axes.set(xlabel=f"other things called {label}", ylabel=f"{label} recognized", xlim=(-0.01, 1), ylim=(0, 1.01))
    axes.set_aspect("equal")
    if rankings:
        axes.legend(loc="lower right")  # where only a network worse than chance has a curve
    return figure
