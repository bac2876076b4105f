"""Surfaces: smooth random heights or depths, their shading, and the disc of the sun at an edge.

The image is 2 units wide: x points to the right, y down, and heights towards the camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Generator, Tensor

from renderer.settings import Size, height_and_width

# A random smooth surface interpolates random heights at a grid of this number of points per side.
SURFACE_NODES = 4
# Largest standard deviation of the random heights of a surface, in units of half the width of the
# image.
MAX_STEEPNESS = 0.3
# Largest angle in degrees between the light of the projector and the normal of a flat print.
MAX_POLAR = 60.0
# Horizontal field of view in degrees of the camera that a depth map is from.
FIELD_OF_VIEW = 60.0


class Range(NamedTuple):
    """Smallest and largest value of a number, and whether its logarithm is uniform."""

    low: float
    high: float
    is_geometric: bool = False


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def limits(
    ranges: tuple[Range, ...], device: torch.device, dtype: torch.dtype
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the low ends and the widths of ranges, and where they are of logarithms."""
    ends = [[math.log(end) if log else end for end in (low, high)] for low, high, log in ranges]
    low, high = torch.tensor(ends, device=device, dtype=dtype).T.contiguous()
    return low, high - low, torch.tensor([each.is_geometric for each in ranges], device=device)


def between(numbers: Tensor, low: float, high: float) -> Tensor:
    """Map numbers in [0, 1] to an interval."""
    return low + (high - low) * numbers


def normal_numbers(uniform: Float[Tensor, " *S"]) -> Float[Tensor, " *S"]:
    """Convert uniform numbers to standard normal ones."""
    return 2**0.5 * torch.erfinv(2 * uniform.clamp(1e-6, 1 - 1e-6) - 1)


def blend(uniform: Float[Tensor, "B E"], angle: Float[Tensor, "B 1 1 1"]) -> Tensor:
    """Blend both halves of uniform numbers to normal ones, of equal variance at any angle."""
    first, second = normal_numbers(uniform)[..., None, None].chunk(2, 1)
    return angle.cos() * first + angle.sin() * second


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _axes(
    height: int, width: int, device: torch.device, dtype: torch.dtype
) -> tuple[Float[Tensor, "1 1 1 W"], Float[Tensor, "1 1 H 1"]]:
    """Return x of the columns and y of the rows of an image."""
    x, y = (
        (torch.arange(count, device=device, dtype=dtype) * 2 + (1 - count)) / width
        for count in (width, height)
    )
    return x.view(1, 1, 1, -1), y.view(1, 1, -1, 1)


def axes(size: Size, like: Tensor) -> tuple[Float[Tensor, "1 1 1 W"], Float[Tensor, "1 1 H 1"]]:
    """Return x of the columns and y of the rows of an image, on a device."""
    return _axes(*height_and_width(size), like.device, like.dtype)


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # Autograd cannot save a tensor that inference mode made.
def spline(
    nodes: int, pixels: int, spacing: float, mode: str, device: torch.device, dtype: torch.dtype
) -> Float[Tensor, "pixels nodes"]:
    """Return the matrix that interpolates nodes to pixels, or to slopes at a spacing of pixels."""
    identity = torch.eye(nodes).view(1, nodes, nodes, 1)
    # A spline has its outer nodes at the border, and linear interpolation at centers of cells.
    corners = True if mode == "bicubic" else None
    # Column i of the matrix is the interpolation of nodes that are 1 at node i and 0 elsewhere.
    matrix = F.interpolate(identity, (pixels, 1), mode=mode, align_corners=corners)[0, :, :, 0].T
    if spacing:
        matrix = _slope(matrix, spacing, 0)
    return matrix.to(device, dtype).contiguous()


def _slope(values: Tensor, spacing: float, axis: int) -> Tensor:
    """Return the gradient of values along an axis. It is 0 along an axis of one value."""
    if values.shape[axis] == 1:
        return torch.zeros_like(values)
    return torch.gradient(values, spacing=spacing, dim=axis)[0]


@lru_cache(maxsize=64)
def grid(nodes: int, size: Size, mode: str = "bicubic") -> tuple[np.ndarray, ...]:
    """Return x, y, weights of nodes (H, n) and (n, W), and those of slopes, in this order."""
    height, width = height_and_width(size)
    kind = torch.device("cpu"), torch.float32
    x, y = (axis.flatten().numpy() for axis in _axes(height, width, *kind))
    rows, row_slopes, columns, column_slopes = (
        spline(nodes, pixels, spacing, mode, *kind).numpy()
        for pixels in (height, width)
        for spacing in (0.0, 2 / width)
    )
    columns, column_slopes = (np.ascontiguousarray(part.T) for part in (columns, column_slopes))
    return x, y, rows, row_slopes, columns, column_slopes


