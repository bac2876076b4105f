"""Images of a report: plots as SVG for light and dark pages, and small images."""

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from train.evaluation.scores.metrics import auc_and_recalls
from train.evaluation.scores.sheet import Pair, draw_roc
from train.evaluation.tables import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# The first two colors are those of the original and of the hardened network on all pages. Their
# contrast to a white and to a dark page is above 3. The others are from Okabe and Ito (2008), for
# color-blind readers. The styles and markers of lines repeat the distinction.
COLORS = ("#7d8590", "#2f81f7", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
LINES = ("--", "-", ":", "-.")
MARKERS = "osD^vP"
# The size of a plot in inches, and its width on the page in CSS pixels.
SIZE = (4.4, 3.3)
WIDTH = 440
# `encoded` writes images of at most this many pixels per side as PNG, and larger
# ones as JPEG.
SMALL = 192
# `_draw_curves` marks the points of lines that have fewer points than this.
MARKED = 30
# Color of text and axes in the file of matplotlib. `_plot` replaces it by the text
# color of the page, which is light or dark.
INK = "#123456"
# Style sheet that `_plot` inserts into each SVG. It sets the text color for light
# and for dark pages.
STYLE = "<style>svg{color:#1a1a1a}@media (prefers-color-scheme:dark){svg{color:#e4e4e4}}</style>"
# Settings of matplotlib with which `_plot` draws.
PLOT = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.parse_math": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "font.size": 10,
    "font.family": "sans-serif",
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9,
}
# Pairs of x and y. None stands for an unknown y.
Points = Sequence[tuple[float, float | None]]


@dataclass(frozen=True)
class Picture:
    """An image of a page.

    Attributes:
        data: The bytes of its file.
        kind: The kind of the file: svg+xml, png or jpeg.
        alt: A description for readers who do not see it.
        width: The width on the page, in CSS pixels.
        caption: The text below it.
    """

    data: bytes
    kind: str
    alt: str
    width: int
    caption: str = ""

    @property
    def uri(self) -> str:
        """Encode the bytes of the file as an address for the page."""
        return f"data:image/{self.kind};base64,{base64.b64encode(self.data).decode()}"


def style(index: int) -> dict[str, Any]:
    """Return matplotlib's keywords for the lines of a method.

    Args:
        index: The place of the method among the methods.

    Returns:
        The color and the line style.
    """
    return {"color": COLORS[index % len(COLORS)], "linestyle": LINES[index % len(LINES)]}


def curves(
    methods: Mapping[str, Sequence[Points]],
    title: str,
    x_title: str = "epoch",
) -> Picture | None:
    """Plot a quantity over epochs or rounds, with a line for each seed of a method.

    Args:
        methods: The points of each seed, by method.
        title: The quantity.
        x_title: What x counts.

    Returns:
        The plot. None if no line has two points that differ.
    """
    lines_of_method: dict[str, list[list[tuple[float, float]]]] = {}
    for method, seeds in methods.items():
        lines_of_method[method] = []
        for points in seeds:
            lines_of_method[method].append([(x, y) for x, y in points if y is not None])
    all_lines = [line for lines in lines_of_method.values() for line in lines]
    # A line whose values are all equal shows nothing.
    if not any(len({y for _, y in line}) > 1 for line in all_lines):
        return None

    means = []
    for method, lines in lines_of_method.items():
        ends = [line[-1][1] for line in lines if line]
        if ends:
            means.append(f"{method} {np.mean(ends):.2f}")
    alt = f"{title} by {x_title}, at the end: {', '.join(means)}"
    return _plot(lambda axes: _draw_curves(axes, lines_of_method, x_title), title, alt)


def _draw_curves(
    axes: "Axes",
    lines_of_method: Mapping[str, list[list[tuple[float, float]]]],
    x_title: str,
) -> None:
    """Draw the lines of each method in the color of the method.

    Args:
        axes: Axes to draw on.
        lines_of_method: For each method, a line for each seed. A line is a list
            of pairs of x and y.
        x_title: Title of the x axis.
    """
    for index, (method, lines) in enumerate(lines_of_method.items()):
        name: str | None = method
        for line in lines:
            if len(line) < 2:
                continue
            marker = MARKERS[index % len(MARKERS)] if len(line) < MARKED else None
            x, y = zip(*line, strict=True)
            axes.plot(x, y, marker=marker, ms=4, label=name, **style(index))
            # Only the first line of a method has an entry in the legend.
            name = None
    axes.set(xlabel=x_title)
    axes.locator_params(axis="x", integer=True, min_n_ticks=1)


def roc(methods: Mapping[str, Sequence[Pair]], label: str) -> Picture | None:
    """Plot ROC curves, one for each seed of a method.

    Args:
        methods: Pairs of the scores of the positives and of the negatives, one
            pair for each seed, by method.
        label: Positive classes in words, for the title of the plot.

    Returns:
        The plot. None if no seed has both positives and negatives.
    """
    # The pairs of each method that have both positives and negatives.
    known = {}
    for method, pairs in methods.items():
        known[method] = [
            (positives, negatives)
            for positives, negatives in pairs
            if len(positives) and len(negatives)
        ]
    if not any(known.values()):
        return None
    # One network has the color of networks after hardening, as on all charts.
    first = 1 if len(methods) == 1 else 0
    styles = {method: style(index) for index, method in enumerate(methods, first)}
    means = []
    for method, pairs in known.items():
        areas = [auc_and_recalls(*pair)[0] for pair in pairs]
        if areas:
            means.append(f"{method} {np.mean(areas):.3f}")
    alt = f"ROC of {label}; AUC: {', '.join(means)}"
    return _plot(lambda axes: draw_roc(axes, known, styles), f"ROC: {label}", alt)


