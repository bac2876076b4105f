"""Images of a report: plots as SVG for light and dark pages, and small images."""

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from train.photographs.metrics import auc_and_recalls
from train.photographs.sheet import Pair, draw_roc

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito 2008, for color-blind readers, without yellow, which is faint on white. Line styles repeat the color.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES, MARKERS = ("--", "-", ":", "-."), "osD^vP"
SIZE = (4.4, 3.3)  # inches
WIDTH = 440  # CSS pixels
SMALL = 192  # pixels per side of images that stay PNG
INK = "#123456"  # replaced by the ink of the reader's color scheme
STYLE = "<style>svg{color:#1a1a1a}@media (prefers-color-scheme:dark){svg{color:#e4e4e4}}</style>"
PLOT = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.parse_math": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "font.size": 10,
    "font.family": "sans-serif",
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
    "legend.frameon": False,
    "legend.fontsize": 9,
}
Points = Sequence[tuple[float, float | None]]  # x and y, which may be unknown


@dataclass(frozen=True)
class Picture:
    """A file's bytes. kind: svg+xml, png or jpeg. alt: a description. width: CSS pixels to show it at."""

    data: bytes
    kind: str
    alt: str
    width: int
    caption: str = ""

    @property
    def uri(self) -> str:
        """The whole file, as an address in a page."""
        return f"data:image/{self.kind};base64,{base64.b64encode(self.data).decode()}"


def style(index: int) -> dict[str, Any]:
    """The color and line style of an arm, by its place among the arms."""
    return {"color": COLORS[index % len(COLORS)], "linestyle": LINES[index % len(LINES)]}


def curves(arms: Mapping[str, Sequence[Points]], title: str, x_title: str = "epoch") -> Picture | None:
    """A line per seed in the color of its arm, over epochs or rounds; None where no line has two points that differ."""
    known = {arm: [[(x, y) for x, y in seed if y is not None] for seed in seeds] for arm, seeds in arms.items()}
    if not any(len({y for _, y in line}) > 1 for lines in known.values() for line in lines):
        return None

    def draw(axes: "Axes") -> None:
        for index, (arm, lines) in enumerate(known.items()):
            for number, line in enumerate(line for line in lines if len(line) > 1):
                marker = MARKERS[index % len(MARKERS)] if len(line) < 30 else None
                axes.plot(*zip(*line, strict=True), marker=marker, ms=4, label=None if number else arm, **style(index))
        axes.set(xlabel=x_title)
        axes.locator_params(axis="x", integer=True, min_n_ticks=1)

    ends = {arm: [line[-1][1] for line in lines if line] for arm, lines in known.items()}
    means = ", ".join(f"{arm} {np.mean(values):.2f}" for arm, values in ends.items() if values)
    return _plot(draw, title, f"{title} by {x_title}, at the end: {means}")


def roc(arms: Mapping[str, Sequence[Pair]], label: str) -> Picture | None:
    """ROC curves by arm, one per pair of positives' and negatives' scores; None without any of both kinds."""
    known = {arm: [pair for pair in pairs if all(map(len, pair))] for arm, pairs in arms.items()}
    if not any(known.values()):
        return None
    styles = {arm: style(index) for index, arm in enumerate(arms)}
    areas = {arm: [auc_and_recalls(*pair)[0] for pair in pairs] for arm, pairs in known.items() if pairs}
    means = ", ".join(f"{arm} {np.mean(values):.3f}" for arm, values in areas.items())
    return _plot(lambda axes: draw_roc(axes, known, label, styles), "ROC", f"ROC; AUC: {means}")


def _plot(draw: Callable[["Axes"], None], title: str, alt: str) -> Picture:
    """A transparent SVG, whose text and axes have the color of the reader's scheme."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    file = io.StringIO()
    with mpl.rc_context(PLOT):  # type: ignore[arg-type]  # which wants its keys as literals
        figure = Figure(figsize=SIZE, layout="constrained")
        axes = figure.subplots()
        draw(axes)
        handles, labels = axes.get_legend_handles_labels()
        if labels:
            legend = dict(zip(labels, handles, strict=True))  # each label once
            columns = 1 if len(max(labels, key=len)) > 16 else 3
            figure.legend([*legend.values()], [*legend], loc="outside lower center", ncols=columns)
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    start, tag, rest = file.getvalue().partition("<defs>")
    return Picture((start + STYLE + tag + rest.replace(INK, "currentColor")).encode(), "svg+xml", alt, WIDTH, title)


def encoded(image: Image.Image, alt: str, caption: str = "") -> Picture:
    """As PNG if it is small, else as JPEG."""
    file, small = io.BytesIO(), max(image.size) <= SMALL
    shown = image if small else image.convert("RGB")
    shown.save(file, "PNG" if small else "JPEG", optimize=True, quality=82)
    return Picture(file.getvalue(), "png" if small else "jpeg", alt, image.width, caption)


def from_file(path: Path, alt: str, widest: int, caption: str = "") -> list[Picture]:
    """The image of a file, reduced to a width; [] if it is missing or broken."""
    try:
        with Image.open(path) as image:
            pixels = image.convert("RGB")
    except Exception:  # Pillow's decoders raise almost anything at a broken file
        return []
    pixels.thumbnail((widest, 4 * widest))
    return [encoded(pixels, alt, caption)]
