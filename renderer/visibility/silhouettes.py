"""How outlines move: the derivative of an image by where surfaces lie in it, which `renderer.surface.shading` holds fixed.

At a fixed place, the radiance L of an image changes as the surface there is shaded otherwise, and by −v · ∇L, as it
moves with a velocity v in the image. Between neighboring samples i and j, ∇L is a difference, whether surface goes on
between them or ends (Pidhorskyi et al. 2024, "Rasterized edge gradients"): where it moves by δ samples from i to j, the
pixel of s² samples gains δ (L_i − L_j) / s². Pixels on both sides of a border gain half each.

Where a silhouette lies between i and j, δ is the silhouette's (Li et al. 2018), not that of the surface beside it: the
points of a ball move as it turns, its outline does not. Silhouettes are the edges whose faces all lie on one side of
them in the image. They are cut where they cross rows and columns of samples. A line with unit normal n that moves by v
moves by n · v / n_x along a row; with rows weighted by n_x² and columns by n_y², the pieces add up to its length.

Light is fixed: edges of shadows and of projected patterns stay on the surface that they are on.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.camera import Camera
from renderer.geometry.mesh import EDGES
from renderer.visibility.fragments import Fragments
from renderer.visibility.rasterizers.numpy import SUBSAMPLES, to_fixed_point

if TYPE_CHECKING:
    from jaxtyping import Float, Int

NEAR = 1e-3  # of the mesh's depth: an edge no farther behind a surface lies on it


class Crossings(NamedTuple):
    """K places where a silhouette runs between neighboring samples; of several between the same two, the one next to
    the sample that sees farther, which no other hides.

    ends: (2, K), its vertices. fraction: (K,), of the way between them. normal: (2, K), of unit length. horizontal:
    (K,) bool, the neighbors lie in a row; otherwise in a column. cells: (2, K), the neighbors' row-major positions
    among all samples of the image, the left or the upper one first. samples: (2, K), the same among the covered ones,
    or -1.
    """

    ends: Tensor
    fraction: Tensor
    normal: Tensor
    horizontal: Tensor
    cells: Tensor
    samples: Tensor


def moving_outlines(
    fragments: Fragments,
    camera: Camera,
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    radiance: Float[Tensor, "3 S"],
    background: Float[Tensor, "3 pixels"],
) -> tuple[Int[Tensor, " E"], Float[Tensor, "3 P_E"]]:
    """E pixels beside the P covered ones, into which outlines may move, and zeros to add to the linear values of these
    P + E pixels, whose derivative by vertices, and by fields of the camera that are tensors, is that of the outlines.

    radiance: linear, at the S samples. background: linear, of all pixels of the image.
    """
    positions, nearness = camera.homogeneous(vertices.double())
    numbers = torch.arange(len(fragments.sample), dtype=torch.int32, device=vertices.device)
    grid = fragments.image_of_samples(numbers, -1)
    arrays = (tensor.detach().cpu().numpy() for tensor in (positions, nearness, faces, grid))
    crossings = Crossings(*(part.to(grid.device) for part in _crossings(fragments.to("cpu"), *arrays)))
    touched = torch.zeros(fragments.size**2, dtype=torch.bool, device=grid.device)
    touched.index_fill_(0, _pixels(crossings.cells, fragments).flatten(), True)
    beside = touched.index_fill_(0, fragments.pixels, False).nonzero().squeeze(1)
    zeros = _Outlines.apply(positions, fragments, crossings, grid, beside, radiance.detach(), background.detach())
    return beside, zeros


class _Outlines(torch.autograd.Function):
    """Zeros (3, P + E) of homogeneous positions (V, 3)."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, fragments: Fragments, *others: Tensor) -> Tensor:
        ctx.save_for_backward(positions)
        ctx.view = fragments, *others
        return others[3].new_zeros(3, len(fragments.pixels) + len(others[2]))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (positions,) = ctx.saved_tensors
        fragments, crossings, grid, beside, radiance, background = ctx.view
        upstream = upstream * (fragments.size / 4 / fragments.samples)  # from half the image's width to samples' areas
        gradient = _by_surface(positions, fragments, crossings, grid, radiance, upstream)
        ends, by_ends = _by_silhouettes(positions, fragments, crossings, beside, radiance, background, upstream)
        return gradient.index_add_(0, ends, by_ends), None, None, None, None, None, None


