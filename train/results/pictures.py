"""Pictures of results: plots as SVG for light and dark pages, contact sheets and ROC curves."""

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from renderer.io.files import atomic_write
from renderer.io.images import PAPER, Tile, draw_grid, encode_image, open_image, read_center
from train.results.intervals import RATES, auc_and_recalls, roc_curve
from train.results.predictions import ROC_FIGURE, ROC_TABLE, Predictions
from train.results.tables import Estimate, write_csv

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colors of the lines of a plot. The first two colors are those of the original and of the hardened
# network. Their contrast to a white and to a dark page is above 3. The other colors are from Okabe
# and Ito (2008), who chose them for color-blind readers.
COLORS = ("#7d8590", "#2f81f7", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
LINES = ("--", "-", ":", "-.")
# The size of a plot in inches, and its width on the page in CSS pixels.
SIZE = (4.4, 3.3)
WIDTH = 440
# `encode_picture` writes images of at most this many pixels per side as PNG, and larger
# ones as JPEG.
SMALL = 192
# Color of text and axes in the SVG that matplotlib writes. It stands for the text color
# of the page, and is replaced by "currentColor".
INK = "#123456"
# Style sheet that is inserted into each SVG. It sets the text color to dark on light
# pages and to light on dark pages.
STYLE = "<style>svg{color:#1a1a1a}@media (prefers-color-scheme:dark){svg{color:#e4e4e4}}</style>"
# Settings of matplotlib (rcParams) for the plots of a report.
PLOT = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.parse_math": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "font.size": 10,
    "font.family": "sans-serif",
    "legend.frameon": False,
    "legend.fontsize": 9,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor"), INK),
    **dict.fromkeys(("xtick.color", "ytick.color"), INK),
}
# Each section of the contact sheet, such as the false positives, shows at most 40
# photographs.
MAX_IMAGES = 40
# Each row of the contact sheet has 10 photographs.
COLUMNS = 10
# Width and height of a photograph on the contact sheet, in pixels.
IMAGE_SIZE = 96
# Width of the colored frame around a photograph, in pixels.
FRAME_WIDTH = 4
# A caption with more characters is cut off.
MAX_CAPTION_LENGTH = 18
LEGEND = (
    "Under each image: the predicted class and its probability. "
    "If the prediction is wrong, the true class follows in gray."
)

Item = TypeVar("Item")
# Data of one ROC curve: the log-odds of the positives, shape (n,), and of the
# negatives, shape (m,).
Pair = tuple[np.ndarray, np.ndarray]
# Points of a line: pairs of x and y. None stands for an unknown y.
Points = Sequence[tuple[float, float | None]]


@dataclass(frozen=True)
class Picture:
    """An image on an HTML page.

    Attributes:
        data: Bytes of the file of the image.
        kind: Subtype of the media type of the file: "svg+xml", "png" or "jpeg".
        alt: Description for readers who do not see the image.
        width: Width on the page, in CSS pixels.
        caption: Text below the image.
    """

    data: bytes
    kind: str
    alt: str
    width: int
    caption: str = ""

    @property
    def uri(self) -> str:
        """Data URI that contains the whole image, for the attribute `src` of an `img` element."""
        return f"data:image/{self.kind};base64,{base64.b64encode(self.data).decode()}"


def style(index: int) -> dict[str, Any]:
    """Return the color and line style of the method with this index, as matplotlib takes them."""
    return {"color": COLORS[index % len(COLORS)], "linestyle": LINES[index % len(LINES)]}


