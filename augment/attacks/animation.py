"""Draws an attack as an animation: images and lights with captions, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from renderer.io.tiles import PAPER, Tile, draw_grid, tiles_of

# Pixels per side of the ball that shows the light. Smaller images are enlarged
# by a whole factor to at least this width.
SIDE = 160
# Larger images are shown with this number of pixels per side, since a .gif file
# takes up to a byte for each pixel of a frame.
MAX_SIDE = 224
# Milliseconds for which each frame is shown. The first and the last frame are
# shown for PAUSE instead.
FRAME_TIME = 120
PAUSE = 1200


def draw_frames(
    images: Sequence[Tensor], balls: Sequence[Tensor], captions: Sequence[str]
) -> list[Image.Image]:
    """Draw frames of an image with its caption beside a ball in the light.

    Args:
        images: Image of each frame in [0, 1], shape (3, size, size) each.
        balls: White ball in the light of each frame, shape (3, SIDE, SIDE) each.
        captions: Line of text below each image.

    Returns:
        Frames of the same size.
    """
    frames = []
    for image, ball, caption in zip(images, balls, captions, strict=True):
        frames.append(draw_grid([[_tile(image, caption), _tile(ball, "light")]]))
    return _with_equal_sizes(frames)


def frame_times(frame_count: int) -> list[int]:
    """Return the time for which each frame is shown in milliseconds.

    Args:
        frame_count: Number of frames, at least 2.
    """
    return [PAUSE, *[FRAME_TIME] * (frame_count - 2), PAUSE]


def _tile(image: Tensor, caption: str) -> Tile:
    """Return the tile of an image (3, size, size) with a caption of one line."""
    shown = image.detach().cpu().float()
    if image.shape[-1] > MAX_SIDE:
        size = (MAX_SIDE, MAX_SIDE)
        shown = F.interpolate(shown[None], size, mode="bilinear", antialias=True)[0]
    [tile] = tiles_of([shown], [(caption,)], SIDE)
    return tile


def _with_equal_sizes(frames: list[Image.Image]) -> list[Image.Image]:
    """Return frames that are extended to the right and down to the size of the largest."""
    width = max(frame.width for frame in frames)
    height = max(frame.height for frame in frames)
    extended = []
    for frame in frames:
        canvas = Image.new("RGB", (width, height), PAPER)
        canvas.paste(frame)
        extended.append(canvas)
    return extended
