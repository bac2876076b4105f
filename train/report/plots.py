"""Images of a report: plots as SVG for light and dark pages, small images from files, and the headline."""

import io
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from train.attack_examples import Side
from train.photographs.metrics import Roc
from train.photographs.sheet import draw_roc
from train.report.summary import Score

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

# Okabe and Ito 2008, for color-blind readers, without yellow, which is faint on white. Line styles repeat the color.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES, MARKERS = ("--", "-", ":", "-."), "osD^vP"
SIZE = (4.4, 3.3)  # inches
WIDTH = 440  # CSS pixels
SMALL = 96  # pixels per side of small images
INK = "#123456"  # replaced by the ink of the reader's color scheme
STYLE = "<style>svg{color:#1a1a1a}@media (prefers-color-scheme:dark){svg{color:#e4e4e4}}</style>"
NO_SPINES = {"axes.spines.top": False, "axes.spines.right": False, "text.parse_math": False}
PLOT = {
    **NO_SPINES,
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "font.size": 10,
    "font.family": "sans-serif",
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
    "legend.frameon": False,
    "legend.fontsize": 9,
}
Series = Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]]  # by arm, (x, y) of each seed


@dataclass(frozen=True)
class Picture:
    """A file's bytes. kind: svg, png or jpeg. alt: a description. width: CSS pixels to show it at."""

    data: bytes
    kind: str
    alt: str
    width: int
    caption: str = ""


# ------------------------------------------------------------------------------------- plots


def style(index: int) -> dict[str, Any]:
    """The color and line style of an arm, by its place among the arms."""
    return {"color": COLORS[index % len(COLORS)], "linestyle": LINES[index % len(LINES)]}


def curves(series: Series, title: str, limits: tuple[float, float] | None = (-0.02, 1.02)) -> Picture | None:
    """A line over the epochs per seed, in the color of its arm; None without any data."""
    lines_by_arm = {arm: [line for line in lines if line[0]] for arm, lines in series.items()}
    if not any(lines_by_arm.values()):
        return None

    def draw(axes: "Axes") -> None:
        for index, (arm, lines) in enumerate(lines_by_arm.items()):
            for number, (x, y) in enumerate(lines):
                marker = MARKERS[index % len(MARKERS)] if len(x) < 30 else None
                axes.plot(x, y, marker=marker, ms=4, label=None if number else arm, **style(index))
        axes.set(xlabel="epoch", ylim=limits)
        axes.locator_params(axis="x", integer=True, min_n_ticks=1)

    ends = [f"{arm} {np.mean([y[-1] for _, y in lines]):.2f}" for arm, lines in lines_by_arm.items() if lines]
    return _plot(draw, title, f"{title} by epoch, at the end: {', '.join(ends)}")


def roc(rocs: Mapping[str, Sequence[Roc]], label: str) -> Picture | None:
    """ROC curves by arm, one per seed; None without any."""
    if not any(rocs.values()):
        return None
    styles = {arm: style(index) for index, arm in enumerate(rocs)}
    areas = [f"{arm} {np.mean([r.values()['auc'] for r in group]):.3f}" for arm, group in rocs.items() if group]
    return _plot(lambda axes: draw_roc(axes, rocs, label, styles), "ROC", f"ROC; AUC: {', '.join(areas)}")


def bars(scores: Mapping[str, Mapping[str, Score | None]], title: str) -> Picture | None:
    """Bars with intervals, a row per source and a bar per arm; None without any score."""
    if not scores:
        return None
    sources, arms = [*scores], [*next(iter(scores.values()))]
    thickness = 0.8 / len(arms)

    def draw(axes: "Axes") -> None:
        for index, arm in enumerate(arms):
            known = [(row, value) for row, source in enumerate(sources) if (value := scores[source][arm])]
            rows = [row + (index - (len(arms) - 1) / 2) * thickness for row, _ in known]
            errors = np.array([[s.value - s.low, s.high - s.value] for _, s in known]).reshape(-1, 2).T.clip(0)
            look = {"color": style(index)["color"], "label": arm, "ecolor": INK, "error_kw": {"linewidth": 1}}
            axes.barh(rows, [s.value for _, s in known], thickness * 0.9, xerr=errors, **look)
        axes.set_yticks(range(len(sources)), [name if len(name) < 24 else f"{name[:22]}…" for name in sources])
        axes.set_xlim(0, 1.02)
        axes.invert_yaxis()

    texts = [f"{source}: {_listed(by_arm)}" for source, by_arm in scores.items()]
    height = max(SIZE[1], 0.9 + 0.24 * len(sources) * len(arms))
    return _plot(draw, title, f"{title}. {'; '.join(texts)}", height)


def _listed(scores: Mapping[str, Score | None]) -> str:
    return ", ".join(f"{arm} {score.value:.2f}" for arm, score in scores.items() if score)


