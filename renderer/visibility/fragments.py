"""Surface samples that a camera sees of a mesh, found once by rasterization.

An image of size² pixels has s² samples per pixel, where s is
`Fragments.samples`. The samples that show the mesh are kept in `Fragments`,
with the pixel and the face of each. They stay fixed while the lighting, the
albedo or the vertex positions are differentiated.

Shapes use these letters: a view has S covered samples in P pixels, and they
show G of the F faces of the mesh.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from renderer.camera import Camera
from renderer.errors import require_finite
from renderer.settings import ImageSettings
from renderer.visibility.rasterizers import Rasterizer

# Number of samples that loops process at once, so that their values stay in
# the cache of the processor.
BLOCK = 2**14

# Name of the cached property `Fragments.barycentric`.
_WEIGHTS = "barycentric"


class Runs(NamedTuple):
    """R runs of neighboring samples that show one face in one pixel.

    The runs have the order of the samples.

    Attributes:
        pixel: Index into `Fragments.pixels` of each run, ascending, int64,
            shape (R,).
        face: Index into `Fragments.faces` of each run, int64, shape (R,).
        sample_count: Number of samples in each run, int64, shape (R,).
    """

    pixel: Tensor
    face: Tensor
    sample_count: Tensor


@dataclass(frozen=True)
class Fragments:
    """The S samples of an image that show a mesh, with their pixels and faces.

    The samples of a pixel are neighbors in all tensors of shape (S,).

    Attributes:
        size: Width and height of the image in pixels.
        samples: Number of samples along one side of a pixel.
        pixels: Row-major indices of the P pixels with covered samples,
            ascending, int64, shape (P,). Row 0 is the top of the image.
        coverage: Fraction of the samples of each pixel that show the mesh, in
            (0, 1], float64, shape (P,).
        faces: Indices in the mesh of the G faces that samples show, ascending,
            int64, shape (G,).
        corners: Indices of the three vertices of each seen face, int64,
            shape (G, 3).
        facing: -1 for seen faces that the camera sees from behind, and 1 for
            the others, float64, shape (G, 1).
        outlines: Projected corners of each seen face, x to the right and y up,
            with the image in [-1, 1], float64, shape (G, 3, 2).
        pixel: Index into `pixels` of each sample, int64, shape (S,).
        face: Index into `faces` of each sample, int64, shape (S,).
        sample: Position of each sample among all samples of the image, int64,
            shape (S,). Positions count pixel by pixel, and row by row within a
            pixel.
        depths: Depths of the corners of seen faces (see `Camera.depths`),
            float64, shape (G, 3). None without perspective.
        camera: Camera of the view. None if the samples come from no camera.
    """

    size: int
    samples: int
    pixels: Tensor
    coverage: Tensor
    faces: Tensor
    corners: Tensor
    facing: Tensor
    outlines: Tensor
    pixel: Tensor
    face: Tensor
    sample: Tensor
    depths: Tensor | None = None
    camera: Camera | None = None

    @property
    def eye(self) -> Tensor:
        """Position of the camera or direction to it, see `Camera.eye`. Zeros without a camera."""
        if self.camera is None:
            return torch.zeros(4)
        return torch.from_numpy(self.camera.eye())

    @cached_property
    def barycentric(self) -> Tensor:
        """Barycentric weights of the three corners at each sample, float64, shape (S, 3).

        They are computed from unrounded corners, but the rasterizer rounds
        corners. A sample may therefore lie slightly outside its face, and its
        weights are clipped at 0.

        In a perspective image, a function that is linear on a face is a
        quotient of two linear functions of the image position (Heckbert and
        Moreton 1991). The weights are therefore divided by the depths of the
        corners and normalized.
        """
        # Shape (2, 3, G), for x and y, and three corners.
        outlines = self.outlines.permute(2, 1, 0)
        # The edges b and c lead from the first corner to the other two corners.
        edges = outlines[:, 1:] - outlines[:, :1]
        (bx, cx), (by, cy) = edges
        area = bx * cy - cx * by
        edges_by_area = edges / area.masked_fill(area == 0, 1)
        # Rows x₀ and y₀ of the first corner, and bx, cx, by and cy over the
        # area, shape (6, G).
        face_values = torch.cat([outlines[:, 0], edges_by_area.flatten(0, 1)])
        nearness = None if self.depths is None else self.depths.T.reciprocal()
        weights = face_values.new_empty(3, len(self.face))
        for weight, face, position in _blocks(weights, self.face, self.positions().T):
            # gather takes a third of the time of index_select.
            x0, y0, bx, cx, by, cy = face_values.gather(1, face.expand(len(face_values), -1))
            x = position[0] - x0
            y = position[1] - y0
            weight[1] = x * cy - y * cx
            weight[2] = y * bx - x * by
            weight[0] = 1 - weight[1] - weight[2]
            weight.clamp_(0, 1)
            if nearness is not None:
                weight.mul_(nearness.gather(1, face.expand(3, -1)))
            weight.div_(weight.sum(0))
        return weights.T

    def positions(self) -> Tensor:
        """Compute the positions of the samples in the image.

        Returns:
            x to the right and y up, with the image in [-1, 1], float64,
            shape (S, 2).
        """
        # Floating-point numbers are divided in a tenth of the time of integers.
        pixel, within_pixel = _divide(self.sample.double(), self.samples**2)
        pixel_row, pixel_column = _divide(pixel, self.size)
        row_within, column_within = _divide(within_pixel, self.samples)
        resolution = self.size * self.samples
        column = pixel_column * self.samples + column_within
        row = pixel_row * self.samples + row_within
        # Samples are the centers of cells of width 2 / resolution.
        return torch.stack([2 * column + 1, 2 * (resolution - row) - 1]).T / resolution - 1

    def by_sample(self) -> "Fragments":
        """Return the same samples as pixels of a finer image.

        Returns:
            Samples in the same order, for an image with size · s pixels per
            side and one sample per pixel.
        """
        resolution = self.size * self.samples
        # Row-major position of each sample among all samples of the image,
        # shape (size, s, size, s), for the row and column of a pixel and of a
        # sample in it.
        cells = torch.arange(resolution**2, device=self.sample.device)
        cells = cells.view(self.size, self.samples, self.size, -1)
        position = cells.transpose(1, 2).flatten().index_select(0, self.sample)
        finer = replace(
            self,
            size=resolution,
            samples=1,
            pixels=position,
            coverage=self.coverage.new_ones(len(position)),
            pixel=torch.arange(len(position), device=position.device),
            sample=position,
        )
        return self._share_weights(finer, slice(None))

    def select(self, samples: Tensor) -> "Fragments":
        """Return some of the samples, in the same pixels.

        Args:
            samples: Indices of the N samples to keep, shape (N,).

        Returns:
            Copy whose `pixel`, `face` and `sample` have N entries.
        """
        selected = replace(
            self,
            pixel=self.pixel.index_select(0, samples),
            face=self.face.index_select(0, samples),
            sample=self.sample.index_select(0, samples),
        )
        return self._share_weights(selected, samples)

    def _share_weights(self, view: "Fragments", samples: Tensor | slice) -> "Fragments":
        """Give a view of some of these samples their barycentric weights if they are known."""
        if _WEIGHTS in vars(self):
            vars(view)[_WEIGHTS] = self.barycentric[samples]
        return view

    def image_of_samples(self, values: Tensor, empty: float) -> Tensor:
        """Arrange values at samples as an image with one pixel per sample.

        Args:
            values: Value of each covered sample, shape (S,).
            empty: Value of samples that show no mesh.

        Returns:
            Image of samples, shape (size · s, size · s). Row 0 is at the top.
        """
        image = values.new_full((self.size**2 * self.samples**2,), empty)
        image.index_copy_(0, self.sample, values)
        # Rows of pixels and columns of pixels, then rows and columns of samples.
        by_pixel = image.view(self.size, self.size, self.samples, self.samples)
        return by_pixel.transpose(1, 2).reshape(self.size * self.samples, -1)

    def of_image(self, image: Tensor) -> Tensor:
        """Read an image with one pixel per sample at the covered samples.

        This is the inverse of `image_of_samples`.

        Args:
            image: Image of samples, shape (size · s, size · s).

        Returns:
            Values of the covered samples, shape (S,).
        """
        by_row = image.view(self.size, self.samples, self.size, self.samples)
        return by_row.transpose(1, 2).flatten().index_select(0, self.sample)

    def interpolate(self, corners: Tensor) -> Tensor:
        """Interpolate values of face corners at the samples.

        The result is differentiable with respect to `corners`.

        Args:
            corners: D values for each of the three corners of the seen faces,
                shape (G, 3, D).

        Returns:
            Values at the samples, shape (S, D).
        """
        rows = corners.permute(1, 2, 0).flatten(0, 1).contiguous()
        return _Interpolation.apply(rows, self.face, self.barycentric.T).T

    def distribute(self, values: Tensor) -> Tensor:
        """Add values at samples to the corners of their faces.

        Each value is weighted with the barycentric weight of the corner. This
        is the transpose of `interpolate`.

        Args:
            values: D values for each sample, shape (S, D).

        Returns:
            Weighted sums for the three corners of the seen faces,
            shape (G, 3, D).
        """
        shape = (3 * values.shape[1], len(self.faces))
        rows = _distribute(values.T, self.face, self.barycentric.T, shape)
        return rows.unflatten(0, (3, -1)).permute(2, 0, 1)

    def merge(self, albedo: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Join neighboring samples that show one face in one pixel into runs.

        The samples of a run share a normal if normals are flat. Shading one run
        then replaces shading its samples.

        Args:
            albedo: C values of albedo for each sample, shape (S, C). The result
                is differentiable with respect to it.

        Returns:
            A tuple of
            - the index into `pixels` of each of R runs, shape (R,);
            - the index into `faces` of each run, shape (R,);
            - the albedo summed over the samples of each run and divided by the
              number of samples in a pixel, shape (R, C).
        """
        if self.samples == 1 or len(self.pixel) == 0:
            return self.pixel, self.face, albedo
        runs = self.runs
        sample_count = runs.sample_count.cpu().numpy()
        # NumPy repeats in a quarter of the time of torch.
        run_of_sample = np.repeat(np.arange(len(sample_count)), sample_count)
        scaled = albedo.T / self.samples**2
        zeros = albedo.new_zeros(albedo.shape[1], len(sample_count))
        summed = zeros.index_add(1, torch.from_numpy(run_of_sample).to(albedo.device), scaled)
        return runs.pixel, runs.face, summed.T

    @cached_property
    def runs(self) -> Runs:
        """Runs of neighboring samples that show one face in one pixel."""
        # The additional last entry marks the end of all samples.
        is_start = torch.ones(len(self.pixel) + 1, dtype=torch.bool, device=self.pixel.device)
        torch.ne(self.pixel[1:], self.pixel[:-1], out=is_start[1:-1])
        is_start[1:-1] |= self.face[1:] != self.face[:-1]
        # NumPy finds the starts in a quarter of the time of torch.
        found = np.flatnonzero(is_start.cpu().numpy())
        starts = torch.from_numpy(found).to(self.pixel.device)
        return Runs(
            pixel=self.pixel.index_select(0, starts[:-1]),
            face=self.face.index_select(0, starts[:-1]),
            sample_count=starts.diff(),
        )

    def to(self, device: torch.device | str) -> "Fragments":
        """Return a copy with all tensors on a device.

        Args:
            device: Device for the tensors.

        Returns:
            The same samples with tensors on `device`.
        """
        moved: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                moved[field.name] = value.to(device)
        return replace(self, **moved)


