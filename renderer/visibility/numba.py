"""Rasterizer that is compiled with numba and draws one triangle after another.

The arithmetic and the results are the same as in
`renderer.visibility.numpy`. numba stores the machine code in
__pycache__. If this folder is read-only, numba stores it below ~/.cache.

Positions are fixed-point numbers: integers in units of a subsample, which is
1 / 2^bits of a sample. x points to the right and y down.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from renderer.errors import import_package
from renderer.visibility.numpy import FAR, SUBSAMPLE_BITS, FaceIds, Faces, Views, to_fixed_point

# numba also raises ImportError for an unsupported NumPy.
numba = import_package("numba", "numba, or choose the rasterizer numpy")
VERSION = numba.__version__
# Types of the arguments and of the result of `_draw`, for which numba compiles it: positions (2, V)
# and depths (V,) of the vertices, faces (F, 3), and the index of the nearest face and its depth at
# each sample.
TYPES = (
    "void(int64[:, ::1], float64[::1], uint64[:, ::1], b1, int64, int32[:, ::1], float32[:, ::1])"
)


def rasterize(points: Views, faces: Faces, shape: tuple[int, int], closed: bool) -> FaceIds:
    """Find the nearest face at each sample of each view.

    The docstring of the package `renderer.visibility` defines the
    coordinates and the rounding. Samples without a face get -1.
    """
    # Unsigned indices are faster: compiled code checks signed indices for negative values.
    corners = np.ascontiguousarray(faces, dtype=np.int64).view(np.uint64)
    ids = np.full((len(points), *shape), -1, dtype=np.int32)
    # Depths are whole numbers with 24 bits, which float32 can store exactly.
    nearest_depths = np.empty(ids.shape[1:], dtype=np.float32)
    for view_points, view_ids in zip(points, ids, strict=True):
        nearest_depths.fill(FAR)
        positions, depths = to_fixed_point(view_points, shape)
        _draw(positions, depths, corners, closed, SUBSAMPLE_BITS, view_ids, nearest_depths)
    return ids


# With the error model "numpy", the compiled code does not check whether a divisor is 0.
# The code never divides by 0, because triangles without area are skipped.
_njit: Callable[..., Any] = partial(numba.njit, nogil=True, error_model="numpy")


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function for TYPES, and store the code in a file for the next process."""
    # numba may raise any exception if its cache is read-only or damaged.
    try:
        return _njit(TYPES, cache=True)(function)
    except Exception:
        return _njit(TYPES)(function)


@_njit
def _doubled_area(x: Any, y: Any, a: int, b: int, c: int) -> Any:
    """Compute twice the signed area of a triangle, negative if counter-clockwise in the image."""
    return (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])


@_njit
def _covered_range(
    coordinates: Any, a: int, b: int, c: int, bits: int, count: int
) -> tuple[int, int]:
    """Find the range of rows, or of columns, in which a triangle can cover samples.

    `coordinates` are y of all vertices for rows and x for columns, with `bits` fractional
    bits. The results are the first row, and the first row after the range.
    """
    least = min(coordinates[a], coordinates[b], coordinates[c])
    greatest = max(coordinates[a], coordinates[b], coordinates[c])
    # The operator >> divides by 2^bits and rounds down. The two minus signs make it round
    # up.
    return max(-(-least >> bits), 0), min(-(-greatest >> bits), count)


@_njit
def _sort_downward(ax: int, ay: int, bx: int, by: int, cx: int, cy: int) -> Any:
    """Sort three corners by y, which points down: x and y of the top, middle and bottom corner."""
    if ay > by:
        ax, ay, bx, by = bx, by, ax, ay
    if by > cy:
        bx, by, cx, cy = cx, cy, bx, by
    if ay > by:
        ax, ay, bx, by = bx, by, ax, ay
    return ax, ay, bx, by, cx, cy


@_njit
def _crossing(x: int, y: int, to_x: int, to_y: int, row_y: int, bits: int) -> int:
    """Find the first column of samples at or after the point at which a row crosses an edge.

    All coordinates are in subsamples, which are 1 / 2^bits of a sample. The row crosses the edge at
    x + (row_y - y) (to_x - x) / (to_y - y). This is divided by 2^bits and rounded up.
    """
    # The operator // rounds down. The minus sign before it makes the result round up.
    return -(((to_x - x) * (y - row_y) - x * (to_y - y)) // ((to_y - y) << bits))


@_compiled
def _draw(
    positions: Any, depths: Any, faces: Any, closed: bool, bits: int, ids: Any, nearest: Any
) -> None:
    """Draw faces in place in ascending order, so that at equal depth the lower index stays."""
    x = positions[0]
    y = positions[1]
    row_count, column_count = ids.shape
    subsamples = 1 << bits
    for index in range(len(faces)):
        i, j, k = faces[index]
        # Skip faces without an area and, of a closed mesh, faces that are seen from behind.
        area = _doubled_area(x, y, i, j, k)
        if area == 0 or (closed and area > 0):
            continue
        top, bottom = _covered_range(y, i, j, k, bits, row_count)
        left, right = _covered_range(x, i, j, k, bits, column_count)
        if top >= bottom or left >= right:
            continue
        # Sort the corners, so that two faces with the same corners in another order get
        # exactly the same depth.
        a = min(i, j, k)
        c = max(i, j, k)
        b = i + j + k - a - c
        to_b = depths[b] - depths[a]
        to_c = depths[c] - depths[a]
        scale = subsamples / _doubled_area(x, y, a, b, c)
        # Change of the depth of the face from one column, or row, to the next.
        slope_x = (to_b * (y[c] - y[a]) - to_c * (y[b] - y[a])) * scale
        slope_y = (to_c * (x[b] - x[a]) - to_b * (x[c] - x[a])) * scale
        # Position of the corner a in samples, which need not be a whole number.
        first_column = x[a] / subsamples
        first_row = y[a] / subsamples
        ax, ay, bx, by, cx, cy = _sort_downward(x[a], y[a], x[b], y[b], x[c], y[c])
        for row in range(top, bottom):
            row_y = row << bits
            row_depth = depths[a] + (row - first_row) * slope_y
            # A row crosses the edge from the top to the bottom corner, and one of the
            # two other edges.
            long_edge = _crossing(ax, ay, cx, cy, row_y, bits)
            short_edge = (
                _crossing(ax, ay, bx, by, row_y, bits)
                if row_y < by
                else _crossing(bx, by, cx, cy, row_y, bits)
            )
            first = max(min(long_edge, short_edge), 0)
            end = min(max(long_edge, short_edge), column_count)
            for column in range(first, end):
                sample = np.uint64(row), np.uint64(column)
                depth = np.rint(row_depth + slope_x * (column - first_column))
                if 0 <= depth < nearest[sample]:
                    nearest[sample] = depth
                    ids[sample] = index
