"""NumPy rasterizer with fixed-point corners and exact integer arithmetic, as on GPUs.

Corners (x, y) are integers in 1/256 of a sample. In the row y = 256 r, an edge
from (x₀, y₀) to (x₁, y₁) begins at the column

    ⌈(x₀ + (y - y₀) (x₁ - x₀) / (y₁ - y₀)) / 256⌉.

This quotient of integers is exact, and both faces of the edge share it. Each
sample therefore belongs to one of the two faces (the top-left rule). In a row,
a face covers the samples between its two columns. The depth of a face is the
plane z = z_a + (x - x_a) ∂z/∂x + (y - y_a) ∂z/∂y, rounded to 24 bits. Each
sample keeps the smallest of its keys,

    key = depth · 2³² + face.

The lower half of the key is then the nearest face, and the one with the lower
index if depths are equal.

Only covered samples are computed: triangles are split into rows, and rows into
samples. This happens in blocks that stay in the cache of the processor. The
longest axis is the last axis of every array. An array of triangles has shape
(2, 3, T), for x and y, three corners and T triangles. x points to the right and
y down.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int

# Positions in the image are integers. Their unit, the subsample, is the distance of two
# neighboring samples divided by SUBSAMPLES.
SUBSAMPLE_BITS = 8
SUBSAMPLES = 2**SUBSAMPLE_BITS
# Depth of the far plane. Depths are integers with 24 bits. Surfaces at the far plane
# are not drawn.
FAR = 2**24 - 1
# A key is an integer with the depth of a face at a sample in its high bits, and the index
# of the face in its low bits. This is the number of low bits.
FACE_BITS = 32
# Key of samples without a face: a depth just in front of the far plane, and the face index
# -1 in the low bits.
EMPTY_KEY = (FAR << FACE_BITS) - 1
# Number of faces that are drawn at once. Their arrays fit into the cache of the processor.
FACES_PER_BLOCK = 2**14
# Approximate length of the arrays that `_expand` returns. They fit into the cache of the
# processor.
ENTRIES_PER_BLOCK = 2**13

# Projected points of N views, the faces of a mesh, and the face at each sample of each view.
Views = Float[np.ndarray, "N V 3"]
Faces = Int[np.ndarray, "F 3"]
FaceIds = Int[np.ndarray, "N R C"]


def rasterize(points: Views, faces: Faces, shape: tuple[int, int], closed: bool) -> FaceIds:
    """Find the nearest face at each sample of each view.

    The docstring of the package `renderer.visibility` defines the
    coordinates and the rounding. Samples without a face get -1.
    """
    ids = np.empty((len(points), *shape), dtype=np.int32)
    for view, view_ids in zip(points, ids, strict=True):
        positions, depths = to_fixed_point(view, shape)
        # Smallest key of each sample: the depth of its nearest face, and the face in the low bits.
        keys = np.full(shape, EMPTY_KEY)
        for begin in range(0, len(faces), FACES_PER_BLOCK):
            block = np.ascontiguousarray(faces[begin : begin + FACES_PER_BLOCK].T)
            _draw(keys, positions, depths, block, begin, closed)
        # The conversion to int32 keeps the low 32 bits of each key, the face index.
        view_ids[:] = keys
    return ids


def _draw(
    keys: Int[np.ndarray, "R C"],
    positions: Int[np.ndarray, "2 V"],
    depths: Float[np.ndarray, " V"],
    block: Int[np.ndarray, "3 F"],
    begin: int,
    closed: bool,
) -> None:
    """Draw a block of faces: lower the keys of the samples at which a face is nearest so far.

    Each face has one key at a sample that it covers: its depth, and in the low FACE_BITS bits its
    index. The smallest key therefore belongs to the nearest face. The first face has the index
    `begin`.
    """
    row_count, column_count = keys.shape
    flat_keys = keys.ravel()
    # By the top-left rule, a sample on an edge belongs to the triangle to the right of the edge or,
    # if the edge is horizontal, to the triangle below it. A triangle therefore covers only samples
    # whose x and y are at least its smallest x and y, and less than its largest x and y.
    triangles = positions.take(block, axis=1)
    areas = doubled_areas(triangles)
    # First column and first row of samples in the bounding box of each triangle, as the
    # two rows of this array.
    first = next_sample(triangles.min(axis=1)).clip(0, None)
    limits = np.array([[column_count], [row_count]])
    counts = next_sample(triangles.max(axis=1)).clip(None, limits) - first
    # y points down, so triangles that are counter-clockwise in the image have negative
    # areas.
    is_facing = areas < 0 if closed else areas != 0
    drawn = np.flatnonzero(is_facing & (counts > 0).all(axis=0))
    first_row = first[1].take(drawn)
    # Sort the corners of each face, so that two faces with the same corners in another
    # order get exactly the same depth.
    corners = _sort(block.take(drawn, axis=1))
    triangles = positions.take(corners, axis=1)
    edges, middle_row = _edges(triangles)
    areas = doubled_areas(triangles)
    planes = np.stack(depth_planes(triangles, depths.take(corners), areas))
    # One entry for each pair of a triangle and a row of samples that it may cover.
    for triangle, row in _expand(counts[1].take(drawn)):
        row += first_row.take(triangle)
        # A row crosses the edge from the top to the bottom corner (edge 0), and edge 1 above or
        # edge 2 below the middle corner. Edge e of triangle t has the number e · T + t.
        is_below_middle = row >= middle_row.take(triangle)
        crossed_edges = np.stack([triangle, triangle + (1 + is_below_middle) * len(drawn)])
        slope, constant, height = edges.take(crossed_edges, axis=1)
        # Each row crosses an edge at the column -(slope · row + constant) / height. The first
        # column after it is this number, rounded up. The operator // rounds down, but the minus
        # sign before it makes the result round up.
        columns = (-((slope * row + constant) // height)).clip(0, column_count)
        left, right = columns.min(axis=0), columns.max(axis=0)
        # Position and depth of the first corner, and slopes of the depth.
        x, y, depth, slope_x, slope_y = planes.take(triangle, axis=1)
        depth_at_row = depth + (row - y) * slope_y
        # Columns from the first corner to the first covered sample.
        first_offset = left - x
        first_sample = row * column_count + left
        face = drawn.take(triangle) + begin
        # One entry for each covered sample: the index of its pair of triangle and row, and
        # the number of steps from the first covered sample of the row.
        for pair, step in _expand(right - left):
            offset = first_offset.take(pair) + step
            exact_depth = depth_at_row.take(pair) + slope_x.take(pair) * offset
            rounded = np.rint(exact_depth).astype(np.int64)
            # Depths in front of the near plane are negative. As unsigned integers, they are
            # larger than FAR, so they become FAR and are not drawn.
            clipped = np.minimum(rounded.view(np.uint64), FAR).view(np.int64)
            sample_keys = (clipped << FACE_BITS) | face.take(pair)
            np.minimum.at(flat_keys, first_sample.take(pair) + step, sample_keys)


def to_fixed_point(
    points: Float[np.ndarray, "V 3"], shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Convert projected points to integer positions and to depths from 0 to FAR.

    The unit of the positions is a subsample, 1/256 of the distance of two samples.
    As on GPUs, positions in samples are computed with one multiplication and one
    addition, rounded to float32, and then rounded to subsamples. Positions are x to the
    right and y down from the center of the first sample. Points have the image in [-1, 1]
    along x and the near plane at the depth -1. `shape` is rows and columns of samples.
    """
    half_height, half_width = shape[0] / 2, shape[1] / 2
    # Positions from the top left corner of the image, in samples. The product with a
    # float64 array is float64, so that only the conversion to float32 below rounds.
    window = points[:, :2].T.astype(np.float32, order="C") * np.array([[half_width], [-half_width]])
    window += [[half_width], [half_height]]
    positions = np.rint(window.astype(np.float32) * SUBSAMPLES).astype(np.int64)
    # Measure from the center of the first sample instead of its corner.
    return positions - SUBSAMPLES // 2, (points[:, 2] + 1) / 2 * FAR


