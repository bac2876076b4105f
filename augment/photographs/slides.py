"""Random slides of a projector: two-color patterns, cells, smooth fields and photographs.

A slide is linear light in [0, 1]. The two-color patterns are those of
`augment.scene.patterns`: stripes, chessboards, discs, half planes and single
colors.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.scene.patterns import (
    MAX_ZOOM,
    draw_patterns,
    pixel_centers,
    random_colors,
    show_photographs,
)
from renderer.image import decode, to_unit

# Smallest and largest number of cells of a slide that `draw_cells` draws.
MIN_CELLS = 3
MAX_CELLS = 24
# Smallest and largest number of nodes per side of a grid at which `draw_fields` draws values.
MIN_NODES = 2
MAX_NODES = 6
# Standard deviation of these values. A sigmoid then maps them to light in [0, 1].
FIELD_CONTRAST = 2.0
# Relative frequencies with which `draw_slides` draws two-color patterns, cells, smooth fields
# and photographs.
SHARES = (0.4, 0.15, 0.15, 0.3)
# Coordinate of unused centers of cells in `draw_cells`. They are so far away that no pixel is
# in their cells.
FAR = 100.0


def draw_slides(
    count: int,
    size: int,
    draws: torch.Generator,
    photographs: Tensor | None = None,
) -> Tensor:
    """Draw slides of random families.

    Args:
        count: Number of slides.
        size: Pixels per side.
        draws: CPU generator of the random numbers.
        photographs: Photographs that slides may show, uint8,
            shape (N, 3, H, W). None for slides without photographs.

    Returns:
        Linear light in [0, 1], on the CPU, shape (count, 3, size, size).

    Example:
        >>> draw_slides(2, 8, torch.Generator().manual_seed(0)).shape
        torch.Size([2, 3, 8, 8])
    """
    families: list[Callable[[int, int, torch.Generator], Tensor]]
    families = [draw_patterns, draw_cells, draw_fields]
    if photographs is not None:
        families.append(partial(draw_projected, photographs))
    shares = torch.tensor(SHARES[: len(families)])
    # Index of the family of each slide, shape (count,).
    slide_to_family = torch.multinomial(shares, count, replacement=True, generator=draws)
    slides = torch.empty(count, 3, size, size)
    for index, draw in enumerate(families):
        rows = torch.nonzero(slide_to_family == index).squeeze(1)
        if len(rows):
            slides[rows] = draw(len(rows), size, draws)
    return slides


def draw_cells(count: int, size: int, draws: torch.Generator) -> Tensor:
    """Draw the Voronoi cells of random points, each in a color of its own.

    Args:
        count: Number of slides.
        size: Pixels per side.
        draws: CPU generator of the random numbers.

    Returns:
        Linear light in [0, 1], shape (count, 3, size, size).
    """
    cell_counts = torch.randint(MIN_CELLS, MAX_CELLS + 1, (count,), generator=draws)
    # Every slide gets `MAX_CELLS` centers, of which some are not used, in [-1, 1].
    centers = 2 * torch.rand(count, MAX_CELLS, 2, generator=draws) - 1
    is_unused = torch.arange(MAX_CELLS) >= cell_counts[:, None]
    centers[is_unused] = FAR
    # Centers of the pixels, shape (size², 2).
    pixels = pixel_centers(size).flatten(1).T
    # Index of the nearest center of a cell, shape (count, size²).
    pixel_to_cell = torch.cdist(pixels.expand(count, -1, -1), centers).argmin(2)

    hue, saturation, brightness = torch.rand(3, count * MAX_CELLS, generator=draws)
    colors = random_colors(torch.stack([hue, saturation], dim=1))
    colors = colors[:, :, 0, 0] * brightness[:, None]
    colors = colors.view(count, MAX_CELLS, 3)
    # Color of each pixel, shape (count, size², 3).
    shown = colors.gather(1, pixel_to_cell[:, :, None].expand(-1, -1, 3))
    return shown.transpose(1, 2).unflatten(2, (size, size))


def draw_fields(count: int, size: int, draws: torch.Generator) -> Tensor:
    """Draw smooth fields of light, independent in the three channels.

    Args:
        count: Number of slides.
        size: Pixels per side.
        draws: CPU generator of the random numbers.

    Returns:
        Linear light in [0, 1], shape (count, 3, size, size).
    """
    fields = []
    for _ in range(count):
        node_count = int(torch.randint(MIN_NODES, MAX_NODES + 1, (), generator=draws))
        node_values = FIELD_CONTRAST * torch.randn(1, 3, node_count, node_count, generator=draws)
        fields.append(interpolate_smoothly(node_values, size).sigmoid())
    return torch.cat(fields)


def interpolate_smoothly(values: Tensor, size: int) -> Tensor:
    """Interpolate values between nodes by bicubic splines.

    Values between nodes may be larger or smaller than those at all nodes.

    Args:
        values: Values at the nodes, shape (N, C, n, n).
        size: Pixels per side.

    Returns:
        Values at the pixels, shape (N, C, size, size).
    """
    return F.interpolate(values, (size, size), mode="bicubic", align_corners=True)


def draw_projected(photographs: Tensor, count: int, size: int, draws: torch.Generator) -> Tensor:
    """Draw photographs as slides: turned, scaled and saturated at random.

    Beyond the border, a photograph is mirrored.

    Args:
        photographs: Photographs to choose from, uint8, shape (N, 3, H, W).
        count: Number of slides.
        size: Pixels per side.
        draws: CPU generator of the random numbers.

    Returns:
        Linear light in [0, 1], on the CPU, shape (count, 3, size, size).
    """
    # Index of the photograph of each slide, shape (count,).
    rows = torch.randint(len(photographs), (count,), generator=draws)
    # Numbers in [0, 1], shape (count,) each.
    turn, zoom, saturation = torch.rand(3, count, generator=draws)
    angle = 2 * math.pi * turn
    scale = MAX_ZOOM ** (2 * zoom - 1)
    cosine = scale * angle.cos()
    sine = scale * angle.sin()
    zero = torch.zeros(count)
    # The affine map from each slide to its photograph, shape (count, 2, 3).
    maps = torch.stack([cosine, -sine, zero, sine, cosine, zero], dim=1).view(-1, 2, 3)
    grid = F.affine_grid(maps, [count, 3, size, size], align_corners=False)

    chosen = photographs[rows.to(photographs.device)].cpu()
    linear = decode(to_unit(chosen), "srgb")
    return show_photographs(linear, grid, saturation)
