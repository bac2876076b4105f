"""Gradients of images with respect to the positions of surfaces and silhouettes in the image.

`renderer.shading.shading` differentiates the shading of samples, but holds fixed
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

The light is fixed: edges of shadows and of projected patterns stay on the
surface on which they lie.

Shapes use these letters: a view has S covered samples in P pixels, s² samples
per pixel, and shows G faces. The mesh has V vertices and F faces. Homogeneous
positions are (x w, y w, w) for the image position (x, y). The number w is
proportional to the depth, and 1 without perspective.
"""

from __future__ import annotations

from dataclasses import dataclass
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

# A silhouette counts as visible if it is at most this fraction of the mesh's depth
# range behind the surface beside it. For example, an object that stands on a table
# touches the table. By rounding, or because of how the object was modeled, its edge
# may then lie slightly below the table.
NEAR = 1e-3

# Index of a sample that shows no mesh, instead of an index of a covered sample.
NOT_COVERED = -1

# Axes of the image. Neighboring samples in a row differ along X, and neighbors in a
# column along Y.
X = 0
Y = 1


class Crossings(NamedTuple):
    """K crossings: places where a visible silhouette edge passes between two neighboring samples.

    If several silhouettes pass between the same two samples, only one is kept.
    This is the silhouette next to the sample that shows the farther surface,
    because it is the boundary of this surface's visible part.

    Attributes:
        ends: Vertices at both ends of each edge, shape (2, K).
        fraction: Position of the place between the ends, from 0 to 1,
            shape (K,).
        normal: Unit normal of each edge in the image, x to the right and y up,
            shape (2, K).
        horizontal: True if the two samples are neighbors in a row, and False if
            they are neighbors in a column, shape (K,).
        cells: Row-major positions of the two samples among all samples of the
            image, the left or the upper one first, shape (2, K).
        samples: Indices of the two samples among the covered samples, or
            NOT_COVERED, shape (2, K).
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
    """Create zeros whose gradient says how an image changes if surfaces move in it.

    Adding the zeros to an image adds the missing gradient, and does not change
    the values. Besides the P covered pixels, E uncovered pixels beside silhouettes
    have a gradient. The gradient reaches the vertices, and fields of the camera
    that are tensors.

    Args:
        fragments: The S covered samples of the view.
        camera: Camera of the view.
        vertices: Vertex positions in world axes, shape (V, 3).
        faces: Vertex indices of the faces, shape (F, 3).
        radiance: Linear radiance at the covered samples, shape (3, S).
        background: Linear background of all pixels, shape (3, size²).

    Returns:
        A tuple of
        - the row-major indices of the E uncovered pixels, shape (E,);
        - zeros to add to the linear values of the P covered pixels and then of
          the E uncovered pixels, shape (3, P + E).
    """
    positions, nearness = camera.homogeneous(vertices.double())
    sample_indices = torch.arange(
        len(fragments.sample_numbers), dtype=torch.int32, device=vertices.device
    )
    # Index of the covered sample at each sample of the image.
    sample_grid = fragments.image_of_samples(sample_indices, NOT_COVERED)
    crossings_on_cpu = _find_crossings(
        fragments.to("cpu"),
        _to_numpy(positions),
        _to_numpy(nearness),
        faces=_to_numpy(faces),
        sample_grid=_to_numpy(sample_grid),
    )
    crossings = Crossings(*(values.to(sample_grid.device) for values in crossings_on_cpu))
    # Uncovered pixels with a sample beside a crossing.
    is_uncovered = torch.zeros(fragments.size**2, dtype=torch.bool, device=sample_grid.device)
    is_uncovered.index_fill_(0, _pixels_of_cells(crossings.cells, fragments).flatten(), True)
    is_uncovered.index_fill_(0, fragments.pixels, False)
    uncovered_pixels = is_uncovered.nonzero().squeeze(1)
    view = _MovingView(
        fragments=fragments,
        crossings=crossings,
        sample_grid=sample_grid,
        uncovered_pixels=uncovered_pixels,
        radiance=radiance.detach(),
        background=background.detach(),
    )
    return uncovered_pixels, _ZerosWithGradient.apply(positions, view)


def _to_numpy(tensor: Tensor) -> np.ndarray:
    """Convert a tensor to a NumPy array, without its graph."""
    return tensor.detach().cpu().numpy()


class _ZerosWithGradient(torch.autograd.Function):
    """Zeros with a gradient by the homogeneous positions of the vertices, see `moving_outlines`."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, view: _MovingView) -> Tensor:
        """Create the zeros, and store the view and the positions for the gradient.

        Args:
            ctx: Context of autograd.
            positions: Homogeneous positions (x w, y w, w) of the V vertices in
                the image, shape (V, 3).
            view: View with P covered and E uncovered pixels, whose gradient
                `backward` computes.

        Returns:
            Zeros, shape (3, P + E).
        """
        ctx.save_for_backward(positions)
        ctx.view = view
        pixel_count = len(view.fragments.pixels) + len(view.uncovered_pixels)
        return view.radiance.new_zeros(3, pixel_count)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        """Compute the gradient by the homogeneous positions.

        Args:
            ctx: Context of autograd.
            upstream: Gradient by the linear values of the P covered and E
                uncovered pixels, shape (3, P + E).

        Returns:
            Gradient by the homogeneous positions, shape (V, 3), and None for the
            view.
        """
        (positions,) = ctx.saved_tensors
        view: _MovingView = ctx.view
        # Movements are in image coordinates, in which the image has the width 2. A
        # movement by 1 is size · s / 2 samples, and a sample has the weight 1 / s² in
        # its pixel. The factor 1/2 shares the difference of two samples between both.
        upstream = upstream * (view.fragments.size / 4 / view.fragments.samples)
        gradient = view.gradient_by_surface(positions, upstream)
        ends, gradient_by_ends = view.gradient_by_silhouettes(positions, upstream)
        return gradient.index_add_(0, ends, gradient_by_ends), None


