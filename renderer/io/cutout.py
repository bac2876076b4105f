"""Cut out the parts of a surface whose alpha is too small.

The renderer has no transparency, so holes are cut into the faces. Faces that
the border of a hole crosses are divided until their sides are shorter than a
texel. The border is straight within such a face.
"""

import numpy as np
from jaxtyping import Float, Int, UInt8

# Columns of the values at the corners of faces.
U, V, ALPHA = 0, 1, 2
# Largest alpha of a texel.
FULL = 255
# Largest number of faces before the last division.
MAX_FACES = 10**6


class _AlphaTexture:
    """Alpha of a texture, which repeats, and its range within rectangles."""

    def __init__(self, texels: np.ndarray) -> None:
        """Reduce the texels (H, W) to their ranges in blocks of 2^n × 2^n texels."""
        self.texels = texels
        height, width = texels.shape
        # Twice the texture holds every rectangle that begins within the texture.
        low = np.pad(texels, ((0, height), (0, width)), mode="wrap")
        self._levels = [(low, low)]
        while max(low.shape) > 1:
            low, high = (
                np.pad(values, [(0, n % 2) for n in values.shape], mode="edge")
                for values in self._levels[-1]
            )
            blocks = (low.shape[0] // 2, 2, low.shape[1] // 2, 2)
            low = low.reshape(blocks).min(axis=(1, 3))
            self._levels.append((low, high.reshape(blocks).max(axis=(1, 3))))

    def position(self, corners: np.ndarray) -> np.ndarray:
        """Compute the positions (column, row), in texels, of points with texture coordinates."""
        height, width = self.texels.shape
        return np.stack(
            [corners[..., U] * width - 0.5, (1 - corners[..., V]) * height - 0.5], axis=-1
        )

    def at(self, positions: np.ndarray) -> np.ndarray:
        """Interpolate alpha in [0, 1] bilinearly at positions (N, 2) in texels."""
        height, width = self.texels.shape
        first = np.floor(positions)
        weight = positions - first
        columns = (first[:, :1].astype(np.int64) + np.arange(2)) % width
        rows = (first[:, 1:].astype(np.int64) + np.arange(2)) % height
        values = self.texels[rows[:, :, None], columns[:, None, :]] / FULL
        values = values[:, 0] + weight[:, 1:] * (values[:, 1] - values[:, 0])
        return values[:, 0] + weight[:, 0] * (values[:, 1] - values[:, 0])

    def ranges(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of alpha within F faces with corners at positions (F, 3, 2)."""
        size = np.array(self.texels.shape[::-1])
        start = np.floor(positions.min(axis=1)).astype(np.int64)
        end = np.floor(positions.max(axis=1)).astype(np.int64) + 1
        # A rectangle as large as the texture holds all texels.
        end = np.minimum(end, start + size - 1)
        end -= start - start % size
        start %= size
        level_of_face = np.ceil(np.log2((end - start).max(axis=1) + 1)).astype(np.int64)
        low = np.empty(len(positions))
        high = np.empty(len(positions))
        for level in np.unique(level_of_face):
            faces = level_of_face == level
            # A rectangle lies in the four blocks of its corners.
            columns = np.stack([start[faces, 0], end[faces, 0]], axis=1) >> level
            rows = np.stack([start[faces, 1], end[faces, 1]], axis=1) >> level
            blocks = (rows[:, :, None], columns[:, None, :])
            lows, highs = self._levels[min(level, len(self._levels) - 1)]
            low[faces] = lows[blocks].min(axis=(1, 2))
            high[faces] = highs[blocks].max(axis=(1, 2))
        return low / FULL, high / FULL


def cut_out(
    vertices: Float[np.ndarray, "V D"],
    faces: Int[np.ndarray, "F 3"],
    corners: Float[np.ndarray, "F 3 C"],
    texels: UInt8[np.ndarray, "H W"] | None,
    cutoff: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Remove the parts of F faces whose alpha is below a value.

    Alpha is the interpolated product of the texture and of the alpha of corners.
    All values are interpolated linearly at new vertices. Faces that share an
    edge also share the new vertices on it. The first three values of a corner are u, v and alpha.
    Without texels, the alpha of the texture is 1. The result is new vertices, faces and corners.
    """
    given = vertices, faces, corners
    texture = _AlphaTexture(np.full((1, 1), FULL, np.uint8) if texels is None else texels)
    while True:
        positions = texture.position(corners)
        low, high = texture.ranges(positions)
        alphas = corners[..., ALPHA]
        is_shown = high * alphas.max(axis=1) >= cutoff
        is_crossed = is_shown & (low * alphas.min(axis=1) < cutoff)
        # The sides are opposite to the corners 2, 0 and 1.
        lengths = np.linalg.norm(positions - np.roll(positions, -1, axis=1), axis=2)
        if texels is None:
            # Alpha is linear in each face, so faces need not be divided.
            lengths *= 0
        is_large = is_crossed & (lengths.max(axis=1) > 1)
        if not is_large.any():
            break
        if len(faces) > MAX_FACES:
            raise ValueError(
                f"the border of its alpha needs more than {MAX_FACES} faces: use fewer texels "
                "or fewer repetitions of the texture"
            )
        keep = np.flatnonzero(is_shown)
        vertices, faces, corners = _divide(
            vertices, faces[keep], corners[keep], lengths[keep].argmax(axis=1), is_large[keep]
        )
    crossed = np.flatnonzero(is_crossed)
    flat_alpha = texture.at(positions[crossed].reshape(-1, 2)).reshape(-1, 3)
    excess = flat_alpha * alphas[crossed] - cutoff
    if is_shown.all() and not (excess < 0).any():
        return given
    kept = is_shown & ~is_crossed
    vertices, cut_faces, cut_corners = _cut(vertices, faces[crossed], corners[crossed], excess)
    return (
        vertices,
        np.concatenate([faces[kept], cut_faces]),
        np.concatenate([corners[kept], cut_corners]),
    )


def _interpolate(values: np.ndarray, others: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Interpolate between two arrays of N rows by the shares (N,) of the second one."""
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return values + share * (others - values)


def _edges(faces: np.ndarray, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """List the ends (E, 2) of the edges of faces, and the edge (F, 3) from each corner on."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    keys, edge_of_side = np.unique(ends @ [vertex_count, 1], return_inverse=True)
    return np.stack(np.divmod(keys, vertex_count), axis=1), edge_of_side.reshape(-1, 3)


def _divide(
    vertices: np.ndarray,
    faces: np.ndarray,
    corners: np.ndarray,
    longest: np.ndarray,
    is_large: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divide large faces at their longest side (F,), and neighbors so that no crack opens.

    Rivara (1984): a face that is divided at any side is also divided at its longest side.
    """
    ends, edge_of_side = _edges(faces, len(vertices))
    longest_edge = np.take_along_axis(edge_of_side, longest[:, None], axis=1)[:, 0]
    is_divided = np.zeros(len(ends), dtype=bool)
    touched = is_large
    while not is_divided[longest_edge[touched]].all():
        is_divided[longest_edge[touched]] = True
        touched = is_divided[edge_of_side].any(axis=1)
    # Corners 0 and 1 are the ends of the longest side. Points 3, 4 and 5
    # are the middles of the sides 0-1, 1-2 and 2-0.
    order = (longest[touched, None] + np.arange(3)) % 3
    ordered_faces = np.take_along_axis(faces[touched], order, axis=1)
    ordered_corners = np.take_along_axis(corners[touched], order[..., None], axis=1)
    sides = np.take_along_axis(edge_of_side[touched], order, axis=1)
    new_vertex = len(vertices) + np.cumsum(is_divided) - 1
    points = np.concatenate([ordered_faces, new_vertex[sides]], axis=1)
    middles = (ordered_corners + np.roll(ordered_corners, -1, axis=1)) / 2
    values = np.concatenate([ordered_corners, middles], axis=1)
    side_divided = is_divided[sides]
    new_faces = [faces[~touched]]
    new_corners = [corners[~touched]]
    pieces = {
        (1, True): [(3, 1, 4), (3, 4, 2)],
        (1, False): [(3, 1, 2)],
        (2, True): [(0, 3, 5), (5, 3, 2)],
        (2, False): [(0, 3, 2)],
    }
    for (side, divided), triangles in pieces.items():
        rows = np.flatnonzero(side_divided[:, side] == divided)
        for triangle in triangles:
            new_faces.append(points[rows][:, triangle])
            new_corners.append(values[rows][:, triangle])
    middle_vertices = vertices[ends[is_divided]].mean(axis=1)
    return (
        np.concatenate([vertices, middle_vertices]),
        np.concatenate(new_faces),
        np.concatenate(new_corners),
    )


def _cut(
    vertices: np.ndarray, faces: np.ndarray, corners: np.ndarray, excess: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keep the parts of faces where a linear function is not negative.

    Its values at the corners are `excess`, shape (F, 3).
    """
    is_kept = excess >= 0
    count = is_kept.sum(axis=1)
    # The corner 0 is the one that differs from both others.
    odd = np.where(count == 1, is_kept.argmax(axis=1), is_kept.argmin(axis=1))
    order = (odd[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, order, axis=1)
    corners = np.take_along_axis(corners, order[..., None], axis=1)
    excess = np.take_along_axis(excess, order, axis=1)
    cut_faces = [faces[count == 3]]
    cut_corners = [corners[count == 3]]
    crossed = (count == 1) | (count == 2)
    faces, corners, excess = faces[crossed], corners[crossed], excess[crossed]
    # Points 3 and 4 lie on the sides 0-1 and 0-2.
    shares = excess[:, :1] / (excess[:, :1] - excess[:, 1:])
    points = [_interpolate(corners[:, 0], corners[:, k], shares[:, k - 1]) for k in (1, 2)]
    values = np.concatenate([corners, np.stack(points, axis=1)], axis=1)
    # Both faces at an edge get the same point, at the share of the first of them.
    starts = faces[:, [0, 0]].ravel()
    stops = faces[:, [1, 2]].ravel()
    is_forward = starts < stops
    low, high = np.minimum(starts, stops), np.maximum(starts, stops)
    share = np.where(is_forward, shares.ravel(), 1 - shares.ravel())
    _, first, point_of_side = np.unique(
        low * len(vertices) + high, return_index=True, return_inverse=True
    )
    new_vertices = _interpolate(vertices[low[first]], vertices[high[first]], share[first])
    ids = np.concatenate([faces, len(vertices) + point_of_side.reshape(-1, 2)], axis=1)
    one = count[crossed] == 1
    pieces = [(one, (0, 3, 4)), (~one, (3, 1, 2)), (~one, (3, 2, 4))]
    return (
        np.concatenate([vertices, new_vertices]),
        np.concatenate([*cut_faces, *(ids[rows][:, triangle] for rows, triangle in pieces)]),
        np.concatenate([*cut_corners, *(values[rows][:, triangle] for rows, triangle in pieces)]),
    )
