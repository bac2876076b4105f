"""One image for the first minute: what fooled, the network's answers, and how the arms fare."""

import io
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from train.report.arms import Arms, Score
from train.report.blocks import Illustration
from train.report.images import turned
from train.report.photographs import scored, scored_on, scores_of
from train.report.plots import COLORS
from train.run_folder.attack_examples import Side

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

EXAMPLES = 3
FIGURES = {"recall": "Recall", "false_alarms": "False alarms", "auc": "AUC"}
WIDTH, DPI = 7.2, 200  # inches; a phone shows them in 360 CSS pixels, letters at half their size
TOP, LINE = 1.4, 0.22  # inches: of titles and margins, and of a line of an arm's name beside its bar
LONGEST_LINE, LONGEST_ANSWER, LONGEST_TITLE = 14, 9, 25  # characters; more are wrapped, or set smaller
FONT = 14  # points
LOOK = {"axes.spines.top": False, "axes.spines.right": False, "text.parse_math": False, "font.size": FONT}
Pairs = Sequence[tuple[Side, Side]]  # before and after
Scores = Mapping[str, Mapping[str, Score]]  # by the figure's title and the arm's name


def headline(arms: Arms, name: str) -> Illustration | None:
    """Of the runs of each arm by its name, with their scores in the sub-folder `name`.

    None where no arm's first run keeps an example that was right before and wrong after.
    """
    pairs = next((found for group in reversed([*arms.values()]) if (found := turned(group[0].folder, EXAMPLES))), [])
    if not pairs:
        return None
    first = next(iter(arms.values()))[0]
    label, where = first.config.label, f"on {scored_on(first, name)}"
    scores = {title: scores_of(scored(arms, name), name, figure) for figure, title in FIGURES.items()}
    scores = {title: found for title, found in scores.items() if found}
    answers = "; ".join(f"{_said(before)}, then {_said(after)}" for before, after in pairs)
    alt = f"{label.capitalize()} before and after its light changed, called {answers}."
    told = [f" {title} {where}: {_told(found)}." for title, found in scores.items()]
    width = WIDTH if scores else WIDTH / 2
    return Illustration(_drawn(pairs, scores, label, where), "png", "".join([alt, *told]), int(100 * width))


def _drawn(pairs: Pairs, scores: Scores, label: str, where: str) -> bytes:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    lines = sum(len(textwrap.wrap(arm, LONGEST_LINE)) for found in scores.values() for arm in found)
    file = io.BytesIO()
    with mpl.rc_context(LOOK):  # type: ignore[arg-type]  # which wants its keys as literals
        size = WIDTH if scores else WIDTH / 2, max(4.0, TOP + lines * LINE)
        figure = Figure(figsize=size, layout="constrained", dpi=DPI)
        panels = figure.subfigures(1, 2 if scores else 1, squeeze=False)[0]
        _draw_pairs(panels[0], pairs, label)
        if scores:
            _draw_scores(panels[1], scores, where)
        figure.savefig(file, format="png")
    return file.getvalue()


def _draw_pairs(figure: "SubFigure", pairs: Pairs, label: str) -> None:
    _draw_title(figure, f"One {label}, another light")
    grid = figure.subplots(2, len(pairs), squeeze=False)
    grid[0, 0].set_ylabel("before")
    grid[1, 0].set_ylabel("after")
    for column, pair in zip(grid.T, pairs, strict=True):
        for axes, side, mark in zip(column, pair, "✓✗", strict=True):
            axes.imshow(side.image.permute(1, 2, 0).numpy(), interpolation="nearest")
            size = FONT * min(1, LONGEST_ANSWER / len(side.answer))
            axes.set_xlabel(f"{side.answer}\n{mark} {side.confidence:.0%}", fontsize=size)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set(visible=True, color="0.8")


def _draw_scores(figure: "SubFigure", scores: Scores, where: str) -> None:
    _draw_title(figure, where.capitalize())
    most = max(score.seeds for found in scores.values() for score in found.values())
    note = "one seed, 95 % intervals" if most == 1 else f"means of {most} seeds, lowest to highest"
    figure.supxlabel(note, color="0.35", fontsize=11)
    grid = figure.subplots(len(scores), 1, sharex=True, squeeze=False)
    for axes, (name, found) in zip(grid.flat, scores.items(), strict=True):
        for row, score in enumerate(found.values()):
            _draw_bar(axes, row, score)
        axes.set(xlim=(0, 1.25), xticks=[], yticks=range(len(found)))
        axes.set_yticklabels([textwrap.fill(arm, LONGEST_LINE) for arm in found])
        axes.set_title(name, loc="left", fontsize=FONT)
        axes.invert_yaxis()
        axes.spines["bottom"].set_visible(False)
        axes.tick_params(left=False)


def _draw_title(figure: "SubFigure", text: str) -> None:
    size = (FONT + 1) * min(1, LONGEST_TITLE / len(text))
    figure.suptitle(text, x=0.02, ha="left", weight="bold", fontsize=size)


def _draw_bar(axes: "Axes", row: int, score: Score) -> None:
    axes.barh(row, score.value, 0.75, color=COLORS[row % len(COLORS)])
    axes.hlines(row, score.low, score.high, color="0.1", linewidth=2)
    axes.annotate(f" {score.value:.2f}", (max(score.high, score.value), row), va="center")


def _said(side: Side) -> str:
    return f"{side.answer} {side.confidence:.0%}"


def _told(found: Mapping[str, Score]) -> str:
    return ", ".join(f"{arm} {score.value:.2f}" for arm, score in found.items())
