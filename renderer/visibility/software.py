"""The NumPy rasteriser: fixed-point corners and exact integer edge functions, as GPUs have them."""

from collections.abc import Iterator

import numpy as np

SUBSAMPLES = 256  # corners snap to this fraction of a sample
FAR = 2**24 - 1  # depth is a 24-bit key, and surface at the far plane itself is not drawn
EMPTY = np.iinfo(np.int64).max
FACE_BITS = 32  # a sample's key is its depth above so many bits of face index, so the least key wins
CHUNK = 2**15  # (face, sample) pairs at a time: bounds the memory and stays in the cache


def rasterise(points: np.ndarray, faces: np.ndarray, resolution: int) -> np.ndarray:
    """Ids by the contract in `renderer.visibility`, for finite points."""
    return np.stack([_rasterise_view(view, faces, resolution) for view in points])


def _rasterise_view(points: np.ndarray, faces: np.ndarray, resolution: int) -> np.ndarray:
    corners = _snap(points[:, :2], resolution)[faces]
    areas = np.abs(_cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    boxes = _boxes(corners, resolution)
    drawn = np.flatnonzero((areas > 0) & (boxes[:, 2:] > 0).all(axis=1))
    edges, areas = _edges(corners[drawn]), areas[drawn]
    depths = ((points[:, 2] + 1) / 2 * FAR)[faces[drawn]].T

    keys = np.full(resolution * resolution, EMPTY)
    for triangle, column, row in _candidates(boxes[drawn]):
        x, y, constant, least = (part.take(triangle, axis=1) for part in edges)
        edge = x * column + y * row + constant
        inside = np.flatnonzero((edge >= least).all(axis=0))
        triangle, sample = triangle[inside], (row * resolution + column)[inside]
        depth = np.rint((edge[:, inside] * depths.take(triangle, axis=1)).sum(axis=0) / areas[triangle])
        shown = (depth >= 0) & (depth < FAR)
        key = (depth[shown].astype(np.int64) << FACE_BITS) | drawn[triangle[shown]]
        np.minimum.at(keys, sample[shown], key)
    ids = np.where(keys == EMPTY, -1, keys & (2**FACE_BITS - 1))
    return ids.astype(np.int32).reshape(resolution, resolution)


def _snap(points: np.ndarray, resolution: int) -> np.ndarray:
    """(V, 2) int64 of x right, y down from the top left, in 1/256 sample.

    Before that they are float32 numbers, from a multiply-add that rounds once, as GPUs have it.
    """
    half = resolution / 2
    window = points.astype(np.float32) * np.array([half, -half]) + half
    return np.rint(window.astype(np.float32) * SUBSAMPLES).astype(np.int64)


def _boxes(corners: np.ndarray, resolution: int) -> np.ndarray:
    """(F, 4) first column, first row, columns and rows of the samples whose centres a triangle's box holds."""
    centre = SUBSAMPLES // 2
    first = -((centre - corners.min(axis=1)) // SUBSAMPLES)
    last = (corners.max(axis=1) - centre) // SUBSAMPLES
    first, last = first.clip(0, resolution), last.clip(-1, resolution - 1)
    return np.concatenate([first, last - first + 1], axis=1)


def _edges(corners: np.ndarray) -> np.ndarray:
    """(4, 3, T) int64 x, y, constant and least value inside of the edge function opposite each corner.

    An edge function is x·column + y·row + constant, positive inside whichever way the triangle winds. By the
    top-left rule a sample on an edge belongs to the triangle that has the edge at its left or, if level, its top.
    """
    start = corners[:, [1, 2, 0]]
    along = corners[:, [2, 0, 1]] - start
    along *= np.sign(_cross(along[:, 0], along[:, 1]))[:, None, None]
    to_sample = SUBSAMPLES // 2 - start  # the first one's centre, at the top left
    dx, dy = along[..., 0], along[..., 1]
    top_left = (dy < 0) | ((dy == 0) & (dx > 0))
    edges = np.stack([-dy * SUBSAMPLES, dx * SUBSAMPLES, _cross(along, to_sample), 1 - top_left])
    return np.ascontiguousarray(edges.transpose(0, 2, 1))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _candidates(boxes: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Every (triangle, column, row) with the sample in the triangle's box, at most CHUNK at a time."""
    first_column, first_row, columns, rows = boxes.T
    sizes = columns * rows
    ends = np.cumsum(sizes)
    for begin in range(0, sizes.sum(), CHUNK):
        pair = np.arange(begin, min(begin + CHUNK, ends[-1]))
        triangle = np.searchsorted(ends, pair, side="right")
        down, across = np.divmod(pair - (ends - sizes)[triangle], columns[triangle])
        yield triangle, first_column[triangle] + across, first_row[triangle] + down