def by_radius(
    lines: Mapping[str, Sequence[Estimate]],
    radii: Sequence[float],
    title: str,
    x_title: str,
) -> Picture:
    """Plot the fraction of views that stay recognized by the radius of attacks.

    Args:
        lines: Fraction at each radius, by name. Each second line is of random
            draws against the network of the line before it.
        radii: Radii in ascending order.
        title: Title of the plot.
        x_title: Title of the radii.

    Returns:
        The plot, with the radii at equal distances.
    """
    ends = [f"{name} {_percent(values[-1])}" for name, values in lines.items()]
    alt = f"{title}: still recognized at the largest radius: {', '.join(ends)}"

    def draw(axes: "Axes") -> None:
        positions = np.arange(len(radii))
        # One network has the second color, that of networks after hardening.
        first = 1 if len(lines) <= 2 else 0
        for index, (name, values) in enumerate(lines.items()):
            is_random = index % 2 == 1
            _draw_fractions(axes, positions, values, name, COLORS[first + index // 2], is_random)
        axes.set(ylim=(-0.02, 1.02), xlabel=x_title, ylabel="still recognized")
        axes.set_xticks(positions, [f"{radius:g}" for radius in radii])

    return _plot(draw, title, alt)


def _percent(estimate: Estimate) -> str:
    """Write a fraction in percent, such as "81%", or "-" if it is unknown."""
    return "-" if estimate.value is None else f"{estimate.value:.0%}"


def _draw_fractions(
    axes: "Axes",
    positions: np.ndarray,
    values: Sequence[Estimate],
    name: str,
    color: str,
    is_random: bool,
) -> None:
    """Draw the line of the fractions of views that stay recognized.

    Args:
        axes: Axes to draw on.
        positions: Position of each radius on the x axis, shape (radii,).
        values: Fraction at each radius, with its 95% interval.
        name: Name of the line in the legend.
        color: Color of the line.
        is_random: Whether the line is of random draws. It is then dotted.
            Otherwise it is of attacks, and has error bars.
    """
    heights = np.array([estimate.value for estimate in values], float)
    if is_random:
        axes.plot(positions, heights, color=color, linestyle=":", label=name)
        return
    lows = np.array([estimate.low for estimate in values], float)
    highs = np.array([estimate.high for estimate in values], float)
    # Rounding can put the lower end just above the fraction, or the upper end
    # just below it. Error bars must not be negative.
    errors = np.stack([heights - lows, highs - heights]).clip(min=0)
    axes.errorbar(positions, heights, errors, color=color, marker="o", ms=4, capsize=3, label=name)


def _plot(draw: Callable[["Axes"], None], title: str, alt: str) -> Picture:
    """Draw a transparent SVG for light and dark pages.

    Args:
        draw: Function that draws on the axes.
        title: Caption of the plot.
        alt: Description for readers who do not see the plot.

    Returns:
        The plot. A browser shows its text and axes in dark color on light
        pages, and in light color on dark pages.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    file = io.StringIO()
    with mpl.rc_context(PLOT):  # type: ignore[arg-type]  # Its type wants the keys as literals.
        figure = Figure(figsize=SIZE, layout="constrained")
        axes = figure.subplots()
        draw(axes)
        handles, labels = axes.get_legend_handles_labels()
        if labels:
            legend = dict(zip(labels, handles, strict=True))  # This keeps each label once.
            columns = 1 if len(max(labels, key=len)) > 16 else 3
            figure.legend([*legend.values()], [*legend], loc="outside lower center", ncols=columns)
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    # The style sheet is inserted before the first definition of the SVG.
    start, tag, rest = file.getvalue().partition("<defs>")
    page = start + STYLE + tag + rest.replace(INK, "currentColor")
    return Picture(page.encode(), "svg+xml", alt, WIDTH, title)


def encoded(image: Image.Image, alt: str, caption: str = "") -> Picture:
    """Encode an image, as PNG if it is small, and otherwise as JPEG.

    Args:
        image: The image.
        alt: A description for readers who do not see it.
        caption: The text below it.

    Returns:
        The picture, shown at its own size.
    """
    file = io.BytesIO()
    if max(image.size) <= SMALL:
        image.save(file, "PNG", optimize=True)
        return Picture(file.getvalue(), "png", alt, image.width, caption)
    image.convert("RGB").save(file, "JPEG", optimize=True, quality=82)
    return Picture(file.getvalue(), "jpeg", alt, image.width, caption)


def from_file(path: Path, alt: str, widest: int, caption: str = "") -> list[Picture]:
    """Read the image of a file, and reduce it.

    Args:
        path: The file.
        alt: A description for readers who do not see it.
        widest: The width in pixels, at most.
        caption: The text below it.

    Returns:
        The picture. Nothing if the file is missing or broken.
    """
    try:
        with Image.open(path) as image:
            pixels = image.convert("RGB")
    except Exception:  # Pillow's decoders raise almost anything at a broken file.
        return []
    pixels.thumbnail((widest, 4 * widest))
    return [encoded(pixels, alt, caption)]
