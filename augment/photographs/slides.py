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

from augment.scene.patterns import draw_patterns, pixel_centers, random_colors
from renderer.image import decode, to_unit

# Smallest and largest number of cells of a slide.
MIN_CELLS = 3
MAX_CELLS = 24
# Smallest and largest number of nodes per side of a smooth field.
MIN_NODES = 2
MAX_NODES = 6
# Standard deviation of the logits of a smooth field at its nodes.
FIELD_CONTRAST = 2.0
# A photograph is shown at a scale from 1 / MAX_ZOOM to MAX_ZOOM.
MAX_ZOOM = 2.0
# Largest factor of the saturation of a photograph.
MAX_SATURATION = 3.0
# Shares of two-color patterns, cells, smooth fields and photographs.
SHARES = (0.4, 0.15, 0.15, 0.3)
# Position of points that are the nearest point of no pixel.
FAR = 100.0
# Luminance of red, green and blue of linear sRGB (IEC 61966-2-1).
LUMINANCE = (0.2126, 0.7152, 0.0722)


def luminance(linear: Tensor) -> Tensor:
    """Compute the luminance of linear RGB.

    Args:
        linear: Linear RGB, shape (N, 3, H, W).

    Returns:
        Luminance, shape (N, 1, H, W).
    """
    weights = linear.new_tensor(LUMINANCE)[:, None, None]
    return (linear * weights).sum(1, keepdim=True)


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
    chosen = torch.multinomial(shares, count, replacement=True, generator=draws)
    slides = torch.empty(count, 3, size, size)
    for index, draw in enumerate(families):
        rows = torch.nonzero(chosen == index).squeeze(1)
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
    centers = 2 * torch.rand(count, MAX_CELLS, 2, generator=draws) - 1
    is_unused = torch.arange(MAX_CELLS) >= cell_counts[:, None]
    centers[is_unused] = FAR
    pixels = pixel_centers(size).flatten(1).T
    cell_of_pixel = torch.cdist(pixels.expand(count, -1, -1), centers).argmin(2)

    hue, saturation, brightness = torch.rand(3, count * MAX_CELLS, generator=draws)
    colors = random_colors(torch.stack([hue, saturation], dim=1))
    colors = colors[:, :, 0, 0] * brightness[:, None]
    colors = colors.view(count, MAX_CELLS, 3)
    shown = colors.gather(1, cell_of_pixel[:, :, None].expand(-1, -1, 3))
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
        nodes = int(torch.randint(MIN_NODES, MAX_NODES + 1, (), generator=draws))
        logits = FIELD_CONTRAST * torch.randn(1, 3, nodes, nodes, generator=draws)
        fields.append(interpolate_smoothly(logits, size).sigmoid())
    return torch.cat(fields)


def interpolate_smoothly(values: Tensor, size: int) -> Tensor:
    """Interpolate values between nodes by bicubic splines, which may exceed them.

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
    rows = torch.randint(len(photographs), (count,), generator=draws)
    turn, zoom, saturation = torch.rand(3, count, generator=draws)
    angle = 2 * math.pi * turn
    scale = MAX_ZOOM ** (2 * zoom - 1)
    cosine = scale * angle.cos()
    sine = scale * angle.sin()
    zero = torch.zeros(count)
    maps = torch.stack([cosine, -sine, zero, sine, cosine, zero], dim=1).view(-1, 2, 3)
    grid = F.affine_grid(maps, [count, 3, size, size], align_corners=False)

    chosen = photographs[rows.to(photographs.device)].cpu()
    linear = decode(to_unit(chosen), "srgb")
    turned = F.grid_sample(linear, grid, padding_mode="reflection", align_corners=False)
    gray = luminance(turned)
    factor = MAX_SATURATION * saturation[:, None, None, None]
    return (gray + factor * (turned - gray)).clamp(0, 1)
