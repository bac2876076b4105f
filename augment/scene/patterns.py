"""Patterns that a projector adds to an image: shapes of light in two colors.

A point has two coordinates in the projected image: x to the right and y down, both in [-1, 1].
Tensors of points have these coordinates on their first axis, shape (2, ...). A shape gives each
point a weight (...): 1 in the first color, 0 in the second. `draw_patterns` draws the patterns of
the training. The laboratory uses the same shapes in other sizes
(train/evaluation/laboratory/lab_patterns.py).
"""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.image import LUMINANCE, decode

# The radius of a disc in a cell of width 1. The discs cover half of the area.
DISC_RADIUS = 0.4
# The smallest and the largest period of a pattern.
MIN_PERIOD = 0.25
MAX_PERIOD = 1.0
# A pattern shows a photograph at a scale from 1 / MAX_ZOOM to MAX_ZOOM.
MAX_ZOOM = 2.0
# The largest factor by which the saturation of such a photograph is multiplied.
MAX_SATURATION = 3.0


def stripes(points: Tensor, shift: Tensor | float, bright: float = 0.5) -> Tensor:
    """Find the points on the bright parts of vertical stripes with period 1.

    Args:
        points: Points, shape (2, ...).
        shift: Shift of the stripes. Of a tensor (2, ...), only the first row,
            along x, is used.
        bright: Fraction of a period that is bright.

    Returns:
        Mask of the points on bright stripes, shape (...).
    """
    # Row 0 of the comparison is about x. The stripes do not depend on y.
    return ((points + shift) % 1 < bright)[0]


def checkers(points: Tensor, shift: Tensor) -> Tensor:
    """Find the points on the bright squares of a chessboard with period 1.

    Args:
        points: Points, shape (2, ...).
        shift: Shift of the chessboard along x and y, shape (2, ...).

    Returns:
        Mask of the points on bright squares, shape (...).
    """
    # A square is bright if exactly one of x and y is in the first half of its period.
    is_in_first_half = (points + shift) % 1 < 0.5
    return is_in_first_half.sum(0) == 1


def spots(points: Tensor, shift: Tensor) -> Tensor:
    """Find the points in the discs of a grid with period 1.

    Args:
        points: Points, shape (2, ...).
        shift: Shift of the grid along x and y, shape (2, ...).

    Returns:
        Mask of the points in discs, shape (...).
    """
    # Offset of each point from the center of its disc, shape (2, ...).
    from_center = (points + shift) % 1 - 0.5
    return from_center.square().sum(0) < DISC_RADIUS**2


def half(points: Tensor, shift: Tensor | float) -> Tensor:
    """Find the points to the right of the line x = shift - 0.5.

    Args:
        points: Points, shape (2, ...).
        shift: Shift of the line. Of a tensor (2, ...), only the first row,
            along x, is used.

    Returns:
        Mask of the points to the right, shape (...).
    """
    # Row 0 of the comparison is about x. The line does not depend on y.
    return (points > shift - 0.5)[0]


def solid(points: Tensor, shift: Tensor | float = 0.0) -> Tensor:
    """Return ones for all points, which makes a pattern of a single color.

    Args:
        points: Points, shape (2, ...).
        shift: Not used. All shapes are called with a shift.

    Returns:
        Ones, shape (...).
    """
    return torch.ones_like(points[0])


# Shapes of which `draw_patterns` chooses one for each pattern.
FAMILIES: tuple[Callable[[Tensor, Tensor], Tensor], ...] = (stripes, checkers, spots, half, solid)


def pixel_centers(size: int) -> Tensor:
    """Return the centers of the pixels of an image as points.

    Args:
        size: Pixels per side.

    Returns:
        x (to the right) and y (down) of each center in [-1, 1], shape (2, 1, size, size).
    """
    centers = (torch.arange(size) + 0.5) / size * 2 - 1
    return torch.stack(torch.meshgrid(centers, centers, indexing="xy"))[:, None]


def turned(points: Tensor, cosine: Tensor | float, sine: Tensor | float) -> Tensor:
    """Rotate points about the center of the image.

    Args:
        points: Points, shape (2, ...).
        cosine: Cosine of the angle. A positive angle turns right to down.
        sine: Sine of the angle.

    Returns:
        The rotated points, shape (2, ...).
    """
    x, y = points
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y])