def plot_curves(
    methods: Mapping[str, Sequence[Points]], title: str, x_title: str = "epoch"
) -> Picture | None:
    """Plot a metric over epochs or rounds, with a line for each seed of each method.

    None if the metric is constant in each line.
    """
    # Epochs in which the metric is unknown are left out.
    lines_of_method = {
        method: [[(x, y) for x, y in points if y is not None] for points in seeds]
        for method, seeds in methods.items()
    }
    if all(len({y for _, y in line}) < 2 for line in chain(*lines_of_method.values())):
        return None
    # The last value of each line, whose mean the description states.
    ends = {
        method: [line[-1][1] for line in lines if line] for method, lines in lines_of_method.items()
    }
    means = [f"{method} {np.mean(values):.2f}" for method, values in ends.items() if values]

    def draw(axes: "Axes") -> None:
        for index, (method, lines) in enumerate(lines_of_method.items()):
            for line in lines:
                if len(line) > 1:
                    axes.plot(*np.array(line).T, label=method, **style(index))
        axes.set(xlabel=x_title)
        axes.locator_params(axis="x", integer=True, min_n_ticks=1)

    return _plot(draw, title, f"{title} by {x_title}, at the end: {', '.join(means)}")


def plot_roc(methods: Mapping[str, Sequence[Pair]], label: str) -> Picture | None:
    """Plot ROC curves, with a curve for each seed of each method.

    A pair has the scores of the positive and of the negative images of a seed. None if no seed has
    both.
    """
    # Seeds of each method that have both positive and negative images.
    known = {
        method: [pair for pair in pairs if all(map(len, pair))] for method, pairs in methods.items()
    }
    if not any(known.values()):
        return None
    # A single network gets the second color, which is the color of a hardened network.
    first_color = 1 if len(methods) == 1 else 0
    styles = {method: style(index) for index, method in enumerate(methods, first_color)}
    means = [f"{method} {_mean_auc(pairs):.3f}" for method, pairs in known.items() if pairs]
    alt = f"ROC of {label}; AUC: {', '.join(means)}"
    return _plot(lambda axes: draw_roc(axes, known, styles), f"ROC: {label}", alt)


