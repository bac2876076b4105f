"""Random slides: pictures that a projector shows.

A slide is linear light in [0, 1]. It shows a pattern in two colors (`augment.scene.patterns`),
Voronoi cells, smooth random fields, or a photograph.
"""

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from augment.scene.patterns import (
    draw_patterns,
    draw_photograph_patterns,
    pixel_centers,
    random_colors,
)
from renderer.image import decode, to_unit

# Smallest and largest number of Voronoi cells of a slide.
MIN_CELLS = 3
MAX_CELLS = 24
# A smooth field interpolates random values at a grid. These are the smallest and the largest number
# of points of the grid per side.
MIN_NODES = 2
MAX_NODES = 6
# Standard deviation of the random values of a smooth field, before a sigmoid maps them to [0, 1].
FIELD_CONTRAST = 2.0
# Probabilities of a slide with a two-color pattern, Voronoi cells, a smooth field or a photograph.
PROBABILITIES = (0.4, 0.15, 0.15, 0.3)
# Coordinate of the centers of Voronoi cells that a slide does not use. They are so far away that no
# pixel belongs to their cells.
FAR = 100.0


def draw_slides(
    count: int,
    size: int,
    draws: torch.Generator,
    photographs: UInt8[Tensor, "N 3 H W"] | None = None,
) -> Float[Tensor, "count 3 size size"]:
    """Draw random slides, which are pictures that a projector shows.

    A slide has a two-color pattern, Voronoi cells, a smooth field or a photograph. Slides are
    linear light on the CPU.
    """
    families: list[Callable[[int, int, torch.Generator], Tensor]]
    families = [draw_patterns, draw_cells, draw_fields]
    if photographs is not None:
        families.append(partial(draw_projected, photographs))
    # `multinomial` divides by the sum, so the probabilities fit without photographs, too.
    weights = torch.tensor(PROBABILITIES[: len(families)])
    # Kind of each slide as an index of `families`, shape (count,).
    slide_to_family = torch.multinomial(weights, count, replacement=True, generator=draws)
    slides = torch.empty(count, 3, size, size)
    for index, draw in enumerate(families):
        rows = torch.nonzero(slide_to_family == index).squeeze(1)
        if len(rows):
            slides[rows] = draw(len(rows), size, draws)
    return slides


def draw_cells(count: int, size: int, draws: torch.Generator) -> Float[Tensor, "count 3 size size"]:
    """Draw pictures of Voronoi cells, each cell in a random color.

    The centers of the cells are random points. A pixel belongs to the cell whose center is nearest.
    Pictures are linear light.
    """
    cell_counts = torch.randint(MIN_CELLS, MAX_CELLS + 1, (count,), generator=draws)
    # Draw `MAX_CELLS` centers for each picture, and move those that are not needed far away.
    centers = 2 * torch.rand(count, MAX_CELLS, 2, generator=draws) - 1
    is_unused = torch.arange(MAX_CELLS) >= cell_counts[:, None]
    centers[is_unused] = FAR
    # Coordinates x and y of the pixel centers, shape (size², 2).
    pixels = pixel_centers(size).flatten(1).T
    # Index of the cell of each pixel, which has the nearest center, shape (count, size²).
    pixel_to_cell = torch.cdist(pixels.expand(count, -1, -1), centers).argmin(2)

    hue, saturation, brightness = torch.rand(3, count * MAX_CELLS, generator=draws)
    colors = random_colors(torch.stack([hue, saturation], dim=1))
    colors = colors[:, :, 0, 0] * brightness[:, None]
    colors = colors.view(count, MAX_CELLS, 3)
    # Color of each pixel, shape (count, size², 3).
    shown = colors.gather(1, pixel_to_cell[:, :, None].expand(-1, -1, 3))
    return shown.transpose(1, 2).unflatten(2, (size, size))


def draw_fields(
    count: int, size: int, draws: torch.Generator
) -> Float[Tensor, "count 3 size size"]:
    """Draw pictures of smooth random light, which differs between the three channels.

    Pictures are linear light.
    """
    fields = []
    for _ in range(count):
        node_count = int(torch.randint(MIN_NODES, MAX_NODES + 1, (), generator=draws))
        node_values = FIELD_CONTRAST * torch.randn(1, 3, node_count, node_count, generator=draws)
        fields.append(interpolate_smoothly(node_values, size).sigmoid())
    return torch.cat(fields)


def interpolate_smoothly(
    values: Float[Tensor, "N C n n"], size: int
) -> Float[Tensor, "N C size size"]:
    """Interpolate the values of a coarse grid to the pixels of an image, by bicubic splines.

    Interpolated values may be outside of the range of the given values.
    """
    return F.interpolate(values, (size, size), mode="bicubic", align_corners=True)


def draw_projected(
    photographs: UInt8[Tensor, "N 3 H W"], count: int, size: int, draws: torch.Generator
) -> Float[Tensor, "count 3 size size"]:
    """Choose photographs, and rotate, scale and saturate them at random.

    Beyond its border, a photograph is mirrored. Pictures are linear light on the CPU.
    """
    # Index of the random photograph that each of the pictures shows, shape (count,).
    rows = torch.randint(len(photographs), (count,), generator=draws)
    chosen = photographs[rows.to(photographs.device)].cpu()
    linear = decode(to_unit(chosen), "srgb")
    return draw_photograph_patterns(linear, pixel_centers(size), draws)
