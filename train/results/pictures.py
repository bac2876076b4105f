"""Pictures of results: plots as SVG for light and dark pages, contact sheets and ROC curves."""

import base64
import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Int
from PIL import Image, ImageOps
from torch import Tensor

from renderer.io.files import atomic_write
from renderer.io.images import PAPER, Tile, draw_grid, open_image
from train.results.intervals import RATES, auc_and_recalls, roc_curve
from train.results.predictions import ROC_FIGURE, ROC_TABLE, Prediction, by_label
from train.results.tables import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Colors of the lines of a plot. The first two colors are those of the original and of the hardened
# network. Their contrast to a white and to a dark page is above 3. The other colors are from Okabe
# and Ito (2008), who chose them for color-blind readers.
COLORS = ("#7d8590", "#2f81f7", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
LINES = ("--", "-", ":", "-.")
MARKERS = "osD^vP"
# The size of a plot in inches, and its width on the page in CSS pixels.
SIZE = (4.4, 3.3)
WIDTH = 440
# `encode_picture` writes images of at most this many pixels per side as PNG, and larger
# ones as JPEG.
SMALL = 192
# Lines with fewer points than this have a marker at each point.
MARKED = 30
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
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9,
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
# Colors of the frames: true positives, false negatives and false positives.
GREEN = "#2e9e5b"
RED = "#d03b3b"
YELLOW = "#e8a317"

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
    methods: Mapping[str, Sequence[Points]],
    title: str,
    x_title: str = "epoch",
) -> Picture | None:
    """Plot a metric over epochs or rounds, with a line for each seed of each method.

    None if the metric is constant in each line.
    """
    lines_of_method: dict[str, list[list[tuple[float, float]]]] = {}
    for method, seeds in methods.items():
        lines_of_method[method] = []
        for points in seeds:
            lines_of_method[method].append([(x, y) for x, y in points if y is not None])
    all_lines = [line for lines in lines_of_method.values() for line in lines]
    is_constant = [len({y for _, y in line}) < 2 for line in all_lines]
    if all(is_constant):
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
    """Draw the lines of each method in the color of the method."""
    for index, (method, lines) in enumerate(lines_of_method.items()):
        name: str | None = method
        for line in lines:
            if len(line) < 2:
                continue
            marker = MARKERS[index % len(MARKERS)] if len(line) < MARKED else None
            x, y = zip(*line, strict=True)
            axes.plot(x, y, marker=marker, ms=4, label=name, **style(index))
            # The other lines of the method get no label, and so no entry in the legend.
            name = None
    axes.set(xlabel=x_title)
    axes.locator_params(axis="x", integer=True, min_n_ticks=1)


def plot_roc(methods: Mapping[str, Sequence[Pair]], label: str) -> Picture | None:
    """Plot ROC curves, with a curve for each seed of each method.

    A pair has the scores of the positive and of the negative images of a seed. None if no seed has
    both.
    """
    # Seeds of each method that have both positive and negative images.
    known = {}
    for method, pairs in methods.items():
        known[method] = [
            (positives, negatives)
            for positives, negatives in pairs
            if len(positives) and len(negatives)
        ]
    if not any(known.values()):
        return None
    # A single network gets the second color, which is the color of a hardened network.
    first_color = 1 if len(methods) == 1 else 0
    styles = {method: style(index) for index, method in enumerate(methods, first_color)}
    means = []
    for method, pairs in known.items():
        areas = [auc_and_recalls(*pair)[0] for pair in pairs]
        if areas:
            means.append(f"{method} {np.mean(areas):.3f}")
    alt = f"ROC of {label}; AUC: {', '.join(means)}"
    return _plot(lambda axes: draw_roc(axes, known, styles), f"ROC: {label}", alt)


