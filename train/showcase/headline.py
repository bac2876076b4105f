"""One image for the first minute: what fooled, the network's answers, and how the arms fare."""

import io
from collections.abc import Sequence

from train.photographs import find_figure
from train.report import RunSummary
from train.showcase.blocks import Illustration
from train.showcase.images import headline_tiles
from train.showcase.plots import COLOURS

EXAMPLES = 3
FIGURES = {"recall": "recognised", "false_alarms": "false alarms", "auc": "AUC"}


def headline(runs: dict[str, RunSummary], photographs: str) -> Illustration | None:
    """One run of each arm, by name; None where none keeps an example that was right before and wrong after."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    arms = list(runs.items())
    tiles = next((found for _, run in reversed(arms) if (found := headline_tiles(run.folder, EXAMPLES))), [])
    if not tiles:
        return None
    look = {"axes.spines.top": False, "axes.spines.right": False, "text.parse_math": False}
    with mpl.rc_context(look):
        figure = Figure(figsize=(8.6, 3.6), layout="constrained", dpi=120)
        left, right = figure.subfigures(1, 2, width_ratios=(1.1, 1))
        _draw_tiles(left, tiles, arms[0][1].config.label)
        axes = right.subplots()
        _draw_bars(axes, arms, photographs)
        right.legend(loc="outside lower center", ncols=3, frameon=False)
        file = io.BytesIO()
        figure.savefig(file, format="png")
    told = "; ".join(f"{name}: {_told(run, photographs)}" for name, run in arms)
    alt = f"Renders before and after the light changed, with the network's answers; {told}"
    return Illustration(file.getvalue(), "png", alt, 1032)


def _draw_tiles(figure, tiles: Sequence, label: str) -> None:
    grid = figure.subplots(2, len(tiles), squeeze=False)
    figure.suptitle(f"the same {label} before and after", fontsize=10)
    for column, (before, said_before, after, said_after) in zip(grid.T, tiles, strict=True):
        for axes, image, said, colour in (
            (column[0], before, said_before, COLOURS[2]),
            (column[1], after, said_after, COLOURS[1]),
        ):
            axes.imshow(image, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            axes.set_xlabel(said, color=colour)
            for spine in axes.spines.values():
                spine.set(visible=True, color=colour, linewidth=2)


def _draw_bars(axes, arms: Sequence[tuple[str, RunSummary]], photographs: str) -> None:
    thickness = 0.8 / len(arms)
    for index, (name, run) in enumerate(arms):
        figures = [find_figure(run.photographs.get(photographs, {}), figure) for figure in FIGURES]
        for row, figure in enumerate(figures):
            if figure.get("value") is None:
                continue
            at, value = row + (index - (len(arms) - 1) / 2) * thickness, figure["value"]
            error = [[max(0, value - figure["low"])], [max(0, figure["high"] - value)]]
            label = name if row == 0 else None
            axes.barh(at, value, thickness * 0.9, xerr=error, color=COLOURS[index % len(COLOURS)], label=label)
            axes.annotate(f"{value:.2f}", (min(1, figure["high"]) + 0.02, at), va="center", fontsize=9)
    axes.set(xlim=(0, 1.15), xticks=(0, 0.5, 1), yticks=range(len(FIGURES)), yticklabels=FIGURES.values())
    axes.invert_yaxis()
    axes.set_title(f"{photographs}: one seed an arm, 95 % intervals", fontsize=9)


def _told(run: RunSummary, photographs: str) -> str:
    found = {title: find_figure(run.photographs.get(photographs, {}), name) for name, title in FIGURES.items()}
    return ", ".join(f"{title} {each['value']:.2f}" for title, each in found.items() if each.get("value") is not None)
