"""Rasterizer of torch operations, which draws all faces of many views at once, on any device.

Each face is expanded to the samples of its bounding box. A sample is covered if the three edge
functions of the face are not negative there. They are exact integers of the fixed-point corners,
less 1 for an edge that leaves its samples to the other face (the top-left rule). Depths, keys and
therefore faces are those of `renderer.visibility.numpy`.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from renderer.visibility import numpy as exact
from renderer.visibility.fragments import block_size
from renderer.visibility.numpy import EMPTY_KEY, FACE_BITS, FAR, SUBSAMPLES

# Faces of all views that are prepared at once, and smallest number of pairs of a face and a sample
# that are tested at once. A face takes up to 700 bytes, and a pair 200.
FACES_PER_TILE = 2**20
PAIRS_PER_TILE = 2**20


def rasterize(
    points: Float[Tensor, "N V 3"], faces: Int[Tensor, "F 3"], shape: tuple[int, int], closed: bool
) -> Int[Tensor, "N R C"]:
    """Find the nearest face at each sample of all views, on the device of the points.

    The docstring of the package `renderer.visibility` defines the coordinates and the rounding.
    Samples without a face get -1. The program waits for a GPU once for FACES_PER_TILE faces.
    """
    keys = torch.full((len(points), *shape), EMPTY_KEY, device=points.device)
    # Number of views that are drawn at once.
    step = max(1, FACES_PER_TILE // max(1, len(faces)))
    for some_keys, some_points in zip(keys.split(step), points.split(step), strict=True):
        for first in range(0, len(faces), FACES_PER_TILE):
            _draw(some_keys, some_points, faces[first : first + FACES_PER_TILE], first, closed)
    # The conversion keeps the low 32 bits of each key, the face index.
    return keys.int()


def _triangles(
    points: Float[Tensor, "N V 3"], faces: Int[Tensor, "F 3"], shape: tuple[int, int], closed: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Prepare the M = N · F triangles of N views, and their pairs with samples of bounding boxes.

    Pairs are numbered triangle by triangle, and row by row in a bounding box. Triangles that are
    not drawn have no pairs.

    Returns:
        A tuple of

        - integers by which column and row of a sample are multiplied, and a constant, for each of
          the three edge functions, shape (3, 3, M);
        - results of `depth_planes`, shape (5, M);
        - first column and first row of the bounding box, its width, and the number of the first
          pair, shape (4, M);
        - first number behind the pairs of each triangle, shape (M,).
    """
    rows, columns = shape
    positions, depths = to_fixed_point(points, shape)
    # A closed mesh shows only faces that are counter-clockwise in the image.
    areas = exact.doubled_areas(_by_corner(positions, faces))
    is_drawn = areas < 0 if closed else areas != 0
    # Corners are sorted, so that two faces with the same corners get exactly the same depth.
    corners = faces.sort(dim=1).values
    triangles = _by_corner(positions, corners)
    areas = exact.doubled_areas(triangles)
    corner_depths = depths[:, corners].flatten(0, 1).T
    planes = exact.depth_planes(triangles.double(), corner_depths, areas.double())
    x, y = triangles
    first_column, widths = _covered_range(x, columns)
    first_row, heights = _covered_range(y, rows)
    counts = widths * heights * is_drawn
    ends = counts.cumsum(0)
    # The sign of the area makes the edge functions positive inside, whatever the orientation.
    sign = areas.sign()
    to_x, to_y = x.roll(-1, 0) - x, y.roll(-1, 0) - y
    by_column, by_row = -SUBSAMPLES * to_y * sign, SUBSAMPLES * to_x * sign
    is_owner = (by_column > 0) | ((by_column == 0) & (by_row > 0))
    constant = (x * to_y - y * to_x) * sign - (~is_owner).long()
    edges = torch.stack([by_column, by_row, constant])
    boxes = torch.stack([first_column, first_row, widths, ends - counts])
    return edges, torch.stack(planes), boxes, ends


def to_fixed_point(
    points: Float[Tensor, "*N V 3"], shape: tuple[int, int]
) -> tuple[Int[Tensor, "*N V 2"], Float[Tensor, "*N V"]]:
    """Convert points to integers and depths, as `renderer.visibility.numpy` does."""
    rows, columns = shape
    # As on GPUs, positions in samples are computed with one multiplication and one addition, and
    # rounded to float32. x points to the right and y down. A tensor of constants would be copied
    # to the GPU.
    x, y = points[..., :2].float().to(points.dtype).unbind(-1)
    window = torch.stack([x * (columns / 2) + columns / 2, y * (-columns / 2) + rows / 2], dim=-1)
    positions = (window.float() * SUBSAMPLES).round().long() - SUBSAMPLES // 2
    return positions, (points[..., 2] + 1) / 2 * FAR


def _draw(
    keys: Int[Tensor, "N R C"],
    points: Float[Tensor, "N V 3"],
    faces: Int[Tensor, "F 3"],
    first: int,
    closed: bool,
) -> None:
    """Lower the key of each sample to that of the nearest face. `first` is the index of face 0.

    A key has the depth in its high bits and the index of the face in its low FACE_BITS bits. The
    smallest key of a sample is therefore the nearest face, or the first of equally near faces.
    """
    rows, columns = keys.shape[1:]
    edges, planes, boxes, ends = _triangles(points, faces, (rows, columns), closed)
    pair_count = int(ends[-1:].sum())  # The only wait for a GPU.
    step = max(PAIRS_PER_TILE, block_size(points.device))
    for begin in range(0, pair_count, step):
        pair = torch.arange(begin, min(begin + step, pair_count), device=points.device)
        # Triangle of each pair, and the sample from the place of the pair in the bounding box.
        triangle = torch.searchsorted(ends, pair, right=True)
        column, row, width, first_pair = boxes[:, triangle]
        place = pair - first_pair
        column, row = column + place % width, row + place // width
        by_column, by_row, constant = edges[..., triangle]
        is_inside = (by_column * column + by_row * row + constant >= 0).all(0)
        x, y, depth, slope_x, slope_y = planes[:, triangle]
        rounded = (depth + (row - y) * slope_y + slope_x * (column - x)).round()
        is_seen = is_inside & (rounded >= 0) & (rounded < FAR)
        view, face = triangle // len(faces), first + triangle % len(faces)
        key = torch.where(is_seen, (rounded.long() << FACE_BITS) | face, EMPTY_KEY)
        keys.view(-1).scatter_reduce_(0, (view * rows + row) * columns + column, key, "amin")


def _by_corner(positions: Int[Tensor, "N V 2"], faces: Int[Tensor, "F 3"]) -> Int[Tensor, "2 3 M"]:
    """Return the corners of the faces in all views, with the axes coordinate, corner, triangle."""
    return positions[:, faces].flatten(0, 1).permute(2, 1, 0)


def _covered_range(positions: Int[Tensor, "3 M"], count: int) -> tuple[Tensor, Tensor]:
    """Find the first row, or column, that each triangle can cover, and the number of them."""
    low, high = (exact.next_sample(limits) for limits in positions.aminmax(dim=0))
    first = low.clamp(min=0)
    return first, (high.clamp(max=count) - first).clamp(min=0)
