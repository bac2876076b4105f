"""Divide polygons into triangles."""

from itertools import pairwise

import mapbox_earcut
import numpy as np
from jaxtyping import Int, Num

# Axes that remain if a polygon is projected along the axis x, y or z. A
# polygon that is counter-clockwise seen from the positive axis stays so.
_REMAINING_AXES = np.array([[1, 2], [2, 0], [0, 1]])
# Largest relative difference of areas that counts as rounding.
_TOLERANCE = 1e-6


def triangulate(
    corners: Num[np.ndarray, "C 3"], sizes: Int[np.ndarray, " P"]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Divide polygons into triangles that cover the same area, also if the polygons are concave.

    All corners of a polygon are corners of its triangles, also corners on a
    straight edge. Neighboring faces therefore still share their vertices. The results are
    the corners of the triangles, the ascending polygon of each triangle, and the number of
    polygons that intersect themselves, whose area is unclear.
    """
    starts = np.cumsum(sizes) - sizes
    triangle_counts = sizes - 2
    polygons = np.arange(len(sizes)).repeat(triangle_counts)
    first_triangles = np.cumsum(triangle_counts) - triangle_counts
    steps = np.arange(len(polygons)) - first_triangles[polygons]
    # Each fan of triangles is around the first corner of the polygon.
    fans = np.stack([0 * steps, steps + 1, steps + 2], axis=1)
    triangles = starts[polygons, None] + fans
    if (sizes == 3).all():
        return triangles, polygons, 0
    points = _projected(corners, starts, sizes)
    is_fan = _are_counterclockwise(points, triangles, first_triangles) | (sizes == 3)
    # The fan around the second corner covers a quadrilateral
    # that is concave at the second or the fourth corner.
    is_bent = ~is_fan[polygons]
    turned_fans = (fans[is_bent] + 1) % sizes[polygons[is_bent], None]
    triangles[is_bent] = starts[polygons[is_bent], None] + turned_fans
    is_fan |= _are_counterclockwise(points, triangles, first_triangles)
    parts = [triangles[is_fan[polygons]]]
    owners = [polygons[is_fan[polygons]]]
    crossing_count = 0
    for polygon in np.flatnonzero(~is_fan):
        polygon_points = points[starts[polygon] : starts[polygon] + sizes[polygon]]
        clipped, is_crossing = _clip_ears(polygon_points)
        crossing_count += is_crossing
        parts.append(starts[polygon] + clipped)
        owners.append(np.full(len(clipped), polygon))
    polygons = np.concatenate(owners)
    order = np.argsort(polygons, kind="stable")
    return np.concatenate(parts)[order], polygons[order], crossing_count


def _projected(corners: np.ndarray, starts: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Project polygons along the largest component of their normals, so that they turn left.

    The coordinates are relative to the first corner of the polygon, shape (C, 2).
    """
    relative = corners - corners[starts].repeat(sizes, axis=0)
    following = np.arange(1, len(corners) + 1)
    following[starts + sizes - 1] = starts
    # Newell's normal, whose length is twice the area of a planar polygon.
    normals = np.add.reduceat(np.cross(relative, relative[following]), starts)
    axes = np.abs(normals).argmax(axis=1)
    remaining = _REMAINING_AXES[axes]
    is_clockwise = np.take_along_axis(normals, axes[:, None], axis=1)[:, 0] < 0
    remaining[is_clockwise] = remaining[is_clockwise, ::-1]
    return np.take_along_axis(relative, remaining.repeat(sizes, axis=0), axis=1)


def _doubled_areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Compute twice the areas of triangles in the plane, which are negative if clockwise."""
    a, b, c = points[triangles].swapaxes(0, 1)
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def _are_counterclockwise(
    points: np.ndarray, triangles: np.ndarray, first_triangles: np.ndarray
) -> np.ndarray:
    """Tell which polygons have only counter-clockwise triangles, which then cover the polygon."""
    return np.minimum.reduceat(_doubled_areas(points, triangles), first_triangles) >= 0


def _clip_ears(points: np.ndarray) -> tuple[np.ndarray, bool]:
    """Divide a counter-clockwise polygon (N, 2), and tell whether it intersects itself."""
    count = len(points)
    ends = np.array([count], dtype=np.uint32)
    indices = mapbox_earcut.triangulate_float64(points, ends).astype(np.int64)
    triangles = indices.reshape(-1, 3)
    if not len(triangles):
        fan = np.arange(1, count - 1)
        return np.stack([0 * fan, fan, fan + 1], axis=1), False
    if _doubled_areas(points, triangles).sum() < 0:
        triangles = triangles[:, ::-1]
    # The ears leave out some corners on straight edges. Each triangle
    # at such an edge is divided, so that it has these corners, too.
    kept = np.unique(triangles)
    for start, end in pairwise([*kept, kept[0] + count]):
        if end == start + 1:
            continue
        chain = np.arange(start, end + 1) % count
        is_at_edge = (triangles == chain[0]) & (np.roll(triangles, -1, axis=1) == chain[-1])
        if not is_at_edge.any():
            continue
        row, column = np.argwhere(is_at_edge)[0]
        opposite = np.full(len(chain) - 1, triangles[row, column - 1])
        fan = np.stack([chain[:-1], chain[1:], opposite], axis=1)
        triangles = np.concatenate([np.delete(triangles, row, axis=0), fan])
    following = np.roll(points, -1, axis=0)
    area = (points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum()
    covered = np.abs(_doubled_areas(points, triangles)).sum()
    return triangles, bool(abs(covered - area) > _TOLERANCE * np.ptp(points, axis=0).prod())