class _Interpolation(torch.autograd.Function):
    """Interpolation of corner values at samples, in blocks of samples.

    Corner values have shape (3 D, G) with all values of the first corner first.
    Values at samples have shape (D, S).
    """

    @staticmethod
    def forward(ctx: Any, corners: Tensor, face: Tensor, weights: Tensor) -> Tensor:
        """Interpolate the values of the corners at each sample.

        Args:
            ctx: Context of autograd.
            corners: Values of the corners of the seen faces, shape (3 D, G).
            face: Index of the seen face at each sample, shape (S,).
            weights: Barycentric weights of each sample, shape (3, S).

        Returns:
            Values at the samples, shape (D, S).
        """
        ctx.save_for_backward(face, weights)
        ctx.corners_shape = corners.shape
        values = corners.new_empty(len(corners) // 3, len(face))
        for value, index, weight in _blocks(values, face, weights):
            # Shape (3, D, samples of the block).
            at_corners = corners.gather(1, index.expand(len(corners), -1)).unflatten(0, (3, -1))
            torch.sum(at_corners.mul_(weight[:, None]), 0, out=value)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        """Distribute the gradient by the values to the corners.

        Args:
            ctx: Context of autograd.
            upstream: Gradient by the values at the samples, shape (D, S).

        Returns:
            Gradient by the values of the corners, shape (3 D, G), and None for
            the other arguments of `forward`.
        """
        face, weights = ctx.saved_tensors
        return _distribute(upstream, face, weights, ctx.corners_shape), None, None


def _distribute(
    values: Tensor, face: Tensor, weights: Tensor, corners_shape: Sequence[int]
) -> Tensor:
    """Add weighted values of samples to the corners of their faces.

    Args:
        values: D values for each sample, shape (D, S).
        face: Index of the seen face at each sample, shape (S,).
        weights: Barycentric weights of each sample, shape (3, S).
        corners_shape: Shape (3 D, G) of the result.

    Returns:
        Sums for the corners of the seen faces, with all values of the first
        corner first, shape (3 D, G).
    """
    at_corners = values.new_zeros(corners_shape)
    for value, index, weight in _blocks(values, face, weights.to(values)):
        at_corners.index_add_(1, index, (weight[:, None] * value).flatten(0, 1))
    return at_corners


def _blocks(*tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Split tensors along their last axis into views of BLOCK samples."""
    return zip(*(tensor.split(BLOCK, dim=-1) for tensor in tensors), strict=True)


def _divide(numbers: Tensor, divisor: int) -> tuple[Tensor, Tensor]:
    """Divide whole floating-point numbers, and return the quotients and the remainders."""
    quotient = (numbers / divisor).floor()
    return quotient, numbers - quotient * divisor


def build_fragments(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: Sequence[Camera],
    settings: ImageSettings,
    rasterizer: Rasterizer,
    closed: bool = False,
) -> list[Fragments]:
    """Rasterize a mesh once for each camera.

    Args:
        vertices: Vertex positions in world axes, float64, shape (V, 3).
        faces: Indices of the three vertices of each face, shape (F, 3).
        cameras: Cameras of the N views.
        settings: Size of the images and number of samples per pixel side.
        rasterizer: Rasterizer to use.
        closed: True promises that the mesh is watertight and that its faces are
            counter-clockwise seen from outside (see `Mesh.closed`). Faces that
            are seen from behind are then not drawn, unless the near plane cuts
            the mesh open.

    Returns:
        Samples that show the mesh, for each camera. A mesh outside the image
        has no samples.

    Raises:
        InputError: If `vertices` holds NaN or infinite values, or if the mesh
            reaches a perspective camera.
    """
    require_finite(vertices=torch.from_numpy(vertices))
    # Each coordinate is contiguous in memory, shape (N, 3, V).
    coordinates = np.stack([camera.project(vertices).T for camera in cameras])
    projected = coordinates.swapaxes(1, 2)
    # The third coordinate is -1 at the near plane.
    is_uncut = bool((projected[..., 2] >= -1).all())
    face_ids = rasterizer.rasterize(
        projected, faces, settings.size * settings.samples, closed=closed and is_uncut
    )
    views = []
    for camera, points, ids in zip(cameras, projected, face_ids, strict=True):
        depths = camera.depths(vertices)
        views.append(_fragments(camera, points, depths, ids, faces, settings))
    return views


class _CoveredSamples(NamedTuple):
    """Covered samples of one view, and their pixels.

    Attributes:
        pixels: Row-major indices of the pixels with covered samples, shape (P,).
        counts: Number of covered samples in each of these pixels, shape (P,).
        pixel: Index into `pixels` of each sample, shape (S,).
    """

    pixels: np.ndarray
    counts: np.ndarray
    pixel: np.ndarray


def _fragments(
    camera: Camera,
    projected: np.ndarray,
    depths: np.ndarray | None,
    ids: np.ndarray,
    faces: np.ndarray,
    settings: ImageSettings,
) -> Fragments:
    """Gather the covered samples of one rasterized view.

    Args:
        camera: Camera of the view.
        projected: Vertices as `Camera.project` returns them, shape (V, 3).
        depths: Depths of the vertices, shape (V,). None without perspective.
        ids: Face of each sample of the image or -1, shape (size · s, size · s).
        faces: Vertex indices of all faces, shape (F, 3).
        settings: Size of the image and number of samples per pixel side.

    Returns:
        Samples that show the mesh.
    """
    size = settings.size
    samples = settings.samples
    # The s samples of a pixel in one row are moved as one item.
    row_of_pixel = ids.view(f"V{samples * ids.itemsize}").reshape(size, samples, size)
    ids_by_pixel = row_of_pixel.swapaxes(1, 2).reshape(-1).view(ids.dtype)
    sample = np.flatnonzero(ids_by_pixel >= 0)
    seen_faces, sample_to_seen_face = _compact(ids_by_pixel[sample], len(faces))
    covered = _pixels_of_samples(sample, size, samples)
    # All first corners are contiguous in memory, since they are read together,
    # shape (3, G).
    corners = np.ascontiguousarray(faces.take(seen_faces, axis=0).T)
    # Shape (2, 3, G).
    outlines = projected[:, :2].T.take(corners, axis=1)
    (ax, bx, cx), (ay, by, cy) = outlines
    # The projected corners of a face that is seen from behind are clockwise.
    is_behind = (bx - ax) * (cy - ay) < (cx - ax) * (by - ay)
    return Fragments(
        size=size,
        samples=samples,
        pixels=torch.from_numpy(covered.pixels),
        coverage=torch.from_numpy(covered.counts / samples**2),
        faces=torch.from_numpy(seen_faces),
        corners=torch.from_numpy(corners).T,
        facing=torch.from_numpy(np.where(is_behind, -1.0, 1.0))[:, None],
        outlines=torch.from_numpy(outlines.T),
        pixel=torch.from_numpy(covered.pixel),
        face=torch.from_numpy(sample_to_seen_face),
        sample=torch.from_numpy(sample),
        depths=None if depths is None else torch.from_numpy(depths.take(corners)).T,
        camera=camera,
    )


def _pixels_of_samples(sample: np.ndarray, size: int, samples: int) -> _CoveredSamples:
    """Find the pixels with covered samples, from the positions of these samples (S,)."""
    if samples == 1:
        # A sample is a pixel.
        return _CoveredSamples(
            pixels=sample,
            counts=np.ones(len(sample), dtype=np.int64),
            pixel=np.arange(len(sample)),
        )
    counts_of_all = np.bincount(sample // samples**2, minlength=size**2)
    pixels = np.flatnonzero(counts_of_all > 0)
    counts = counts_of_all[pixels]
    return _CoveredSamples(
        pixels=pixels,
        counts=counts,
        pixel=np.repeat(np.arange(len(pixels)), counts),
    )


def _compact(values: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the distinct values, and the index of each value among them, as np.unique does.

    This takes less time than np.unique because it does not sort.

    Args:
        values: Whole numbers in [0, limit), shape (S,).
        limit: Upper limit of the values.

    Returns:
        A tuple of
        - the G distinct values, ascending, shape (G,);
        - the index of each value among the distinct values, shape (S,).
    """
    # One conversion here replaces one in each of the two lookups below.
    values = values.astype(np.intp)
    is_present = np.zeros(limit, dtype=bool)
    is_present[values] = True
    distinct = np.flatnonzero(is_present)
    # Entries of absent values stay undefined and are never read.
    index_of_value = np.empty(limit, dtype=np.intp)
    index_of_value[distinct] = np.arange(len(distinct))
    return distinct, index_of_value.take(values)