def plot_by_radius(
    lines: Mapping[str, Sequence[Estimate]], radii: Sequence[float], title: str, x_title: str
) -> Picture:
    """Plot which fraction of views is still recognized under attacks of a given radius.

    Each network has two lines in turn: attacks with error bars, the 95% interval, and random
    changes, dotted. The radii, ascending, stand at equal distances.
    """
    last = {name: values[-1].value for name, values in lines.items()}
    ends = [f"{name} {'-' if end is None else f'{end:.0%}'}" for name, end in last.items()]
    alt = f"{title}: still recognized at the largest radius: {', '.join(ends)}"

    def draw(axes: "Axes") -> None:
        positions = np.arange(len(radii))
        # A single network gets the second color, which is the color of a hardened network.
        first_color = 1 if len(lines) <= 2 else 0
        for index, (name, values) in enumerate(lines.items()):
            color = COLORS[first_color + index // 2]
            numbers = [[item.value, item.low, item.high] for item in values]
            heights, lows, highs = np.array(numbers, float).T
            if index % 2 == 1:
                axes.plot(positions, heights, color=color, linestyle=":", label=name)
                continue
            # Error bars must not be negative. Rounding errors can put an end of the interval on
            # the wrong side of the fraction.
            errors = np.stack([heights - lows, highs - heights]).clip(min=0)
            bars: dict[str, Any] = {"marker": "o", "ms": 4, "capsize": 3}
            axes.errorbar(positions, heights, errors, color=color, label=name, **bars)
        axes.set(ylim=(-0.02, 1.02), xlabel=x_title, ylabel="still recognized")
        axes.set_xticks(positions, [f"{radius:g}" for radius in radii])

    return _plot(draw, title, alt)


def _plot(draw: Callable[["Axes"], None], title: str, alt: str) -> Picture:
    """Draw a plot as a transparent SVG, which fits light and dark pages."""
    import matplotlib as mpl

    file = io.StringIO()
    with mpl.rc_context(PLOT):  # type: ignore[arg-type]  # Its type wants the keys as literals.
        figure, axes = new_figure(SIZE)
        draw(axes)
        handles, labels = axes.get_legend_handles_labels()
        if labels:
            # A dictionary has each label once.
            legend = dict(zip(labels, handles, strict=True))
            columns = 1 if len(max(labels, key=len)) > 16 else 3
            figure.legend([*legend.values()], [*legend], loc="outside lower center", ncols=columns)
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    # The style sheet is inserted before the first element <defs> of the SVG.
    start, tag, rest = file.getvalue().partition("<defs>")
    page = start + STYLE + tag + rest.replace(INK, "currentColor")
    return Picture(page.encode(), "svg+xml", alt, WIDTH, title)


def encode_picture(image: Image.Image, alt: str, caption: str = "") -> Picture:
    """Encode an RGB image for a page: a small image as PNG, a larger one as JPEG."""
    kind = "png" if max(image.size) <= SMALL else "jpeg"
    # The quality is that of JPEG.
    content = encode_image(image, kind.upper(), optimize=True, quality=82)
    return Picture(content, kind, alt, image.width, caption)


def read_square(path: Path, side: int, alt: str, caption: str = "") -> Picture:
    """Read the central square of a photograph from a file, and encode it for a page."""
    return encode_picture(Image.fromarray(read_center(path, side)), alt, caption)


def read_pictures(path: Path, alt: str, widest: int, caption: str = "") -> list[Picture]:
    """Read an image from a file, and encode it for a page.

    An image wider than `widest` pixels, or higher than four times as many, is reduced: contact
    sheets are high. The list is empty if the file is missing or damaged.
    """
    try:
        with open_image(path) as image:
            pixels = image.convert("RGB")
    except Exception:  # Pillow raises errors of many types for a damaged file.
        return []
    pixels.thumbnail((widest, 4 * widest))
    return [encode_picture(pixels, alt, caption)]


def contact_sheet(predictions: Predictions, images: UInt8[np.ndarray, "N 3 H W"]) -> Image.Image:
    """Draw a contact sheet of right and wrong predictions for each positive class.

    Each positive class has three sections: true positives, false negatives and
    false positives. A section has at most MAX_IMAGES images. If there are more,
    it shows images at equal distances in the order of probability. The images are enlarged without
    smoothing, so that pixels stay visible.
    """
    grids = [draw_grid([], heading=LEGEND)]
    for label, rows in predictions.by_label.items():
        # Photographs by the probability of their predicted class, the highest first.
        order = np.argsort(-rows.probability, kind="stable")
        is_positive = rows.positive[order]
        is_found = rows.predicted[order] == label
        # The frames are green, red and yellow.
        for name, color, is_shown, is_of_kind in (
            ("true positives", "#2e9e5b", is_positive & is_found, is_positive),
            ("false negatives", "#d03b3b", is_positive & ~is_found, is_positive),
            ("false positives", "#e8a317", ~is_positive & is_found, ~is_positive),
        ):
            count = is_shown.sum()
            limit = f" ({MAX_IMAGES} shown, evenly by probability)" if count > MAX_IMAGES else ""
            heading = f"{label}: {count} {name} of {is_of_kind.sum()}{limit}"
            chosen = evenly_spaced(order[is_shown].tolist(), MAX_IMAGES)
            tiles = [_tile(rows[row], images[row], color) for row in chosen]
            lines = [tiles[first : first + COLUMNS] for first in range(0, len(tiles), COLUMNS)]
            grids.append(draw_grid(lines, heading=heading))
    # The upper edge of each grid. `tops.pop()` is the height of the sheet.
    tops = [0, *accumulate(grid.height for grid in grids)]
    sheet = Image.new("RGB", (max(grid.width for grid in grids), tops.pop()), PAPER)
    for grid, top in zip(grids, tops, strict=True):
        sheet.paste(grid, (0, top))
    return sheet


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """Choose items of a list at equal distances, including the first and the last one.

    All, if there are at most `count`.
    """
    indices = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[index] for index in indices.round().astype(int)]