def smooth(
    nodes: Float[Tensor, "B C n n"], size: Size, slope: str = "", mode: str = "bicubic"
) -> Float[Tensor, "B C H W"]:
    """Interpolate nodes at the pixels of an image by bicubic splines, or return a slope of them.

    The slope is along "x" or "y". Interpolated values may be outside of the range of the nodes. Two
    products of matrices are faster than `F.interpolate`.
    """
    height, width = height_and_width(size)
    count = nodes.shape[-1]
    kind = mode, nodes.device, nodes.dtype
    # Matrices from nodes to rows and to columns. Half the width has the length 1, so a pixel is
    # 2 / width.
    to_rows = spline(count, height, 2 / width if slope == "y" else 0.0, *kind)
    to_columns = spline(count, width, 2 / width if slope == "x" else 0.0, *kind)
    return to_rows @ nodes @ to_columns.T


@lru_cache(maxsize=8)
@torch.inference_mode(False)
def sum_of_octaves(
    octaves: Sequence[int], device: torch.device, dtype: torch.dtype
) -> Float[Tensor, "E nodes"]:
    """Return the matrix that adds the nodes of all octaves at the nodes of the last one."""
    # Each octave is interpolated at the nodes of the last one, along rows and along columns.
    parts = [spline(count, octaves[-1], 0.0, "bicubic", device, dtype) for count in octaves]
    return torch.cat([0.5**i * torch.kron(part, part).T for i, part in enumerate(parts)])


class Surface(NamedTuple):
    """Slopes of the heights of a surface, and the position (x, y, height) of each pixel."""

    slope_down: Tensor
    slope_right: Tensor
    position: tuple[Tensor, Tensor, Tensor]


def surface_of_depth(depth: Float[Tensor, "B 1 H W"]) -> Surface:
    """Compute the surface that a pinhole camera sees at given depths, in any unit.

    It is enlarged such that the mean depth has half the width 1. Pixels without a depth, which is
    not positive or not finite, get the mean.
    """
    is_known = depth.isfinite() & (depth > 0)
    known = torch.where(is_known, depth, 0)
    mean = known.mean((2, 3), keepdim=True) / is_known.float().mean((2, 3), keepdim=True)
    # An image without any depth has the mean 0 / 0.
    mean = mean.nan_to_num(1.0)
    relative = torch.where(is_known, known / mean, 1)
    tangent = math.tan(math.radians(FIELD_OF_VIEW / 2))
    x, y = axes(depth.shape[-2:], depth)
    # Slopes of the logarithm of the depth along the pixels, where half the width is the tangent.
    spacing = 2 * tangent / depth.shape[-1]
    down, right = (_slope(relative.log(), spacing, axis) for axis in (2, 3))
    # Product of both tangents of the surface z · (x, y, 1), up to a factor.
    towards = (1 + tangent * (x * right + y * down)).clamp(min=0.05)
    height = (1 - relative) / tangent
    return Surface(-down / towards, -right / towards, (x * relative, y * relative, height))


def draw_shading(count: int, size: Size, draws: Generator) -> Float[Tensor, "count 1 height width"]:
    """Draw the shading of random smooth surfaces in light from random directions.

    It is the cosine between normal and light, or 0 if the surface faces away.
    """
    # Steepness, azimuth and polar angle of the light, as fractions of their ranges.
    steepness, turn, tilt = torch.rand(3, count, 1, 1, 1, generator=draws)
    node_heights = torch.randn(count, 1, SURFACE_NODES, SURFACE_NODES, generator=draws)
    heights = MAX_STEEPNESS * steepness * node_heights
    down, right = (smooth(heights, size, slope) for slope in "yx")
    return lambert(down, right, *direction(2 * math.pi * turn, math.radians(MAX_POLAR) * tilt))


def direction(azimuth: Tensor, polar: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the unit vector towards a light: its components to the right, to the bottom and up."""
    return polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()


def lambert(down: Tensor, right: Tensor, to_right: Tensor, to_bottom: Tensor, up: Tensor) -> Tensor:
    """Return the cosine between a light and the normal of slopes, or 0 if the surface faces away.

    The vector towards the light has the components to the right, to the bottom and up.
    """
    squares = torch.addcmul(torch.addcmul(down.new_ones(()), down, down), right, right)
    # Product of the light's vector with the normal (-right, -down, 1) / length.
    dot = torch.addcmul(torch.addcmul(up, to_right, right, value=-1), to_bottom, down, value=-1)
    return (dot * squares.rsqrt()).clamp(min=0)


def circle_segment(distance: Tensor) -> Tensor:
    """Return t √(1 − t²) + asin t, where t is the distance of an edge from the center of a disc.

    A straight edge at a distance, in units of the radius, leaves the fraction 1/2 + segment / π of
    a uniform disc visible. The distance is positive if the center is visible.
    """
    t = distance.clamp(-1 + 1e-6, 1 - 1e-6)
    return torch.addcmul(torch.asin(t), t, torch.addcmul(t.new_ones(()), t, t, value=-1).sqrt())
