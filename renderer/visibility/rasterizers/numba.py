"""Compiled rasterizer, which draws one triangle after another.

The arithmetic is that of `renderer.visibility.rasterizers.numpy`.

The results are equal to those of `renderer.visibility.rasterizers.numpy`. numba stores the
machine code in __pycache__ or, if that folder is read-only, below ~/.cache.
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
except ImportError as error:  # numba also raises this for a version of NumPy that it does not know.
    raise InputError(
        f"numba cannot be imported ({error}): pip install numba, or choose the rasterizer numpy"
    ) from error

VERSION = numba.__version__
# Types of the arguments of `_draw`.
TYPES = (
    "void(int64[:, ::1], float64[::1], uint64[:, ::1], b1, int64, int32[:, ::1], float32[:, ::1])"
)


def rasterize(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """Find the nearest face at each sample, as `renderer.visibility.rasterizers` describes.

    Args:
        points: Projected vertices, finite, float64, shape (N, V, 3).
        faces: Vertex indices of the faces, shape (F, 3).
        resolution: Number R of samples per side.
        closed: Whether faces that are clockwise in the image are left out.

    Returns:
        Index of the face at each sample, or -1, int32, shape (N, R, R).

    Raises:
        IndexError: If a face has a vertex that does not exist.
    """
    # The compiled code does not look for negative indices if they are unsigned.
    corners = np.ascontiguousarray(faces, dtype=np.int64).view(np.uint64)
    if corners.max(initial=0) >= points.shape[1]:
        raise IndexError(f"faces has vertex indices beyond the {points.shape[1]} vertices")
    ids = np.full((len(points), resolution, resolution), -1, dtype=np.int32)
    # Depths are whole numbers of 24 bits, which float32 holds exactly.
    nearest = np.empty(ids.shape[1:], dtype=np.float32)
    for view, view_ids in zip(points, ids, strict=True):
        nearest.fill(FAR)
        positions, depths = to_fixed_point(view, resolution)
        _draw(positions, depths, corners, closed, SUBSAMPLE_BITS, view_ids, nearest)
    return ids


# The error model of NumPy leaves out checks for divisors of 0. There are none.
_njit: Callable[..., Any] = partial(numba.njit, nogil=True, error_model="numpy")


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function with arguments of TYPES, and store the machine code if possible."""
    try:
        return _njit(TYPES, cache=True)(function)
    except Exception:  # numba has no narrower class for a read-only or damaged cache.
        return _njit(TYPES)(function)


@_njit
def _doubled_area(x: Any, y: Any, a: int, b: int, c: int) -> Any:
    """Compute twice the signed area of a triangle, negative if it is counter-clockwise."""
    return (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])


@_njit
def _covered_range(
    coordinates: Any, a: int, b: int, c: int, bits: int, resolution: int
) -> tuple[int, int]:
    """Find the rows, or the columns, that a triangle can cover: the first one, and the end."""
    least = min(coordinates[a], coordinates[b], coordinates[c])
    greatest = max(coordinates[a], coordinates[b], coordinates[c])
    # Negating before and after the shift rounds up.
    return max(-(-least >> bits), 0), min(-(-greatest >> bits), resolution)


@_njit
def _sort_downward(ax: int, ay: int, bx: int, by: int, cx: int, cy: int) -> Any:
    """Sort the corners (ax, ay), (bx, by) and (cx, cy) by y, from the top to the bottom."""
    if ay > by:
        ax, ay, bx, by = bx, by, ax, ay
    if by > cy:
        bx, by, cx, cy = cx, cy, bx, by
    if ay > by:
        ax, ay, bx, by = bx, by, ax, ay
    return ax, ay, bx, by, cx, cy


@_njit
def _crossing(x: int, y: int, to_x: int, to_y: int, row_y: int, bits: int) -> int:
    """Find the first column at or after the place where a row crosses an edge.

    All coordinates are in subsamples. The edge leads from (x, y) to
    (to_x, to_y).
    """
    return -(((to_x - x) * (y - row_y) - x * (to_y - y)) // ((to_y - y) << bits))


@_compiled
def _draw(
    positions: Any, depths: Any, faces: Any, closed: bool, bits: int, ids: Any, nearest: Any
) -> None:
    """Draw the faces of one view in place.

    Faces are drawn in ascending order, so that the lower index stays if depths
    are equal.

    Args:
        positions: Fixed-point positions of the vertices, shape (2, V).
        depths: Depths of the vertices, from 0 to FAR, shape (V,).
        faces: Vertex indices of the faces, shape (F, 3).
        closed: Whether faces that are clockwise in the image are left out.
        bits: Number of fractional bits of the positions.
        ids: Index of the face at each sample, changed in place, shape (R, R).
        nearest: Depth at each sample, changed in place, shape (R, R).
    """
    x = positions[0]
    y = positions[1]
    resolution = len(ids)
    subsamples = 1 << bits
    for index in range(len(faces)):
        i, j, k = faces[index]
        area = _doubled_area(x, y, i, j, k)
        if area == 0 or (closed and area > 0):
            continue
        top, bottom = _covered_range(y, i, j, k, bits, resolution)
        left, right = _covered_range(x, i, j, k, bits, resolution)
        if top >= bottom or left >= right:
            continue
        # Duplicate faces with sorted corners have exactly the same depth. The first
        # one stays.
        a = min(i, j, k)
        c = max(i, j, k)
        b = i + j + k - a - c
        to_b = depths[b] - depths[a]
        to_c = depths[c] - depths[a]
        scale = subsamples / _doubled_area(x, y, a, b, c)
        slope_x = (to_b * (y[c] - y[a]) - to_c * (y[b] - y[a])) * scale
        slope_y = (to_c * (x[b] - x[a]) - to_b * (x[c] - x[a])) * scale
        first_column = x[a] / subsamples
        first_row = y[a] / subsamples
        ax, ay, bx, by, cx, cy = _sort_downward(x[a], y[a], x[b], y[b], x[c], y[c])
        for row in range(top, bottom):
            row_y = row << bits
            row_depth = depths[a] + (row - first_row) * slope_y
            # A row crosses the longest edge and one of the two other edges.
            one = _crossing(ax, ay, cx, cy, row_y, bits)
            other = (
                _crossing(ax, ay, bx, by, row_y, bits)
                if row_y < by
                else _crossing(bx, by, cx, cy, row_y, bits)
            )
            for column in range(max(min(one, other), 0), min(max(one, other), resolution)):
                sample = np.uint64(row), np.uint64(column)
                depth = np.rint(row_depth + slope_x * (column - first_column))
                if 0 <= depth < nearest[sample]:
                    nearest[sample] = depth
                    ids[sample] = index