def _by_surface(
    positions: Tensor, fragments: Fragments, crossings: Crossings, grid: Tensor, radiance: Tensor, upstream: Tensor
) -> Tensor:
    """(V, 3) the gradient by surface that goes on from one sample to the next: both move with it."""
    upstream = upstream.index_select(1, fragments.pixel)
    level = fragments.image_of_samples((radiance * upstream).sum(0), torch.nan)
    right, down = (_forces_along(dim, fragments, crossings, grid, level, radiance, upstream) for dim in (1, 0))
    moving = torch.nonzero((right != 0) | (down != 0)).squeeze(1)
    part = fragments.select(moving)
    forces = torch.stack([right.index_select(0, moving), -down.index_select(0, moving)]).T
    if fragments.depths is not None:
        depth = part.interpolate(positions[:, 2:][part.corners])
        forces = _homogeneous(forces, part.positions(), depth)
    by_corners = part.distribute(forces).permute(2, 1, 0).flatten(1).double()
    gradient = positions.new_zeros(positions.shape[::-1])
    gradient[: forces.shape[1]].index_add_(1, part.corners.T.flatten(), by_corners)
    return gradient.T


def _forces_along(
    dim: int,
    fragments: Fragments,
    crossings: Crossings,
    grid: Tensor,
    level: Tensor,
    radiance: Tensor,
    upstream: Tensor,
) -> Tensor:
    """(S,) the gradient by the places of samples along columns (dim 0) or rows (dim 1) of all samples of the image.

    level: radiance times upstream gradient, (3, S) both, as an image of samples, NaN where nothing is covered."""
    samples, steps = fragments.samples, len(grid) - 1
    jump = torch.zeros_like(level)  # from a sample to the next one
    torch.sub(level.narrow(dim, 0, steps), level.narrow(dim, 1, steps), out=jump.narrow(dim, 0, steps))
    jump.nan_to_num_(0)  # one of them is background
    # The upstream gradient differs between the two pixels of neighbors across a border.
    borders = slice(samples - 1, -1, samples), slice(samples, None, samples)
    before, after = ((border, slice(None)) if dim == 0 else (slice(None), border) for border in borders)
    covered = (grid[before] >= 0) & (grid[after] >= 0)
    first, second = grid[before][covered], grid[after][covered]
    both = upstream.index_select(1, first) + upstream.index_select(1, second)
    difference = radiance.index_select(1, first) - radiance.index_select(1, second)
    jump[before].masked_scatter_(covered, (difference * both).sum(0) / 2)
    jump.view(-1).index_fill_(0, crossings.cells[0, crossings.horizontal == (dim == 1)], 0)
    force = jump.clone()  # half of the jump times the upstream gradients of both
    force.narrow(dim, 1, steps).add_(jump.narrow(dim, 0, steps))
    return fragments.of_image(force)


def _by_silhouettes(
    positions: Tensor,
    fragments: Fragments,
    crossings: Crossings,
    beside: Tensor,
    radiance: Tensor,
    background: Tensor,
    upstream: Tensor,
) -> tuple[Tensor, Tensor]:
    """(2 K) vertices of silhouettes, and the gradient by them (2 K, 3)."""
    pixels = _pixels(crossings.cells, fragments)
    slots = torch.full((fragments.size**2,), -1, device=pixels.device)
    slots[torch.cat([fragments.pixels, beside])] = torch.arange(upstream.shape[1], device=pixels.device)
    force = radiance.new_zeros(pixels.shape[1])
    for pixel in pixels:  # of either neighbor, whose background is seen where nothing covers it
        first, second = (
            torch.where(samples >= 0, radiance[:, samples], background[:, pixel]) for samples in crossings.samples
        )
        force += (upstream[:, slots[pixel]] * (first - second)).sum(0)
    along = torch.where(crossings.horizontal, crossings.normal[0], -crossings.normal[1])  # rows run down
    forces = (force * along * crossings.normal).T
    gradients = []
    for ends, weight in zip(crossings.ends, (1 - crossings.fraction, crossings.fraction), strict=True):
        x, y, depth = positions[ends].T
        place = torch.stack([x / depth, y / depth], dim=1)
        gradients.append(_homogeneous(forces * weight[:, None], place, depth[:, None]))
    return crossings.ends.flatten(), torch.cat(gradients)


def _homogeneous(forces: Tensor, places: Tensor, depth: Tensor) -> Tensor:
    """(N, 3) gradients by (x w, y w, w) of those (N, 2) by places (x, y) in the image; depth: w (N, 1)."""
    return torch.cat([forces, -(forces * places).sum(1, keepdim=True)], dim=1) / depth


def _pixels(cells: Tensor, fragments: Fragments) -> Tensor:
    """The pixels that samples at row-major positions lie in."""
    resolution = fragments.size * fragments.samples
    return cells // resolution // fragments.samples * fragments.size + cells % resolution // fragments.samples


