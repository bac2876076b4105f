"""The NumPy rasterizer: fixed-point corners and exact integer arithmetic, as GPUs have them.

Corners (x, y) are integers in 1/256 of a sample. In the row y = 256 r, an edge from (x₀, y₀) to (x₁, y₁) begins at the
column ⌈(x₀ + (y − y₀) (x₁ − x₀) / (y₁ − y₀)) / 256⌉, an exact quotient of integers, which both faces of the edge share:
so each sample belongs to one of them (the top-left rule). Between its two columns in a row, a face covers a run of
samples. Depth is the plane z = z_a + (x − x_a) ∂z/∂x + (y − y_a) ∂z/∂y, rounded to 24 bits, and the image is the least
key of each sample,

    key = depth · 2³² + face,

whose lower half is the id: the nearest face, and of equal depths the one with the lower index. Only covered samples are
computed: faces are cut into rows, and rows into samples, in blocks that stay in the cache. The longest axis is the last
of every array.
"""

from collections.abc import Iterator

import numpy as np

SUBSAMPLE_BITS = 8
SUBSAMPLES = 2**SUBSAMPLE_BITS  # corners snap to this fraction of a sample
FAR = 2**24 - 1  # depth is a 24-bit key, and surface at the far plane itself is not drawn
FACE_BITS = 32  # a sample's key is its depth above so many bits of face index, so the least key wins
EMPTY = (FAR << FACE_BITS) - 1  # less than any key at the far plane; its face index reads -1
FACES, PARTS = 2**14, 2**13  # faces, and their rows or samples, at a time: what they take stays in the cache


