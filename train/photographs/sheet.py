"""The images of an evaluation: a contact sheet of photographs with their predictions, and ROC curves."""

import csv
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from PIL import Image, ImageFont, ImageOps

from renderer.io.tiles import CAPTION_SIZE, PAPER, Tile, draw_grid
from train.photographs.metrics import OVERALL, RATES, Roc
from train.photographs.predictions import Prediction, escaped, outcomes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PER_SECTION, COLUMNS = 40, 10
IMAGE, FRAME = 96, 4  # px: the side of an enlarged image, and the width of its frame
COLORS = {"true positives": "#2e9e5b", "false negatives": "#d03b3b", "false positives": "#e8a317"}
Item = TypeVar("Item")


# ------------------------------------------------------------------------------------- contact sheet


def contact_sheet(predictions: Sequence[Prediction], images: torch.Tensor, label: str) -> Image.Image:
    """True positives, false negatives and false positives, up to PER_SECTION each, evenly by falling probability.

    images: (N, 3, H, W) uint8 sRGB, enlarged without smoothing, so that one sees the pixels that the classifier saw.
    """
    paths = [item.photograph.path for item in predictions]
    pixels = dict(zip(paths, images.permute(0, 2, 3, 1).numpy(), strict=True))
    positives = sum(item.photograph.label == label for item in predictions)
    totals = positives, positives, len(predictions) - positives
    grids = []
    for (name, color), group, total in zip(COLORS.items(), outcomes(predictions, label), totals, strict=True):
        title = f"{label}: {len(group)} {name} of {total}"
        if len(group) > PER_SECTION:
            title += f" ({PER_SECTION} shown, evenly by probability)"
        tiles = [_tile(pixels[item.photograph.path], caption(item), color) for item in evenly(group, PER_SECTION)]
        grids.append(draw_grid([tiles[i : i + COLUMNS] for i in range(0, len(tiles), COLUMNS)], heading=title))
    sheet = Image.new("RGB", (max(grid.width for grid in grids), sum(grid.height for grid in grids)), PAPER)
    for grid, bottom in zip(grids, accumulate(grid.height for grid in grids), strict=True):
        sheet.paste(grid, (0, bottom - grid.height))
    return sheet


def evenly(ordered: Sequence[Item], count: int) -> list[Item]:
    """`count` items at equal distances, the first and the last among them; all if there are no more."""
    return [ordered[index] for index in np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int)]


def caption(prediction: Prediction) -> tuple[str, ...]:
    """The predicted class and, where it is wrong, the true class below it."""
    predicted = f"{prediction.probability:.0%} {prediction.predicted}"
    if prediction.true_rank == 1:
        return (predicted,)
    if prediction.true_probability is None:
        return predicted, prediction.photograph.label
    return predicted, f"{prediction.true_probability:.0%} {prediction.photograph.label}"


def _tile(pixels: np.ndarray, lines: Sequence[str], color: str) -> Tile:
    enlarged = Image.fromarray(pixels).resize((IMAGE, IMAGE), Image.Resampling.NEAREST)
    framed = np.asarray(ImageOps.expand(enlarged, FRAME, color))
    return Tile(framed, tuple(map(_shortened, lines)))


def _shortened(text: str) -> str:
    """The longest start of the text that fits under a tile, with an ellipsis if it is cut."""
    width, font = IMAGE + 2 * FRAME, ImageFont.load_default(CAPTION_SIZE)
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"


# ------------------------------------------------------------------------------------- ROC


def write_roc(folder: Path, rocs: Mapping[str, Roc], label: str) -> None:
    """roc.csv, a row per point of each source's curve, and roc.png with all curves."""
    from matplotlib.figure import Figure  # half a second

    with (folder / "roc.csv").open("w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["source", "false_positive_rate", "recall", "threshold"])
        for source, roc in rocs.items():
            writer.writerows((escaped(source), *map(float, point)) for point in zip(*roc.curve(), strict=True))
    figure = Figure(figsize=(7, 7), layout="constrained")
    axes = figure.subplots()
    bold = {"color": "black", "linewidth": 2.5, "zorder": 3}
    draw_roc(axes, {s or "all": [roc] for s, roc in rocs.items()}, label, {"all": bold} if OVERALL in rocs else {})
    axes.set_aspect("equal")
    if rocs:
        axes.legend(loc="lower right")
    figure.savefig(folder / "roc.png")


def draw_roc(axes: "Axes", rocs: Mapping[str, Sequence[Roc]], label: str, styles: Mapping[str, Any]) -> None:
    """ROC curves by name, several of a name as with seeds, with the mean AUC as label, and lines at RATES.

    styles: matplotlib's keywords of a name's lines.
    """
    axes.axline((0, 0), slope=1, color="0.6", linewidth=1)  # chance
    for marked in map(float, RATES):
        axes.axvline(marked, color="0.6", linewidth=1, linestyle=":")
    for name, group in rocs.items():
        title = f"{name}: AUC {np.mean([roc.values()['auc'] for roc in group]):.3f}" if group else None
        for roc in group:
            rate, recall, _ = roc.curve()
            axes.plot(rate, recall, label=title, **styles.get(name, {}))
            title = None
    axes.set(xlabel="false positive rate", ylabel=f"recall of {label}", xlim=(-0.01, 1), ylim=(0, 1.01))
