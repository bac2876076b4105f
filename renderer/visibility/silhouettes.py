"""Gradients of images with respect to the positions of surfaces and silhouettes in the image.

`renderer.surface.shading` differentiates the shading of samples, but holds fixed
which face a sample shows. This module adds the gradient that is missing: how the
image changes if the surfaces move in it.

At a fixed position of the image, the radiance L changes by -v · ∇L if the surface
there moves with velocity v. Between neighboring samples i and j, ∇L is the
difference of their radiances, no matter whether they show one surface or two
(Pidhorskyi et al. 2024, "Rasterized edge gradients"). If the surface moves by δ
samples from i toward j, a pixel of s² samples gains δ (L_i - L_j) / s². If i and
j lie in two pixels, each pixel gains half of this.

If a silhouette lies between i and j, δ is the movement of the silhouette (Li et
al. 2018), not of the surface beside it. For example, when a ball rotates, its
points move but its silhouette does not. Silhouette edges are edges of the mesh
whose faces all lie on one side of the edge in the image. The module finds the
crossings, which are the places where silhouette edges cross rows and columns of
samples. A line with unit normal n that moves by v moves along a row by n · v / n_x.
Crossings with rows have the weight n_x², and crossings with columns the weight
n_y². All crossings of a line together then have its length as their weight.

Edges of shadows stay on the surface on which they lie.

Shapes use these letters: a view has S covered samples in P pixels, s² samples
per pixel, and shows G faces. The mesh has V vertices and F faces. Homogeneous
positions are (x w, y w, w) for the image position (x, y). The number w is
proportional to the depth, and 1 without perspective.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderer.camera import Camera
from renderer.mesh import EDGES, shared_edges
from renderer.modes import once_differentiable
from renderer.visibility.fragments import Fragments
from renderer.visibility.numpy import SUBSAMPLES, doubled_areas
from renderer.visibility.torch import to_fixed_point

# A silhouette counts as visible if it is behind the surface beside it by at most this
# fraction of the depth range of the mesh. For example, the lower edge of an object that
# stands on a table may lie slightly below the table.
VISIBILITY_TOLERANCE = 1e-3

# Stands for the index of a covered sample if a sample shows no mesh.
NOT_COVERED = -1

# Axes of the image: X along rows of samples, and Y along columns.
X = 0
Y = 1


class Crossings(NamedTuple):
    """K crossings: places where a visible silhouette edge passes between two neighboring samples.

    If several silhouettes pass between the same two samples, only one is kept: the
    one next to the sample that shows the farther surface. There, the farther
    surface starts to be hidden.

    Attributes:
        ends: Indices of the vertices at both ends of each edge, shape (2, K).
        fraction: Position of the crossing on the edge, from 0 at the first end to
            1 at the second end, shape (K,).
        normal: Unit normal of each edge in the image, x to the right and y up,
            shape (2, K).
        horizontal: True if the two samples are neighbors in a row, and False if
            they are neighbors in a column, shape (K,).
        cells: Row-major positions of the two samples among all samples of the
            image, the left or the upper one first, shape (2, K).
        samples: Indices of the two samples among the covered samples, or
            NOT_COVERED, shape (2, K).
    """

    ends: Int[Tensor, "2 K"]
    fraction: Float[Tensor, " K"]
    normal: Float[Tensor, "2 K"]
    horizontal: Bool[Tensor, " K"]
    cells: Float[Tensor, "2 K"]
    samples: Int[Tensor, "2 K"]


def moving_outlines(
    fragments: Fragments,
    camera: Camera,
    vertices: Float[Tensor, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    radiance: Float[Tensor, "3 S"],
    background: Float[Tensor, "3 pixels"],
) -> tuple[Int[Tensor, " E"], Float[Tensor, "3 P_E"]]:
    """Create zeros that give an image its gradient with respect to movements of surfaces.

    Rasterized images lack this gradient. Adding the zeros to an image adds the
    gradient and does not change the values. Not only the P covered pixels have
    such a gradient, but also E uncovered pixels beside silhouettes. The gradient
    reaches the vertices, and the fields of the camera that are tensors. The results are the
    row-major indices of the E uncovered pixels, and the zeros for the P covered and then
    these pixels. The background is that of all pixels, and it is linear.
    """
    positions, nearness = camera.homogeneous(vertices.double())
    indices = torch.arange(len(fragments.sample_numbers), dtype=torch.int32, device=vertices.device)
    # Index of each sample of the image among the covered samples, or NOT_COVERED.
    sample_grid = fragments.image_of_samples(indices, NOT_COVERED)
    points = torch.cat([positions[:, :2] / positions[:, 2:], nearness[:, None]], dim=1).detach()
    silhouettes = _Silhouettes(fragments, points, faces, sample_grid)
    # Those in rows come first.
    both = zip(silhouettes.crossings_along(X), silhouettes.crossings_along(Y), strict=True)
    crossings = Crossings(*(torch.cat(pair, dim=-1) for pair in both))
    # Pixels that show no mesh, but have a sample beside a visible silhouette.
    crossed_pixels = _pixels_of_cells(crossings.cells, fragments).unique()
    uncovered_pixels = crossed_pixels[~torch.isin(crossed_pixels, fragments.pixels)]
    constants = radiance.detach(), background.detach()
    view = _MovingView(fragments, crossings, sample_grid, uncovered_pixels, *constants)
    return uncovered_pixels, _ZerosWithGradient.apply(positions, view)


class _ZerosWithGradient(torch.autograd.Function):
    """Zeros with a gradient with respect to the positions of vertices in the image.

    See `moving_outlines`.
    """

    @staticmethod
    def forward(
        ctx: Any, positions: Float[Tensor, "V 3"], view: _MovingView
    ) -> Float[Tensor, "3 _"]:
        """Create the zeros, and store the view and the homogeneous positions (x w, y w, w)."""
        ctx.save_for_backward(positions)
        ctx.view = view
        return view.radiance.new_zeros(3, len(view.fragments.pixels) + len(view.uncovered_pixels))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "3 _"]) -> tuple[Tensor, None]:
        """Compute the gradient with respect to the homogeneous positions."""
        (positions,) = ctx.saved_tensors
        view: _MovingView = ctx.view
        # The factor width / (4 s) is a product of three: the image has the width 2, so a
        # movement by 1 is width · s / 2 samples. A sample has the weight 1 / s² in its
        # pixel. Half of the difference of two samples belongs to each of them.
        upstream = upstream * (view.fragments.shape[1] / 4 / view.fragments.samples)
        gradient = view.gradient_of_surfaces(positions, upstream)
        ends, end_gradients = view.gradient_of_silhouettes(positions, upstream)
        return gradient.index_add_(0, ends, end_gradients), None


@dataclass(frozen=True)
class _MovingView:
    """View whose image is differentiated with respect to the positions of surfaces in it.

    Attributes:
        fragments: The S covered samples in P pixels.
        crossings: Places where visible silhouettes pass between samples.
        sample_grid: Index of the covered sample at each sample of the image, or
            NOT_COVERED, shape (height · s, width · s).
        uncovered_pixels: Row-major indices of the E uncovered pixels into which
            silhouettes may move, shape (E,).
        radiance: Linear radiance at the covered samples, shape (3, S).
        background: Linear background of all pixels, shape (3, height · width).
    """

    fragments: Fragments
    crossings: Crossings
    sample_grid: Int[Tensor, "_ _"]
    uncovered_pixels: Int[Tensor, " E"]
    radiance: Float[Tensor, "3 S"]
    background: Float[Tensor, "3 P"]

    def gradient_of_surfaces(
        self, positions: Float[Tensor, "V 3"], upstream: Float[Tensor, "3 _"]
    ) -> Float[Tensor, "V 3"]:
        """Compute the gradient with respect to movements of surfaces, without silhouettes.

        The positions are homogeneous, and `upstream` is for the P covered and then the E
        uncovered pixels.
        """
        fragments = self.fragments
        upstream_at_samples = upstream.index_select(1, fragments.sample_to_pixel)
        # Radiance times upstream gradient, summed over the color channels.
        weighted_radiance = (self.radiance * upstream_at_samples).sum(0)
        weighted_image = fragments.image_of_samples(weighted_radiance, torch.nan)
        right = self._gradient_along(X, weighted_image, upstream_at_samples)
        down = self._gradient_along(Y, weighted_image, upstream_at_samples)
        # Most samples have neighbors of the same color. Their gradient is 0.
        samples = torch.nonzero((right != 0) | (down != 0)).squeeze(1)
        # Gradient with respect to the image position (x, y) of each selected sample. The
        # minus sign is there because y points up.
        sample_gradients = torch.stack([right, -down]).index_select(1, samples).T
        if fragments.depths is not None:
            depth = fragments.interpolate(positions[:, 2:][fragments.corners])[samples]
            places = fragments.positions()[samples]
            sample_gradients = _to_homogeneous(sample_gradients, places, depth)
        # Distribute the gradients to the corners of faces: one row for each coordinate, one
        # column for each corner.
        corner_gradients = fragments.distribute(sample_gradients, samples).double()
        gradient = positions.new_zeros(positions.shape[::-1])
        # Without perspective, only the first two coordinates have a gradient.
        coordinate_count = sample_gradients.shape[1]
        gradient[:coordinate_count].index_add_(1, fragments.corners.T.flatten(), corner_gradients)
        return gradient.T

    def _gradient_along(
        self,
        axis: int,
        weighted_image: Float[Tensor, "_ _"],
        upstream_at_samples: Float[Tensor, "3 S"],
    ) -> Float[Tensor, " S"]:
        """Compute the gradient with respect to movements of surfaces along one image axis.

        `axis` is X for movements to the right, or Y for movements down. The image is
        radiance times upstream gradient, summed over the colors, and NaN where no mesh is.
        """
        samples = self.fragments.samples
        grid = self.sample_grid
        # `gradient_of_silhouettes` computes the gradient where a silhouette passes between samples.
        is_along_axis = self.crossings.horizontal if axis == X else ~self.crossings.horizontal
        cells = self.crossings.cells[0, is_along_axis]
        crossed = [cells // grid.shape[1], cells % grid.shape[1]]
        if axis == Y:
            # Make rows of the image of its columns.
            weighted_image, grid = weighted_image.T, grid.T
            crossed.reverse()
        # Value of each sample minus the value of the next sample along the axis. The difference
        # is NaN if one of the two samples shows no mesh.
        difference = (weighted_image[:, :-1] - weighted_image[:, 1:]).nan_to_num_(0)
        # Two neighboring pixels have different upstream gradients. The correct difference between
        # the last sample of a pixel and the first of the next is the difference of the two
        # radiances times the mean of the two upstream gradients.
        before, after = grid[:, samples - 1 : -1 : samples], grid[:, samples::samples]
        are_covered = (before >= 0) & (after >= 0)
        covered = are_covered.nonzero(as_tuple=True)
        before, after = before[covered], after[covered]
        upstream_sum = upstream_at_samples[:, before] + upstream_at_samples[:, after]
        radiance_difference = self.radiance[:, before] - self.radiance[:, after]
        corrected = (radiance_difference * upstream_sum).sum(0) / 2
        difference[:, samples - 1 :: samples].masked_scatter_(are_covered, corrected)
        difference[tuple(crossed)] = 0
        # The gradient of a sample is the sum of its differences to both neighbors.
        gradient = F.pad(difference, (0, 1))
        gradient[:, 1:] += difference
        if axis == Y:
            gradient = gradient.T
        return gradient.flatten().index_select(0, self.fragments.sample_numbers)

    def gradient_of_silhouettes(
        self, positions: Float[Tensor, "V 3"], upstream: Float[Tensor, "3 _"]
    ) -> tuple[Tensor, Tensor]:
        """Compute the gradient with respect to movements of silhouette edges at K crossings.

        A crossing is a place where a silhouette edge passes between two samples. An edge with the
        unit normal n that moves by v moves along a row by n · v / n_x. Its crossing with the row
        has the weight n_x², so that the product is n_x (n · v). The results are the vertices at the
        first and then at the second ends of the K edges, and the gradients with respect to their
        homogeneous positions.
        """
        crossings = self.crossings
        # Component of the edge normal in the direction from the first to the second sample,
        # which is to the right in a row, and down in a column.
        along = torch.where(crossings.horizontal, crossings.normal[0], -crossings.normal[1])
        # Index of the column of `upstream` for each pixel of the image, or -1 without a column.
        column_of_pixel = torch.full((math.prod(self.fragments.shape),), -1, device=upstream.device)
        upstream_pixels = torch.cat([self.fragments.pixels, self.uncovered_pixels])
        column_of_pixel[upstream_pixels] = torch.arange(upstream.shape[1], device=upstream.device)
        # Gradient with respect to movements toward the second sample. The pixel of the first
        # sample and the pixel of the second sample each gain half of the difference of the two
        # radiances. The factor 1/2 is already in `upstream`.
        toward_second = self.radiance.new_zeros(len(along))
        is_covered, of_mesh = crossings.samples >= 0, self.radiance[:, crossings.samples]
        for pixels in _pixels_of_cells(crossings.cells, self.fragments):
            # Radiance at both samples, or the background if a sample shows no mesh.
            radiance = torch.where(is_covered, of_mesh, self.background[:, None, pixels])
            pixel_gradient = upstream[:, column_of_pixel[pixels]]
            toward_second += (pixel_gradient * (radiance[:, 0] - radiance[:, 1])).sum(0)
        # Gradient with respect to the position (x, y) of each crossing in the image.
        crossing_gradients = (toward_second * along * crossings.normal).T
        # Distances by which a crossing moves if the first, or the second, end of its edge
        # moves by 1.
        end_weights = torch.stack([1 - crossings.fraction, crossings.fraction])
        end_gradients = (crossing_gradients * end_weights[..., None]).flatten(0, 1)
        ends = crossings.ends.flatten()
        places, depth = positions[ends].split([2, 1], dim=1)
        return ends, _to_homogeneous(end_gradients, places / depth, depth)


def _to_homogeneous(
    gradients: Float[Tensor, "N 2"], places: Float[Tensor, "N 2"], depth: Float[Tensor, "N 1"]
) -> Float[Tensor, "N 3"]:
    """Convert gradients of N points from image positions to homogeneous positions.

    The image position (x, y) has the homogeneous coordinates (x w, y w, w). With the gradient (a,
    b) with respect to (x, y), the chain rule gives (a, b, -(a x + b y)) / w.
    """
    depth_gradient = -(gradients * places).sum(1, keepdim=True)
    return torch.cat([gradients, depth_gradient], dim=1) / depth


def _pixels_of_cells(cells: Tensor, fragments: Fragments) -> Tensor:
    """Find the row-major pixels to which samples, row-major in the whole image, belong."""
    samples = fragments.samples
    width = fragments.shape[1]
    return cells // (width * samples**2) * width + cells % (width * samples) // samples


class _Silhouettes:
    """Silhouette edges of a view, which may be hidden.

    In `places`, vertices are in units of samples, x to the right and y down. `nearness` is larger
    for nearer points, and linear in the image on each face. `sample_grid` is that of
    `_MovingView`. `ends` are the vertices at both ends of each edge, and `normal` is its unit
    normal in the image.
    """

    def __init__(
        self, fragments: Fragments, points: Tensor, faces: np.ndarray, sample_grid: Tensor
    ) -> None:
        """Find the silhouette edges. Points have an image position and a nearness, (V, 3)."""
        self.fragments, self.sample_grid = fragments, sample_grid
        self.nearness = nearness = points[:, 2]
        # Positions are rounded to subsamples as in rasterizers.
        rows, columns = sample_grid.shape
        self.places = to_fixed_point(points, (rows, columns))[0].T.double() / SUBSAMPLES
        key = np.ascontiguousarray(faces, dtype=np.int64).tobytes()
        all_ends, edge_of_side, direction, face_count = _edges(key, points.device)
        corners = torch.from_numpy(faces).to(points.device, non_blocking=True).T
        orientation = doubled_areas(self.places[:, corners]).sign()
        # One number for each face and each of its three edges: 1 if the face lies on one side of
        # the edge, and -1 if it lies on the other side. An edge leads to its higher vertex index.
        side_of_face = (orientation * direction).flatten()
        side_sums = self.places.new_zeros(len(face_count)).index_add_(0, edge_of_side, side_of_face)
        # All n faces of an edge lie on the same side in the image if the sum is n or -n. It is
        # n - 1 or 1 - n if one of them is seen edge-on, because this face counts 0.
        self.ends = all_ends[:, side_sums.abs() > face_count - 2]
        # Vertices that no face uses do not count.
        self.nearness_range = nearness[all_ends].max() - nearness[all_ends].min()
        if len(fragments.sample_to_seen_face) == 0:
            self.ends = self.ends[:, :0]  # If no sample shows the mesh, no silhouette is visible.
        # An edge (a, b) with y down has the normal (b, a) with y up.
        normal = self.places[:, self.ends].diff(dim=1)[:, 0].flip(0)
        # Edges without length divide by a small number instead of 0.
        self.normal = normal / normal.square().sum(0).sqrt().clamp(min=1 / SUBSAMPLES)

    def crossings_along(self, axis: int) -> Crossings:
        """Find visible silhouettes between neighbors in a row (`axis` is X) or in a column."""
        rows, columns = self.sample_grid.shape
        start, end = self.places[:, self.ends].unbind(1)
        # Places (cuts) where edges cross rows of samples for the axis X, or columns for Y.
        shape = (rows, columns) if axis == X else (columns, rows)
        places = [ends.flip(0) if axis == X else ends for ends in (start, end)]
        edge, line, fraction, next_sample = _cut_edges(places[0], places[1], shape)
        # Row-major indices of the first sample after each cut, and of the sample before.
        row, column, step = (line, next_sample, 1) if axis == X else (next_sample, line, columns)
        after = row * columns + column
        cells = torch.stack([after - step, after])
        # Indices among the covered samples before and after the cuts, or NOT_COVERED.
        samples = self.sample_grid.flatten()[cells].long()
        place = start[:, edge] + fraction * (end - start)[:, edge]
        surface_nearness = self._surface_nearness(samples, place)
        start_nearness, end_nearness = self.nearness[self.ends[:, edge]]
        edge_nearness = start_nearness + fraction * (end_nearness - start_nearness)
        # An edge is hidden if the surfaces at both samples beside it are nearer to the camera.
        # It counts as hidden, too, if no sample beside it shows a surface. If one of them
        # shows no surface, the minimum is minus infinity, and the edge is in front.
        tolerance = VISIBILITY_TOLERANCE * self.nearness_range
        is_in_front = edge_nearness >= surface_nearness.amin(0) - tolerance
        # Distance from the sample with the farther surface, plus the same number for all cuts
        # between the same two samples.
        distance = torch.where(surface_nearness[0] < surface_nearness[1], place[axis], -place[axis])
        order = ((samples != NOT_COVERED).any(0) & is_in_front).nonzero().squeeze(1)
        # Of all cuts between the same two samples, keep the one with the smallest distance.
        for keys in (distance, after):
            order = order[keys[order].argsort(stable=True)]
        kept = order[after[order].diff(prepend=after.new_full((1,), -1)) != 0]
        edge = edge[kept]
        horizontal = torch.full_like(edge, axis == X, dtype=torch.bool)
        of_edges = self.ends[:, edge], fraction[kept], self.normal[:, edge]
        return Crossings(*of_edges, horizontal, cells[:, kept], samples[:, kept])

    def _surface_nearness(
        self, samples: Int[Tensor, "2 K"], place: Float[Tensor, "2 K"]
    ) -> Float[Tensor, "2 K"]:
        """Compute how near the faces beside K cuts are, if they are extended to the cuts.

        A cut is the place where a silhouette edge crosses a row or a column of
        samples. The faces are those that the samples before and after it show. The result
        is minus infinity for NOT_COVERED. Places are in units of samples.
        """
        # Axes: before or after the cut, cut, corner. The index -1 (NOT_COVERED) selects an
        # arbitrary face, whose result is replaced at the end.
        corners = self.fragments.corners[self.fragments.sample_to_seen_face[samples]]
        # Nearness and positions (x, y) of the corners a, b and c of the faces beside each cut.
        nearness_a, nearness_b, nearness_c = self.nearness[corners].unbind(2)
        (ax, bx, cx), (ay, by, cy) = self.places[:, corners].movedim(3, 1)
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        # For a face without area, divide by infinity. The result is the nearness of corner a.
        area = area.masked_fill(area == 0, torch.inf)
        # Barycentric weights of the corners b and c.
        weight_b = ((place[0] - ax) * (cy - ay) - (place[1] - ay) * (cx - ax)) / area
        weight_c = ((bx - ax) * (place[1] - ay) - (by - ay) * (place[0] - ax)) / area
        to_b, to_c = nearness_b - nearness_a, nearness_c - nearness_a
        plane = nearness_a + weight_b * to_b + weight_c * to_c
        return torch.where(samples >= 0, plane, -torch.inf)


def _cut_edges(
    start: Float[Tensor, "2 N"], end: Float[Tensor, "2 N"], shape: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find where N edges cross rows of samples, or columns of samples.

    Rows and columns are both called lines. The first coordinate of the ends of the edges is across
    the lines, and the second one along the lines, in units of samples. Line i has the coordinate i.
    `shape` is the number of lines, and of samples in a line.
    Crossings before the first sample or after the last sample of a line are left out. The results
    are, for each of K crossings, the index of the edge, the index of the line, the position on the
    edge from 0 (start) to 1 (end), and the index in the line of the first sample at or after the
    crossing.
    """
    # Each edge crosses the lines from `first_line` to `end_line` - 1.
    lower, upper = torch.minimum(start[0], end[0]), torch.maximum(start[0], end[0])
    first_line, end_line = (ends.ceil().clamp(0, shape[0]).long() for ends in (lower, upper))
    cuts_per_edge = end_line - first_line
    # One entry for each pair of an edge and a line (row or column of samples) that the edge
    # crosses. The index of an edge is repeated for all lines that it crosses.
    edge = torch.repeat_interleave(cuts_per_edge)
    cuts_before_edge = cuts_per_edge.cumsum(0) - cuts_per_edge
    line = torch.arange(len(edge), device=edge.device) - (cuts_before_edge - first_line)[edge]
    # Position of the crossing on the edge, from 0 at the start of the edge to 1 at its end.
    fraction = (line - start[0, edge]) / (end[0] - start[0])[edge]
    next_sample = (start[1, edge] + fraction * (end[1] - start[1])[edge]).ceil().long()
    inside = ((next_sample > 0) & (next_sample < shape[1])).nonzero().squeeze(1)
    return edge[inside], line[inside], fraction[inside], next_sample[inside]


@lru_cache(maxsize=4)
def _edges(face_bytes: bytes, device: torch.device) -> tuple[Tensor, ...]:
    """Find the N edges of a mesh with F faces, of which each has three sides.

    Sides with the same two vertices are one edge. The results are the vertices at both
    ends of each edge, the lower index first, shape (2, N); the edge of each side, with
    side i of face f at i F + f, shape (3 F,); 1 for sides that lead from the lower to the higher
    vertex index, and -1 for others, shape (3, F); and the number of faces at each edge. The
    argument holds int64 vertex indices as bytes, because a key of the cache is hashed.
    """
    faces = np.frombuffer(face_bytes, dtype=np.int64).reshape(-1, 3)
    ends, edge_of_side = shared_edges(faces)
    start, end = faces.T[np.array(EDGES)].swapaxes(0, 1)
    direction = np.where(start < end, 1.0, -1.0)
    arrays = ends.T, edge_of_side.T.ravel(), direction, np.bincount(edge_of_side.ravel())
    return tuple(torch.from_numpy(array.copy()).to(device) for array in arrays)
