"""Draws an attack as an animation, from the light of the scene to the adversarial light."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from augment.attacks.attack import logits_of
from renderer.io.tiles import PAPER, Tile, draw_grid, tiles_of
from renderer.rendering import light_sphere

if TYPE_CHECKING:
    from augment.attacks.attack import AttackResult

# Pixels per side of the ball that shows the light. Smaller images are enlarged
# by a whole factor to at least this width.
SIDE = 160
# Larger images are shown with this number of pixels per side, since a .gif file
# takes up to a byte for each pixel of a frame.
MAX_SIDE = 224
# Milliseconds for which a frame is shown, and the first and the last frame.
FRAME_TIME = 120
PAUSE = 1200


def draw_frames(
    result: AttackResult, example: int, view: int, frame_count: int
) -> list[Image.Image]:
    """Draw one view at equal steps from the values before the attack to the values after it.

    Args:
        result: Result of an attack.
        example: Index of the example.
        view: Index of the view.
        frame_count: Number of frames, at least 2.

    Returns:
        Frames of the same size. The first and the last show the images of the
        result.
    """
    problem = result.problem
    start = problem.start
    reached = result.descent.values.to(start)
    row = problem.all_examples[[example]]
    frames = []
    for index in range(frame_count):
        fraction = index / (frame_count - 1)
        values = start + fraction * (reached - start)
        if index == 0:
            image = result.images_before[example, view]
        elif index == frame_count - 1:
            image = result.images[example, view]
        else:
            image = problem.images(values, row)[0, view]
        conditions = problem.conditions(values[row], row)
        basis = problem.scene.basis_under(conditions, 0)
        ball = light_sphere(conditions.light[0], SIDE, basis=basis)
        frames.append(draw_grid([[_captioned(result, image), _tile(ball, "light")]]))
    return _with_equal_sizes(frames)


def frame_times(frame_count: int) -> list[int]:
    """Return the time for which each frame is shown in milliseconds.

    Args:
        frame_count: Number of frames, at least 2.
    """
    return [PAUSE, *[FRAME_TIME] * (frame_count - 2), PAUSE]


def _captioned(result: AttackResult, image: Tensor) -> Tile:
    """Return the tile of an image with its predicted class and the probability of this class."""
    logits = logits_of(result.preprocessed_model, image[None, None], 1)[0, 0]
    probability, index = logits.softmax(0).max(0)
    name = result.classifier.classes[int(index)]
    return _tile(image, f"{name} {float(probability):.0%}")


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
