"""The NumPy rasteriser: fixed-point corners and exact integer edge functions, as GPUs have them.

A triangle's box of samples is cut into tiles of 4×4: what differs from triangle to triangle is gathered once for a
tile, and its samples are evaluated without a gather. The longest axis is the last one of every array.
"""

from collections.abc import Iterator

import numpy as np

SUBSAMPLE_BITS = 8
SUBSAMPLES = 2**SUBSAMPLE_BITS  # corners snap to this fraction of a sample
FAR = 2**24 - 1  # depth is a 24-bit key, and surface at the far plane itself is not drawn
FACE_BITS = 32  # a sample's key is its depth above so many bits of face index, so the least key wins
EMPTY = (FAR << FACE_BITS) - 1  # less than any key at the far plane; its face index reads -1
TILE = 4  # samples per side
TILES, FACES = 2**12, 2**15  # at a time: bounds the memory and stays in the cache


def rasterise(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """Ids by the contract in `renderer.visibility`, for finite points."""
    return np.stack([_rasterise_view(view, faces, resolution, closed) for view in points])


def _rasterise_view(points: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    positions, depths = _snap(points[:, :2], resolution), (points[:, 2] + 1) / 2 * FAR
    stride = resolution + TILE - 1  # tiles may reach beyond the last column and row
    keys = np.full(stride * stride, EMPTY)
    places = np.add.outer(np.arange(TILE) * stride, np.arange(TILE)).ravel()
    for begin in range(0, len(faces), FACES):
        block = np.ascontiguousarray(faces[begin : begin + FACES].T)
        drawn, first, last = _cull(positions.take(block, axis=1), resolution, closed)
        corners = _sort(block.take(drawn, axis=1))  # so that duplicate faces have one depth and tie
        edges, fractions, areas = _edges(positions.take(corners, axis=1))
        corner_depths, ids = depths.take(corners), drawn + begin
        for triangle, column, row in _tiles(first, last):
            tile, place, edge = _inside(edges.take(triangle, axis=2), column, row)
            sample = (row * stride + column).take(tile) + places.take(place)
            triangle = triangle.take(tile)
            weighted = (edge + fractions.take(triangle, axis=1)) * corner_depths.take(triangle, axis=1)
            depth = np.rint(weighted.sum(axis=0) / areas.take(triangle)).astype(np.int64)
            depth = np.minimum(depth.view(np.uint64), FAR).view(np.int64)  # negative ones are large as unsigned
            np.minimum.at(keys, sample, (depth << FACE_BITS) | ids.take(triangle))
    return keys.reshape(stride, stride)[:resolution, :resolution].astype(np.int32)


def _snap(points: np.ndarray, resolution: int) -> np.ndarray:
    """(2, V) int64 of x right, y down from the centre of the first sample, in 1/256 sample.

    Before that they are float32 numbers, from a multiply-add that rounds once, as GPUs have it.
    """
    half = resolution / 2
    window = points.T.astype(np.float32, order="C") * np.array([[half], [-half]]) + half
    return np.rint(window.astype(np.float32) * SUBSAMPLES).astype(np.int64) - SUBSAMPLES // 2


def _cull(corners: np.ndarray, resolution: int, closed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which triangles (2, 3, F) to draw (T,), and the first and last column and row (2, T) of their boxes."""
    areas = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    first = ((corners.min(axis=1) + SUBSAMPLES - 1) >> SUBSAMPLE_BITS).clip(0, None)
    last = (corners.max(axis=1) >> SUBSAMPLE_BITS).clip(None, resolution - 1)
    towards = areas < 0 if closed else areas != 0  # y runs down: counter-clockwise areas are negative
    drawn = np.flatnonzero(towards & (first <= last).all(axis=0))
    return drawn, first.take(drawn, axis=1), last.take(drawn, axis=1)


def _sort(corners: np.ndarray) -> np.ndarray:
    """np.sort(corners, axis=0) of (3, T), several times faster."""
    least, greatest = corners.min(axis=0), corners.max(axis=0)
    return np.stack([least, corners.sum(axis=0) - least - greatest, greatest])


def _edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edge functions (3, 3, T) int64 with their fractions (3, T), and doubled areas (T,), of triangles (2, 3, T).

    The edge function opposite each corner is x·column + y·row + constant + fraction, in 1/256 sample², positive inside
    whichever way the triangle winds. By the top-left rule a sample on an edge belongs to the triangle that has the
    edge at its left or, if level, its top. Fractions are in [0, 1], so that a sample is inside where the integers'
    sum is not negative.
    """
    start = corners[:, [1, 2, 0]]
    along = corners[:, [2, 0, 1]] - start
    areas = _cross(along[:, 0], along[:, 1])
    along *= np.sign(areas)
    dx, dy = along
    top_left = (dy < 0) | ((dy == 0) & (dx > 0))
    exact = _cross(start, along)
    constant = (exact + top_left - 1) >> SUBSAMPLE_BITS
    fractions = (exact - constant * SUBSAMPLES) / SUBSAMPLES
    return np.stack([-dy, dx, constant]), fractions, np.abs(areas) / SUBSAMPLES


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[1] - a[1] * b[0]


def _tiles(first: np.ndarray, last: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(triangle, first column, first row) of the tiles that cover the triangles' boxes, at most TILES at a time."""
    columns, rows = (last - first) // TILE + 1
    counts = columns * rows
    ends = np.cumsum(counts)
    for begin in range(0, counts.sum(), TILES):
        end = min(begin + TILES, ends[-1])
        low, high = np.searchsorted(ends, [begin, end - 1], side="right")
        repeats = np.diff(ends[low : high + 1].clip(None, end), prepend=begin)
        triangle = np.repeat(np.arange(low, high + 1), repeats)
        down, across = np.divmod(np.arange(begin, end) - (ends - counts).take(triangle), columns.take(triangle))
        yield triangle, first[0].take(triangle) + across * TILE, first[1].take(triangle) + down * TILE


def _inside(edges: np.ndarray, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The samples in their triangles: tile, row-major place in it (S,) and the edge functions (3, S) but fractions."""
    x, y, constant = edges
    steps = np.arange(TILE)[:, None]
    at_left = (constant + x * column + y * row)[:, None] + y[:, None] * steps
    edge = (at_left[:, :, None] + (x[:, None] * steps)[:, None]).reshape(3, -1)
    inside = np.flatnonzero((edge[0] | edge[1] | edge[2]) >= 0)  # none has its sign bit set
    place = inside // len(row)
    return inside - place * len(row), place, edge.take(inside, axis=1)