@dataclass(frozen=True)
class _MovingView:
    """View whose image is differentiated by the positions of surfaces in it.

    Attributes:
        fragments: The S covered samples in P pixels.
        crossings: Places where visible silhouettes pass between samples.
        sample_grid: Index of the covered sample at each sample of the image, or
            NOT_COVERED, shape (size · s, size · s).
        uncovered_pixels: Row-major indices of the E uncovered pixels into which
            silhouettes may move, shape (E,).
        radiance: Linear radiance at the covered samples, shape (3, S).
        background: Linear background of all pixels, shape (3, size²).
    """

    fragments: Fragments
    crossings: Crossings
    sample_grid: Tensor
    uncovered_pixels: Tensor
    radiance: Tensor
    background: Tensor

    def gradient_by_surface(self, positions: Tensor, upstream: Tensor) -> Tensor:
        """Compute the gradient by the movement of surfaces, without silhouettes.

        In this class, the force at a sample is the gradient by the position of
        the surface point at this sample in the image.

        Args:
            positions: Homogeneous positions of the vertices, shape (V, 3).
            upstream: Gradient by the linear values of the P covered and E
                uncovered pixels, shape (3, P + E).

        Returns:
            Gradient by the homogeneous positions, shape (V, 3).
        """
        fragments = self.fragments
        upstream_at_samples = upstream.index_select(1, fragments.sample_to_pixel)
        # Radiance times upstream gradient, summed over the channels, shape (S,).
        weighted_radiance = (self.radiance * upstream_at_samples).sum(0)
        weighted_image = fragments.image_of_samples(weighted_radiance, torch.nan)
        force_right = self._forces_along(X, weighted_image, upstream_at_samples)
        force_down = self._forces_along(Y, weighted_image, upstream_at_samples)
        # Most samples have neighbors of the same color, and therefore no force.
        has_force = (force_right != 0) | (force_down != 0)
        samples = torch.nonzero(has_force).squeeze(1)
        part = fragments.select(samples)
        # The y-axis of image positions points up.
        forces = torch.stack(
            [force_right.index_select(0, samples), -force_down.index_select(0, samples)]
        ).T
        if fragments.depths is not None:
            depth = part.interpolate(positions[:, 2:][part.corners])
            forces = _by_homogeneous(forces, part.positions(), depth)
        # Distribute the forces to the corners of the seen faces. Shape (2 or 3, 3 G),
        # for the coordinates and the corners.
        corner_gradients = part.distribute(forces).permute(2, 1, 0).flatten(1).double()
        gradient = positions.new_zeros(positions.shape[::-1])
        coordinate_count = forces.shape[1]
        gradient[:coordinate_count].index_add_(1, part.corners.T.flatten(), corner_gradients)
        return gradient.T

    def _forces_along(
        self, axis: int, weighted_image: Tensor, upstream_at_samples: Tensor
    ) -> Tensor:
        """Compute the gradient by movements of the surface at each sample, along one image axis.

        Args:
            axis: X for movements to the right, or Y for movements down.
            weighted_image: Radiance times upstream gradient, summed over the
                channels, for each sample of the image. NaN for samples that show
                no mesh. Shape (size · s, size · s).
            upstream_at_samples: Upstream gradient of the pixel of each covered
                sample, shape (3, S).

        Returns:
            Gradient for each covered sample, shape (S,).
        """
        # Columns are dimension 1 of the image, and rows dimension 0.
        dim = 1 - axis
        steps = len(self.sample_grid) - 1
        # Value of each sample minus the value of the next sample along the axis.
        jump = torch.zeros_like(weighted_image)
        torch.sub(
            weighted_image.narrow(dim, 0, steps),
            weighted_image.narrow(dim, 1, steps),
            out=jump.narrow(dim, 0, steps),
        )
        # The difference is NaN if one of the two samples shows no mesh.
        jump.nan_to_num_(0)
        self._correct_pixel_borders(dim, jump, upstream_at_samples)
        # `gradient_by_silhouettes` handles the jumps across silhouettes.
        is_along_axis = self.crossings.horizontal == (axis == X)
        jump.view(-1).index_fill_(0, self.crossings.cells[0, is_along_axis], 0)
        # The force at a sample is the sum of the jumps before and after the sample.
        force = jump.clone()
        force.narrow(dim, 1, steps).add_(jump.narrow(dim, 0, steps))
        return self.fragments.of_image(force)

    def _correct_pixel_borders(self, dim: int, jump: Tensor, upstream_at_samples: Tensor) -> None:
        """Replace the jumps between samples of two neighboring pixels, in place.

        The two pixels have different upstream gradients. The right jump is the
        difference of the two radiances times the mean of the two upstream
        gradients.

        Args:
            dim: Dimension of the image along which the samples are neighbors.
            jump: Weighted difference between each sample of the image and the
                next one, changed in place, shape (size · s, size · s).
            upstream_at_samples: Upstream gradient of the pixel of each covered
                sample, shape (3, S).
        """
        samples = self.fragments.samples
        # Slices for the last sample of each pixel, and the first sample of the next.
        before: Any = (slice(None), slice(samples - 1, -1, samples))
        after: Any = (slice(None), slice(samples, None, samples))
        if dim == 0:
            before = before[::-1]
            after = after[::-1]
        grid = self.sample_grid
        are_covered = (grid[before] >= 0) & (grid[after] >= 0)
        sample_before = grid[before][are_covered]
        sample_after = grid[after][are_covered]
        upstream_before = upstream_at_samples.index_select(1, sample_before)
        upstream_sum = upstream_before + upstream_at_samples.index_select(1, sample_after)
        radiance_before = self.radiance.index_select(1, sample_before)
        difference = radiance_before - self.radiance.index_select(1, sample_after)
        corrected = (difference * upstream_sum).sum(0) / 2
        jump[before].masked_scatter_(are_covered, corrected)

    def gradient_by_silhouettes(self, positions: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the gradient by the movement of silhouette edges at the K crossings.

        Args:
            positions: Homogeneous positions of the vertices, shape (V, 3).
            upstream: Gradient by the linear values of the P covered and E
                uncovered pixels, shape (3, P + E).

        Returns:
            A tuple of
            - the vertices at the first ends of the K edges, and then at the
              second ends, shape (2 K,);
            - the gradient by the homogeneous positions of these vertices,
              shape (2 K, 3).
        """
        crossings = self.crossings
        # Component of the edge normal along the row (to the right) or column (down) of
        # the two samples. The weight n_x² of a crossing times its movement n · v / n_x
        # is n_x (n · v).
        along = torch.where(crossings.horizontal, crossings.normal[0], -crossings.normal[1])
        # Gradient by the position of the crossing in the image, shape (K, 2).
        forces = (self._silhouette_forces(upstream) * along * crossings.normal).T
        # An end moves the crossing the more, the nearer it is.
        end_weights = (1 - crossings.fraction, crossings.fraction)
        gradients = []
        for end_vertices, end_weight in zip(crossings.ends, end_weights, strict=True):
            x, y, depth = positions[end_vertices].T
            end_position = torch.stack([x / depth, y / depth], dim=1)
            end_forces = forces * end_weight[:, None]
            gradients.append(_by_homogeneous(end_forces, end_position, depth[:, None]))
        return crossings.ends.flatten(), torch.cat(gradients)

    def _silhouette_forces(self, upstream: Tensor) -> Tensor:
        """Compute the gradient by the movement of K silhouettes toward the second sample.

        Args:
            upstream: Gradient by the linear values of the P covered and E
                uncovered pixels, shape (3, P + E).

        Returns:
            Gradient at each crossing, shape (K,).
        """
        # Pixels of the first and of the second sample at each crossing, shape (2, K).
        pixels_at_crossings = _pixels_of_cells(self.crossings.cells, self.fragments)
        device = pixels_at_crossings.device
        # Column of `upstream` for each pixel of the image, or -1.
        column_of_pixel = torch.full((self.fragments.size**2,), -1, device=device)
        upstream_pixels = torch.cat([self.fragments.pixels, self.uncovered_pixels])
        column_of_pixel[upstream_pixels] = torch.arange(upstream.shape[1], device=device)
        force = self.radiance.new_zeros(pixels_at_crossings.shape[1])
        first_samples, second_samples = self.crossings.samples
        # The pixels of both samples gain half of the difference each.
        for pixels in pixels_at_crossings:
            first_radiance = self._seen_radiance(first_samples, pixels)
            second_radiance = self._seen_radiance(second_samples, pixels)
            pixel_gradient = upstream[:, column_of_pixel[pixels]]
            force += (pixel_gradient * (first_radiance - second_radiance)).sum(0)
        return force

    def _seen_radiance(self, samples: Tensor, pixels: Tensor) -> Tensor:
        """Look up the radiance at samples, or the background of pixels if a sample shows no mesh.

        Args:
            samples: Indices of K covered samples, or NOT_COVERED, shape (K,).
            pixels: Row-major indices of K pixels, whose background is used for
                NOT_COVERED, shape (K,).

        Returns:
            Radiance, shape (3, K).
        """
        return torch.where(samples >= 0, self.radiance[:, samples], self.background[:, pixels])


def _by_homogeneous(forces: Tensor, places: Tensor, depth: Tensor) -> Tensor:
    """Convert gradients by image positions to gradients by homogeneous positions (chain rule).

    Args:
        forces: Gradients by the image positions (x, y) of N points,
            shape (N, 2).
        places: Image positions (x, y), shape (N, 2).
        depth: Third homogeneous coordinate w, shape (N, 1).

    Returns:
        Gradients by (x w, y w, w), shape (N, 3).
    """
    return torch.cat([forces, -(forces * places).sum(1, keepdim=True)], dim=1) / depth


def _pixels_of_cells(cells: Tensor, fragments: Fragments) -> Tensor:
    """Find the pixels to which samples of an image belong.

    Args:
        cells: Row-major indices of the samples among all samples of the image,
            any shape.
        fragments: View with the size of the image and its samples per pixel.

    Returns:
        Row-major indices of the pixels, same shape.
    """
    samples = fragments.samples
    resolution = fragments.size * samples
    row = cells // resolution // samples
    column = cells % resolution // samples
    return row * fragments.size + column


def _find_crossings(
    fragments: Fragments,
    positions: np.ndarray,
    nearness: np.ndarray,
    faces: np.ndarray,
    sample_grid: np.ndarray,
) -> Crossings:
    """Find where visible silhouettes pass between neighboring samples.

    Args:
        fragments: Covered samples of the view, with tensors on the CPU.
        positions: Homogeneous positions of the vertices, shape (V, 3).
        nearness: Nearness of the vertices to the camera, shape (V,). On a plane,
            it is a linear function of the image position. It is larger for
            nearer points.
        faces: Vertex indices of all faces, shape (F, 3).
        sample_grid: Index of the covered sample at each sample of the image, or
            NOT_COVERED, shape (size · s, size · s).

    Returns:
        Crossings with rows of samples, and then crossings with columns.
    """
    x, y, w = positions.T
    points = np.stack([x / w, y / w, nearness]).T
    # Positions in units of samples, x to the right and y down, shape (2, V). They are
    # rounded as in the rasterizers.
    places = to_fixed_point(points, len(sample_grid))[0] / SUBSAMPLES
    ends = _silhouette_edges(places, faces)
    if len(fragments.sample_to_seen_face) == 0:
        # A mesh outside of the image has no visible silhouettes.
        ends = ends[:, :0]
    start = places[:, ends[0]]
    end = places[:, ends[1]]
    # Normal of each edge, with y up. The edge (a, b) with y down has the normal (b, a).
    normal = np.stack([end[1] - start[1], end[0] - start[0]])
    # The minimum avoids a division by 0 for edges without length.
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1 / SUBSAMPLES)
    silhouettes = _Silhouettes(fragments, places, nearness, sample_grid, ends, normal)
    in_rows = silhouettes.crossings_along(X)
    in_columns = silhouettes.crossings_along(Y)
    both = [np.concatenate(pair, axis=-1) for pair in zip(in_rows, in_columns, strict=True)]
    return Crossings(*map(torch.from_numpy, both))


@dataclass(frozen=True)
class _Silhouettes:
    """N silhouette edges of a view.

    Attributes:
        fragments: Covered samples, with tensors on the CPU.
        places: Positions of the vertices in units of samples, x to the right
            and y down, shape (2, V).
        nearness: Nearness of the vertices to the camera, shape (V,).
        sample_grid: Index of the covered sample at each sample of the image, or
            NOT_COVERED, shape (size · s, size · s).
        ends: Vertices at both ends of each edge, shape (2, N).
        normal: Unit normal of each edge in the image, shape (2, N).
    """

    fragments: Fragments
    places: np.ndarray
    nearness: np.ndarray
    sample_grid: np.ndarray
    ends: np.ndarray
    normal: np.ndarray

    def crossings_along(self, axis: int) -> tuple[np.ndarray, ...]:
        """Find visible crossings between samples that are neighbors along an axis.

        Args:
            axis: X for neighbors in a row, and Y for neighbors in a column.

        Returns:
            Arrays for the attributes of `Crossings`, in their order.
        """
        resolution = len(self.sample_grid)
        start = self.places[:, self.ends[0]]
        end = self.places[:, self.ends[1]]
        # A line is a row for the axis X, and a column for the axis Y.
        cuts = _cut_edges(
            start_across=start[1 - axis],
            end_across=end[1 - axis],
            start_along=start[axis],
            end_along=end[axis],
            resolution=resolution,
        )
        edge = cuts.edge
        # Row-major indices of the samples after and before each of the K cuts.
        if axis == X:
            after = cuts.line * resolution + cuts.next_sample
            before = after - 1
        else:
            after = cuts.next_sample * resolution + cuts.line
            before = after - resolution
        cells = np.stack([before, after])
        # Indices of the covered samples, or NOT_COVERED, shape (2, K).
        samples = self.sample_grid.ravel()[cells].astype(np.int64)
        place = start[:, edge] + cuts.fraction * (end - start)[:, edge]
        surface_nearness = self._surface_nearness(samples, place)
        is_visible = self._is_visible(cuts, samples, surface_nearness)
        # This coordinate grows with the distance of the cut from the sample that shows
        # the farther surface.
        from_farther = np.where(surface_nearness[0] < surface_nearness[1], 1, -1) * place[axis]
        kept = np.flatnonzero(is_visible)
        # Sort by the pair of samples, and then by the distance.
        kept = kept[np.lexsort([from_farther[kept], after[kept]])]
        # Keep the first cut between two samples.
        kept = kept[np.diff(after[kept], prepend=-1) != 0]
        return (
            self.ends[:, edge[kept]],
            cuts.fraction[kept],
            self.normal[:, edge[kept]],
            np.full(len(kept), axis == X),
            cells[:, kept],
            samples[:, kept],
        )

    def _is_visible(
        self, cuts: _Cuts, samples: np.ndarray, surface_nearness: np.ndarray
    ) -> np.ndarray:
        """Tell which of K cuts of silhouette edges are visible.

        A cut is hidden if the surfaces at both samples beside the cut are nearer
        than the edge.

        Args:
            cuts: The K cuts.
            samples: Indices of the covered samples before and after each cut, or
                NOT_COVERED, shape (2, K).
            surface_nearness: Nearness, at each cut, of the surfaces that the two
                samples show, shape (2, K).

        Returns:
            True for visible cuts, shape (K,).
        """
        tolerance = NEAR * np.ptp(self.nearness)
        start_nearness, end_nearness = self.nearness[self.ends[:, cuts.edge]]
        edge_nearness = start_nearness + cuts.fraction * (end_nearness - start_nearness)
        is_in_front = edge_nearness >= surface_nearness.min(axis=0) - tolerance
        return (samples >= 0).any(axis=0) & is_in_front

    def _surface_nearness(self, samples: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Compute the nearness of the faces beside K cuts, extended to the position of the cut.

        Args:
            samples: Indices of the covered samples before and after each cut, or
                NOT_COVERED, shape (2, K).
            place: Image position (x, y) of each cut in units of samples,
                shape (2, K).

        Returns:
            Nearness of the face that each sample shows, shape (2, K). It is minus
            infinity for NOT_COVERED.
        """
        sample_to_seen_face = self.fragments.sample_to_seen_face.numpy()
        # Vertices of the three corners, shape (2, K, 3). The index -1 (NOT_COVERED)
        # selects an arbitrary face, whose result is replaced at the end.
        corners = self.fragments.corners.numpy()[sample_to_seen_face[samples]]
        nearness_of_corners = self.nearness[corners]
        # x and y of the corners a, b and c, shape (2, K) each.
        (ax, bx, cx), (ay, by, cy) = np.moveaxis(self.places[:, corners], 3, 1)
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        # Dividing by infinity gives a face without area the nearness of corner a.
        area = np.where(area == 0, np.inf, area)
        # Barycentric weights of the corners b and c.
        weight_b = ((place[0] - ax) * (cy - ay) - (place[1] - ay) * (cx - ax)) / area
        weight_c = ((bx - ax) * (place[1] - ay) - (by - ay) * (place[0] - ax)) / area
        nearness_a = nearness_of_corners[..., 0]
        difference_b = nearness_of_corners[..., 1] - nearness_a
        difference_c = nearness_of_corners[..., 2] - nearness_a
        plane = nearness_a + weight_b * difference_b + weight_c * difference_c
        return np.where(samples >= 0, plane, -np.inf)


class _Cuts(NamedTuple):
    """K cuts: places where edges cross rows of samples, or columns of samples.

    A line is a row if rows are cut, and a column if columns are cut.

    Attributes:
        edge: Index of the edge of each cut, shape (K,).
        line: Index of the line of each cut, shape (K,).
        fraction: Position of the cut between the start (0) and the end (1) of
            the edge, shape (K,).
        next_sample: Index in the line of the first sample at or after the cut,
            shape (K,).
    """

    edge: np.ndarray
    line: np.ndarray
    fraction: np.ndarray
    next_sample: np.ndarray


def _cut_edges(
    start_across: np.ndarray,
    end_across: np.ndarray,
    start_along: np.ndarray,
    end_along: np.ndarray,
    resolution: int,
) -> _Cuts:
    """Find where N edges cross the lines of samples, which are rows or columns.

    Cuts before the first sample or after the last sample of a line are left out.
    All coordinates are in units of samples. Line i has the coordinate i.

    Args:
        start_across: Coordinate of the start of each edge across the lines,
            shape (N,).
        end_across: Coordinate of the end of each edge across the lines,
            shape (N,).
        start_along: Coordinate of the start along the lines, shape (N,).
        end_along: Coordinate of the end along the lines, shape (N,).
        resolution: Number of lines, and of samples in a line.

    Returns:
        Cuts in ascending order of the edge and then of the line.
    """
    # An edge crosses the lines from first_line to end_line - 1.
    lower = np.minimum(start_across, end_across)
    upper = np.maximum(start_across, end_across)
    first_line = np.ceil(lower).clip(0, resolution).astype(np.int64)
    end_line = np.ceil(upper).clip(0, resolution).astype(np.int64)
    cuts_per_edge = end_line - first_line
    # There is one entry for each pair of an edge and a line that the edge crosses. The lines
    # of an edge follow each other, from its first line on.
    edge = np.repeat(np.arange(len(start_across)), cuts_per_edge)
    cuts_before_edge = np.cumsum(cuts_per_edge) - cuts_per_edge
    line = np.arange(len(edge)) - (cuts_before_edge - first_line)[edge]
    # Fraction of the edge from its start to the cut, and coordinate of the cut along the line.
    fraction = (line - start_across[edge]) / (end_across - start_across)[edge]
    position = start_along[edge] + fraction * (end_along - start_along)[edge]
    next_sample = np.ceil(position).astype(np.int64)
    is_inside = (next_sample > 0) & (next_sample < resolution)
    return _Cuts(
        edge=edge[is_inside],
        line=line[is_inside],
        fraction=fraction[is_inside],
        next_sample=next_sample[is_inside],
    )


def _silhouette_edges(places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Find the edges of a mesh whose faces all lie on the same side of the edge in the image.

    Args:
        places: Image positions (x, y) of the vertices, shape (2, V).
        faces: Vertex indices of the faces, shape (F, 3).

    Returns:
        Vertices at both ends of the N silhouette edges, shape (2, N).
    """
    edges = _edges(np.ascontiguousarray(faces, dtype=np.int64).tobytes())
    # x and y of the corners a, b and c of each face, shape (F,) each.
    (ax, bx, cx), (ay, by, cy) = places.take(edges.corners, axis=1)
    orientation = np.sign((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    # 1 and -1 if the face lies on one or the other side of its edge. The direction of
    # an edge is from the lower to the higher vertex index.
    face_sides = (orientation * edges.direction).ravel()
    side_sums = np.bincount(edges.edge_of_face_side, face_sides, len(edges.face_count))
    # All faces lie on the same side if the sum is ± the number of faces. A face that is
    # seen edge-on counts 0, so one face of an edge may be missing in the sum.
    is_silhouette = np.abs(side_sums) > edges.face_count - 2
    return edges.ends.take(np.flatnonzero(is_silhouette), axis=1)


class _Edges(NamedTuple):
    """The N edges of a mesh with F faces.

    Each face has three sides. An edge is a side of one or more faces.

    Attributes:
        corners: Vertex indices of the three corners of each face, shape (3, F).
        ends: Vertices at both ends of each edge, the lower index first,
            shape (2, N).
        edge_of_face_side: Index of the edge for each side of each face, the
            first sides of all faces first, shape (3 F,).
        direction: 1 for sides of faces that lead from the lower to the higher
            vertex index, and -1 for other sides, shape (3, F).
        face_count: Number of faces at each edge, shape (N,).
    """

    corners: np.ndarray
    ends: np.ndarray
    edge_of_face_side: np.ndarray
    direction: np.ndarray
    face_count: np.ndarray


@lru_cache(maxsize=4)
def _edges(face_bytes: bytes) -> _Edges:
    """Find the edges of a mesh.

    Args:
        face_bytes: Bytes of an int64 array with the vertex indices of F faces,
            shape (F, 3). Bytes can be hashed, so that the result can be cached.

    Returns:
        Edges of the mesh.
    """
    faces = np.frombuffer(face_bytes, dtype=np.int64).reshape(-1, 3)
    corners = np.ascontiguousarray(faces.T)
    # Vertices at the starts and at the ends of the three sides, shape (3, F) each.
    start, end = corners.take(EDGES, axis=0).swapaxes(0, 1)
    low = np.minimum(start, end).ravel()
    high = np.maximum(start, end).ravel()
    vertex_count = int(high.max()) + 1
    # Sides with the same key are the same edge. np.unique sorts one number per side
    # faster than a pair of vertices.
    keys, edge_of_face_side, face_count = np.unique(
        low * vertex_count + high, return_inverse=True, return_counts=True
    )
    return _Edges(
        corners=corners,
        ends=np.stack(np.divmod(keys, vertex_count)),
        edge_of_face_side=edge_of_face_side.ravel(),
        direction=np.where(start < end, 1.0, -1.0),
        face_count=face_count,
    )