def _plot(draw: Callable[["Axes"], None], title: str, alt: str, height: float = SIZE[1]) -> Picture:
    """A transparent SVG, whose text and axes have the color of the reader's scheme."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    file = io.StringIO()
    with mpl.rc_context(PLOT):  # type: ignore[arg-type]  # which wants its keys as literals
        figure = Figure(figsize=(SIZE[0], height), layout="constrained")
        axes = figure.subplots()
        draw(axes)
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=1 if len(max(labels, key=len)) > 16 else 3)
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    start, tag, rest = file.getvalue().partition("<defs>")
    return Picture((start + STYLE + tag + rest.replace(INK, "currentColor")).encode(), "svg", alt, WIDTH, title)


# ------------------------------------------------------------------------------------- images


def encoded(image: Image.Image, alt: str, caption: str = "") -> Picture:
    """As PNG if it is small, else as JPEG."""
    file, small = io.BytesIO(), max(image.size) <= 2 * SMALL
    image.convert("RGB").save(file, "PNG" if small else "JPEG", optimize=True, quality=82)
    return Picture(file.getvalue(), "png" if small else "jpeg", alt, image.width, caption)


def from_file(path: Path, alt: str, widest: int, caption: str = "") -> list[Picture]:
    """The image of a file, reduced to a width; [] if it is missing or broken."""
    try:
        if not path.is_file():  # opening a pipe would block
            return []
        with Image.open(path) as image:
            pixels = image.convert("RGB")
    except Exception:  # Pillow's decoders raise almost anything at a broken file
        return []
    pixels.thumbnail((widest, 4 * widest))
    return [encoded(pixels, alt, caption)]


# ------------------------------------------------------------------------------------- headline

DPI, FONT = 200, 14  # a phone shows its 7.2 inches at half their size
WIDE = 7.2  # inches
HEADLINE = {**NO_SPINES, "font.size": FONT}
LONGEST_LINE, LONGEST_CLASS, LONGEST_TITLE = 14, 9, 25  # characters; longer ones are wrapped, or set smaller


def headline(
    pairs: Sequence[tuple[Side, Side]], scores: Mapping[str, Mapping[str, Score]], label: str, images: str
) -> Picture:
    """Examples before and after their attack beside the scores of every arm, for the first minute.

    scores: by metric and arm, on the images of that name.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    lines = sum(len(textwrap.wrap(arm, LONGEST_LINE)) for by_arm in scores.values() for arm in by_arm)
    width, file = WIDE if scores else WIDE / 2, io.BytesIO()
    with mpl.rc_context(HEADLINE):  # type: ignore[arg-type]
        figure = Figure(figsize=(width, max(4.0, 1.4 + 0.22 * lines)), layout="constrained", dpi=DPI)
        panels = figure.subfigures(1, 2 if scores else 1, squeeze=False)[0]
        _draw_pairs(panels[0], pairs, f"One {label}, another light")
        if scores:
            _draw_scores(panels[1], scores, f"On {images}")
        figure.savefig(file, format="png")
    changes = "; ".join(f"{before.predicted}, then {after.predicted}" for before, after in pairs)
    texts = [f" {metric} on {images}: {_listed(by_arm)}." for metric, by_arm in scores.items()]
    alt = f"{label.capitalize()} before and after its light changed, classified as {changes}.{''.join(texts)}"
    return Picture(file.getvalue(), "png", alt, int(100 * width))


def _draw_pairs(figure: "SubFigure", pairs: Sequence[tuple[Side, Side]], title: str) -> None:
    _draw_title(figure, title)
    grid = figure.subplots(2, len(pairs), squeeze=False)
    grid[0, 0].set_ylabel("before")
    grid[1, 0].set_ylabel("after")
    for column, pair in zip(grid.T, pairs, strict=True):
        for axes, side, mark in zip(column, pair, "✓✗", strict=True):
            axes.imshow(side.image.permute(1, 2, 0).numpy(), interpolation="nearest")
            size = FONT * min(1, LONGEST_CLASS / len(side.predicted))
            axes.set_xlabel(f"{side.predicted}\n{mark} {side.confidence:.0%}", fontsize=size)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set(visible=True, color="0.8")


def _draw_scores(figure: "SubFigure", scores: Mapping[str, Mapping[str, Score]], title: str) -> None:
    _draw_title(figure, title)
    most = max(score.seeds for by_arm in scores.values() for score in by_arm.values())
    note = "one seed, 95 % intervals" if most == 1 else f"means of {most} seeds, lowest to highest"
    figure.supxlabel(note, color="0.35", fontsize=11)
    grid = figure.subplots(len(scores), 1, sharex=True, squeeze=False)
    for axes, (metric, by_arm) in zip(grid.flat, scores.items(), strict=True):
        for row, score in enumerate(by_arm.values()):
            axes.barh(row, score.value, 0.75, color=COLORS[row % len(COLORS)])
            axes.hlines(row, score.low, score.high, color="0.1", linewidth=2)
            axes.annotate(f" {score.value:.2f}", (max(score.high, score.value), row), va="center")
        axes.set(xlim=(0, 1.25), xticks=[], yticks=range(len(by_arm)))
        axes.set_yticklabels([textwrap.fill(arm, LONGEST_LINE) for arm in by_arm])
        axes.set_title(metric, loc="left", fontsize=FONT)
        axes.invert_yaxis()
        axes.spines["bottom"].set_visible(False)
        axes.tick_params(left=False)


def _draw_title(figure: "SubFigure", text: str) -> None:
    size = (FONT + 1) * min(1, LONGEST_TITLE / len(text))
    figure.suptitle(text, x=0.02, ha="left", weight="bold", fontsize=size)
