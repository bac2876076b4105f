"""Families of projected patterns, drawn at random.

Points are (..., 2) in the projector's image, which spans [-1, 1]; an object in its middle spans about [-0.3, 0.3]. A
family gives each point a weight in [0, 1] between two colors of light, or one for each channel (..., 3).
"""

import colorsys
import math
from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import map_coordinates

from renderer.image import decode

RESOLUTION = 512  # pixels per side of a projected image


def solid(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.ones(points.shape[:-1])


def gradient(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A ramp along x about the middle."""
    return np.clip(points[..., 0] / rng.uniform(0.6, 1.6) + 0.5, 0, 1)


def stripes(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Stripes along y."""
    phase = points[..., 0] / rng.uniform(0.12, 0.5) + rng.uniform()
    return (phase % 1 < rng.uniform(0.3, 0.7)).astype(float)


def checkers(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Squares of a chessboard."""
    odd = (points / rng.uniform(0.12, 0.5) + rng.uniform(size=2)) % 1 < 0.5
    return (odd[..., 0] != odd[..., 1]).astype(float)


def half(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One side of a line through the object."""
    return (points[..., 0] > rng.uniform(-0.12, 0.12)).astype(float)


def spots(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Discs of one size at random positions, over about half of the image."""
    radius = rng.uniform(0.08, 0.25)
    lit = np.zeros(points.shape[:-1], dtype=bool)
    for center in rng.uniform(-1, 1, (round(2.8 / (math.pi * radius**2)), 2)):
        lit |= ((points - center) ** 2).sum(axis=-1) < radius**2
    return lit.astype(float)


def rings(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rings of one width about a random point."""
    radius = np.linalg.norm(points - rng.uniform(-0.5, 0.5, 2), axis=-1)
    return ((radius / rng.uniform(0.12, 0.4) + rng.uniform()) % 1 < rng.uniform(0.3, 0.7)).astype(float)


def window(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The panes of a window with bars between them and darkness around."""
    panes, size = rng.integers(2, 5, 2), rng.uniform(0.15, 0.4, 2)
    places = (points - rng.uniform(-0.15, 0.15, 2)) / size + panes / 2
    inside = (places > 0) & (places < panes) & (abs(places % 1 - 0.5) < rng.uniform(0.3, 0.45))
    return inside.all(axis=-1).astype(float)


def leaves(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The shadows of leaves: ellipses at all angles, over about half of the image."""
    length = rng.uniform(0.15, 0.35)
    lit = np.ones(points.shape[:-1], dtype=bool)
    for _ in range(round(2.8 / (math.pi * length**2 / 3))):
        angle, offset = rng.uniform(0, math.pi), points - rng.uniform(-1, 1, 2)
        along = offset @ [math.cos(angle), math.sin(angle)]
        across = offset @ [-math.sin(angle), math.cos(angle)]
        lit &= (along / length) ** 2 + (across / length * 3) ** 2 > 1
    return lit.astype(float)


def text(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Lines of random capitals, bright, on a dark slide."""
    height = int(rng.integers(40, 120))
    slide, font = Image.new("L", (RESOLUTION, RESOLUTION)), ImageFont.load_default(float(height))
    for top in range(0, RESOLUTION, int(1.2 * height)):
        line = "".join(rng.choice(list("ABCDEFGHIJKLMNOPQRSTUVWXYZ "), 24))
        ImageDraw.Draw(slide).text((-int(rng.integers(height)), top), line, 255, font)
    return _sampled(np.asarray(slide, dtype=np.float32)[..., None] / 255, points, order=1)[..., 0]


def colors(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A smooth field of colors, each channel by itself."""
    grid = rng.uniform(0, 1, (rng.integers(3, 6), rng.integers(3, 6), 3))
    return _sampled(grid, points, order=3).clip(0, 1)


def _sampled(image: np.ndarray, points: np.ndarray, order: int) -> np.ndarray:
    """The image (H, W, C), which spans [-1, 1], at points (..., 2), by splines; mirrored beyond its sides."""
    places = np.moveaxis((points[..., ::-1] + 1) / 2 * image.shape[:2] - 0.5, -1, 0)
    channels = [map_coordinates(channel, places, order=order, mode="reflect") for channel in np.moveaxis(image, -1, 0)]
    return np.stack(channels, axis=-1)


TRAINED = ("solid", "gradient", "stripes", "checkers", "half", "spots")  # all but gradients are thrown in training, too
FAMILIES = {
    family.__name__: family
    for family in (solid, gradient, stripes, checkers, half, spots, rings, window, leaves, text, colors)
}
SLIDES = "slides"  # pictures that the user names, in their own colors
TWO_COLORED = ("gradient", "stripes", "checkers")  # the other families have darkness beside their color


def draw_pattern(family: str, rng: np.random.Generator, slides: Sequence[np.ndarray] = ()) -> np.ndarray:
    """An image (RESOLUTION, RESOLUTION, 3) float32 of the family in random color, scale, angle and position, linear RGB
    in [0, 1]. slides: the pictures (H, W, 3) of the family SLIDES."""
    first, second = draw_color(rng), draw_color(rng) * rng.uniform() * (family in TWO_COLORED)
    centers = (np.arange(RESOLUTION) + 0.5) / RESOLUTION * 2 - 1
    angle = rng.uniform(0, 2 * math.pi)
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    points = np.stack(np.meshgrid(centers, centers, indexing="xy"), axis=-1) @ rotation
    if family == SLIDES:
        picture = slides[int(rng.integers(len(slides)))]
        return _sampled(picture, points * rng.uniform(0.3, 1) + rng.uniform(-0.5, 0.5, 2), order=1).astype(np.float32)
    weight = FAMILIES[family](points, rng)
    weight = weight if weight.ndim == 3 else weight[..., None]
    return (second + weight * (first - second)).astype(np.float32)


def draw_color(rng: np.random.Generator) -> np.ndarray:
    """(3,) linear RGB, the largest channel 1: any hue, from white to pure in even steps of the sRGB values."""
    srgb = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(), 1.0)
    return decode(torch.tensor(srgb, dtype=torch.float64), "srgb").numpy()