def rasterize(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """Ids by the contract in `renderer.visibility.rasterizers`, for finite points."""
    ids = np.empty((len(points), resolution, resolution), dtype=np.int32)
    for view, image in zip(points, ids, strict=True):
        image[:] = _keys(view, faces, resolution, closed).reshape(image.shape)  # of which an id is the lower half
    return ids


def _keys(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """(R²,) the least key of each sample."""
    positions, depths = to_fixed_point(points, resolution)
    keys = np.full(resolution * resolution, EMPTY)
    for begin in range(0, len(faces), FACES):
        block = np.ascontiguousarray(faces[begin : begin + FACES].T)
        drawn, first, rows = _cull(positions.take(block, axis=1), resolution, closed)
        corners = _sort(block.take(drawn, axis=1))  # so that duplicate faces have one depth and tie
        triangles = positions.take(corners, axis=1)
        edges, planes, ids = _edges(triangles), _planes(triangles, depths.take(corners)), drawn + begin
        for triangle, row in _parts(rows):
            row += first.take(triangle)
            left, right = _crossings(edges, triangle, row, resolution)
            x, y, depth, slope, by_row = planes.take(triangle, axis=1)
            at_row, offset = depth + (row - y) * by_row, left - x
            sample, face = row * resolution + left, ids.take(triangle)
            for span, step in _parts(right - left):
                depth = np.rint(at_row.take(span) + slope.take(span) * (offset.take(span) + step)).astype(np.int64)
                depth = np.minimum(depth.view(np.uint64), FAR).view(np.int64)  # negative ones are large as unsigned
                np.minimum.at(keys, sample.take(span) + step, (depth << FACE_BITS) | face.take(span))
    return keys


def to_fixed_point(points: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (V, 3) as positions (2, V) int64, x right and y down from the center of the first sample in 1/256 sample,
    and depths (V,) float64 between 0 and FAR.

    Before they are snapped, positions are float32 numbers, from a multiply-add that rounds once, as GPUs have it.
    """
    half = resolution / 2
    window = points[:, :2].T.astype(np.float32, order="C") * np.array([[half], [-half]])
    window += half
    snapped = window.astype(np.float32)
    snapped *= SUBSAMPLES
    positions = np.rint(snapped, out=snapped).astype(np.int64)
    positions -= SUBSAMPLES // 2
    depths = points[:, 2] + 1
    depths /= 2
    depths *= FAR
    return positions, depths


def _cull(corners: np.ndarray, resolution: int, closed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which triangles (2, 3, F) to draw (T,), and the first and the number of the rows (T,) that they reach.

    By the top-left rule a sample on an edge belongs to the triangle that has the edge at its left or, if level, its
    top. So rows and columns begin at or after a triangle's least coordinate, and end before its greatest.
    """
    areas = _doubled_areas(corners)
    first = _next_sample(corners.min(axis=1)).clip(0, None)
    counts = _next_sample(corners.max(axis=1)).clip(None, resolution) - first
    towards = areas < 0 if closed else areas != 0  # y runs down: counter-clockwise areas are negative
    drawn = np.flatnonzero(towards & (counts > 0).all(axis=0))
    return drawn, first[1].take(drawn), counts[1].take(drawn)


def _doubled_areas(corners: np.ndarray) -> np.ndarray:
    (ax, bx, cx), (ay, by, cy) = corners
    return (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)


def _next_sample(positions: np.ndarray) -> np.ndarray:
    """The first row or column at or after each position."""
    return (positions + (SUBSAMPLES - 1)) >> SUBSAMPLE_BITS


def _sort(corners: np.ndarray) -> np.ndarray:
    """np.sort(corners, axis=0) of (3, T), several times faster."""
    least, greatest = corners.min(axis=0), corners.max(axis=0)
    return np.stack([least, corners.sum(axis=0) - least - greatest, greatest])


def _edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges (3, 3, T) of triangles (2, 3, T), and the first row (T,) after each triangle's middle corner.

    The edges go from the top to the bottom, from the top to the middle and from the middle to the bottom corner. Minus
    the column where a row crosses one is (slope · row + constant) / height, of its three numbers.
    """
    x, y = corners
    downwards = _sort((y << 32) + x)  # the sums may wrap around, and wrap back
    x = ((downwards + 2**31) & (2**32 - 1)) - 2**31
    y = (downwards - x) >> 32
    start, end = [0, 0, 1], [2, 1, 2]
    dx, dy = x[end] - x[start], y[end] - y[start]
    return np.stack([-SUBSAMPLES * dx, y[start] * dx - x[start] * dy, SUBSAMPLES * dy]), _next_sample(y[1])


def _crossings(
    edges: tuple[np.ndarray, np.ndarray], triangle: np.ndarray, row: np.ndarray, resolution: int
) -> tuple[np.ndarray, np.ndarray]:
    """The first column in a triangle and the first after it, for each of its rows."""
    numbers, middle = edges
    below = row >= middle.take(triangle)
    both = np.stack([triangle, triangle + (1 + below) * len(middle)])
    slope, constant, height = numbers.reshape(3, -1).take(both, axis=1)
    columns = (-((slope * row + constant) // height)).clip(0, resolution)
    return np.minimum(*columns), np.maximum(*columns)


def _planes(corners: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """(5, T) of triangles (2, 3, T) with depths (3, T): of the first corner column, row and depth, and the depth's
    slopes by column and row."""
    (ax, bx, cx), (ay, by, cy) = corners
    a, b, c = depths
    scale = SUBSAMPLES / _doubled_areas(corners)
    by_column = ((b - a) * (cy - ay) - (c - a) * (by - ay)) * scale
    by_row = ((c - a) * (bx - ax) - (b - a) * (cx - ax)) * scale
    return np.stack([ax / SUBSAMPLES, ay / SUBSAMPLES, a, by_column, by_row])


def _parts(counts: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(whole, part): each whole repeated by its count, with parts from 0; about PARTS at a time, wholes uncut."""
    ends = np.cumsum(counts)
    starts, begin, done = ends - counts, 0, 0
    while begin < len(counts):
        end = max(begin + 1, int(np.searchsorted(ends, done + PARTS, side="right")))
        whole = np.repeat(np.arange(begin, end), counts[begin:end])
        yield whole, np.arange(done, done + len(whole)) - starts.take(whole)
        begin, done = end, int(ends[end - 1])
