"""Draw the patterns that the projectors of pnb-lab project.

A family of patterns is a function of points and a random number generator.

- The points have shape (2, H, W). They are positions (x, y) in the image of the
  projector, which spans [-1, 1] in both directions. An object in the center of
  the image spans about [-0.3, 0.3].
- The function returns weights in [0, 1], shape (1, H, W), or (3, H, W) with a
  weight for each channel. A weight of 1 is the first of two random colors of
  light, and a weight of 0 is the second one.

The order of the draws decides the patterns of all saved renders.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import map_coordinates
from torch import Tensor

from augment.scene import patterns
from train.command_settings import SLIDES

# Pixels per side of the image of a projector.
RESOLUTION = 512
# Sum of the areas of all spots or leaves. The image has an area of 4, and about
# half of it is covered because they overlap.
TOTAL_AREA = 2.8
# Leaves are ellipses that are this many times as long as wide.
LEAF_RATIO = 3
# `_text` draws the characters of a line of text from these.
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ "
# Number of characters of a line of text.
LINE_LENGTH = 24
# Distance between two lines of text, in heights of a letter.
LINE_SPACING = 1.2


def _solid(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Light the whole image in the first color.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 1 everywhere.
    """
    return patterns.solid(points)[None]


def _gradient(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw a linear ramp along x. At the center, its value is 0.5.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): from 0 to 1 along x.
    """
    return (points[:1] / rng.uniform(0.6, 1.6) + 0.5).clamp(0, 1)


def _stripes(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw stripes along y, with a random width and position.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 1 on stripes, 0 between.
    """
    scaled = points / rng.uniform(0.12, 0.5)
    shift = rng.uniform()
    return patterns.stripes(scaled, shift, rng.uniform(0.3, 0.7)).double()[None]


