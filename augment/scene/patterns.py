"""Random shapes, cells, fields and photographs that a projector shows, and colors of light.

A point has two coordinates in the projected image: x to the right and y down, both in [-1, 1].
Tensors of points have these coordinates on their first axis, shape (2, ...). A shape gives each
point a weight (...): 1 in the first color, 0 in the second. Pictures are linear light in [0, 1].
The training draws them with `draw_patterns` and `draw_slides`. The laboratory draws its own, which
include the same shapes in other sizes, with `draw_lab_pattern`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Generator, Tensor

from augment.random_streams import usual_defaults
from augment.scene.surfaces import between, draw_shading, smooth
from renderer.errors import InputError, require_kind
from renderer.image import LUMINANCE, clamp, decode, encode, to_unit
from renderer.settings import Size, height_and_width

# x and y of points on the first axis, pictures in linear light, and logarithms of the factors of
# each channel in cells of a slide.
Points = Float[Tensor, "2 ..."]
Pictures = Float[Tensor, "N 3 height width"]
Gains = Float[Tensor, "N 3 cells cells"]
# Radius of a disc in the pattern `spots`, which has one disc in each square cell of width 1. The
# discs cover half of the area.
DISC_RADIUS = 0.4
# Smallest and largest period of a random pattern. The image is 2 units wide.
MIN_PERIOD = 0.25
MAX_PERIOD = 1.0
# Largest random factor by which a projected photograph is enlarged or reduced.
MAX_ZOOM = 2.0
# Matrix from XYZ to linear sRGB (IEC 61966-2-1).
XYZ_TO_RGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
# Largest random factor by which the saturation of a projected photograph is multiplied.
MAX_SATURATION = 3.0


def fraction(values: Float[Tensor, " *S"]) -> Float[Tensor, " *S"]:
    """Return values modulo 1, to the bit and several times as fast as torch does."""
    return values - values.floor()


def stripes(
    points: Float[Tensor, " ..."], shift: Tensor | float, bright: float = 0.5
) -> Bool[Tensor, " ..."]:
    """Find the points on the bright parts of vertical stripes with period 1.

    Row 0 of the points is x, row 1 is y. `bright` is the bright fraction of a period.
    """
    # Vertical stripes depend on x only, which is row 0.
    return fraction((points + shift)[0]) < bright


def checkers(points: Points, shift: Points) -> Bool[Tensor, " ..."]:
    """Find the points on the bright squares of a chessboard with period 1."""
    # A square is bright if exactly one of x and y is in the first half of its period.
    return (fraction(points + shift) < 0.5).sum(0) == 1


def spots(points: Points, shift: Points) -> Bool[Tensor, " ..."]:
    """Find the points in the discs of a square grid with period 1."""
    # The difference is the vector from the center of the disc in the same cell, shape (2, ...).
    return (fraction(points + shift) - 0.5).square().sum(0) < DISC_RADIUS**2


def half(points: Points, shift: Tensor | float) -> Bool[Tensor, " ..."]:
    """Find the points to the right of the vertical line x = shift - 0.5."""
    # The line is vertical, so only the coordinate x counts, which is row 0.
    return (points > shift - 0.5)[0]


def solid(points: Points, shift: Tensor | float = 0.0) -> Float[Tensor, " ..."]:
    """Return ones for all points, which makes a pattern of a single color."""
    return torch.ones_like(points[0])


def waves(
    place: Pictures, period: Tensor, phase: Tensor, kind: Tensor, edge: Tensor
) -> Float[Tensor, "N 1 H W"]:
    """Return the light of a scanner, in [0, 1] and differentiable.

    It has stripes if `kind` is below 0.6, waves if it is below 0.8, and otherwise one border.
    `period` and the width `edge` of edges are lengths, as `place` is.
    """
    wave = torch.sin(2 * math.pi * (place / period + phase))
    stripes = torch.sigmoid(wave * period / edge / 2)
    border = torch.sigmoid((place + 1.6 * phase - 0.8) / edge * 2)
    return torch.where(kind < 0.6, stripes, torch.where(kind < 0.8, (1 + wave) / 2, border))


# Kinds of patterns, of which `draw_patterns` chooses at random.
FAMILIES: tuple[Callable[[Tensor, Tensor], Tensor], ...] = (stripes, checkers, spots, half, solid)


def pixel_centers(size: Size) -> Float[Tensor, "2 1 height width"]:
    """Return the coordinates of the pixel centers of an image, which spans [-1, 1] along x.

    Row 0 is x to the right, row 1 is y down, in the same unit. The second axis is for several
    images.
    """
    return torch.stack(torch.broadcast_tensors(*_centers(*height_and_width(size))))


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _centers(height: int, width: int) -> tuple[Float[Tensor, "1 1 W"], Float[Tensor, "1 H 1"]]:
    """Return x of the columns and y of the rows of `pixel_centers`."""
    x, y = ((torch.arange(count) + 0.5) / width * 2 - count / width for count in (width, height))
    return x.view(1, 1, -1), y.view(1, -1, 1)


def turned(
    points: Points | tuple[Tensor, Tensor], cosine: Tensor | float, sine: Tensor | float
) -> Points:
    """Rotate points about the center of the image.

    Positive angles are clockwise, since y points down.
    """
    x, y = points
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y])


def random_colors(draws: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3 1 1"]:
    """Convert hue and saturation to colors of full brightness (HSV with value 1).

    The columns of `draws` are hue and saturation in [0, 1]. Colors are linear RGB.
    """
    # Shape (N, 1) each.
    hue, saturation = draws.split(1, dim=1)
    # The sRGB channels of a pure hue are piecewise linear in the hue (HSV, Smith 1978).
    ramps = (6 * hue + hue.new_tensor([0.0, 4.0, 2.0])) % 6
    pure = ((ramps - 3).abs() - 1).clamp(0, 1)
    return decode(1 - saturation * (1 - pure), "srgb")[:, :, None, None]


def planckian_locus(kelvin: Tensor) -> tuple[Tensor, Tensor]:
    """Return CIE 1960 u and v of a black body at 1,000 to 15,000 K, within 1e-4 (Krystek 1985)."""
    u = (0.860117757 + 1.54118254e-4 * kelvin + 1.28641212e-7 * kelvin**2) / (
        1 + 8.42420235e-4 * kelvin + 7.08145163e-7 * kelvin**2
    )
    v = (0.317398726 + 4.22806245e-5 * kelvin + 4.20481691e-8 * kelvin**2) / (
        1 - 2.89741816e-5 * kelvin + 1.61456053e-7 * kelvin**2
    )
    return u, v


def planckian_rgb(kelvin: Tensor, offset: Tensor | float = 0.0) -> Float[Tensor, "... 3 1 1"]:
    """Return the linear RGB, with Y = 1, of a color at a distance (Duv) above a black body."""
    of_body = torch.stack(planckian_locus(torch.stack([kelvin, 1.01 * kelvin])))
    # A hotter body has less u and v. The normal of the locus points to green.
    (u, v), (along_u, along_v) = of_body[:, 0], of_body[:, 1] - of_body[:, 0]
    shift = offset / torch.hypot(along_u, along_v)
    u, v = u + shift * along_v, v - shift * along_u
    # CIE 1960 (u, v) to X and Z at Y = 1: X / Y = 3u / 2v and Z / Y = (4 − u − 10v) / 2v.
    xyz = torch.cat([3 * u, 2 * v, 4 - u - 10 * v], -3) / (2 * v)
    return (xyz.new_tensor(XYZ_TO_RGB) @ xyz[..., 0, 0, None])[..., None].clamp(min=1e-3)


def draw_patterns(
    count: int, size: Size, draws: Generator, points: Points | None = None
) -> Pictures:
    """Draw random patterns in two colors: stripes, squares, discs, halves or one color.

    Kind, colors, angle, period and position are random. The result is linear light. `points` has x
    and y of the point of the pattern that each pixel shows. By default, the pattern fills the
    image, which spans [-1, 1].
    """
    # Without points, the coordinates of columns and rows are enough.
    x, y = _centers(*height_and_width(size)) if points is None else points
    # Draw all numbers of one pattern before those of the next.
    drawn = []
    for _ in range(count):
        position = torch.rand(4, generator=draws)
        family = torch.randint(len(FAMILIES), (), generator=draws)
        drawn.append((position, family, torch.rand(5, generator=draws)))
    # Shapes (count, 4), (count,) and (count, 5).
    positions, family_of_pattern, colors = map(torch.stack, zip(*drawn, strict=True))
    # Four numbers in [0, 1] of each pattern, each of shape (count, 1, 1): angle as a fraction of
    # a full turn, period as a fraction of its range, and shifts along x and y.
    turn, relative_period, *shifts = positions.T[:, :, None, None]
    period = between(relative_period, MIN_PERIOD, MAX_PERIOD)
    angle = 2 * math.pi * turn
    # Points of the pattern in units of its period, shape (2, count, height, width).
    rotated = turned((x / period, y / period), angle.cos(), angle.sin())
    shift = torch.stack(shifts)
    # Weight of the first color at each pixel, shape (count, 1, height, width).
    weight = by_kind(
        family_of_pattern.tolist(),
        lambda kind, rows: FAMILIES[kind](rotated[:, rows], shift[:, rows]).float()[:, None],
    )
    # Hue and saturation of both colors, and the brightness of the second one.
    first, second = random_colors(colors[:, :4].reshape(-1, 2)).unflatten(0, (count, 2)).unbind(1)
    second = second * colors[:, 4:, None, None]
    return (weight * (first - second)).add_(second)


def by_kind(
    kind_of_row: Sequence[int], compute: Callable[[int, list[int] | slice], Tensor]
) -> Tensor:
    """Compute the rows of a tensor from a function of a kind and of the rows of this kind."""
    kinds = sorted(set(kind_of_row))
    if len(kinds) == 1:
        return compute(kinds[0], slice(None))
    # The rows of each kind, in the order of `kinds`. Parts are then sorted back by row.
    rows = [[row for row, of_row in enumerate(kind_of_row) if of_row == kind] for kind in kinds]
    parts = [compute(kind, of_kind) for kind, of_kind in zip(kinds, rows, strict=True)]
    order = torch.tensor([*chain(*rows)]).argsort().to(parts[0].device)
    return torch.cat(parts)[order]


def draw_photograph_patterns(
    photographs: Float[Tensor, "N 3 H W"], points: Points, draws: Generator
) -> Pictures:
    """Draw random patterns that are photographs, rotated, scaled and saturated at random.

    Beyond its border, a photograph is mirrored. Photographs are linear light. `points` has x and y
    of the point of the pattern that each pixel shows.
    """
    # Three numbers in [0, 1] of each photograph, shape (N, 1, 1) each.
    turn, zoom, relative_saturation = torch.rand(3, len(photographs), 1, 1, generator=draws)
    angle = 2 * math.pi * turn
    rotated = turned(points * MAX_ZOOM ** (2 * zoom - 1), angle.cos(), angle.sin())
    # `grid_sample` needs x and y on the last axis.
    height, width = photographs.shape[-2:]
    grid = rotated.permute(1, 2, 3, 0) * rotated.new_tensor([1, width / height])
    shown = F.grid_sample(
        photographs, grid.to(photographs), padding_mode="reflection", align_corners=False
    )
    # Change the saturation: scale the difference between each color and its gray value.
    gray = luminance(shown)
    return (gray + MAX_SATURATION * relative_saturation[:, None] * (shown - gray)).clamp(0, 1)


def luminance(linear: Float[Tensor, "N 3 H W"]) -> Float[Tensor, "N 1 H W"]:
    """Compute the luminance of each pixel."""
    return (linear * linear.new_tensor(LUMINANCE)[:, None, None]).sum(1, keepdim=True)


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
# Power of 2 above `MAX_CELLS`. A distance to the center of a cell is a multiple of it, to which the
# index of the cell is added.
CELL_CODE = 32


def draw_slides(
    count: int, size: Size, draws: Generator, photographs: UInt8[Tensor, "N 3 H W"] | None = None
) -> Pictures:
    """Draw random slides, which are pictures that a projector shows.

    A slide has a two-color pattern, Voronoi cells, a smooth field or a photograph. Slides are
    linear light on the CPU.
    """
    families: list[Callable[..., Tensor]] = [draw_patterns, draw_cells, draw_fields]
    if photographs is not None:
        families.append(partial(draw_projected, photographs))
    # `multinomial` divides by the sum, so the probabilities fit without photographs, too.
    weights = torch.tensor(PROBABILITIES[: len(families)])
    # Kind of each slide as an index of `families`.
    kinds = torch.multinomial(weights, count, replacement=True, generator=draws).tolist()
    return by_kind(kinds, lambda kind, _: families[kind](kinds.count(kind), size, draws))


def draw_cells(count: int, size: Size, draws: Generator) -> Pictures:
    """Draw pictures of Voronoi cells, each cell in a random color.

    The centers of the cells are random points. A pixel belongs to the cell whose center is nearest.
    Pictures are linear light.
    """
    cell_counts = torch.randint(MIN_CELLS, MAX_CELLS + 1, (count,), generator=draws)
    # `MAX_CELLS` centers and colors are drawn for each picture, of which it uses the first ones.
    height, width = height_and_width(size)
    centers = 2 * torch.rand(count, MAX_CELLS, 2, generator=draws) - 1
    centers[..., 1] *= height / width
    hue, saturation, brightness = torch.rand(3, count * MAX_CELLS, generator=draws)
    colors = random_colors(torch.stack([hue, saturation], dim=1))[:, :, 0, 0] * brightness[:, None]
    colors = colors.view(count, MAX_CELLS, 3).transpose(1, 2)
    x, y = _centers(height, width)
    # Squared distances are whole numbers of 25 bits, before the index of the cell is added.
    unit = 4 * (1 + (height / width) ** 2) / 2**25
    pictures = []
    for used, places, palette in zip(cell_counts.tolist(), centers, colors, strict=True):
        # Squared distances along x and along y from each cell, as multiples of `CELL_CODE`. Their
        # sum is the squared distance, and its lowest bits are the index of the cell.
        columns, rows = (
            ((axis - place) ** 2 / unit).round().int() * CELL_CODE
            for axis, place in zip((x, y), places[:used].T[..., None, None], strict=True)
        )
        columns += torch.arange(used, dtype=torch.int32)[:, None, None]
        nearest = (columns + rows).amin(0)
        shown = palette.index_select(1, (nearest & (CELL_CODE - 1)).flatten())
        pictures.append(shown.unflatten(1, (height, width)))
    return torch.stack(pictures)


def draw_fields(count: int, size: Size, draws: Generator) -> Pictures:
    """Draw pictures of smooth random light, which differs between the three channels.

    Pictures are linear light.
    """
    fields = []
    for _ in range(count):
        node_count = int(torch.randint(MIN_NODES, MAX_NODES + 1, (), generator=draws))
        node_values = FIELD_CONTRAST * torch.randn(1, 3, node_count, node_count, generator=draws)
        fields.append(smooth(node_values, size).sigmoid())
    return torch.cat(fields)


def draw_projected(
    photographs: UInt8[Tensor, "N 3 H W"], count: int, size: Size, draws: Generator
) -> Pictures:
    """Choose photographs, and rotate, scale and saturate them at random.

    Beyond its border, a photograph is mirrored. Pictures are linear light on the CPU.
    """
    # Index of the random photograph that each of the pictures shows, shape (count,).
    rows = torch.randint(len(photographs), (count,), generator=draws)
    linear = decode(to_unit(photographs[rows.to(photographs.device)].cpu()), "srgb")
    return draw_photograph_patterns(linear, pixel_centers(size), draws)


# Smallest and largest ambient light, in units of the light of a white slide.
AMBIENT = (0.01, 0.1)
# Smallest and largest random change of the exposure, in stops.
STOPS = (-1.0, 0.5)
# The exposure divides by the mean luminance of an image, but at least by this, so that black images
# stay dark.
DARKEST = 1e-6


def as_photographs(name: str, given: Tensor | np.ndarray) -> UInt8[Tensor, "N 3 H W"]:
    """Check that a value has photographs of 8 bits, and return them as a tensor."""
    require_kind(name, given, Tensor | np.ndarray, "a tensor or an array of photographs, uint8")
    shape, dtype = tuple(given.shape), str(given.dtype).removeprefix("torch.")
    if dtype != "uint8" or len(shape) != 4 or shape[1] != 3 or not all(shape):
        fault = f"{name} is {dtype} of shape {shape}"
        raise InputError(f"{fault}: give uint8 of shape (N, 3, height, width)")
    if isinstance(given, Tensor):
        return given
    # torch takes only arrays that may be written to and have no negative strides.
    return torch.from_numpy(np.require(given, requirements=["C", "W"]))


class ProjectedLight(NamedTuple):
    """Light of a projector on B photographs, and the exposure of the camera that sees them.

    Attributes:
        slide: Picture that the projector shows on each photograph, as linear light in [0, 1].
        shading: Cosine between the light and the normal of the surface, by which the slide is
            multiplied, in [0, 1].
        ambient: Light that is the same everywhere.
        stops: Exposure in stops. At 0, the mean luminance is that of the unchanged photograph.
    """

    slide: Float[Tensor, "B 3 H W"]
    shading: Float[Tensor, "B 1 H W"]
    ambient: Float[Tensor, "B 1 1 1"]
    stops: Float[Tensor, "B 1 1 1"]

    def to(self, device: torch.device | str) -> ProjectedLight:
        """Return a copy whose tensors are on a device."""
        return ProjectedLight(*(values.to(device) for values in self))

    def light(self, log_gain: Gains | None = None) -> Pictures:
        """Compute the light that falls on each pixel: slide · gain · shading + ambient.

        Logarithms of gains are interpolated linearly between the centers of the cells. None stands
        for no gain.
        """
        slide = self.slide
        if log_gain is not None:
            slide = slide * F.interpolate(log_gain, slide.shape[-2:], mode="bilinear").exp()
        return slide * self.shading + self.ambient

    def expose(self, albedo: Pictures, log_gain: Gains | None = None) -> Pictures:
        """Compute images (sRGB) of linear photographs in the light of the projector.

        The camera exposes an image such that its mean luminance is 2^stops times that of the
        photograph, before values above 1 are clamped. The result is differentiable in `log_gain`.
        """
        radiance = albedo * self.light(log_gain)
        mean_before = luminance(albedo).mean((2, 3), keepdim=True)
        mean_after = luminance(radiance).mean((2, 3), keepdim=True)
        exposure = 2**self.stops * mean_before / mean_after.clamp(min=DARKEST)
        return encode(clamp(exposure * radiance), "srgb")


@usual_defaults()
def draw_projected_light(
    count: int, size: Size, draws: Generator, photographs: UInt8[Tensor, "N 3 H W"] | None = None
) -> ProjectedLight:
    """Draw the random light of a projector: slide, shading, ambient light and exposure.

    Slides show photographs only if some are given.
    """
    slide = draw_slides(count, size, draws, photographs)
    shading = draw_shading(count, size, draws)
    # Fractions in [0, 1] of the ranges of the ambient light and of the exposure.
    ambient, stops = torch.rand(2, count, 1, 1, 1, generator=draws)
    return ProjectedLight(slide, shading, between(ambient, *AMBIENT), between(stops, *STOPS))


# Pictures of the projectors of pnb-lab. The object in the center of a picture spans about
# [-0.3, 0.3]. A function draws each kind of pattern. It computes the weight of the first of two
# colors at each pixel, in [0, 1], or of each channel. The saved renders of the laboratory can be
# made again only if the order of the draws stays.

# Pixels per side of the picture.
LAB_RESOLUTION = 512
# The areas of all spots, or of all leaves, of a pattern have this sum. They overlap
# and cover about half of the projected image, whose area is 4.
TOTAL_AREA = 2.8
# The pattern "leaves" consists of ellipses that are 3 times as long as wide.
LEAF_RATIO = 3
# The pattern "text" consists of lines of these characters in random order.
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ "
# Number of characters of a line of text.
LINE_LENGTH = 24
# Distance between two lines of text, divided by the height of a letter.
LINE_SPACING = 1.2


def _stripes(positions: Tensor, rng: np.random.Generator, widest: float = 0.5) -> Tensor:
    """Draw stripes with a random width and a random position. Row 0 is the position across."""
    scaled = positions / rng.uniform(0.12, widest)
    return stripes(scaled, shift=rng.uniform(), bright=rng.uniform(0.3, 0.7))


def _spots(points: Points, rng: np.random.Generator) -> Tensor:
    """Draw discs at random places. All have one size and cover about half of the image."""
    radius = rng.uniform(0.08, 0.25)
    count = round(TOTAL_AREA / (math.pi * radius**2))
    is_lit = torch.zeros(points.shape[1:], dtype=torch.bool)
    for center in rng.uniform(-1, 1, (count, 2)):
        is_lit |= (points - _pair(center)).square().sum(dim=0) < radius**2
    return is_lit


def _rings(points: Points, rng: np.random.Generator) -> Tensor:
    """Draw concentric rings of the same width around a random center."""
    radius = (points - _pair(rng.uniform(-0.5, 0.5, 2))).norm(dim=0, keepdim=True)
    return _stripes(radius, rng, widest=0.4)


def _window(points: Points, rng: np.random.Generator) -> Tensor:
    """Draw the light that falls through the panes of a window into a dark room."""
    pane_counts = _pair(rng.integers(2, 5, 2))
    pane_size = _pair(rng.uniform(0.15, 0.4, 2))
    # The position (0, 0) is a corner of the window. A pane has the size 1.
    positions = (points - _pair(rng.uniform(-0.15, 0.15, 2))) / pane_size + pane_counts / 2
    is_in_window = (positions > 0) & (positions < pane_counts)
    is_in_pane = (positions % 1 - 0.5).abs() < rng.uniform(0.3, 0.45)
    return (is_in_window & is_in_pane).all(dim=0)


def _leaves(points: Points, rng: np.random.Generator) -> Tensor:
    """Draw the shadows of leaves: random ellipses that cover about half of the image."""
    half_length = rng.uniform(0.15, 0.35)
    is_lit = torch.ones(points.shape[1:], dtype=torch.bool)
    leaf_area = math.pi * half_length**2 / LEAF_RATIO
    for _ in range(round(TOTAL_AREA / leaf_area)):
        angle = rng.uniform(0, math.pi)
        offset = points - _pair(rng.uniform(-1, 1, 2))
        # Coordinates along the long axis of the leaf and along its short axis.
        along, across = turned(offset, math.cos(angle), -math.sin(angle))
        is_lit &= (along / half_length) ** 2 + (across / half_length * LEAF_RATIO) ** 2 > 1
    return is_lit


def _text(points: Points, rng: np.random.Generator) -> Tensor:
    """Draw bright lines of random capital letters on a dark background."""
    from PIL import Image, ImageDraw, ImageFont

    letter_height = int(rng.integers(40, 120))
    image = Image.new("L", (LAB_RESOLUTION, LAB_RESOLUTION))
    font = ImageFont.load_default(float(letter_height))
    for top in range(0, LAB_RESOLUTION, int(LINE_SPACING * letter_height)):
        line = "".join(rng.choice(list(LETTERS), LINE_LENGTH))
        # The line starts at or left of the border, which cuts off a random part of
        # its first letter.
        left = -int(rng.integers(letter_height))
        ImageDraw.Draw(image).text((left, top), line, 255, font)
    return _interpolate(np.asarray(image, dtype=np.float32)[..., None] / 255, points, order=1)


def _colors(points: Points, rng: np.random.Generator) -> Float[Tensor, "3 H W"]:
    """Draw smooth colors: random values on a coarse grid, interpolated by cubic splines."""
    rows, columns = rng.integers(3, 6), rng.integers(3, 6)
    return _interpolate(rng.uniform(0, 1, (rows, columns, 3)), points, order=3).clamp(0, 1)


def _pair(values: np.ndarray) -> Shaped[Tensor, "2 1 1"]:
    """Convert values for x and y to a tensor that fits coordinates of points."""
    return torch.from_numpy(values)[:, None, None]


def _interpolate(
    image: Float[np.ndarray, "H W C"], points: Points, order: int
) -> Float[Tensor, "C _ _"]:
    """Interpolate an image at given positions with splines.

    The image spans [-1, 1] in x and y, and is mirrored at its borders. `points` are (x, y).
    """
    # Importing scipy takes time, and only these pictures need it.
    from scipy.ndimage import map_coordinates

    height_and_width = np.array(image.shape[:2])[:, None, None]
    # `flip` swaps (x, y) to (y, x). The interval [-1, 1] becomes [-0.5, size - 0.5],
    # so that whole numbers are centers of pixels.
    rows_and_columns = (points.flip(0).numpy() + 1) / 2 * height_and_width - 0.5
    channels = [
        map_coordinates(channel, rows_and_columns, order=order, mode="reflect")
        for channel in np.moveaxis(image, -1, 0)
    ]
    return torch.from_numpy(np.stack(channels))


# Functions that draw the patterns, by the name of the pattern. PATTERNS in
# train/command_settings.py lists the same names.
LAB_PATTERNS: dict[str, Callable[[Tensor, np.random.Generator], Tensor]] = {
    "solid": lambda points, rng: solid(points),
    # A linear ramp along x, whose value at the center of the image is 0.5.
    "gradient": lambda points, rng: (points[0] / rng.uniform(0.6, 1.6) + 0.5).clamp(0, 1),
    "stripes": _stripes,
    "checkers": lambda points, rng: checkers(
        points / rng.uniform(0.12, 0.5), _pair(rng.uniform(size=2))
    ),
    # The line x = shift - 0.5 crosses the object.
    "half": lambda points, rng: half(points, 0.5 + rng.uniform(-0.12, 0.12)),
    "spots": _spots,
    "rings": _rings,
    "window": _window,
    "leaves": _leaves,
    "text": _text,
    "colors": _colors,
}
# Patterns that mix two random colors. In all other patterns, the second color is
# black.
TWO_COLORED = ("gradient", "stripes", "checkers")


def draw_lab_pattern(
    name: str, rng: np.random.Generator, slides: Sequence[np.ndarray] = ()
) -> Float[np.ndarray, "H W 3"]:
    """Draw an image for a projector: a pattern with random colors, angle, scale and position.

    The image and the slides are linear RGB. "slides" chooses one of the slides.
    """
    first, second = (torch.from_numpy(draw_lab_color(rng))[:, None, None] for _ in range(2))
    # The brightness is drawn even if it is not used, so that all patterns take the same
    # number of random draws.
    second = second * rng.uniform() * (name in TWO_COLORED)
    angle = rng.uniform(0, 2 * math.pi)
    centers = pixel_centers(LAB_RESOLUTION)[:, 0].double()
    points = turned(centers, math.cos(angle), -math.sin(angle))
    if name == "slides":
        picture = slides[int(rng.integers(len(slides)))]
        scaled = points * rng.uniform(0.3, 1)
        image = _interpolate(picture, scaled + _pair(rng.uniform(-0.5, 0.5, 2)), order=1)
    else:
        image = second + LAB_PATTERNS[name](points, rng) * (first - second)
    return image.permute(1, 2, 0).contiguous().float().numpy()


def draw_lab_color(rng: np.random.Generator) -> Float[np.ndarray, " 3"]:
    """Draw a color of light with a random hue and a random saturation.

    It is linear RGB, and its largest channel is 1.
    """
    return random_colors(torch.from_numpy(rng.uniform(size=(1, 2)))).flatten().numpy()
