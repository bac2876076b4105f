"""Gradients of images by the positions of surfaces and silhouettes in them.

`renderer.shading.shading` differentiates the shading of samples and holds fixed which
face a sample shows. This module adds the gradient that is missing there: of an
image by where the surfaces lie in it.

At a fixed position of the image, the radiance L changes by -v · ∇L as the
surface there moves with velocity v. Between neighboring samples i and j, ∇L is
the difference of their radiances, whether they show one surface or two
(Pidhorskyi et al. 2024, "Rasterized edge gradients"). If the surface moves by δ
samples from i toward j, a pixel of s² samples gains δ (L_i - L_j) / s². If i
and j lie in two pixels, each pixel gains half of this.

If a silhouette lies between i and j, δ is the movement of the silhouette (Li et
al. 2018), not of the surface beside it. When a ball turns, its points move but
its silhouette does not. Silhouette edges are the edges of the mesh whose faces
all lie on one side of them in the image. They are cut where they cross rows and
columns of samples. A line with unit normal n that moves by v moves along a row
by n · v / n_x. Cuts of rows have the weight n_x² and cuts of columns the weight
n_y², so that all cuts together have the length of the line.

The light is fixed: edges of shadows and of projected patterns stay on the
surface on which they lie.
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

# A silhouette is visible if it lies behind the surface beside it by at most
# this fraction of the depth of the mesh. An object that stands on another
# surface touches it there, and by rounding, or as it was modeled, the object's
# edge may lie slightly below this surface.
NEAR = 1e-3

# Index of samples that show no mesh.
NOT_COVERED = -1

# Axes of the image. Neighbors in a row differ along X.
X = 0
Y = 1


class Crossings(NamedTuple):
    """K places where a visible silhouette edge passes between two neighboring samples.

    If several silhouettes pass between the same two samples, only the one next
    to the sample that shows the farther surface is kept. No other silhouette
    hides it.

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
    """Return zeros whose gradient is the gradient of an image by the positions of surfaces.

    The zeros are to be added to the linear values of the P covered pixels and
    of E uncovered pixels into which silhouettes may move. The gradient reaches
    the vertices, and fields of the camera that are tensors.

    Args:
        fragments: Covered samples of the view.
        camera: Camera of the view.
        vertices: Vertices in world axes, shape (V, 3).
        faces: Vertex indices of the faces, shape (F, 3).
        radiance: Linear radiance at the covered samples, shape (3, S).
        background: Linear background of all pixels, shape (3, size²).

    Returns:
        A tuple of
        - row-major indices of the E uncovered pixels, shape (E,);
        - zeros for the P covered pixels and the E uncovered pixels,
          shape (3, P + E).
    """
    positions, nearness = camera.homogeneous(vertices.double())
    sample_indices = torch.arange(len(fragments.sample), dtype=torch.int32, device=vertices.device)
    sample_grid = fragments.image_of_samples(sample_indices, NOT_COVERED)
    on_cpu = _find_crossings(
        fragments.to("cpu"),
        _to_numpy(positions),
        _to_numpy(nearness),
        faces=_to_numpy(faces),
        sample_grid=_to_numpy(sample_grid),
    )
    crossings = Crossings(*(values.to(sample_grid.device) for values in on_cpu))
    is_touched = torch.zeros(fragments.size**2, dtype=torch.bool, device=sample_grid.device)
    is_touched.index_fill_(0, _pixels_of_cells(crossings.cells, fragments).flatten(), True)
    is_touched.index_fill_(0, fragments.pixels, False)
    uncovered_pixels = is_touched.nonzero().squeeze(1)
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
    """Return the values of a tensor as a NumPy array."""
    return tensor.detach().cpu().numpy()