def _crossings(
    fragments: Fragments, positions: np.ndarray, nearness: np.ndarray, faces: np.ndarray, grid: np.ndarray
) -> Crossings:
    """Where silhouettes are seen; they hide where both samples beside them are of nearer surfaces."""
    resolution = len(grid)
    x, y, w = positions.T
    places = to_fixed_point(np.stack([x / w, y / w, nearness]).T, resolution)[0] / SUBSAMPLES
    ends = _silhouettes(places, faces)[:, : None if len(fragments.face) else 0]  # a mesh outside the image has none
    start, end = places[:, ends[0]], places[:, ends[1]]
    normal = np.stack([end[1] - start[1], end[0] - start[0]])  # in an image whose y runs up
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1 / SUBSAMPLES)
    tolerance = NEAR * np.ptp(nearness)
    parts = []
    for axis, step in enumerate((1, resolution)):
        edge, line, fraction, after = _cut(start[1 - axis], end[1 - axis], start[axis], end[axis], resolution)
        after = line * resolution + after if axis == 0 else after * resolution + line
        cells = np.stack([after - step, after])
        samples = grid.ravel()[cells].astype(np.int64)
        first, second = nearness[ends[:, edge]]
        near = first + fraction * (second - first)
        place = start[:, edge] + fraction * (end - start)[:, edge]
        beside = _plane_nearness(fragments, places, nearness, samples, place)
        seen = np.flatnonzero((samples >= 0).any(axis=0) & (near >= beside.min(axis=0) - tolerance))
        onward = np.where(beside[0] < beside[1], 1, -1) * place[axis]  # away from the farther sample
        seen = seen[np.lexsort([onward[seen], after[seen]])]
        seen = seen[np.diff(after[seen], prepend=-1) != 0]  # one between the same two samples
        horizontal = np.full(len(seen), axis == 0)
        parts.append(
            (ends[:, edge[seen]], fraction[seen], normal[:, edge[seen]], horizontal, cells[:, seen], samples[:, seen])
        )
    return Crossings(*(torch.from_numpy(np.concatenate(both, axis=-1)) for both in zip(*parts, strict=True)))


def _cut(
    start: np.ndarray, end: np.ndarray, across: np.ndarray, end_across: np.ndarray, resolution: int
) -> tuple[np.ndarray, ...]:
    """Cut N edges at each line of samples between their starts and ends: (edge (K,), line (K,), the fraction of the way
    along the edge (K,), the first sample of the line at or after it (K,)), where there are samples before it, too."""
    first, last = (
        np.ceil(limit).clip(0, resolution).astype(np.int64)
        for limit in (np.minimum(start, end), np.maximum(start, end))
    )
    counts = last - first
    edge = np.repeat(np.arange(len(start)), counts)
    line = np.arange(len(edge)) - (np.cumsum(counts) - counts - first)[edge]
    fraction = (line - start[edge]) / (end - start)[edge]
    after = np.ceil(across[edge] + fraction * (end_across - across)[edge]).astype(np.int64)
    inside = (after > 0) & (after < resolution)
    return edge[inside], line[inside], fraction[inside], after[inside]


def _plane_nearness(
    fragments: Fragments, places: np.ndarray, nearness: np.ndarray, samples: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """(2, K) of the planes of the faces that samples (2, K) see, at (2, K); of background, minus infinity."""
    corners = fragments.corners.numpy()[fragments.face.numpy()[samples]]
    near = nearness[corners]
    (ax, bx, cx), (ay, by, cy) = np.moveaxis(places[:, corners], 3, 1)
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    area = np.where(area == 0, np.inf, area)
    to_b = ((at[0] - ax) * (cy - ay) - (at[1] - ay) * (cx - ax)) / area
    to_c = ((bx - ax) * (at[1] - ay) - (by - ay) * (at[0] - ax)) / area
    plane = near[..., 0] + to_b * (near[..., 1] - near[..., 0]) + to_c * (near[..., 2] - near[..., 0])
    return np.where(samples >= 0, plane, -np.inf)


def _silhouettes(places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(2, N) the vertices of the edges whose faces all lie on one side of them; places: (2, V)."""
    corners, ends, edge, forth, count = _edges(np.ascontiguousarray(faces, dtype=np.int64).tobytes())
    (ax, bx, cx), (ay, by, cy) = places.take(corners, axis=1)
    turn = np.sign((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    sides = np.bincount(edge, (turn * forth).ravel(), len(count))
    return ends.take(np.flatnonzero(np.abs(sides) > count - 2), axis=1)  # of two faces, one may be seen edge-on


@lru_cache(maxsize=4)
def _edges(faces: bytes) -> tuple[np.ndarray, ...]:
    """Of faces (F, 3) of int64: their corners (3, F), the ends (2, N) of their edges, the edge of each side (3 F,), ±1
    by its direction (3, F), and how many faces an edge has (N,)."""
    corners = np.ascontiguousarray(np.frombuffer(faces, dtype=np.int64).reshape(-1, 3).T)
    first, second = corners.take(EDGES, axis=0).swapaxes(0, 1)
    low, high = np.minimum(first, second).ravel(), np.maximum(first, second).ravel()
    vertices = int(high.max()) + 1
    keys, edge, count = np.unique(low * vertices + high, return_inverse=True, return_counts=True)
    forth = np.where(first < second, 1.0, -1.0)
    return corners, np.stack(np.divmod(keys, vertices)), edge.ravel(), forth, count