def plot_by_radius(
    lines: Mapping[str, Sequence[Estimate]],
    radii: Sequence[float],
    title: str,
    x_title: str,
) -> Picture:
    """Plot which fraction of views is still recognized under attacks of a given radius.

    Each network has two lines in turn: attacks, and random changes. The radii, ascending, stand at
    equal distances.
    """
    ends = [f"{name} {_percent(values[-1])}" for name, values in lines.items()]
    alt = f"{title}: still recognized at the largest radius: {', '.join(ends)}"

    def draw(axes: "Axes") -> None:
        positions = np.arange(len(radii))
        # A single network gets the second color, which is the color of a hardened network.
        first_color = 1 if len(lines) <= 2 else 0
        for index, (name, values) in enumerate(lines.items()):
            is_random = index % 2 == 1
            color = COLORS[first_color + index // 2]
            _draw_fractions(axes, positions, values, name, color, is_random)
        axes.set(ylim=(-0.02, 1.02), xlabel=x_title, ylabel="still recognized")
        axes.set_xticks(positions, [f"{radius:g}" for radius in radii])

    return _plot(draw, title, alt)


def _percent(estimate: Estimate) -> str:
    """Write a fraction in percent without its interval, such as "81%", or "-" if it is unknown."""
    return "-" if estimate.value is None else f"{estimate.value:.0%}"


def _draw_fractions(
    axes: "Axes",
    positions: Int[np.ndarray, " radii"],
    values: Sequence[Estimate],
    name: str,
    color: str,
    is_random: bool,
) -> None:
    """Draw a line with the fraction of views that is still recognized at each radius.

    Random changes are a dotted line. Attacks are a line with error bars, the 95% interval.
    """
    heights = np.array([estimate.value for estimate in values], float)
    if is_random:
        axes.plot(positions, heights, color=color, linestyle=":", label=name)
        return
    lows = np.array([estimate.low for estimate in values], float)
    highs = np.array([estimate.high for estimate in values], float)
    # Error bars must not be negative. Rounding errors can put an end of the interval on
    # the wrong side of the fraction.
    errors = np.stack([heights - lows, highs - heights]).clip(min=0)
    axes.errorbar(positions, heights, errors, color=color, marker="o", ms=4, capsize=3, label=name)


def _plot(draw: Callable[["Axes"], None], title: str, alt: str) -> Picture:
    """Draw a plot as a transparent SVG, which fits light and dark pages."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    file = io.StringIO()
    with mpl.rc_context(PLOT):  # type: ignore[arg-type]  # Its type wants the keys as literals.
        figure = Figure(figsize=SIZE, layout="constrained")
        axes = figure.subplots()
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
    """Encode an image for a page: a small image as PNG, a larger one as JPEG."""
    file = io.BytesIO()
    if max(image.size) <= SMALL:
        image.save(file, "PNG", optimize=True)
        return Picture(file.getvalue(), "png", alt, image.width, caption)
    image.convert("RGB").save(file, "JPEG", optimize=True, quality=82)
    return Picture(file.getvalue(), "jpeg", alt, image.width, caption)


def read_pictures(path: Path, alt: str, widest: int, caption: str = "") -> list[Picture]:
    """Read an image from a file, and encode it for a page.

    A wider image is reduced to `widest` pixels. The list is empty if the file is missing or
    damaged.
    """
    try:
        with open_image(path) as image:
            pixels = image.convert("RGB")
    except Exception:  # Pillow raises errors of many types for a damaged file.
        return []
    pixels.thumbnail((widest, 4 * widest))
    return [encode_picture(pixels, alt, caption)]


def contact_sheet(predictions: Sequence[Prediction], images: Tensor) -> Image.Image:
    """Draw a contact sheet of right and wrong predictions for each positive class.

    Each positive class has three sections: true positives, false negatives and
    false positives. A section has at most MAX_IMAGES images. If there are more,
    it shows images at equal distances in the order of probability. The images are enlarged without
    smoothing, so that pixels stay visible.
    """
    grids = [draw_grid([], heading=LEGEND)]
    for label, of_label in by_label(predictions).items():
        shown = sorted(zip(of_label, images, strict=True), key=lambda pair: -pair[0].probability)
        positives = [pair for pair in shown if pair[0].positive]
        negatives = [pair for pair in shown if not pair[0].positive]
        found = [pair for pair in positives if pair[0].predicted == label]
        missed = [pair for pair in positives if pair[0].predicted != label]
        mistaken = [pair for pair in negatives if pair[0].predicted == label]
        sections = {
            "true positives": (GREEN, found, positives),
            "false negatives": (RED, missed, positives),
            "false positives": (YELLOW, mistaken, negatives),
        }
        for name, (color, pairs, all_of_kind) in sections.items():
            heading = f"{label}: {len(pairs)} {name} of {len(all_of_kind)}"
            grids.append(_draw_section(heading, color, pairs))
    width = max(grid.width for grid in grids)
    sheet = Image.new("RGB", (width, sum(grid.height for grid in grids)), PAPER)
    top = 0
    for grid in grids:
        sheet.paste(grid, (0, top))
        top += grid.height
    return sheet


def _draw_section(
    heading: str, color: str, shown: Sequence[tuple[Prediction, Tensor]]
) -> Image.Image:
    """Draw images with frames of a color in a grid below a heading."""
    if len(shown) > MAX_IMAGES:
        heading += f" ({MAX_IMAGES} shown, evenly by probability)"
    tiles = [_tile(*pair, color) for pair in evenly_spaced(shown, MAX_IMAGES)]
    rows = [tiles[first : first + COLUMNS] for first in range(0, len(tiles), COLUMNS)]
    return draw_grid(rows, heading=heading)


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """Choose items of a list at equal distances, including the first and the last one.

    All, if there are at most `count`.
    """
    indices = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[index] for index in indices.round().astype(int)]


def _tile(prediction: Prediction, image: Tensor, color: str) -> Tile:
    """Enlarge an image, and add a frame, its prediction and, if that is wrong, its true class."""
    pixels = Image.fromarray(image.permute(1, 2, 0).numpy())
    enlarged = pixels.resize((IMAGE_SIZE, IMAGE_SIZE), Image.Resampling.NEAREST)
    lines = [f"{prediction.probability:.0%} {prediction.predicted}"]
    if prediction.true_rank != 1:
        label = prediction.photograph.label
        probability = prediction.true_probability
        lines.append(label if probability is None else f"{probability:.0%} {label}")
    captions = tuple(_shortened(line) for line in lines)
    return Tile(np.asarray(ImageOps.expand(enlarged, FRAME_WIDTH, color)), captions)


def _shortened(caption: str) -> str:
    """Cut off the end of a caption that is too long, and add "…"."""
    if len(caption) <= MAX_CAPTION_LENGTH:
        return caption
    return f"{caption[: MAX_CAPTION_LENGTH - 1]}…"


def write_roc(folder: Path, overall: Pair, by_name: Mapping[str, Pair], label: str) -> None:
    """Write ROC curves to the table roc.csv and to the figure roc.png.

    There is a curve for all images, and one for each source or label. A curve
    is left out if it lacks positives or negatives. A pair has the log-odds of positives and of
    negatives.
    """
    # This import is here because it takes half a second.
    from matplotlib.figure import Figure

    # `all(map(len, pair))` is True if there are both positives and negatives.
    known = {name: pair for name, pair in by_name.items() if all(map(len, pair))}
    has_overall = all(map(len, overall))
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["source", "false_positive_rate", "recall", "threshold"])
    if has_overall:
        writer.writerows(_curve_rows("", overall))
    for name, pair in known.items():
        writer.writerows(_curve_rows(name, pair))
    atomic_write(folder / ROC_TABLE, table.getvalue())

    figure = Figure(figsize=(7, 7), layout="constrained")
    axes = figure.subplots()
    # A source or a label can have the name "all", too.
    title = "all images" if "all" in known else "all"
    curves = {title: [overall]} if has_overall else {}
    curves |= {name: [pair] for name, pair in known.items()}
    bold = {title: {"color": "black", "linewidth": 2.5, "zorder": 3}}
    draw_roc(axes, curves, bold)
    axes.set_title(f"ROC: {label}")
    axes.set_aspect("equal")
    if curves:
        axes.legend(loc="lower right")
    image = io.BytesIO()
    figure.savefig(image)
    atomic_write(folder / ROC_FIGURE, image.getbuffer())


def _curve_rows(name: str, pair: Pair) -> list[tuple[object, ...]]:
    """Make a row of roc.csv for each point of a ROC curve.

    A row has the name (empty for all images), false-positive rate, recall and threshold.
    """
    points = zip(*roc_curve(*pair), strict=True)
    return [(name, *map(float, point)) for point in points]


def draw_roc(
    axes: "Axes",
    scores: Mapping[str, Sequence[Pair]],
    styles: Mapping[str, Mapping[str, Any]],
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
        areas = [auc_and_recalls(*pair)[0] for pair in pairs]
        legend: str | None = f"{name}: AUC {np.mean(areas):.3f}" if areas else None
        for pair in pairs:
            rates, recalls, _ = roc_curve(*pair)
            axes.plot(rates, recalls, label=legend, **styles.get(name, {}))
            # Further curves of the same name have no entry in the legend.
            legend = None
    axes.set(xlabel="false positive rate", ylabel="recall")
    axes.set(xlim=(-0.01, 1), ylim=(0, 1.01))