def two_colors(weight: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Blend two colors of light.

    Args:
        weight: Weight of the first color in [0, 1], shape (N, 1, H, W).
        first: Linear RGB, shape (N, 3, 1, 1).
        second: Linear RGB, shape (N, 3, 1, 1).

    Returns:
        Linear RGB, shape (N, 3, H, W).
    """
    return second + weight * (first - second)


def random_colors(draws: Tensor) -> Tensor:
    """Compute colors of light whose largest channel is 1.

    Args:
        draws: Hue and saturation in [0, 1] of each color, shape (N, 2).

    Returns:
        Linear RGB, shape (N, 3, 1, 1): white at saturation 0, a pure hue at 1.
        The sRGB values are linear in the saturation.

    Example:
        >>> random_colors(torch.tensor([[0.0, 0.0], [0.0, 1.0]])).flatten(1).tolist()
        [[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]]
    """
    hue, saturation = draws.split(1, dim=1)
    # Each channel of a pure hue is a piecewise linear function of the hue (HSV, Smith 1978).
    ramps = (6 * hue + torch.tensor([0.0, 4.0, 2.0])) % 6
    pure = ((ramps - 3).abs() - 1).clamp(0, 1)
    return decode(1 - saturation * (1 - pure), "srgb")[:, :, None, None]


def draw_patterns(
    count: int, size: int, draws: torch.Generator, points: Tensor | None = None
) -> Tensor:
    """Draw patterns of random colors, at random angles, scales and positions.

    Args:
        count: Number of patterns.
        size: Pixels per side.
        draws: Source of random numbers.
        points: Point of the pattern that each pixel shows, shape
            (2, count, size, size). By default, the pattern fills the image.

    Returns:
        Linear light in [0, 1], shape (count, 3, size, size).

    Example:
        >>> draw_patterns(2, 8, torch.Generator().manual_seed(0)).shape
        torch.Size([2, 3, 8, 8])
    """
    if points is None:
        points = pixel_centers(size)
    position_draws = []
    family_draws = []
    color_draws = []
    for _ in range(count):
        position_draws.append(torch.rand(4, generator=draws))
        family_draws.append(torch.randint(len(FAMILIES), (), generator=draws))
        color_draws.append(torch.rand(5, generator=draws))
    # Angle as a fraction of a full turn, period as a fraction of its range, and shifts along x
    # and y. Each of these four numbers in [0, 1] has shape (count, 1, 1).
    turn, relative_period, *shift = torch.stack(position_draws).T[:, :, None, None]
    period = MIN_PERIOD + (MAX_PERIOD - MIN_PERIOD) * relative_period
    angle = 2 * math.pi * turn
    # Shape (2, count, size, size).
    rotated = turned(points / period, angle.cos(), angle.sin())
    shifts = torch.stack(shift)
    # Index in `FAMILIES` of each pattern, shape (count,).
    family_of_pattern = torch.stack(family_draws)
    weight = torch.empty(count, 1, *points.shape[2:])
    for index, shape in enumerate(FAMILIES):
        patterns = torch.nonzero(family_of_pattern == index).squeeze(1)
        weight[patterns, 0] = shape(rotated[:, patterns], shifts[:, patterns]).float()
    # The five numbers of a pattern are hue and saturation of its first color, hue and
    # saturation of its second color, and the brightness of the second color.
    colors = torch.stack(color_draws)
    first = random_colors(colors[:, :2])
    brightness = colors[:, 4:, None, None]
    second = random_colors(colors[:, 2:4]) * brightness
    return two_colors(weight, first, second)


def draw_photograph_patterns(photographs: Tensor, points: Tensor, draws: torch.Generator) -> Tensor:
    """Draw patterns that show photographs: turned, scaled and saturated at random.

    Args:
        photographs: Linear light in [0, 1], shape (N, 3, H, W).
        points: Point of the pattern that each pixel shows, shape
            (2, N, size, size), or (2, 1, size, size) if it is the same for all.
        draws: Source of random numbers.

    Returns:
        Linear light in [0, 1], shape (N, 3, size, size).
    """
    # Numbers in [0, 1], shape (N, 1, 1) each.
    turn, zoom, saturation = torch.rand(3, len(photographs), 1, 1, generator=draws)
    angle = 2 * math.pi * turn
    scale = MAX_ZOOM ** (2 * zoom - 1)
    rotated = turned(points * scale, angle.cos(), angle.sin())
    return show_photographs(photographs, rotated.permute(1, 2, 3, 0), saturation[:, 0, 0])


def show_photographs(photographs: Tensor, grid: Tensor, saturation: Tensor) -> Tensor:
    """Sample photographs at points, and change their saturation.

    Beyond the border, a photograph is mirrored.

    Args:
        photographs: Linear light in [0, 1], shape (N, 3, H, W).
        grid: Point of the photograph that each pixel shows, in [-1, 1], shape
            (N, size, size, 2).
        saturation: Factor of the saturation as a fraction of `MAX_SATURATION`,
            shape (N,).

    Returns:
        Linear light in [0, 1], shape (N, 3, size, size).
    """
    shown = F.grid_sample(photographs, grid, padding_mode="reflection", align_corners=False)
    # The saturation is changed by moving each color away from or towards its gray value.
    gray = luminance(shown)
    factor = MAX_SATURATION * saturation[:, None, None, None]
    return (gray + factor * (shown - gray)).clamp(0, 1)


def luminance(linear: Tensor) -> Tensor:
    """Compute the luminance of linear RGB.

    Args:
        linear: Linear RGB, shape (N, 3, H, W).

    Returns:
        Luminance, shape (N, 1, H, W).
    """
    weights = linear.new_tensor(LUMINANCE)[:, None, None]
    return (linear * weights).sum(1, keepdim=True)
