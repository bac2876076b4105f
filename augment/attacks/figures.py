"""Draws an attack: as a figure with probabilities, or frame by frame as an animation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch.nn.functional as F
from jaxtyping import Float
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from renderer.io.images import PAPER, Tile, draw_grid, tiles_of

# Pixels per side of the white ball that shows the light. Smaller images are enlarged by a whole
# factor to at least this width.
SIDE = 160
# Larger images are reduced to this number of pixels per side, because a .gif file takes up to a
# byte for each pixel of a frame.
MAX_SIDE = 224
# Milliseconds for which a frame is shown, except the first and the last.
FRAME_TIME = 120
# Milliseconds for which the first and the last frame of an animation are shown.
PAUSE = 1200


def draw_frames(
    images: Sequence[Tensor], balls: Sequence[Tensor], captions: Sequence[str]
) -> list[Image.Image]:
    """Draw the frames of an animation: an image with a caption, and a white ball beside it."""
    frames = []
    for image, ball, caption in zip(images, balls, captions, strict=True):
        frames.append(draw_grid([[_tile(image, caption), _tile(ball, "light")]]))
    return _with_equal_sizes(frames)


def frame_times(frame_count: int) -> list[int]:
    """Return for how many milliseconds each frame of an animation is shown.

    The first and the last frame are shown longer than the others.
    """
    return [PAUSE, *[FRAME_TIME] * (frame_count - 2), PAUSE]


def _tile(image: Float[Tensor, "3 size size"], caption: str) -> Tile:
    """Return an image with a caption of one line, as a tile of a grid."""
    shown = image.detach().cpu().float()
    if image.shape[-1] > MAX_SIDE:
        size = (MAX_SIDE, MAX_SIDE)
        shown = F.interpolate(shown[None], size, mode="bilinear", antialias=True)[0]
    [tile] = tiles_of([shown], [(caption,)], SIDE)
    return tile


def _with_equal_sizes(frames: list[Image.Image]) -> list[Image.Image]:
    """Add empty space at the right and the bottom of frames, so that all have the same size."""
    width = max(frame.width for frame in frames)
    height = max(frame.height for frame in frames)
    extended = []
    for frame in frames:
        canvas = Image.new("RGB", (width, height), PAPER)
        canvas.paste(frame)
        extended.append(canvas)
    return extended


if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Largest number of classes in the bar chart of a figure. The most probable classes are drawn.
SHOWN_CLASSES = 5
# Colors of the bars of the probabilities before and after the attack.
BEFORE_COLOR = "#4c78a8"
AFTER_COLOR = "#e45756"


def draw_attack(
    before: Float[Tensor, "3 size size"],
    ball: Float[Tensor, "_ _ _"],
    after: Float[Tensor, "3 size size"],
    probabilities_before: Float[Tensor, " C"],
    probabilities_after: Float[Tensor, " C"],
    classes: Sequence[str],
    true_class: int,
) -> Figure:
    """Draw one view before and after an attack, with the light and the most probable classes.

    `ball` is a white ball in the light after the attack.
    """
    figure = Figure(figsize=(10, 2.6), layout="constrained")
    axes_before, axes_light, axes_after, axes_bars = figure.subplots(
        1, 4, width_ratios=[1, 1, 1, 1.2]
    )
    _show(axes_before, before, f"before: {_most_probable(probabilities_before, classes)}")
    _show(axes_light, ball, "light after the attack")
    _show(axes_after, after, f"after: {_most_probable(probabilities_after, classes)}")
    _draw_probabilities(axes_bars, probabilities_before, probabilities_after, classes, true_class)
    return figure


def _show(axes: Axes, image: Float[Tensor, "3 size size"], title: str) -> None:
    """Draw an image with a title above it."""
    # NumPy has no bfloat16.
    pixels = image.permute(1, 2, 0).clamp(0, 1).float().numpy()
    axes.imshow(pixels, interpolation="nearest")
    axes.set_title(title, fontsize=9)
    axes.axis("off")


def _most_probable(probabilities: Float[Tensor, " C"], classes: Sequence[str]) -> str:
    """Return a text with the most probable class and its probability."""
    probability, index = probabilities.max(0)
    return f"{classes[int(index)]} {float(probability):.0%}"


def _draw_probabilities(
    axes: Axes,
    before: Float[Tensor, " C"],
    after: Float[Tensor, " C"],
    classes: Sequence[str],
    true_class: int,
) -> None:
    """Draw the probabilities of the true class and the most probable classes as pairs of bars."""
    shown_count = min(SHOWN_CLASSES, len(classes))
    # Order the classes by the larger of their two probabilities.
    by_probability = before.maximum(after).topk(shown_count).indices
    if true_class not in by_probability:
        by_probability[-1] = true_class
    # matplotlib draws bars from the bottom to the top, so the most probable class comes last.
    ranked = by_probability.flip(0)
    names = [classes[index] for index in ranked.tolist()]
    above = [row + 0.2 for row in range(shown_count)]
    below = [row - 0.2 for row in range(shown_count)]
    axes.barh(above, before[ranked].float().numpy(), 0.4, color=BEFORE_COLOR, label="before")
    axes.barh(below, after[ranked].float().numpy(), 0.4, color=AFTER_COLOR, label="after")
    axes.set_yticks(range(shown_count), names, fontsize=8)
    axes.set_xlim(0, 1)
    axes.set_xlabel("probability", fontsize=8)
    axes.legend(fontsize=8, loc="lower right")
