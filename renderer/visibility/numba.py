"""Rasterizer that is compiled with numba and draws one triangle after another.

The arithmetic and the results are the same as in
`renderer.visibility.numpy`. numba stores the machine code in
__pycache__. If this folder is read-only, numba stores it below ~/.cache.

Positions are fixed-point numbers: integers in units of a subsample, which is
1 / SUBSAMPLES of a sample. x points to the right and y down.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

import renderer.visibility.numpy as exact
from renderer.errors import import_package
from renderer.visibility.numpy import FAR, SUBSAMPLE_BITS, FaceIds, Faces, Views, to_fixed_point

# numba also raises ImportError for an unsupported NumPy.
numba = import_package("numba", "numba, or choose the rasterizer numpy")
# Types of the arguments and of the result of `_draw`, for which numba compiles it: positions (2, V)
# and depths (V,) of the vertices, faces (F, 3), and the index of the nearest face and its depth at
# each sample.
TYPES = "void(int64[:, ::1], float64[::1], uint64[:, ::1], b1, int32[:, ::1], float32[:, ::1])"


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
        _draw(positions, depths, corners, closed, view_ids, nearest_depths)
    return ids


# With the error model "numpy", the compiled code does not check whether a divisor is 0.
# The code never divides by 0, because triangles without area are skipped.
_njit: Callable[..., Any] = partial(numba.njit, nogil=True, error_model="numpy")


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function for TYPES, and store the code in a file for the next process.

    numba compiles anew if this file or the name of the function changes. Functions of another file
    are compiled in, so the name gets a checksum of that file.
    """
    function.__qualname__ += f"_{crc32(Path(exact.__file__).read_bytes())}"
    # numba may raise any exception if its cache is read-only or damaged.
    try:
        return _njit(TYPES, cache=True)(function)
    except Exception:
        return _njit(TYPES)(function)


_doubled_area = _njit(exact.doubled_areas)
_next_sample = _njit(exact.next_sample)
_depth_plane = _njit(exact.depth_planes)


@_njit
def _covered_range(coordinates: Any, a: int, b: int, c: int, count: int) -> tuple[int, int]:
    """Find the range of rows, or of columns, in which a triangle can cover samples.

    `coordinates` are y of all vertices for rows and x for columns. The results are the first row,
    and the first row after the range.
    """
    least = min(coordinates[a], coordinates[b], coordinates[c])
    greatest = max(coordinates[a], coordinates[b], coordinates[c])
    return max(_next_sample(least), 0), min(_next_sample(greatest), count)


@_njit
def _crossing(x: int, y: int, to_x: int, to_y: int, row_y: int) -> int:
    """Find the first column of samples at or after the point at which a row crosses an edge.

    All coordinates are in subsamples. The row crosses the edge at
    x + (row_y - y) (to_x - x) / (to_y - y). This is divided by SUBSAMPLES and rounded up.
    """
    # The operator // rounds down. The minus sign before it makes the result round up.
    return -(((to_x - x) * (y - row_y) - x * (to_y - y)) // ((to_y - y) << SUBSAMPLE_BITS))


@_compiled
def _draw(positions: Any, depths: Any, faces: Any, closed: bool, ids: Any, nearest: Any) -> None:
    """Draw faces in place in ascending order, so that at equal depth the lower index stays."""
    x = positions[0]
    y = positions[1]
    row_count, column_count = ids.shape
    for index in range(len(faces)):
        i, j, k = faces[index]
        # Skip faces without an area and, of a closed mesh, faces that are seen from behind.
        area = _doubled_area(((x[i], x[j], x[k]), (y[i], y[j], y[k])))
        if area == 0 or (closed and area > 0):
            continue
        top, bottom = _covered_range(y, i, j, k, row_count)
        left, right = _covered_range(x, i, j, k, column_count)
        if top >= bottom or left >= right:
            continue
        # Sort the corners, so that two faces with the same corners in another order get
        # exactly the same depth.
        a = min(i, j, k)
        c = max(i, j, k)
        b = i + j + k - a - c
        triangle = ((x[a], x[b], x[c]), (y[a], y[b], y[c]))
        plane = _depth_plane(triangle, (depths[a], depths[b], depths[c]), _doubled_area(triangle))
        # Position and depth of the corner a, and slopes of the depth, in samples.
        first_column, first_row, depth_a, slope_x, slope_y = plane
        # From here on, a is the top corner and c the bottom corner. y points down.
        if y[a] > y[b]:
            a, b = b, a
        if y[b] > y[c]:
            b, c = c, b
        if y[a] > y[b]:
            a, b = b, a
        ax, ay, bx, by, cx, cy = x[a], y[a], x[b], y[b], x[c], y[c]
        for row in range(top, bottom):
            row_y = row << SUBSAMPLE_BITS
            row_depth = depth_a + (row - first_row) * slope_y
            # A row crosses the edge from the top to the bottom corner, and one of the
            # two other edges.
            long_edge = _crossing(ax, ay, cx, cy, row_y)
            short_edge = (
                _crossing(ax, ay, bx, by, row_y) if row_y < by else _crossing(bx, by, cx, cy, row_y)
            )
            first = max(min(long_edge, short_edge), 0)
            end = min(max(long_edge, short_edge), column_count)
            for column in range(first, end):
                sample = np.uint64(row), np.uint64(column)
                depth = np.rint(row_depth + slope_x * (column - first_column))
                if 0 <= depth < nearest[sample]:
                    nearest[sample] = depth
                    ids[sample] = index
