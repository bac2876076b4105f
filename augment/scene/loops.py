"""Loops over pixels on the CPU, which numba compiles if it is installed (extra `fast`).

Each has the arithmetic of the operations of torch beside which it is called: bytes are equal, and
light is equal to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Linear values are looked up in so many bins. Each has at most one limit between two bytes.
BINS = 4096
# Bits of the position of a linear value in its bin.
BIN_BITS = 16
# Types of arrays: a field (B, C, H, W), numbers of each image, and what `grid` returns.
FIELD = "float32[:,:,:,::1]"
ROWS = "float32[:,::1]"
GRID = f"Tuple((float32[::1], float32[::1], {', '.join(4 * [ROWS])}))"


def _loop(
    signature: str, function: Callable[..., None]
) -> Callable[..., Callable[..., None] | None]:
    """Delay the compilation of a loop until it is wanted for tensors.

    The result is None without numba, and for tensors on a GPU, of 64 bits or with a gradient.
    """

    # Loops over bytes look up tables.
    uses_tables = "uint8" in signature

    # The loop, compiled in the first call. None without numba.
    @cache
    def compiled() -> Callable[..., None] | None:
        try:
            import numba
        except ImportError:
            return None
        settings: Any = numba.config
        vectorize = settings.LOOP_VECTORIZE
        # Vector instructions that look up a table are slower than single ones.
        settings.LOOP_VECTORIZE = int(vectorize and not uses_tables)
        for helper in (_between, _segment, _interpolate):
            numba.extending.register_jitable(fastmath=True)(helper)
        # Bytes are equal to those of torch, and light is to rounding.
        options = {"nogil": True, "error_model": "numpy", "fastmath": not uses_tables}
        njit: Any = partial(numba.njit, f"void({signature})", **options)
        try:
            loop = njit(cache=True)(function)
        except Exception:  # If its cache is read-only or damaged.
            loop = njit()(function)
        finally:
            settings.LOOP_VECTORIZE = vectorize
        return lambda *values: loop(*map(_as_array, values))

    # The loop if it takes such a tensor, or None.
    def fitting(values: Tensor) -> Callable[..., None] | None:
        is_other = values.requires_grad or values.dtype == torch.float64
        return None if is_other or values.device.type != "cpu" else compiled()

    return fitting


def _as_array(value: Any) -> Any:
    """Return a tensor as an array, and anything else as it is."""
    return np.ascontiguousarray(value.numpy()) if isinstance(value, Tensor) else value


@partial(
    _loop, f"uint8[:,:,:,::1], {FIELD}, {ROWS}, {ROWS}, float32[::1], int32[::1], uint8[:,:,:,::1]"
)
def relit_bytes(
    colors: Any, field: Any, gain: Any, offset: Any, decoded: Any, carry: Any, out: Any
) -> None:
    """Multiply the linear values of bytes by light, and look up the nearest bytes."""
    most = np.float32(BINS << BIN_BITS)
    for image in range(len(colors)):
        for channel in range(colors.shape[1]):
            given, shown = colors[image, channel].ravel(), out[image, channel].ravel()
            # A field of one value or of one channel stands for all.
            row = field[image, min(channel, field.shape[1] - 1)].ravel()
            factor, added = gain[image, channel], offset[image, channel]
            step = 1 if len(row) == len(given) else 0
            for pixel in range(len(given)):
                light = factor * row[pixel * step] + added
                # Unsigned indices need no check for negative ones.
                value = np.uint32(np.int32(min(decoded[given[pixel]] * light, most)))
                shown[pixel] = (np.int32(value) + carry[value >> BIN_BITS]) >> BIN_BITS


@partial(_loop, f"uint8[:,::1], {ROWS}, {ROWS}, {ROWS}, {ROWS}, uint8[::1], uint8[:,::1]")
def noisy_bytes(
    colors: Any, z: Any, middle: Any, slope: Any, curve: Any, encoded: Any, out: Any
) -> None:
    """Add noise to the response to each byte, and look up the byte of the signal."""
    zero, most = np.float32(0), np.float32(len(encoded) - 1)
    for image in range(len(colors)):
        for pixel in range(colors.shape[1]):
            byte, noise = colors[image, pixel], z[image, pixel]
            # middle + slope · noise + curve · noise², rounded to a level of the converter.
            signal = (curve[image, byte] * noise + slope[image, byte]) * noise
            signal = min(max(signal + middle[image, byte], zero), most)
            out[image, pixel] = encoded[np.uint32(np.int32(np.rint(signal)))]


# Numbers of 32 bits, with which loops compute.
ZERO, HALF, ONE, PI = map(np.float32, (0, 0.5, 1, math.pi))
# With u = 1 - |t|, π/2 - |t √(1 − t²) + asin t| is u √u times this polynomial, within 3e-6.
SEGMENT = np.array([1.8856159, -0.28273824, -0.02603879, -0.00292429, -0.00311553], np.float32)
# Coefficients of the exponential of numbers in [-0.7, 0.7], within 2e-6.
EXPONENTIAL = np.array([1 / math.factorial(power) for power in range(8)], np.float32)
# Smallest and largest fraction of a gap between blinds, height of a window, width of its bar, and
# distance of the edge of a polygon.
GAP, HIGH, BAR, FAR = (0.15, 0.35), (0.6, 1.6), (0.03, 0.12), (0.4, 1.0)
# Fractions of the light of the sky that its blueness takes from the channels.
SKY = (0.5, 0.2, 0.0)


def _between(number: Any, ends: Any) -> Any:
    """Map a number in [0, 1] to an interval."""
    return np.float32(ends[0]) + np.float32(ends[1] - ends[0]) * number


def _segment(t: Any) -> Any:
    """Return t √(1 − t²) + asin t for a distance, which is clamped to [-1, 1]."""
    a, b, c, d, e = SEGMENT
    u = max(ONE - abs(t), ZERO)
    part = HALF * PI - u * np.sqrt(u) * (a + u * (b + u * (c + u * (d + u * e))))
    return part if t > ZERO else -part


def _interpolate(nodes: Any, weights: Any, columns: Any, out: Any) -> None:
    """Interpolate nodes along a row of pixels, by weights of the rows and columns of nodes."""
    out[:] = ZERO
    for column in range(len(columns)):
        node = ZERO
        for row in range(len(weights)):
            node += weights[row] * nodes[row, column]
        for pixel in range(len(out)):
            out[pixel] += node * columns[column, pixel]


@partial(_loop, f"{ROWS}, {GRID}, float32, {FIELD}, float32[:,:,::1]")
def ramps(numbers: Any, grid: Any, strength: Any, field: Any, parts: Any) -> None:
    """Compute ramps, and their gains and offsets (see `LinearLight`)."""
    x, y = grid[:2]
    for image in range(len(field)):
        turn, contrast, stops = numbers[image]
        right, down, exposure = math.cos(turn), math.sin(turn), np.exp2(strength * stops)
        corner = abs(right) + np.float32(len(y) / len(x)) * abs(down)
        parts[0, image], parts[1, image] = strength * exposure * contrast / corner, exposure
        for row in range(len(y)):
            for column in range(len(x)):
                field[image, 0, row, column] = right * x[column] + down * y[row]


@partial(_loop, f"int64[::1], {ROWS}, {ROWS}, {ROWS}, {GRID}, {FIELD}, float32[:,:,::1]")
def shadows(
    kinds: Any, numbers: Any, constants: Any, heights: Any, grid: Any, field: Any, parts: Any
) -> None:
    """Compute cast shadows of polygons (kind 0), leaves (1), blinds (2) and windows (3)."""
    x, y, rows, row_slopes, columns, column_slopes = grid
    across, along, edges = np.empty_like(x), np.empty_like(x), np.empty((4, 3), np.float32)
    for image in range(len(field)):
        kind, chosen = kinds[image], constants[image, 1:]
        left, top, angle, scale, radius, ambient, blue = numbers[image]
        scale /= radius
        for channel in range(3):
            sky = ambient - ambient * blue * np.float32(SKY[channel])
            parts[0, image, channel], parts[1, image, channel] = (ONE - sky) / PI, HALF + HALF * sky
        # Normal of each edge, in units of the radius, and its distance from the center.
        for edge in range(4):
            shift = np.float32(0.8) * chosen[edge] if kind == 0 else np.float32(kind == 2)
            turn = angle + HALF * PI * (np.float32(edge) + shift)
            edges[edge, 0], edges[edge, 1] = math.cos(turn) / radius, math.sin(turn) / radius
            edges[edge, 2] = scale * _between(chosen[4 + edge], FAR)
        period, gap = scale / np.float32(2.5), _between(chosen[0], GAP)
        high, bar = scale * _between(chosen[0], HIGH), scale * _between(chosen[1], BAR)
        for row in range(len(y)):
            distance, below = field[image, 0, row], y[row] - top
            if kind == 0:
                distance[:] = -ONE
                for edge in range(4):
                    right, down, far = edges[edge]
                    for pixel in range(len(x)):
                        height = right * (x[pixel] - left) + (down * below - far)
                        distance[pixel] = max(distance[pixel], height)
            elif kind == 1:
                nodes = heights[image].reshape(len(columns), len(columns))
                _interpolate(nodes, rows[row], columns, distance)
                _interpolate(nodes, rows[row], column_slopes, across)
                _interpolate(nodes, row_slopes[row], columns, along)
                for pixel in range(len(x)):
                    squares = across[pixel] * across[pixel] + along[pixel] * along[pixel]
                    length = radius * np.sqrt(squares + np.float32(1e-6))
                    distance[pixel] = (distance[pixel] - left) / length
            else:
                for pixel in range(len(x)):
                    p = edges[0, 0] * (x[pixel] - left) + edges[0, 1] * below
                    q = edges[1, 0] * (x[pixel] - left) + edges[1, 1] * below
                    if kind == 2:
                        t = p / period
                        distance[pixel] = (gap - abs(t - np.floor(t) - HALF)) * period
                    else:
                        p, q = abs(p), abs(q)
                        distance[pixel] = min(min(scale - p, high - q), min(p, q) - bar)
            for pixel in range(len(x)):
                distance[pixel] = _segment(distance[pixel])


@partial(_loop, f"{ROWS}, {GRID}, float32, float32[:,:,::1], float32[:,:,::1], {FIELD}")
def lamps(heights: Any, grid: Any, near: Any, places: Any, colors: Any, out: Any) -> None:
    """Add up cos / distance² of small lamps, times their squared heights. Far lamps are at 0."""
    x, y, rows, row_slopes, columns, column_slopes = grid
    # Parts of one array would keep the compiler from vector instructions, as they might overlap.
    height, field, across, along = [np.empty_like(x) for _ in range(4)]
    for image, row in np.ndindex(len(out), len(y)):
        nodes = heights[image].reshape(len(columns), len(columns))
        _interpolate(nodes, rows[row], columns, height)
        _interpolate(nodes, rows[row], column_slopes, across)
        _interpolate(nodes, row_slopes[row], columns, along)
        out[image, :, row] = ZERO
        for lamp in range(places.shape[1]):
            right, down, above = places[image, lamp]
            dy, power = down - near * y[row], above * above if near else ONE
            for pixel in range(len(x)):
                dx = right - near * x[pixel]
                # No surface is nearer to the lamp than a tenth of its distance.
                dz = max(above - near * height[pixel], np.float32(0.1) * above)
                squares = dx * dx + dy * dy + dz * dz
                # Vector to the lamp times the normal (−across, −along, 1), before normalization.
                dot = max(dz - dx * across[pixel] - dy * along[pixel], ZERO) * power
                length = ONE + across[pixel] * across[pixel] + along[pixel] * along[pixel]
                field[pixel] = dot / (squares * np.sqrt(squares * length))
            for channel in range(out.shape[1]):
                shown, color = out[image, channel, row], colors[image, lamp, channel]
                for pixel in range(len(x)):
                    shown[pixel] += color * field[pixel]


@partial(_loop, f"{FIELD}, {GRID}, {FIELD}, {FIELD}")
def multiply_slides(log_gain: Any, grid: Any, shading: Any, slides: Any) -> None:
    """Multiply slides by their shading and by the exponential of interpolated logarithms."""
    # Weights of the nodes of the grid at each row and each column of the image.
    x, _, rows, _, columns, _ = grid
    gain = np.empty_like(x)
    for image, channel, row in np.ndindex(slides.shape[:3]):
        _interpolate(log_gain[image, channel], rows[row], columns, gain)
        shown, shade = slides[image, channel, row], shading[image, 0, row]
        for pixel in range(len(shown)):
            # Horner's scheme: EXPONENTIAL has the coefficients of a polynomial near exp.
            factor = EXPONENTIAL[7]
            for power in range(6, -1, -1):
                factor = factor * gain[pixel] + EXPONENTIAL[power]
            shown[pixel] *= factor * shade[pixel]
