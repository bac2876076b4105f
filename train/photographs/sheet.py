"""The images of an evaluation: a contact sheet of photographs with their predictions, and ROC curves."""

import csv
import io
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from PIL import Image, ImageOps

from renderer.io.files import write_whole
from renderer.io.tiles import PAPER, Tile, draw_grid
from train.photographs.metrics import RATES, auc_and_recalls, roc_curve
from train.photographs.predictions import Prediction, by_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROC_TABLE, ROC_FIGURE = "roc.csv", "roc.png"
PER_SECTION, COLUMNS = 40, 10
IMAGE, FRAME = 96, 4  # px: the side of an enlarged image, and the width of its frame
LONGEST_CAPTION = 18  # characters
LEGEND = "Under each image: the predicted class and its probability; in gray, where that is wrong, the true class"
Item = TypeVar("Item")
Pair = tuple[np.ndarray, np.ndarray]


def contact_sheet(predictions: Sequence[Prediction], images: torch.Tensor) -> Image.Image:
    """Of each class under study, true positives, false negatives and false positives, up to PER_SECTION each, evenly
    by falling probability.

    images: (N, 3, H, W) uint8 sRGB, enlarged without smoothing, so that one sees the pixels that the classifier saw.
    """
    grids = [draw_grid([], heading=LEGEND)]
    for label, items in by_label(predictions).items():
        pairs = sorted(zip(items, images, strict=True), key=lambda pair: -pair[0].probability)
        positives = [pair for pair in pairs if pair[0].positive]
        negatives = [pair for pair in pairs if not pair[0].positive]
        sections = [
            (
                "true positives",
                "#2e9e5b",
                [pair for pair in positives if pair[0].predicted == label],
                len(positives),
            ),
            (
                "false negatives",
                "#d03b3b",
                [pair for pair in positives if pair[0].predicted != label],
                len(positives),
            ),
            (
                "false positives",
                "#e8a317",
                [pair for pair in negatives if pair[0].predicted == label],
                len(negatives),
            ),
        ]
        for name, color, group, total in sections:
            part = (
                f" ({PER_SECTION} shown, evenly by probability)" if len(group) > PER_SECTION else ""
            )
            tiles = [
                _tile(prediction, image, color) for prediction, image in evenly(group, PER_SECTION)
            ]
            rows = [tiles[i : i + COLUMNS] for i in range(0, len(tiles), COLUMNS)]
            grids.append(draw_grid(rows, heading=f"{label}: {len(group)} {name} of {total}{part}"))
    sheet = Image.new(
        "RGB", (max(grid.width for grid in grids), sum(grid.height for grid in grids)), PAPER
    )
    for grid, bottom in zip(grids, accumulate(grid.height for grid in grids), strict=True):
        sheet.paste(grid, (0, bottom - grid.height))
    return sheet


def evenly(ordered: Sequence[Item], count: int) -> list[Item]:
    """`count` items at equal distances, the first and the last among them; all if there are no more."""
    return [
        ordered[index]
        for index in np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int)
    ]


def _tile(prediction: Prediction, image: torch.Tensor, color: str) -> Tile:
    """A framed image over the predicted class and, where it is wrong, the true class."""
    enlarged = Image.fromarray(image.permute(1, 2, 0).numpy()).resize(
        (IMAGE, IMAGE), Image.Resampling.NEAREST
    )
    lines = [f"{prediction.probability:.0%} {prediction.predicted}"]
    if prediction.true_rank != 1:
        probability, label = prediction.true_probability, prediction.photograph.label
        lines.append(label if probability is None else f"{probability:.0%} {label}")
    captions = (
        line if len(line) <= LONGEST_CAPTION else f"{line[: LONGEST_CAPTION - 1]}…"
        for line in lines
    )
    return Tile(np.asarray(ImageOps.expand(enlarged, FRAME, color)), tuple(captions))


def write_roc(folder: Path, overall: Pair, by_name: Mapping[str, Pair], label: str) -> None:
    """Write ROC curves as a table, roc.csv, and as a figure, roc.png.

    A curve is left out if it lacks positives or negatives.

    Args:
        folder: Folder that the files are written to.
        overall: Scores of the positives and of the negatives among all images.
        by_name: Such scores of each source or each label. The table has a row
            for each point of their curves, after those of all images, whose
            name is empty.
        label: Classes under study, as axes name them.
    """
    from matplotlib.figure import Figure  # half a second

    known = {name: pair for name, pair in by_name.items() if all(map(len, pair))}
    has_overall = all(map(len, overall))
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["source", "false_positive_rate", "recall", "threshold"])
    if has_overall:
        writer.writerows(_curve_rows("", overall))
    for name, pair in known.items():
        writer.writerows(_curve_rows(name, pair))
    write_whole(folder / ROC_TABLE, table.getvalue())

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
    write_whole(folder / ROC_FIGURE, image.getbuffer())


def _curve_rows(name: str, pair: Pair) -> list[tuple[object, ...]]:
    """Return a row of roc.csv for each point of a curve."""
    points = zip(*roc_curve(*pair), strict=True)
    return [(name, *map(float, point)) for point in points]


def draw_roc(
    axes: "Axes",
    scores: Mapping[str, Sequence[Pair]],
    label: str,
    styles: Mapping[str, Mapping[str, Any]],
) -> None:
    """ROC curves by name, several of a name as with seeds, with the mean AUC as label, and lines at RATES.

    scores: pairs of positives' and negatives'. styles: matplotlib's keywords of a name's lines.
    """
    axes.axline((0, 0), slope=1, color="0.6", linewidth=1)  # chance
    for rate in map(float, RATES):
        axes.axvline(rate, color="0.6", linewidth=1, linestyle=":")
    for name, pairs in scores.items():
        areas = [auc_and_recalls(*pair)[0] for pair in pairs]
        for number, pair in enumerate(pairs):
            rates, recalls, _ = roc_curve(*pair)
            title = None if number else f"{name}: AUC {np.mean(areas):.3f}"
            axes.plot(rates, recalls, label=title, **styles.get(name, {}))
    axes.set(
        xlabel="false positive rate", ylabel=f"recall of {label}", xlim=(-0.01, 1), ylim=(0, 1.01)
    )