def doubled_areas(triangles: Any) -> Any:
    """Compute twice the signed areas of triangles, negative if counter-clockwise in the image.

    The axes of `triangles` are coordinate, corner and triangle. Like `next_sample` and
    `depth_planes`, this function takes arrays and tensors.
    """
    (ax, bx, cx), (ay, by, cy) = triangles
    return (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)


def next_sample(positions: Any) -> Any:
    """Round positions in subsamples up to whole samples."""
    return (positions + (SUBSAMPLES - 1)) >> SUBSAMPLE_BITS


def _sort(corners: Int[np.ndarray, "3 T"]) -> Int[np.ndarray, "3 T"]:
    """Sort the three values of each column of an array, several times faster than np.sort."""
    smallest = corners.min(axis=0)
    largest = corners.max(axis=0)
    return np.stack([smallest, corners.sum(axis=0) - smallest - largest, largest])


def _edges(
    triangles: Int[np.ndarray, "2 3 T"],
) -> tuple[Int[np.ndarray, "3 _"], Int[np.ndarray, " T"]]:
    """Compute the lines through the edges of T triangles.

    By row, the corners are top, middle and bottom; the edges lead from top to bottom, from top to
    middle, and from middle to bottom. A row of samples crosses an edge at the column -(slope · row
    + constant) / height. The results are slope, constant and height of all first, second and third
    edges, and the first row of samples at or below the middle corners.
    """
    x, y = triangles
    # Sort the corners by y. For this, one integer per corner holds y in its high 32 bits
    # and x in its low 32 bits. The sum in `_sort` may overflow, but the differences are
    # right again.
    downward = _sort((y << 32) + x)
    # Each integer is 2³² y + x. Take x, which may be negative, from the low 32 bits.
    x = ((downward + 2**31) & (2**32 - 1)) - 2**31
    y = (downward - x) >> 32
    # Indices of the sorted corners (0 top, 1 middle, 2 bottom) at both ends of the edges.
    start = [0, 0, 1]
    end = [2, 1, 2]
    dx = x[end] - x[start]
    dy = y[end] - y[start]
    slope = -SUBSAMPLES * dx
    constant = y[start] * dx - x[start] * dy
    height = SUBSAMPLES * dy
    return np.stack([slope, constant, height]).reshape(3, -1), next_sample(y[1])


