"""Plots as SVG that can be read on light and on dark paper, in colors that color-blind readers tell apart."""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from train.photographs.ranking import RATES, Ranking
from train.report.blocks import Illustration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from train.report.arms import Score

# Okabe and Ito 2008, without yellow, which white paper swallows; a line style and a marker tell the same.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES, MARKERS = ("--", "-", ":", "-."), "osD^vP"
SIZE = (4.4, 3.3)  # inches
WIDTH = 440  # CSS pixels
INK = "#123456"  # stands for the ink, which the reader's color scheme decides
STYLE = "<style>svg{color:#1a1a1a}@media (prefers-color-scheme:dark){svg{color:#e4e4e4}}</style>"
RC = {
    "svg.fonttype": "none",
    "text.parse_math": False,
    "svg.hashsalt": "report",
    "font.size": 10,
    "font.family": "sans-serif",
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9,
}
Series = Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]]  # by arm, (x, y) of each seed


def style(index: int) -> dict[str, Any]:
    """The look of an arm's line, by its place among the arms."""
    return {"color": COLORS[index % len(COLORS)], "linestyle": LINES[index % len(LINES)]}


def curves(series: Series, title: str, xlabel: str, limits: tuple[float, float] | None = (0, 1)) -> Illustration | None:
    """A line per seed, in the color of its arm; None where there is nothing to draw."""
    drawn = {arm: [line for line in lines if len(line[0])] for arm, lines in series.items()}
    if not any(drawn.values()):
        return None

    def draw(axes: "Axes") -> None:
        for index, (arm, lines) in enumerate(drawn.items()):
            for number, (x, y) in enumerate(lines):
                marker = MARKERS[index % len(MARKERS)] if len(x) < 30 else None
                axes.plot(x, y, marker=marker, ms=4, label=None if number else arm, **style(index))
        axes.set(xlabel=xlabel, ylim=limits and (limits[0] - 0.02, limits[1] + 0.02))
        axes.locator_params(axis="x", integer=True, min_n_ticks=1)

    ends = [f"{arm} {np.mean([y[-1] for _, y in lines]):.2f}" for arm, lines in drawn.items() if lines]
    return _figure(draw, title, f"{title} over {xlabel}s, at the end: {', '.join(ends)}")


def roc(rankings: Mapping[str, Sequence[Ranking]], label: str, title: str) -> Illustration | None:
    """ROC curves, one per seed, with the arm's mean AUC in the legend and lines at RATES."""
    if not any(rankings.values()):
        return None
    told = {arm: np.mean([each.values()["auc"] for each in group]) for arm, group in rankings.items() if group}

    def draw(axes: "Axes") -> None:
        axes.axline((0, 0), slope=1, color="0.6", linewidth=1)
        for rate in map(float, RATES):
            axes.axvline(rate, color="0.6", linewidth=1, linestyle=":")
        for index, (arm, group) in enumerate(rankings.items()):
            for number, ranking in enumerate(group):
                alarms, recall, _ = ranking.curve()
                axes.plot(alarms, recall, label=None if number else f"{arm}: AUC {told[arm]:.3f}", **style(index))
        axes.set(xlabel=f"others called {label}", ylabel=f"{label} recognized", xlim=(-0.01, 1), ylim=(0, 1.01))

    return _figure(draw, title, f"{title}; AUC: {', '.join(f'{arm} {auc:.3f}' for arm, auc in told.items())}")


def bars(scores: Mapping[str, Mapping[str, "Score | None"]], title: str) -> Illustration | None:
    """A row of bars per source, one for each arm, with its interval; None where there is nothing to draw."""
    if not scores:
        return None
    sources, arms = [*scores], [*next(iter(scores.values()))]
    thickness = 0.8 / len(arms)

    def draw(axes: "Axes") -> None:
        for index, arm in enumerate(arms):
            known = [(row, found) for row, source in enumerate(sources) if (found := scores[source][arm])]
            at = [row + (index - (len(arms) - 1) / 2) * thickness for row, _ in known]
            told = [each.value for _, each in known]
            error = [
                [max(0, each.value - each.low) for _, each in known],
                [max(0, each.high - each.value) for _, each in known],
            ]
            look = {"color": style(index)["color"], "label": arm, "ecolor": INK}
            axes.barh(at, told, thickness * 0.9, xerr=error, error_kw={"linewidth": 1}, **look)
        axes.set_yticks(range(len(sources)), [name if len(name) < 24 else f"{name[:22]}…" for name in sources])
        axes.set_xlim(0, 1.02)
        axes.invert_yaxis()

    told = [
        f"{source}: " + ", ".join(f"{arm} {found.value:.2f}" for arm, found in by_arm.items() if found)
        for source, by_arm in scores.items()
    ]
    height = max(SIZE[1], 0.9 + 0.24 * len(sources) * len(arms))
    return _figure(draw, title, f"{title}. {'; '.join(told)}", height)


def _figure(draw: Callable[["Axes"], None], title: str, alt: str, height: float = SIZE[1]) -> Illustration:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(RC):  # type: ignore[arg-type]  # which wants its keys as literals
        figure = Figure(figsize=(SIZE[0], height), layout="constrained")
        axes = figure.subplots()
        draw(axes)
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=1 if len(max(labels, key=len)) > 16 else 3)
        return Illustration(svg(figure), "svg", alt, WIDTH, title)


def svg(figure: "Figure") -> bytes:
    """A figure's SVG, transparent, in which INK is the color scheme's."""
    file = io.StringIO()
    figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    start, tag, rest = file.getvalue().partition("<defs>")
    return (start + STYLE + tag + rest.replace(INK, "currentColor")).encode()
