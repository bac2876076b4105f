"""Draws an attack as an animation: images and lights with captions, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from jaxtyping import Float
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