class _ZerosWithGradient(torch.autograd.Function):
    """Zeros (3, P + E) with a gradient by the homogeneous positions (V, 3) of the vertices."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, view: _MovingView) -> Tensor:
        """Return zeros and store what the gradient needs.

        Args:
            ctx: Context of autograd.
            positions: Homogeneous positions (x w, y w, w) of the vertices in
                the image, shape (V, 3).
            view: View whose gradient `backward` computes.

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
            upstream: Gradient by the linear values of the pixels,
                shape (3, P + E).

        Returns:
            Gradient, shape (V, 3), and None for the view.
        """
        (positions,) = ctx.saved_tensors
        view: _MovingView = ctx.view
        # A length of 2 is the width of the image, which has size · s samples.
        # A sample has 1 / s² of the area of its pixel.
        upstream = upstream * (view.fragments.size / 4 / view.fragments.samples)
        gradient = view.gradient_by_surface(positions, upstream)
        ends, gradient_by_ends = view.gradient_by_silhouettes(positions, upstream)
        return gradient.index_add_(0, ends, gradient_by_ends), None


@dataclass(frozen=True)
class _MovingView:
    """View whose image is differentiated by the positions of surfaces.

    Attributes:
        fragments: The S covered samples in P pixels.
        crossings: Places where silhouettes pass between samples.
        sample_grid: Index of the covered sample at each sample of the image,
            or NOT_COVERED, shape (size · s, size · s).
        uncovered_pixels: Row-major indices of the E other pixels whose values
            change, shape (E,).
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
        """Compute the gradient by the positions of surfaces, without silhouettes.

        A force is the gradient by the position of a sample in the image.

        Args:
            positions: Homogeneous positions of the vertices, shape (V, 3).
            upstream: Gradient by the linear values of pixels, shape (3, P + E).

        Returns:
            Gradient by the homogeneous positions, shape (V, 3).
        """
        fragments = self.fragments
        at_samples = upstream.index_select(1, fragments.pixel)
        weighted = (self.radiance * at_samples).sum(0)
        weighted_image = fragments.image_of_samples(weighted, torch.nan)
        right = self._forces_along(X, weighted_image, at_samples)
        down = self._forces_along(Y, weighted_image, at_samples)
        # Most samples have neighbors of the same color, and therefore no force.
        moving = torch.nonzero((right != 0) | (down != 0)).squeeze(1)
        part = fragments.select(moving)
        forces = torch.stack([right.index_select(0, moving), -down.index_select(0, moving)]).T
        if fragments.depths is not None:
            depth = part.interpolate(positions[:, 2:][part.corners])
            forces = _by_homogeneous(forces, part.positions(), depth)
        # Shape (2 or 3, 3 G), for the coordinates and the corners of seen faces.
        by_corners = part.distribute(forces).permute(2, 1, 0).flatten(1).double()
        gradient = positions.new_zeros(positions.shape[::-1])
        gradient[: forces.shape[1]].index_add_(1, part.corners.T.flatten(), by_corners)
        return gradient.T

    def _forces_along(self, axis: int, weighted_image: Tensor, at_samples: Tensor) -> Tensor:
        """Compute the gradient by the positions of samples along one axis of the image.

        Args:
            axis: X for movements to the right, or Y for movements down.
            weighted_image: Radiance times upstream gradient, summed over
                channels, as an image of samples, NaN for samples that show no
                mesh, shape (size · s, size · s).
            at_samples: Upstream gradient at the covered samples, shape (3, S).

        Returns:
            Gradient by the position of each covered sample, shape (S,).
        """
        dim = 1 - axis
        steps = len(self.sample_grid) - 1
        # Difference of each sample and the next one along the axis.
        jump = torch.zeros_like(weighted_image)
        torch.sub(
            weighted_image.narrow(dim, 0, steps),
            weighted_image.narrow(dim, 1, steps),
            out=jump.narrow(dim, 0, steps),
        )
        # The difference is NaN if one of the two samples shows no mesh.
        jump.nan_to_num_(0)
        self._correct_borders(dim, jump, at_samples)
        # Silhouettes have a gradient of their own.
        is_along_axis = self.crossings.horizontal == (axis == X)
        jump.view(-1).index_fill_(0, self.crossings.cells[0, is_along_axis], 0)
        # Each sample gets the jumps to both of its neighbors.
        force = jump.clone()
        force.narrow(dim, 1, steps).add_(jump.narrow(dim, 0, steps))
        return self.fragments.of_image(force)

    def _correct_borders(self, dim: int, jump: Tensor, at_samples: Tensor) -> None:
        """Replace the jumps across borders of pixels in place.

        The upstream gradient differs between the two pixels. The difference of
        the radiances is multiplied by the mean of both.
        """
        samples = self.fragments.samples
        before: Any = (slice(None), slice(samples - 1, -1, samples))
        after: Any = (slice(None), slice(samples, None, samples))
        if dim == 0:
            before = before[::-1]
            after = after[::-1]
        grid = self.sample_grid
        is_covered = (grid[before] >= 0) & (grid[after] >= 0)
        first = grid[before][is_covered]
        second = grid[after][is_covered]
        both = at_samples.index_select(1, first) + at_samples.index_select(1, second)
        difference = self.radiance.index_select(1, first) - self.radiance.index_select(1, second)
        jump[before].masked_scatter_(is_covered, (difference * both).sum(0) / 2)

    def gradient_by_silhouettes(self, positions: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the gradient by the positions of the ends of silhouette edges.

        A force is the gradient by the position of an edge in the image.

        Args:
            positions: Homogeneous positions of the vertices, shape (V, 3).
            upstream: Gradient by the linear values of pixels, shape (3, P + E).

        Returns:
            A tuple of
            - the vertices at the ends of the K edges, shape (2 K,);
            - the gradient by their homogeneous positions, shape (2 K, 3).
        """
        crossings = self.crossings
        # Image rows run down.
        along = torch.where(crossings.horizontal, crossings.normal[0], -crossings.normal[1])
        forces = (self._silhouette_forces(upstream) * along * crossings.normal).T
        weights = (1 - crossings.fraction, crossings.fraction)
        gradients = []
        for ends, weight in zip(crossings.ends, weights, strict=True):
            x, y, depth = positions[ends].T
            place = torch.stack([x / depth, y / depth], dim=1)
            gradients.append(_by_homogeneous(forces * weight[:, None], place, depth[:, None]))
        return crossings.ends.flatten(), torch.cat(gradients)

    def _silhouette_forces(self, upstream: Tensor) -> Tensor:
        """Compute the gradient by the movement of silhouettes across samples, shape (K,)."""
        pixels = _pixels_of_cells(self.crossings.cells, self.fragments)
        # Column in `upstream` of each pixel of the image, or -1.
        column_of_pixel = torch.full((self.fragments.size**2,), -1, device=pixels.device)
        changed_pixels = torch.cat([self.fragments.pixels, self.uncovered_pixels])
        column_of_pixel[changed_pixels] = torch.arange(upstream.shape[1], device=pixels.device)
        force = self.radiance.new_zeros(pixels.shape[1])
        first_samples, second_samples = self.crossings.samples
        # The two samples may lie in two pixels, which gain half each.
        for pixels_of_side in pixels:
            first = self._seen_radiance(first_samples, pixels_of_side)
            second = self._seen_radiance(second_samples, pixels_of_side)
            gradient = upstream[:, column_of_pixel[pixels_of_side]]
            force += (gradient * (first - second)).sum(0)
        return force

    def _seen_radiance(self, samples: Tensor, pixels: Tensor) -> Tensor:
        """Return the radiance at K samples, or the background of K pixels if they show no mesh."""
        return torch.where(samples >= 0, self.radiance[:, samples], self.background[:, pixels])


def _by_homogeneous(forces: Tensor, places: Tensor, depth: Tensor) -> Tensor:
    """Convert gradients by positions in the image to gradients by homogeneous positions.

    Args:
        forces: Gradients by the positions (x, y), shape (N, 2).
        places: Positions (x, y) in the image, shape (N, 2).
        depth: Third homogeneous coordinate w, shape (N, 1).

    Returns:
        Gradients by (x w, y w, w), shape (N, 3).
    """
    return torch.cat([forces, -(forces * places).sum(1, keepdim=True)], dim=1) / depth


def _pixels_of_cells(cells: Tensor, fragments: Fragments) -> Tensor:
    """Return the row-major indices of the pixels that hold samples at row-major positions."""
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
        fragments: Covered samples, with tensors on the CPU.
        positions: Homogeneous positions of the vertices, shape (V, 3).
        nearness: Nearness of the vertices to the camera, which is linear in the
            image, shape (V,).
        faces: Vertex indices of all faces, shape (F, 3).
        sample_grid: Index of the covered sample at each sample of the image, or
            NOT_COVERED, shape (size · s, size · s).

    Returns:
        Crossings in rows, and then in columns.
    """
    x, y, w = positions.T
    points = np.stack([x / w, y / w, nearness]).T
    # Positions in units of samples, x to the right and y down, shape (2, V).
    places = to_fixed_point(points, len(sample_grid))[0] / SUBSAMPLES
    ends = _silhouette_edges(places, faces)
    if len(fragments.face) == 0:
        # A mesh outside the image has no visible silhouettes.
        ends = ends[:, :0]
    start = places[:, ends[0]]
    end = places[:, ends[1]]
    # The normal is in an image whose y-axis points up.
    normal = np.stack([end[1] - start[1], end[0] - start[0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1 / SUBSAMPLES)
    silhouettes = _Silhouettes(fragments, places, nearness, sample_grid, ends, normal)
    in_rows = silhouettes.crossings_along(X)
    in_columns = silhouettes.crossings_along(Y)
    joined = [np.concatenate(pair, axis=-1) for pair in zip(in_rows, in_columns, strict=True)]
    return Crossings(*map(torch.from_numpy, joined))


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
        cuts = _cut(start[1 - axis], end[1 - axis], start[axis], end[axis], resolution)
        edge = cuts.edge
        # Row-major positions of the samples after and before each cut.
        if axis == X:
            after = cuts.line * resolution + cuts.next_sample
            before = after - 1
        else:
            after = cuts.next_sample * resolution + cuts.line
            before = after - resolution
        cells = np.stack([before, after])
        samples = self.sample_grid.ravel()[cells].astype(np.int64)
        place = start[:, edge] + cuts.fraction * (end - start)[:, edge]
        surface_nearness = self._surface_nearness(samples, place)
        is_visible = self._is_visible(cuts, samples, surface_nearness)
        # This coordinate grows with the distance from the farther sample.
        from_farther = np.where(surface_nearness[0] < surface_nearness[1], 1, -1) * place[axis]
        kept = np.flatnonzero(is_visible)
        kept = kept[np.lexsort([from_farther[kept], after[kept]])]
        # If several cuts lie between the same two samples, the first one is kept.
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
        """Tell which cuts are visible.

        A cut is hidden if the surfaces at both samples beside it are nearer.

        Args:
            cuts: K cuts of the silhouette edges.
            samples: Covered samples beside each cut, shape (2, K).
            surface_nearness: Nearness of their surfaces at the cut,
                shape (2, K).

        Returns:
            True for visible cuts, shape (K,).
        """
        tolerance = NEAR * np.ptp(self.nearness)
        start_nearness, end_nearness = self.nearness[self.ends[:, cuts.edge]]
        edge_nearness = start_nearness + cuts.fraction * (end_nearness - start_nearness)
        is_in_front = edge_nearness >= surface_nearness.min(axis=0) - tolerance
        return (samples >= 0).any(axis=0) & is_in_front

    def _surface_nearness(self, samples: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Compute the nearness of the planes of faces at places in the image.

        Args:
            samples: Covered samples that show the faces, or NOT_COVERED,
                shape (2, K).
            place: Positions at which the planes are evaluated, in units of
                samples, shape (2, K).

        Returns:
            Nearness, shape (2, K). It is minus infinity for NOT_COVERED.
        """
        sample_to_seen_face = self.fragments.face.numpy()
        corners = self.fragments.corners.numpy()[sample_to_seen_face[samples]]
        nearness_of_corners = self.nearness[corners]
        (ax, bx, cx), (ay, by, cy) = np.moveaxis(self.places[:, corners], 3, 1)
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        # Faces without area get the nearness of their first corner.
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
    """K places where edges cross rows of samples, or columns of samples.

    A line stands for a row or a column.

    Attributes:
        edge: Index of the edge, shape (K,).
        line: Index of the line, shape (K,).
        fraction: Position between start and end of the edge, from 0 to 1,
            shape (K,).
        next_sample: Index in the line of the first sample at or after the
            place, shape (K,).
    """

    edge: np.ndarray
    line: np.ndarray
    fraction: np.ndarray
    next_sample: np.ndarray


def _cut(
    start: np.ndarray, end: np.ndarray, across: np.ndarray, end_across: np.ndarray, resolution: int
) -> _Cuts:
    """Cut edges at each line of samples between their starts and ends.

    Cuts before the first sample or after the last sample of a line are left
    out. All coordinates are in units of samples.

    Args:
        start: Coordinate of the start of N edges across the lines, shape (N,).
        end: Coordinate of their ends across the lines, shape (N,).
        across: Coordinate of their starts along the lines, shape (N,).
        end_across: Coordinate of their ends along the lines, shape (N,).
        resolution: Number of lines, and of samples in a line.

    Returns:
        Cuts in ascending order of the edge and then of the line.
    """
    first = np.ceil(np.minimum(start, end)).clip(0, resolution).astype(np.int64)
    last = np.ceil(np.maximum(start, end)).clip(0, resolution).astype(np.int64)
    counts = last - first
    edge = np.repeat(np.arange(len(start)), counts)
    cuts_before_edge = np.cumsum(counts) - counts
    line = np.arange(len(edge)) - (cuts_before_edge - first)[edge]
    fraction = (line - start[edge]) / (end - start)[edge]
    position = across[edge] + fraction * (end_across - across)[edge]
    next_sample = np.ceil(position).astype(np.int64)
    is_inside = (next_sample > 0) & (next_sample < resolution)
    return _Cuts(
        edge=edge[is_inside],
        line=line[is_inside],
        fraction=fraction[is_inside],
        next_sample=next_sample[is_inside],
    )


def _silhouette_edges(places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Find the edges whose faces all lie on one side of them in the image.

    Args:
        places: Positions of the vertices in the image, shape (2, V).
        faces: Vertex indices of the faces, shape (F, 3).

    Returns:
        Vertices at both ends of the N silhouette edges, shape (2, N).
    """
    edges = _edges(np.ascontiguousarray(faces, dtype=np.int64).tobytes())
    (ax, bx, cx), (ay, by, cy) = places.take(edges.corners, axis=1)
    orientation = np.sign((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    # A face lies to the left (+1) or to the right (-1) of its sides.
    sides = (orientation * edges.direction).ravel()
    sum_of_sides = np.bincount(edges.edge_of_side, sides, len(edges.face_count))
    # A face that is seen edge-on is on neither side. One of two faces may be.
    is_silhouette = np.abs(sum_of_sides) > edges.face_count - 2
    return edges.ends.take(np.flatnonzero(is_silhouette), axis=1)


class _Edges(NamedTuple):
    """N edges of a mesh of F faces.

    Attributes:
        corners: Vertices of the faces, shape (3, F).
        ends: Vertices at both ends of each edge, the lower index first,
            shape (2, N).
        edge_of_side: Edge of each of the three sides of the faces,
            shape (3 F,).
        direction: 1 for sides that lead to the vertex with the higher index,
            and -1 for the others, shape (3, F).
        face_count: Number of faces at each edge, shape (N,).
    """

    corners: np.ndarray
    ends: np.ndarray
    edge_of_side: np.ndarray
    direction: np.ndarray
    face_count: np.ndarray


@lru_cache(maxsize=4)
def _edges(faces: bytes) -> _Edges:
    """Find the edges of faces (F, 3), given as the bytes of int64 numbers so that they hash."""
    corners = np.ascontiguousarray(np.frombuffer(faces, dtype=np.int64).reshape(-1, 3).T)
    # Shape (3, F), for the first and the second vertex of the three sides.
    first, second = corners.take(EDGES, axis=0).swapaxes(0, 1)
    low = np.minimum(first, second).ravel()
    high = np.maximum(first, second).ravel()
    vertex_count = int(high.max()) + 1
    # np.unique sorts one number per side faster than a pair of vertices.
    keys, edge_of_side, face_count = np.unique(
        low * vertex_count + high, return_inverse=True, return_counts=True
    )
    return _Edges(
        corners=corners,
        ends=np.stack(np.divmod(keys, vertex_count)),
        edge_of_side=edge_of_side.ravel(),
        direction=np.where(first < second, 1.0, -1.0),
        face_count=face_count,
    )
