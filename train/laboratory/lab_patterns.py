"""Draw the random patterns that the projectors of pnb-lab project onto objects.

A pattern mixes two colors of light. One function for each kind of pattern
computes the weight of the first color at each pixel. The second color has the
remaining weight.

- `points` has the position (x, y) of each pixel of the projected image, shape
  (2, H, W). The image spans [-1, 1] in both directions. The object in its
  center spans about [-0.3, 0.3].
- The weights are in [0, 1], shape (1, H, W), or (3, H, W) if each color channel
  has its own weight.

Saved renders can be reproduced only if the order of the random draws stays as
it is.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import map_coordinates
from torch import Tensor

from augment.scene import patterns
from train.command_settings import SLIDES

# Pixels per side of the image that a projector projects.
RESOLUTION = 512
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


def _solid(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Light the whole image in the first color."""
    return patterns.solid(points)[None]


def _gradient(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Draw a linear ramp along x, whose value at the center of the image is 0.5."""
    return (points[:1] / rng.uniform(0.6, 1.6) + 0.5).clamp(0, 1)


def _stripes(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Draw stripes along y with a random width and a random position."""
    scaled = points / rng.uniform(0.12, 0.5)
    shift = rng.uniform()
    bright_fraction = rng.uniform(0.3, 0.7)
    return patterns.stripes(scaled, shift, bright_fraction).double()[None]


def _checkers(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Draw a checkerboard with a random size and a random position."""
    scaled = points / rng.uniform(0.12, 0.5)
    shift = torch.from_numpy(rng.uniform(size=2))
    return patterns.checkers(scaled, shift[:, None, None]).double()[None]


def _half(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Light the pixels on one side of a vertical line that crosses the object."""
    line_x = rng.uniform(-0.12, 0.12)
    # `half` lights the points to the right of the line x = shift - 0.5.
    return patterns.half(points, shift=0.5 + line_x).double()[None]


def _spots(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Draw discs at random places. All have one size and cover about half of the image."""
    radius = rng.uniform(0.08, 0.25)
    count = round(TOTAL_AREA / (math.pi * radius**2))
    is_lit = torch.zeros(points.shape[1:], dtype=torch.bool)
    for center in torch.from_numpy(rng.uniform(-1, 1, (count, 2))):
        squared_distance = (points - center[:, None, None]).square().sum(dim=0)
        is_lit |= squared_distance < radius**2
    return is_lit.double()[None]


def _rings(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Draw concentric rings of the same width around a random center."""
    center = torch.from_numpy(rng.uniform(-0.5, 0.5, 2))
    radius = (points - center[:, None, None]).norm(dim=0, keepdim=True)
    scaled = radius / rng.uniform(0.12, 0.4)
    shift = rng.uniform()
    bright_fraction = rng.uniform(0.3, 0.7)
    return patterns.stripes(scaled, shift, bright_fraction).double()[None]


def _window(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Draw the light that falls through the panes of a window into a dark room."""
    # Each of these three tensors has one value for x and one for y, shape (2, 1, 1).
    pane_counts = torch.from_numpy(rng.integers(2, 5, 2))[:, None, None]
    pane_size = torch.from_numpy(rng.uniform(0.15, 0.4, 2))[:, None, None]
    center = torch.from_numpy(rng.uniform(-0.15, 0.15, 2))[:, None, None]
    # The position (0, 0) is a corner of the window. A pane has the size 1.
    positions = (points - center) / pane_size + pane_counts / 2
    is_in_window = (positions > 0) & (positions < pane_counts)
    distance_from_middle = (positions % 1 - 0.5).abs()
    is_in_pane = distance_from_middle < rng.uniform(0.3, 0.45)
    return (is_in_window & is_in_pane).all(dim=0).double()[None]


def _leaves(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Draw the shadows of leaves: random ellipses that cover about half of the image."""
    half_length = rng.uniform(0.15, 0.35)
    is_lit = torch.ones(points.shape[1:], dtype=torch.bool)
    leaf_area = math.pi * half_length**2 / LEAF_RATIO
    for _ in range(round(TOTAL_AREA / leaf_area)):
        angle = rng.uniform(0, math.pi)
        center = torch.from_numpy(rng.uniform(-1, 1, 2))
        offset = points - center[:, None, None]
        # `along` is the coordinate along the long axis of the leaf, `across` along
        # its short axis.
        along, across = patterns.turned(offset, math.cos(angle), -math.sin(angle))
        is_lit &= (along / half_length) ** 2 + (across / half_length * LEAF_RATIO) ** 2 > 1
    return is_lit.double()[None]


def _text(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "1 H W"]:
    """Draw bright lines of random capital letters on a dark background."""
    letter_height = int(rng.integers(40, 120))
    image = Image.new("L", (RESOLUTION, RESOLUTION))
    font = ImageFont.load_default(float(letter_height))
    for top in range(0, RESOLUTION, int(LINE_SPACING * letter_height)):
        line = "".join(rng.choice(list(LETTERS), LINE_LENGTH))
        # The line starts at or left of the border, which cuts off a random part of
        # its first letter.
        left = -int(rng.integers(letter_height))
        ImageDraw.Draw(image).text((left, top), line, 255, font)
    weights = np.asarray(image, dtype=np.float32)[..., None] / 255
    return _sample(weights, points, order=1)


def _colors(points: Float[Tensor, "2 H W"], rng: np.random.Generator) -> Float[Tensor, "3 H W"]:
    """Draw smooth colors: random values on a coarse grid, interpolated by cubic splines."""
    row_count = rng.integers(3, 6)
    column_count = rng.integers(3, 6)
    grid = rng.uniform(0, 1, (row_count, column_count, 3))
    return _sample(grid, points, order=3).clamp(0, 1)


def _sample(
    image: Float[np.ndarray, "H W C"], points: Float[Tensor, "2 _ _"], order: int
) -> Float[Tensor, "C _ _"]:
    """Interpolate an image at given positions with splines.

    The image spans [-1, 1] in x and y, and is mirrored at its borders. `points` are (x, y).
    """
    height_and_width = np.array(image.shape[:2])[:, None, None]
    # `flip` swaps (x, y) to (y, x). The interval [-1, 1] becomes [-0.5, size - 0.5],
    # so that whole numbers are centers of pixels.
    rows_and_columns = (points.flip(0).numpy() + 1) / 2 * height_and_width - 0.5
    channels = []
    for channel in np.moveaxis(image, -1, 0):
        channels.append(map_coordinates(channel, rows_and_columns, order=order, mode="reflect"))
    return torch.from_numpy(np.stack(channels))


# Functions that draw the patterns, by the name of the pattern. PATTERNS in
# train/command_settings.py lists the same names.
PATTERN_FUNCTIONS = {
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
# Patterns that mix two random colors. In all other patterns, the second color is
# black.
TWO_COLORED = ("gradient", "stripes", "checkers")


def draw_pattern(
    name: str,
    rng: np.random.Generator,
    slides: Sequence[np.ndarray] = (),
) -> Float[np.ndarray, "RESOLUTION RESOLUTION 3"]:
    """Draw an image for a projector: a pattern with random colors, angle, scale and position.

    The image and the slides are linear RGB. "slides" chooses one of the slides.
    """
    first_color = torch.from_numpy(draw_color(rng))[:, None, None]
    second_color = torch.from_numpy(draw_color(rng))[:, None, None]
    # The brightness is drawn even if it is not used, so that all patterns take the same
    # number of random draws.
    second_brightness = rng.uniform()
    if name not in TWO_COLORED:
        second_brightness = 0.0
    second_color = second_color * second_brightness
    angle = rng.uniform(0, 2 * math.pi)
    centers = patterns.pixel_centers(RESOLUTION)[:, 0].double()
    points = patterns.turned(centers, math.cos(angle), -math.sin(angle))
    if name == SLIDES:
        picture = slides[int(rng.integers(len(slides)))]
        scaled = points * rng.uniform(0.3, 1)
        shift = torch.from_numpy(rng.uniform(-0.5, 0.5, 2))
        image = _sample(picture, scaled + shift[:, None, None], order=1)
    else:
        weight = PATTERN_FUNCTIONS[name](points, rng)
        image = patterns.two_colors(weight, first_color, second_color).expand(3, -1, -1)
    return image.permute(1, 2, 0).contiguous().float().numpy()


def draw_color(rng: np.random.Generator) -> Float[np.ndarray, " 3"]:
    """Draw a color of light with a random hue and a random saturation.

    It is linear RGB, and its largest channel is 1.
    """
    hue_and_saturation = torch.from_numpy(rng.uniform(size=(1, 2)))
    return patterns.random_colors(hue_and_saturation).flatten().numpy()
