"""Families of projected patterns of the laboratory, drawn at random.

Points are (2, H, W) in the projector's image, which spans [-1, 1]; an object in its middle spans about [-0.3, 0.3]. A
family gives each point a weight in [0, 1] between two colors of light, (1, H, W), or one for each channel (3, H, W).
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

RESOLUTION = 512  # pixels per side of a projected image


def solid(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Light of one color."""
    return patterns.solid(points)[None]


def gradient(points: Tensor, rng: np.random.Generator) -> Tensor:
    """A ramp along x about the middle."""
    return (points[:1] / rng.uniform(0.6, 1.6) + 0.5).clamp(0, 1)


def stripes(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Stripes along y."""
    scaled = points / rng.uniform(0.12, 0.5)
    shift = rng.uniform()
    return patterns.stripes(scaled, shift, rng.uniform(0.3, 0.7)).double()[None]


def checkers(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Squares of a chessboard."""
    scaled = points / rng.uniform(0.12, 0.5)
    shift = torch.from_numpy(rng.uniform(size=2))
    return patterns.checkers(scaled, shift[:, None, None]).double()[None]


def half(points: Tensor, rng: np.random.Generator) -> Tensor:
    """One side of a line through the object."""
    return patterns.half(points, 0.5 + rng.uniform(-0.12, 0.12)).double()[None]


def spots(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Discs of one size at random positions, over about half of the image."""
    radius = rng.uniform(0.08, 0.25)
    count = round(2.8 / (math.pi * radius**2))
    is_lit = torch.zeros(points.shape[1:], dtype=torch.bool)
    for center in torch.from_numpy(rng.uniform(-1, 1, (count, 2))):
        is_lit |= (points - center[:, None, None]).square().sum(0) < radius**2
    return is_lit.double()[None]


def rings(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Rings of one width about a random point."""
    center = torch.from_numpy(rng.uniform(-0.5, 0.5, 2))
    radius = (points - center[:, None, None]).norm(dim=0, keepdim=True)
    scaled = radius / rng.uniform(0.12, 0.4)
    shift = rng.uniform()
    return patterns.stripes(scaled, shift, rng.uniform(0.3, 0.7)).double()[None]


def window(points: Tensor, rng: np.random.Generator) -> Tensor:
    """The panes of a window with bars between them and darkness around."""
    panes = torch.from_numpy(rng.integers(2, 5, 2))[:, None, None]
    size = torch.from_numpy(rng.uniform(0.15, 0.4, 2))[:, None, None]
    middle = torch.from_numpy(rng.uniform(-0.15, 0.15, 2))[:, None, None]
    places = (points - middle) / size + panes / 2
    is_within = (places > 0) & (places < panes)
    is_pane = (places % 1 - 0.5).abs() < rng.uniform(0.3, 0.45)
    return (is_within & is_pane).all(dim=0).double()[None]


def leaves(points: Tensor, rng: np.random.Generator) -> Tensor:
    """The shadows of leaves: ellipses at all angles, over about half of the image."""
    length = rng.uniform(0.15, 0.35)
    is_lit = torch.ones(points.shape[1:], dtype=torch.bool)
    for _ in range(round(2.8 / (math.pi * length**2 / 3))):
        angle = rng.uniform(0, math.pi)
        center = torch.from_numpy(rng.uniform(-1, 1, 2))
        offset = points - center[:, None, None]
        along, across = patterns.turned(offset, math.cos(angle), -math.sin(angle))
        is_lit &= (along / length) ** 2 + (across / length * 3) ** 2 > 1
    return is_lit.double()[None]


def text(points: Tensor, rng: np.random.Generator) -> Tensor:
    """Lines of random capitals, bright, on a dark slide."""
    height = int(rng.integers(40, 120))
    slide, font = Image.new("L", (RESOLUTION, RESOLUTION)), ImageFont.load_default(float(height))
    for top in range(0, RESOLUTION, int(1.2 * height)):
        line = "".join(rng.choice(list("ABCDEFGHIJKLMNOPQRSTUVWXYZ "), 24))
        ImageDraw.Draw(slide).text((-int(rng.integers(height)), top), line, 255, font)
    return _sampled(np.asarray(slide, dtype=np.float32)[..., None] / 255, points, order=1)


def colors(points: Tensor, rng: np.random.Generator) -> Tensor:
    """A smooth field of colors, each channel by itself."""
    grid = rng.uniform(0, 1, (rng.integers(3, 6), rng.integers(3, 6), 3))
    return _sampled(grid, points, order=3).clamp(0, 1)


def _sampled(image: np.ndarray, points: Tensor, order: int) -> Tensor:
    """Return an image (H, W, C), which spans [-1, 1], at points, by splines; mirrored beyond its sides."""
    size = np.array(image.shape[:2])[:, None, None]
    places = (points.flip(0).numpy() + 1) / 2 * size - 0.5
    channels = [map_coordinates(channel, places, order=order, mode="reflect") for channel in np.moveaxis(image, -1, 0)]
    return torch.from_numpy(np.stack(channels))


FAMILIES = {  # see PATTERNS in train/command_settings.py
    family.__name__: family
    for family in (solid, gradient, stripes, checkers, half, spots, rings, window, leaves, text, colors)
}
TWO_COLORED = ("gradient", "stripes", "checkers")  # the other families have darkness beside their color


def draw_pattern(family: str, rng: np.random.Generator, slides: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Draw a pattern of random colors, at a random angle, scale and position.

    Args:
        family: Name of the family, or SLIDES.
        rng: Source of random numbers.
        slides: The pictures (H, W, 3) of the family SLIDES, in linear RGB.

    Returns:
        Linear RGB in [0, 1], shape (RESOLUTION, RESOLUTION, 3), float32.
    """
    first = torch.from_numpy(draw_color(rng))[:, None, None]
    second = torch.from_numpy(draw_color(rng))[:, None, None]
    second = second * rng.uniform() * (family in TWO_COLORED)
    angle = rng.uniform(0, 2 * math.pi)
    middles = patterns.pixel_middles(RESOLUTION)[:, 0].double()
    points = patterns.turned(middles, math.cos(angle), -math.sin(angle))
    if family == SLIDES:
        picture = slides[int(rng.integers(len(slides)))]
        scaled = points * rng.uniform(0.3, 1)
        shift = torch.from_numpy(rng.uniform(-0.5, 0.5, 2))
        light = _sampled(picture, scaled + shift[:, None, None], order=1)
    else:
        weight = FAMILIES[family](points, rng)
        light = patterns.two_colors(weight, first, second).expand(3, -1, -1)
    return light.permute(1, 2, 0).contiguous().float().numpy()


def draw_color(rng: np.random.Generator) -> np.ndarray:
    """Draw a color of light, see `augment.scene.patterns.random_colors`.

    Args:
        rng: Source of random numbers.

    Returns:
        Linear RGB, shape (3,), whose largest channel is 1.
    """
    hue_and_saturation = torch.from_numpy(rng.uniform(size=(1, 2)))
    return patterns.random_colors(hue_and_saturation).flatten().numpy()
