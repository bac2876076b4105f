"""The compiled rasterizer: the arithmetic of `renderer.visibility.rasterizers.numpy` triangle by triangle, by numba, to the bit.

numba keeps the machine code in __pycache__ or, where that cannot be written, below ~/.cache.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from renderer.errors import InputError
from renderer.visibility.rasterizers.numpy import FAR, SUBSAMPLE_BITS, to_fixed_point

try:
    import numba
except ImportError as error:  # also where it does not know this version of NumPy
    raise InputError(f"numba does not start ({error}): pip install numba, or choose the rasterizer numpy") from error

VERSION = numba.__version__
TYPES = "void(int64[:, ::1], float64[::1], uint64[:, ::1], b1, int64, int32[:, ::1], float32[:, ::1])"


def rasterize(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """Ids by the contract in `renderer.visibility.rasterizers`, for finite points. IndexError: a face of a missing vertex."""
    corners = np.ascontiguousarray(faces, dtype=np.int64).view(np.uint64)  # numba looks for no negative ones then
    if corners.max(initial=0) >= points.shape[1]:
        raise IndexError(f"faces name vertices that are not among the {points.shape[1]}")
    ids = np.full((len(points), resolution, resolution), -1, dtype=np.int32)
    nearest = np.empty(ids.shape[1:], dtype=np.float32)  # whole numbers of 24 bits
    for view, image in zip(points, ids, strict=True):
        nearest.fill(FAR)
        _draw(*to_fixed_point(view, resolution), corners, closed, SUBSAMPLE_BITS, image, nearest)
    return ids


_njit: Callable[..., Any] = partial(numba.njit, nogil=True, error_model="numpy")  # no divisor is 0, so none is checked


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    try:
        return _njit(TYPES, cache=True)(function)
    except Exception:  # its cache cannot be written or is damaged: numba has no narrower class
        return _njit(TYPES)(function)


@_njit
def _doubled_area(x: Any, y: Any, a: int, b: int, c: int) -> Any:
    return (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])


@_njit
def _covered_range(along: Any, a: int, b: int, c: int, bits: int, resolution: int) -> tuple[int, int]:
    """The first row or column at or after a triangle's least coordinate, and at or after its greatest."""
    least, greatest = min(along[a], along[b], along[c]), max(along[a], along[b], along[c])
    return max(-(-least >> bits), 0), min(-(-greatest >> bits), resolution)


@_njit
def _crossing(x: int, y: int, to_x: int, to_y: int, row: int, bits: int) -> int:
    """The first column at or after where a row crosses an edge, all but the column in subsamples."""
    return -(((to_x - x) * (y - row) - x * (to_y - y)) // ((to_y - y) << bits))


@_compiled
def _draw(positions: Any, depths: Any, faces: Any, closed: bool, bits: int, ids: Any, nearest: Any) -> None:
    """Into ids and nearest (R, R): one face after the other, so that of equal depths the lower index stays."""
    (x, y), resolution, subsamples = positions, len(ids), 1 << bits
    for index in range(len(faces)):
        a, b, c = faces[index]
        area = _doubled_area(x, y, a, b, c)
        if area == 0 or (closed and area > 0):
            continue
        top, bottom = _covered_range(y, a, b, c, bits, resolution)
        left, right = _covered_range(x, a, b, c, bits, resolution)
        if top >= bottom or left >= right:
            continue
        a, b, c = min(a, b, c), a + b + c - min(a, b, c) - max(a, b, c), max(a, b, c)  # duplicates have one depth
        ax, ay, bx, by, cx, cy = x[a], y[a], x[b], y[b], x[c], y[c]
        to_b, to_c, scale = depths[b] - depths[a], depths[c] - depths[a], subsamples / _doubled_area(x, y, a, b, c)
        by_column = (to_b * (cy - ay) - to_c * (by - ay)) * scale
        by_row = (to_c * (bx - ax) - to_b * (cx - ax)) * scale
        first_depth, first_column, first_row = depths[a], ax / subsamples, ay / subsamples
        if ay > by:  # from here on from the top to the bottom
            ax, ay, bx, by = bx, by, ax, ay
        if by > cy:
            bx, by, cx, cy = cx, cy, bx, by
        if ay > by:
            ax, ay, bx, by = bx, by, ax, ay
        for row in range(top, bottom):
            y_row, depth = row << bits, first_depth + (row - first_row) * by_row
            one = _crossing(ax, ay, cx, cy, y_row, bits)
            other = _crossing(ax, ay, bx, by, y_row, bits) if y_row < by else _crossing(bx, by, cx, cy, y_row, bits)
            for column in range(max(min(one, other), 0), min(max(one, other), resolution)):
                sample = np.uint64(row), np.uint64(column)
                z = np.rint(depth + by_column * (column - first_column))
                if 0 <= z < nearest[sample]:
                    nearest[sample], ids[sample] = z, index
