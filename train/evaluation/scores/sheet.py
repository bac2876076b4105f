"""Images of an evaluation: a contact sheet of photographs with predictions, and ROC curves."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from PIL import Image, ImageOps

from renderer.io.files import atomic_write
from renderer.io.tiles import PAPER, Tile, draw_grid
from train.evaluation.scores.metrics import RATES, auc_and_recalls, roc_curve
from train.evaluation.scores.predictions import Prediction, by_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROC_TABLE = "roc.csv"
ROC_FIGURE = "roc.png"
# Largest number of images in a section of the contact sheet.
PER_SECTION = 40
# Number of images in a row of a section.
COLUMNS = 10
# Side of an enlarged image in pixels.
IMAGE = 96
# Width of the frame of an image in pixels.
FRAME = 4
# `_shortened` cuts captions of more characters than this.
LONGEST_CAPTION = 18
LEGEND = (
    "Under each image: the predicted class and its probability. "
    "If the prediction is wrong, the true class follows in gray."
)
# Colors of the frames.
GREEN = "#2e9e5b"
RED = "#d03b3b"
YELLOW = "#e8a317"

Item = TypeVar("Item")
# Log-odds of the positives, shape (n,), and of the negatives, shape (m,).
Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class _Section:
    """A section of the contact sheet about one class.

    Attributes:
        name: Title of the section, such as "true positives".
        color: Color of the frames.
        shown: Predictions with their images, by falling probability.
        total: Number of all positives, for true positives and false negatives.
            Number of all negatives, for false positives.
    """

    name: str
    color: str
    shown: list[tuple[Prediction, torch.Tensor]]
    total: int


def contact_sheet(predictions: Sequence[Prediction], images: torch.Tensor) -> Image.Image:
    """Draw what is right and wrong about each positive class.

    True positives, false negatives and false positives have a section each, with up to
    PER_SECTION images that are evenly spread by probability.

    Args:
        predictions: The predictions, about the first class for all images, then about the next.
        images: The images, uint8 sRGB, shape (N, 3, H, W). They are enlarged without smoothing,
            so that one sees the pixels that the classifier saw.

    Returns:
        The sheet.
    """
    grids = [draw_grid([], heading=LEGEND)]
    for label, items in by_label(predictions).items():
        for section in _sections(label, items, images):
            grids.append(_section_grid(label, section))
    width = max(grid.width for grid in grids)
    sheet = Image.new("RGB", (width, sum(grid.height for grid in grids)), PAPER)
    top = 0
    for grid in grids:
        sheet.paste(grid, (0, top))
        top += grid.height
    return sheet


def _sections(
    label: str,
    predictions: Sequence[Prediction],
    images: torch.Tensor,
) -> list[_Section]:
    """Divide the predictions about a class into the sections of the contact sheet.

    True negatives have no section.

    Args:
        label: The class.
        predictions: Predictions about this class for all images.
        images: The images, uint8, shape (N, 3, H, W).
    """
    pairs = list(zip(predictions, images, strict=True))
    # The images with the most confident predictions come first.
    pairs.sort(key=lambda pair: pair[0].probability, reverse=True)
    positives = [(item, image) for item, image in pairs if item.positive]
    negatives = [(item, image) for item, image in pairs if not item.positive]
    found = [(item, image) for item, image in positives if item.predicted == label]
    missed = [(item, image) for item, image in positives if item.predicted != label]
    mistaken = [(item, image) for item, image in negatives if item.predicted == label]
    return [
        _Section("true positives", GREEN, found, len(positives)),
        _Section("false negatives", RED, missed, len(positives)),
        _Section("false positives", YELLOW, mistaken, len(negatives)),
    ]


def _section_grid(label: str, section: _Section) -> Image.Image:
    """Draw the heading of a section and, below it, at most PER_SECTION of its images."""
    count = len(section.shown)
    heading = f"{label}: {count} {section.name} of {section.total}"
    if count > PER_SECTION:
        heading += f" ({PER_SECTION} shown, evenly by probability)"
    tiles = []
    for prediction, image in evenly_spaced(section.shown, PER_SECTION):
        tiles.append(_tile(prediction, image, section.color))
    rows = [tiles[first : first + COLUMNS] for first in range(0, len(tiles), COLUMNS)]
    return draw_grid(rows, heading=heading)


def evenly_spaced(ordered: Sequence[Item], count: int) -> list[Item]:
    """Choose items at equal distances, the first and the last among them.

    Args:
        ordered: The items.
        count: The number of items to choose.

    Returns:
        The chosen items; all items if there are no more.
    """
    places = np.linspace(0, len(ordered) - 1, min(count, len(ordered)))
    return [ordered[index] for index in places.round().astype(int)]


def _tile(prediction: Prediction, image: torch.Tensor, color: str) -> Tile:
    """Draw an image in a frame, with captions below it.

    Args:
        prediction: Prediction for the image. The first caption has the
            predicted class with its probability. If it is wrong, the second
            caption has the true class.
        image: The image, uint8, shape (3, H, W).
        color: Color of the frame.
    """
    pixels = Image.fromarray(image.permute(1, 2, 0).numpy())
    enlarged = pixels.resize((IMAGE, IMAGE), Image.Resampling.NEAREST)
    lines = [f"{prediction.probability:.0%} {prediction.predicted}"]
    if prediction.true_rank != 1:
        label = prediction.photograph.label
        probability = prediction.true_probability
        lines.append(label if probability is None else f"{probability:.0%} {label}")
    captions = tuple(_shortened(line) for line in lines)
    return Tile(np.asarray(ImageOps.expand(enlarged, FRAME, color)), captions)


def _shortened(caption: str) -> str:
    """Cut a caption of more than LONGEST_CAPTION characters, and end it with "…"."""
    if len(caption) <= LONGEST_CAPTION:
        return caption
    return f"{caption[: LONGEST_CAPTION - 1]}…"


def write_roc(folder: Path, overall: Pair, by_name: Mapping[str, Pair], label: str) -> None:
    """Write ROC curves as a table, roc.csv, and as a figure, roc.png.

    A curve is left out if it lacks positives or negatives.

    Args:
        folder: Folder that the files are written to.
        overall: Scores of the positives and of the negatives among all images.
        by_name: Scores of the positives and of the negatives of each source, or
            of each label. In the table, the points of the curve of all images
            come first, under an empty name. The points of the curve of each
            source or label follow.
        label: Positive classes, as axes name them.
    """
    # This import takes half a second.
    from matplotlib.figure import Figure

    # A curve needs both positives and negatives.
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
    curves = {"all": [overall]} if has_overall else {}
    curves |= {name: [pair] for name, pair in known.items()}
    bold = {"all": {"color": "black", "linewidth": 2.5, "zorder": 3}}
    draw_roc(axes, curves, label, bold)
    axes.set_aspect("equal")
    if curves:
        axes.legend(loc="lower right")
    image = io.BytesIO()
    figure.savefig(image)
    atomic_write(folder / ROC_FIGURE, image.getbuffer())


def _curve_rows(name: str, pair: Pair) -> list[tuple[object, ...]]:
    """Make a row of roc.csv for each point of a curve.

    Args:
        name: Name of the source or label of the curve. Empty for all images.
        pair: Scores of the positives and of the negatives.

    Returns:
        Rows of name, false-positive rate, recall and threshold.
    """
    points = zip(*roc_curve(*pair), strict=True)
    return [(name, *map(float, point)) for point in points]


def draw_roc(
    axes: "Axes",
    scores: Mapping[str, Sequence[Pair]],
    label: str,
    styles: Mapping[str, Mapping[str, Any]],
) -> None:
    """Draw ROC curves with their mean AUC, and a line at each of RATES.

    Args:
        axes: The axes to draw on.
        scores: The scores of positives and negatives by name. A name has several pairs if it has
            several seeds.
        label: Positive classes in words, for the title of an axis.
        styles: matplotlib's keywords for the lines of a name.
    """
    # A classifier that guesses has this line.
    axes.axline((0, 0), slope=1, color="0.6", linewidth=1)
    for rate in map(float, RATES):
        axes.axvline(rate, color="0.6", linewidth=1, linestyle=":")
    for name, pairs in scores.items():
        areas = [auc_and_recalls(*pair)[0] for pair in pairs]
        # The legend names the curve of the first seed only.
        title: str | None = f"{name}: AUC {np.mean(areas):.3f}" if areas else None
        for pair in pairs:
            rates, recalls, _ = roc_curve(*pair)
            axes.plot(rates, recalls, label=title, **styles.get(name, {}))
            title = None
    axes.set(xlabel="false positive rate", ylabel=f"recall of {label}")
    axes.set(xlim=(-0.01, 1), ylim=(0, 1.01))