def depth_planes(triangles: Any, depths: Any, areas: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Compute the depth of triangles as a linear function of column and row.

    `areas` are those of `doubled_areas`. The results are the column, the row and the depth of the
    first corner, and the slopes of the depth per column and per row.
    """
    (ax, bx, cx), (ay, by, cy) = triangles
    depth_a, depth_b, depth_c = depths
    # Differences of depth along the edges from a to b and c. The slopes solve two linear equations
    # (Cramer's rule).
    to_b = depth_b - depth_a
    to_c = depth_c - depth_a
    scale = SUBSAMPLES / areas
    slope_x = (to_b * (cy - ay) - to_c * (by - ay)) * scale
    slope_y = (to_c * (bx - ax) - to_b * (cx - ax)) * scale
    return ax / SUBSAMPLES, ay / SUBSAMPLES, depth_a, slope_x, slope_y


def _expand(counts: Int[np.ndarray, " N"]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Repeat the index of each item as often as its count, and number the repetitions.

    For example, the counts 2 and 3 give the indices 0, 0, 1, 1, 1 and the numbers
    0, 1, 0, 1, 2. The result comes in blocks of about ENTRIES_PER_BLOCK entries.
    All entries of an item are in the same block.
    """
    # Number of entries of all items up to each item, with and without the item itself.
    entries_with_item = np.cumsum(counts)
    entries_before_item = entries_with_item - counts
    first_item = 0
    entries_before_block = 0
    while first_item < len(counts):
        # The block has at least one item, even if the item has too many entries.
        largest_total = entries_before_block + ENTRIES_PER_BLOCK
        next_item = int(np.searchsorted(entries_with_item, largest_total, side="right"))
        next_item = max(first_item + 1, next_item)
        item = np.repeat(np.arange(first_item, next_item), counts[first_item:next_item])
        entry = np.arange(entries_before_block, entries_before_block + len(item))
        yield item, entry - entries_before_item.take(item)
        first_item = next_item
        entries_before_block = int(entries_with_item[next_item - 1])
