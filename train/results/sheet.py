"""Pictures of an evaluation: a contact sheet of photographs with predictions, and ROC curves."""

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
from train.results.metrics import RATES, auc_and_recalls, roc_curve
from train.results.predictions import ROC_FIGURE, ROC_TABLE, Prediction, by_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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


@dataclass(frozen=True)
class _Section:
    """Section of the contact sheet, such as the true positives of one class.

    Attributes:
        name: Title of the section, such as "true positives".
        color: Color of the frames around its images.
        shown: Predictions with their images, in descending order of the
            probability of the predicted class.
        total: Number of positives, if the section shows true positives or false
            negatives. Number of negatives, if it shows false positives.
    """

    name: str
    color: str
    shown: list[tuple[Prediction, torch.Tensor]]
    total: int


def contact_sheet(predictions: Sequence[Prediction], images: torch.Tensor) -> Image.Image:
    """Draw a contact sheet of right and wrong predictions for each positive class.

    Each positive class has three sections: true positives, false negatives and
    false positives. A section has at most MAX_IMAGES images. If there are more,
    it shows images at equal distances in the order of probability. The images are enlarged without
    smoothing, so that pixels stay visible.
    """
    grids = [draw_grid([], heading=LEGEND)]
    for label, predictions_of_label in by_label(predictions).items():
        for section in _sections(label, predictions_of_label, images):
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
    """Divide images into true positives, false negatives and false positives of a class.

    True negatives are left out. The most confident predictions come first.
    """
    pairs = list(zip(predictions, images, strict=True))
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
    """Draw the images of a section of the contact sheet in a grid below a heading."""
    count = len(section.shown)
    heading = f"{label}: {count} {section.name} of {section.total}"
    if count > MAX_IMAGES:
        heading += f" ({MAX_IMAGES} shown, evenly by probability)"
    tiles = []
    for prediction, image in evenly_spaced(section.shown, MAX_IMAGES):
        tiles.append(_tile(prediction, image, section.color))
    rows = [tiles[first : first + COLUMNS] for first in range(0, len(tiles), COLUMNS)]
    return draw_grid(rows, heading=heading)


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """Choose items of a list at equal distances, including the first and the last one.

    All, if there are at most `count`.
    """
    indices = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[index] for index in indices.round().astype(int)]


def _tile(prediction: Prediction, image: torch.Tensor, color: str) -> Tile:
    """Enlarge an image, and add a colored frame and captions.

    The first caption is the predicted class with its probability. If the
    prediction is wrong, the second caption is the true class.
    """
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