def _checkers(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw the squares of a chessboard, with a random size and position.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 0 or 1.
    """
    scaled = points / rng.uniform(0.12, 0.5)
    shift = torch.from_numpy(rng.uniform(size=2))
    return patterns.checkers(scaled, shift[:, None, None]).double()[None]


def _half(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Light one side of a line through the object.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 1 on this side.
    """
    return patterns.half(points, 0.5 + rng.uniform(-0.12, 0.12)).double()[None]


def _spots(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw random discs of one size that cover about half of the image.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 1 on the discs.
    """
    radius = rng.uniform(0.08, 0.25)
    count = round(TOTAL_AREA / (math.pi * radius**2))
    is_lit = torch.zeros(points.shape[1:], dtype=torch.bool)
    for center in torch.from_numpy(rng.uniform(-1, 1, (count, 2))):
        is_lit |= (points - center[:, None, None]).square().sum(0) < radius**2
    return is_lit.double()[None]


def _rings(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw rings of one width around a random point.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 1 on rings, 0 between.
    """
    center = torch.from_numpy(rng.uniform(-0.5, 0.5, 2))
    radius = (points - center[:, None, None]).norm(dim=0, keepdim=True)
    scaled = radius / rng.uniform(0.12, 0.4)
    shift = rng.uniform()
    return patterns.stripes(scaled, shift, rng.uniform(0.3, 0.7)).double()[None]


def _window(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw the light through the panes of a window. The bars and the wall around it are dark.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 1 on the panes.
    """
    pane_counts = torch.from_numpy(rng.integers(2, 5, 2))[:, None, None]
    pane_size = torch.from_numpy(rng.uniform(0.15, 0.4, 2))[:, None, None]
    center = torch.from_numpy(rng.uniform(-0.15, 0.15, 2))[:, None, None]
    # Positions in units of panes, from a corner of the window.
    positions = (points - center) / pane_size + pane_counts / 2
    is_in_window = (positions > 0) & (positions < pane_counts)
    is_in_pane = (positions % 1 - 0.5).abs() < rng.uniform(0.3, 0.45)
    return (is_in_window & is_in_pane).all(dim=0).double()[None]


def _leaves(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw the shadows of leaves: random ellipses that cover about half of the image.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 0 on the leaves.
    """
    length = rng.uniform(0.15, 0.35)
    is_lit = torch.ones(points.shape[1:], dtype=torch.bool)
    leaf_area = math.pi * length**2 / LEAF_RATIO
    for _ in range(round(TOTAL_AREA / leaf_area)):
        angle = rng.uniform(0, math.pi)
        center = torch.from_numpy(rng.uniform(-1, 1, 2))
        offset = points - center[:, None, None]
        # Coordinates along the length and along the width of the leaf.
        along, across = patterns.turned(offset, math.cos(angle), -math.sin(angle))
        is_lit &= (along / length) ** 2 + (across / length * LEAF_RATIO) ** 2 > 1
    return is_lit.double()[None]


def _text(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw lines of random capital letters, bright on a dark slide.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color, shape (1, H, W): 1 on letters.
    """
    height = int(rng.integers(40, 120))
    slide = Image.new("L", (RESOLUTION, RESOLUTION))
    font = ImageFont.load_default(float(height))
    for top in range(0, RESOLUTION, int(LINE_SPACING * height)):
        line = "".join(rng.choice(list(LETTERS), LINE_LENGTH))
        # The first letter of a line may be cut off.
        left = -int(rng.integers(height))
        ImageDraw.Draw(slide).text((left, top), line, 255, font)
    values = np.asarray(slide, dtype=np.float32)[..., None] / 255
    return _sample(values, points, order=1)


def _colors(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw a smooth field of colors, with independent channels.

    Args:
        points: Positions (x, y) in the image of the projector, shape (2, H, W).
        rng: Random number generator.

    Returns:
        Weight of the first color for each channel, shape (3, H, W), in [0, 1].
    """
    grid = rng.uniform(0, 1, (rng.integers(3, 6), rng.integers(3, 6), 3))
    return _sample(grid, points, order=3).clamp(0, 1)


def _sample(image: np.ndarray, points: Tensor, order: int) -> Tensor:
    """Interpolate an image by splines of an order.

    Args:
        image: Image that spans [-1, 1] in both directions, shape (H, W, C). It
            is mirrored at its borders.
        points: Positions (x, y), shape (2, H', W').
        order: Order of the splines. 1 interpolates linearly.

    Returns:
        Interpolated values, shape (C, H', W').
    """
    size = np.array(image.shape[:2])[:, None, None]
    # (x, y) in [-1, 1] become rows and columns, in pixels.
    places = (points.flip(0).numpy() + 1) / 2 * size - 0.5
    channels = []
    for channel in np.moveaxis(image, -1, 0):
        channels.append(map_coordinates(channel, places, order=order, mode="reflect"))
    return torch.from_numpy(np.stack(channels))


# Functions that draw patterns, by the names of the families. PATTERNS in train/command_settings.py
# lists the same names.
FAMILIES = {
    "solid": _solid,
    "gradient": _gradient,
    "stripes": _stripes,
    "checkers": _checkers,
    "half": _half,
    "spots": _spots,
    "rings": _rings,
    "window": _window,
    "leaves": _leaves,
    "text": _text,
    "colors": _colors,
}
# Families with two colors of light. The second color of the others is black.
TWO_COLORED = ("gradient", "stripes", "checkers")


def draw_pattern(
    family: str,
    rng: np.random.Generator,
    slides: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Draw a pattern of random colors, at a random angle, scale and position.

    Args:
        family: Key of FAMILIES, or SLIDES for one of the pictures.
        rng: Random number generator.
        slides: Pictures for the family SLIDES, linear RGB, shape (H, W, 3).

    Returns:
        Linear RGB in [0, 1], shape (RESOLUTION, RESOLUTION, 3), float32.
    """
    first = torch.from_numpy(draw_color(rng))[:, None, None]
    second = torch.from_numpy(draw_color(rng))[:, None, None]
    # For families that are not in TWO_COLORED, the second color is black.
    second = second * rng.uniform() * (family in TWO_COLORED)
    angle = rng.uniform(0, 2 * math.pi)
    centers = patterns.pixel_centers(RESOLUTION)[:, 0].double()
    points = patterns.turned(centers, math.cos(angle), -math.sin(angle))
    if family == SLIDES:
        picture = slides[int(rng.integers(len(slides)))]
        scaled = points * rng.uniform(0.3, 1)
        shift = torch.from_numpy(rng.uniform(-0.5, 0.5, 2))
        light = _sample(picture, scaled + shift[:, None, None], order=1)
    else:
        weight = FAMILIES[family](points, rng)
        light = patterns.two_colors(weight, first, second).expand(3, -1, -1)
    return light.permute(1, 2, 0).contiguous().float().numpy()


def draw_color(rng: np.random.Generator) -> np.ndarray:
    """Draw a color of light with `augment.scene.patterns.random_colors`.

    Args:
        rng: Random number generator.

    Returns:
        Linear RGB, shape (3,), whose largest channel is 1.
    """
    hue_and_saturation = torch.from_numpy(rng.uniform(size=(1, 2)))
    return patterns.random_colors(hue_and_saturation).flatten().numpy()
