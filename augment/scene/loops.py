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


def _loop(
    signature: str, uses_tables: bool = False
) -> Callable[[Callable[..., None]], Callable[..., Callable[..., None] | None]]:
    """Return a decorator that delays the compilation until a loop is wanted for tensors.

    The result is None without numba, and for tensors on a GPU, of 64 bits or with a gradient.
    """

    def delayed(function: Callable[..., None]) -> Callable[..., Callable[..., None] | None]:
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
            # Bytes are equal to those of torch, and light is to rounding.
            njit: Any = partial(
                numba.njit,
                f"void({signature})",
                nogil=True,
                error_model="numpy",
                fastmath=not uses_tables,
            )
            try:
                loop = njit(cache=True)(function)
            except Exception:  # If its cache is read-only or damaged.
                loop = njit()(function)
            finally:
                settings.LOOP_VECTORIZE = vectorize
            return lambda *values: loop(*map(_as_array, values))

        # The loop if it takes such tensors, or None.
        def fitting(*tensors: Tensor) -> Callable[..., None] | None:
            for values in tensors:
                is_other = values.requires_grad or values.dtype == torch.float64
                if is_other or values.device.type != "cpu":
                    return None
            return compiled()

        return fitting

    return delayed


def _as_array(value: Any) -> Any:
    """Return a tensor as an array, and anything else as it is."""
    return value.contiguous().numpy() if isinstance(value, Tensor) else value


@_loop(
    "uint8[:,:,::1], float32[:,:,::1], float32[:,::1], float32[:,::1], float32[::1], uint8[::1],"
    "float32[::1], uint8[:,:,::1]",
    uses_tables=True,
)
def relit_bytes(
    colors: Any, field: Any, gain: Any, offset: Any, decoded: Any, lowest: Any, limit: Any, out: Any
) -> None:
    """Multiply the linear values of bytes by light, and look up the nearest bytes."""
    one, bins = np.float32(1), np.float32(BINS)
    pixels = colors.shape[2]
    for image in range(len(colors)):
        for channel in range(colors.shape[1]):
            given, shown = colors[image, channel], out[image, channel]
            # A field of one value or of one channel stands for all.
            row = field[image, min(channel, field.shape[1] - 1)]
            factor, added = gain[image, channel], offset[image, channel]
            step = 1 if len(row) == pixels else 0
            for pixel in range(pixels):
                light = factor * row[pixel * step] + added
                value = min(decoded[given[pixel]] * light, one)
                # Unsigned indices need no check for negative ones.
                index = np.uint32(np.int32(value * bins))
                shown[pixel] = lowest[index] + (value >= limit[index])


@_loop(
    "uint8[:,::1], float32[:,::1], float32[:,::1], float32[:,::1], float32[:,::1], uint8[::1],"
    "uint8[:,::1]",
    uses_tables=True,
)
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


@_loop("int64, float32[:,:,::1], float32[:,:,::1], float32[:,::1], float32[:,:,::1]")
def edges(kind: int, columns: Any, rows: Any, limits: Any, out: Any) -> None:
    """Compute the distance of each pixel to the nearest edge of a shadow."""
    # Kind 0 is a polygon, 1 are blinds, and 2 is a window (see `CastShadow`).
    half = np.float32(0.5)
    for image, row in np.ndindex(out.shape[:2]):
        across, down, distance = columns[image, 0], rows[image, 0, row], out[image, row]
        first, second, third = limits[image]
        if kind == 0:
            distance[:] = np.float32(-1)
            for edge in range(columns.shape[1]):
                across, down = columns[image, edge], rows[image, edge, row]
                for column in range(len(across)):
                    distance[column] = max(distance[column], across[column] + down)
        elif kind == 1:
            for column in range(len(across)):
                t = across[column] + down
                distance[column] = (first - abs(t - np.floor(t) - half)) * second
        else:
            other, lower = columns[image, 1], rows[image, 1, row]
            for column in range(len(across)):
                p, q = abs(across[column] + down), abs(other[column] + lower)
                distance[column] = min(min(first - p, second - q), min(p, q) - third)


# With u = 1 - |t|, π/2 - |t √(1 − t²) + asin t| is u √u times this polynomial, within 3e-6.
SEGMENT = np.array([1.8856159, -0.28273824, -0.02603879, -0.00292429, -0.00311553], np.float32)


@_loop("float32[::1], float32[::1]")
def segment(distance: Any, out: Any) -> None:
    """Compute t √(1 − t²) + asin t for distances, which are clamped to [-1, 1]."""
    zero, one, most = np.float32(0), np.float32(1), np.float32(math.pi / 2)
    a, b, c, d, e = SEGMENT
    for pixel in range(len(out)):
        t = distance[pixel]
        u = max(one - abs(t), zero)
        part = most - u * np.sqrt(u) * (a + u * (b + u * (c + u * (d + u * e))))
        out[pixel] = part if t > zero else -part


@_loop(
    "float32[:,:,::1], float32[:,:,::1], float32[:,:,::1], float32[::1], float32[::1],"
    "float32[:,:,::1], float32[:,:,::1], float32[:,:,:,::1]"
)
def lamps(
    slope_down: Any,
    slope_right: Any,
    heights: Any,
    x: Any,
    y: Any,
    places: Any,
    colors: Any,
    out: Any,
) -> None:
    """Add up the irradiance of small lamps, cos / distance², times their squared heights."""
    zero, one = np.float32(0), np.float32(1)
    field = np.empty(len(x), np.float32)
    for image, row in np.ndindex(len(out), len(y)):
        # The slope to the right comes first, as x does.
        slopes, height = (slope_right[image, row], slope_down[image, row]), heights[image, row]
        out[image, :, row] = zero
        for lamp in range(places.shape[1]):
            right, down, above = places[image, lamp]
            dy = down - y[row]
            for column in range(len(x)):
                dx, dz = right - x[column], max(above - height[column], np.float32(0.1) * above)
                across, along = slopes[0][column], slopes[1][column]
                squares = dx * dx + dy * dy + dz * dz
                # Vector to the lamp times the normal (−across, −along, 1), before normalization.
                dot = max(dz - dx * across - dy * along, zero) * (above * above)
                length = one + across * across + along * along
                field[column] = dot / (squares * np.sqrt(squares * length))
            for channel in range(out.shape[1]):
                shown, color = out[image, channel, row], colors[image, lamp, channel]
                for column in range(len(field)):
                    shown[column] += color * field[column]


@_loop("float32[:,::1], float32[:,::1], float32[:,::1], float32[:,::1]")
def cosines(slope_down: Any, slope_right: Any, towards: Any, out: Any) -> None:
    """Compute the cosine between the normal of each pixel and a direction, at least 0."""
    zero, one = np.float32(0), np.float32(1)
    for image in range(len(out)):
        right, down, up = towards[image]
        along, across, field = slope_down[image], slope_right[image], out[image]
        for pixel in range(len(field)):
            length = one + across[pixel] * across[pixel] + along[pixel] * along[pixel]
            dot = up - right * across[pixel] - down * along[pixel]
            field[pixel] = max(dot, zero) / np.sqrt(length)


@_loop("int32[:,::1], int32[:,::1], int32[:,::1]")
def lowest_sums(columns: Any, rows: Any, out: Any) -> None:
    """Compute the lowest sum of the numbers of a column and of a row."""
    for row in range(len(out)):
        out[row] = 2**31 - 1
        for cell in range(len(columns)):
            for column in range(out.shape[1]):
                out[row, column] = min(out[row, column], columns[cell, column] + rows[cell, row])