def _tile(row: Any, image: UInt8[np.ndarray, "3 H W"], color: str) -> Tile:
    """Enlarge an image, and add a frame, its prediction and, if that is wrong, its true class."""
    pixels = Image.fromarray(image.transpose(1, 2, 0))
    enlarged = pixels.resize((IMAGE_SIZE, IMAGE_SIZE), Image.Resampling.NEAREST)
    lines = [f"{row.probability:.0%} {row.predicted}"]
    # A class that the network lacks has the rank infinity, and no probability.
    if row.true_rank != 1:
        label = row.photograph.label
        is_known = np.isfinite(row.true_rank)
        lines.append(f"{row.true_probability:.0%} {label}" if is_known else label)
    captions = tuple(
        line if len(line) <= MAX_CAPTION_LENGTH else f"{line[: MAX_CAPTION_LENGTH - 1]}…"
        for line in lines
    )
    return Tile(np.asarray(ImageOps.expand(enlarged, FRAME_WIDTH, color)), captions)


def write_roc(folder: Path, pairs: Mapping[str, Pair], label: str) -> None:
    """Write ROC curves to the table roc.csv and to the figure roc.png.

    There is a curve for all images, whose name is "", and one for each source or label. A curve
    is left out if it lacks positives or negatives. A pair has the log-odds of positives and of
    negatives.
    """
    known = {name: pair for name, pair in pairs.items() if all(map(len, pair))}
    # A source or a label can have the name "all", too.
    title = "all images" if "all" in known else "all"
    rows: list[Sequence[object]] = [["source", "false_positive_rate", "recall", "threshold"]]
    for name, pair in known.items():
        columns = (column.tolist() for column in roc_curve(*pair))
        rows += [[name, *point] for point in zip(*columns, strict=True)]
    write_csv(folder / ROC_TABLE, rows)

    figure, axes = new_figure((7, 7))
    bold = {title: {"color": "black", "linewidth": 2.5, "zorder": 3}}
    draw_roc(axes, {name or title: [pair] for name, pair in known.items()}, bold)
    axes.set_title(f"ROC: {label}")
    axes.set_aspect("equal")
    if known:
        axes.legend(loc="lower right")
    write_figure(folder / ROC_FIGURE, figure)


def new_figure(size: tuple[float, float]) -> tuple["Figure", "Axes"]:
    """Make a figure of matplotlib of a size in inches, with one plot."""
    from matplotlib.figure import Figure  # matplotlib takes half a second.

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots()


def write_figure(path: Path, figure: "Figure", **options: Any) -> None:
    """Write a figure of matplotlib to a PNG file."""
    image = io.BytesIO()
    figure.savefig(image, **options)
    atomic_write(path, image.getbuffer())


def _mean_auc(pairs: Sequence[Pair]) -> float:
    """Average the area under the ROC curves of several runs."""
    return float(np.mean([auc_and_recalls(*pair)[0] for pair in pairs]))


def draw_roc(
    axes: "Axes", scores: Mapping[str, Sequence[Pair]], styles: Mapping[str, Mapping[str, Any]]
) -> None:
    """Draw ROC curves, with the AUC in the legend.

    Dotted vertical lines mark the false-positive rates in `RATES`. `scores` has pairs of log-odds
    of positives and negatives. Several runs have a curve each in one style, and their mean AUC in
    the legend.
    """
    # The ROC curve of a random classifier is the diagonal.
    axes.axline((0, 0), slope=1, color="0.6", linewidth=1)
    for rate in map(float, RATES):
        axes.axvline(rate, color="0.6", linewidth=1, linestyle=":")
    for name, pairs in scores.items():
        for number, pair in enumerate(pairs):
            rates, recalls, _ = roc_curve(*pair)
            # Further curves of the same name have no entry in the legend.
            legend = None if number else f"{name}: AUC {_mean_auc(pairs):.3f}"
            axes.plot(rates, recalls, label=legend, **styles.get(name, {}))
    axes.set(xlabel="false positive rate", ylabel="recall")
    axes.set(xlim=(-0.01, 1), ylim=(0, 1.01))
