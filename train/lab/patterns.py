"""Families of projected patterns, each drawn at random in color, scale, angle and position.

Points are (..., 2) in the projector's image, which spans [-1, 1]; an object in its middle spans about [-0.3, 0.3]. A
family gives each point a weight in [0, 1] between two colors of light, linear RGB with a largest channel of at most 1.
"""

import colorsys
import math
from collections.abc import Callable

import numpy as np
import torch

from renderer.image import decode

RESOLUTION = 512  # pixels per side of a projected image
TWO_COLORED = ("gradient", "stripes", "checkers")  # the other families have darkness beside their color


def draw_pattern(family: str, rng: np.random.Generator, resolution: int = RESOLUTION) -> np.ndarray:
    """An image (resolution, resolution, 3) float32 of the family, linear RGB in [0, 1]."""
    first, second = draw_color(rng), draw_color(rng) * rng.uniform() * (family in TWO_COLORED)
    centers = (np.arange(resolution) + 0.5) / resolution * 2 - 1
    angle = rng.uniform(0, 2 * math.pi)
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    points = np.stack(np.meshgrid(centers, centers, indexing="xy"), axis=-1) @ rotation
    weight = FAMILIES[family](points, rng)[..., None]
    return (second + weight * (first - second)).astype(np.float32)


def draw_color(rng: np.random.Generator) -> np.ndarray:
    """(3,) linear RGB, the largest channel 1: any hue, from white to pure in even steps of the sRGB values."""
    srgb = colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(), 1.0)
    return decode(torch.tensor(srgb, dtype=torch.float64), "srgb").numpy()


def solid_color(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.ones(points.shape[:-1])


def gradient(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A ramp along x about the middle."""
    return np.clip(points[..., 0] / rng.uniform(0.6, 1.6) + 0.5, 0, 1)


def stripes(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Stripes along y."""
    return square_wave(points[..., 0] / rng.uniform(0.12, 0.5) + rng.uniform(), duty=rng.uniform(0.3, 0.7))


def checkers(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Squares of a chessboard."""
    cells = points / rng.uniform(0.12, 0.5) + rng.uniform(size=2)
    return np.abs(square_wave(cells[..., 0]) - square_wave(cells[..., 1]))


def half(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One side of a line through the object."""
    return (points[..., 0] > rng.uniform(-0.12, 0.12)).astype(float)


def spots(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Discs of one size at random positions, over about half of the image."""
    radius = rng.uniform(0.08, 0.25)
    centers = rng.uniform(-1, 1, (round(2.8 / (math.pi * radius**2)), 2))
    lit = np.zeros(points.shape[:-1], dtype=bool)
    for center in centers:
        lit |= ((points - center) ** 2).sum(axis=-1) < radius**2
    return lit.astype(float)


FAMILIES: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "solid": solid_color,
    "gradient": gradient,
    "stripes": stripes,
    "checkers": checkers,
    "half": half,
    "spots": spots,
}


def square_wave(phase: np.ndarray, duty: float = 0.5) -> np.ndarray:
    """1 for the fraction `duty` of each unit of phase, then 0."""
    return (phase % 1 < duty).astype(float)
