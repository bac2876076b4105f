"""Projected patterns: shapes of light in two colors.

Points have their two coordinates in the projected image on the first axis,
right and down, shape (2, ...). The image spans [-1, 1]. A shape gives each
point a weight (...) between two colors, here 0 or 1. The training draws these
patterns (`draw_patterns`), and the laboratory draws them in its own sizes,
beside others (train/evaluation/laboratory/lab_patterns.py).
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from renderer.image import decode

DISC_RADIUS = 0.4  # Of spots in the unit cells of a grid, which then cover half of the area.


def stripes(points: Tensor, shift: Tensor | float, bright: float = 0.5) -> Tensor:
    """Return where stripes of period 1 are bright.

    Args:
        points: Points, shape (2, ...).
        shift: Shift of the stripes along x; of a tensor (2, ...), the first.
        bright: Fraction of a period that is bright.

    Returns:
        A mask of the points, shape (...).
    """
    return ((points + shift) % 1 < bright)[0]


def checkers(points: Tensor, shift: Tensor) -> Tensor:
    """Return which squares of a chessboard of period 1 are bright, shifted by (2, ...)."""
    return ((points + shift) % 1 < 0.5).sum(0) == 1


def spots(points: Tensor, shift: Tensor) -> Tensor:
    """Return where the discs of a grid of period 1 are, shifted by (2, ...)."""
    return ((points + shift) % 1 - 0.5).square().sum(0) < DISC_RADIUS**2


def half(points: Tensor, shift: Tensor | float) -> Tensor:
    """Return which points are to the right of a line at x = shift - 0.5.

    Of a shift (2, ...), the first counts.
    """
    return (points > shift - 0.5)[0]


def solid(points: Tensor, shift: Tensor | float = 0.0) -> Tensor:
    """Return ones for all points: a single color."""
    return torch.ones_like(points[0])


FAMILIES: tuple[Callable[[Tensor, Tensor], Tensor], ...] = (stripes, checkers, spots, half, solid)


def pixel_middles(size: int) -> Tensor:
    """Return the middles of the pixels of an image, shape (2, 1, size, size)."""
    middles = (torch.arange(size) + 0.5) / size * 2 - 1
    return torch.stack(torch.meshgrid(middles, middles, indexing="xy"))[:, None]


def turned(points: Tensor, cosine: Tensor | float, sine: Tensor | float) -> Tensor:
    """Rotate points (2, ...) about the middle of the image by an angle.

    Args:
        points: Points, shape (2, ...).
        cosine: Cosine of the angle, which goes from right to down.
        sine: Sine of the angle.

    Returns:
        The rotated points, shape (2, ...).
    """
    x, y = points
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y])


def two_colors(weight: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Blend two colors of light: the first where the weight is 1, the second where it is 0."""
    return second + weight * (first - second)


def random_colors(draws: Tensor) -> Tensor:
    """Compute colors of light whose largest channel is 1.

    Args:
        draws: Hue and saturation in [0, 1] of each color, shape (N, 2).

    Returns:
        Linear RGB from white to pure, shape (N, 3, 1, 1). Steps of saturation are
        even in sRGB values.

    Example:
        >>> random_colors(torch.tensor([[0.0, 0.0], [0.0, 1.0]])).flatten(1).tolist()
        [[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]]
    """
    hue, saturation = draws.split(1, dim=1)
    # The ramps of the hexcone (Smith 1978).
    ramps = (6 * hue + torch.tensor([0.0, 4.0, 2.0])) % 6
    pure = ((ramps - 3).abs() - 1).clamp(0, 1)
    return decode(1 - saturation * (1 - pure), "srgb")[:, :, None, None]


def draw_patterns(count: int, size: int, draws: torch.Generator, points: Tensor | None = None) -> Tensor:
    """Draw patterns of random colors, at random angles, scales and positions.

    Args:
        count: Number of patterns.
        size: Pixels per side.
        draws: Source of random numbers.
        points: Where in the pattern each pixel is, shape (2, count, size, size).
            By default, the pattern fills the image.

    Returns:
        Linear light in [0, 1], shape (count, 3, size, size).

    Example:
        >>> draw_patterns(2, 8, torch.Generator().manual_seed(0)).shape
        torch.Size([2, 3, 8, 8])
    """
    points = pixel_middles(size) if points is None else points
    places, families, color_draws = [], [], []
    for _ in range(count):
        places.append(torch.rand(4, generator=draws))
        families.append(torch.randint(len(FAMILIES), (), generator=draws))
        color_draws.append(torch.rand(5, generator=draws))
    turn, period, *shift = torch.stack(places).T[:, :, None, None]
    angle = 2 * math.pi * turn
    rotated = turned(points / (0.25 + 0.75 * period), angle.cos(), angle.sin())
    shifts = torch.stack(shift)
    family_of_pattern = torch.stack(families)
    weight = torch.empty(count, 1, *points.shape[2:])
    for index, mask in enumerate(FAMILIES):
        here = torch.nonzero(family_of_pattern == index).squeeze(1)
        weight[here, 0] = mask(rotated[:, here], shifts[:, here]).float()
    colors = torch.stack(color_draws)
    first = random_colors(colors[:, :2])
    second = random_colors(colors[:, 2:4]) * colors[:, 4:, None, None]  # Down to black.
    return two_colors(weight, first, second)
