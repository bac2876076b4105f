"""Surface samples that a camera sees of a mesh, found once by rasterization.

An image of height × width pixels has s² samples per pixel, where s is
`Fragments.samples`. The samples that show the mesh are kept in `Fragments`,
with the pixel and the face of each. They stay fixed while the lighting, the
albedo or the vertex positions are differentiated.

Shapes use these letters: a view has S covered samples in P pixels, and they
show G of the F faces of the mesh.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Num, Shaped
from torch import Tensor

from renderer.camera import Camera, depths_of_views, project_views
from renderer.errors import require_finite
from renderer.modes import once_differentiable, without_autocast
from renderer.settings import ImageSettings
from renderer.visibility import Rasterizer
from renderer.visibility.numpy import doubled_areas

# Largest number of samples of the views that are shaded at once on a CPU, into whose cache their
# values should fit. A larger view is shaded alone.
SAMPLES_ON_CPU = 2**16
# Number of samples whose values are computed at once on a CPU. They fit into its cache.
BLOCK_ON_CPU = 2**14
# Fraction of the memory of a GPU that the samples take which are shaded at once, and bytes of one.
MEMORY_FRACTION = 1 / 16
SAMPLE_BYTES = 2**10


class PixelGroups(NamedTuple):
    """Groups of successive samples that show the same face in the same pixel.

    There are R groups, in the order of their samples.

    Attributes:
        group_to_pixel: Index into `Fragments.pixels` of each group, ascending, int64,
            shape (R,).
        group_to_seen_face: Index into `Fragments.faces` of each group, int64,
            shape (R,).
        sample_count: Number of samples in each group, int64, shape (R,).
        sample_to_group: Index of the group of each sample, int64, shape (S,).
    """

    group_to_pixel: Int[Tensor, " R"]
    group_to_seen_face: Int[Tensor, " R"]
    sample_count: Int[Tensor, " R"]
    sample_to_group: Int[Tensor, " S"]


@dataclass(frozen=True)
class Fragments:
    """The S samples of an image that show a mesh, with their pixels and faces.

    These samples are called covered. The samples of a pixel follow each other in
    all tensors of shape (S,). The faces that samples show are called seen.

    Attributes:
        shape: Height and width of the image in pixels.
        samples: Number of samples along one side of a pixel.
        pixels: Row-major indices of the P pixels with covered samples,
            ascending, int64, shape (P,). Row 0 is the top of the image.
        coverage: Fraction of the samples of each pixel that show the mesh, in
            (0, 1], float64, shape (P,).
        faces: Indices in the mesh of the G faces that samples show, ascending in each view,
            int64, shape (G,).
        corners: Indices of the three vertices of each seen face, int64,
            shape (G, 3).
        facing: -1 for seen faces that the camera sees from behind, and 1 for
            the others, float64, shape (G, 1).
        outlines: Positions (x, y) of the three corners of each seen face in the
            image, float64, shape (G, 3, 2). x points to the right and y up. The
            image is [-1, 1] in x, and [-height / width, height / width] in y.
        sample_to_pixel: Index into `pixels` of the pixel of each sample, int64,
            shape (S,).
        sample_to_seen_face: Index into `faces` of the face that each sample
            shows, int64, shape (S,).
        sample_numbers: Row-major index of each sample among all samples of the image,
            covered or not, int64, shape (S,).
        depths: Depths of the corners of seen faces (see `Camera.depths`),
            float64, shape (G, 3). None without perspective.
        cameras: Camera of each view. Empty if the samples come from no camera.
    """

    shape: tuple[int, int]
    samples: int
    pixels: Int[Tensor, " P"]
    coverage: Float[Tensor, " P"]
    faces: Int[Tensor, " G"]
    corners: Int[Tensor, "G 3"]
    facing: Float[Tensor, "G 1"]
    outlines: Float[Tensor, "G 3 2"]
    sample_to_pixel: Int[Tensor, " S"]
    sample_to_seen_face: Int[Tensor, " S"]
    sample_numbers: Int[Tensor, " S"]
    depths: Float[Tensor, "G 3"] | None = None
    cameras: tuple[Camera, ...] = ()

    @property
    def sample_shape(self) -> tuple[int, int]:
        """Numbers of rows and columns of samples."""
        return self.shape[0] * self.samples, self.shape[1] * self.samples

    @property
    def eyes(self) -> Float[Tensor, "_ 4"]:
        """Homogeneous position (x, y, z, w) of the camera of the only view, or of each sample.

        w is 1 for the position of a perspective camera, and 0 for the direction
        to an orthographic camera.
        """
        eyes = torch.stack([camera.differentiable_eye() for camera in self.cameras])
        if len(eyes) == 1:
            return eyes
        return eyes.to(self.pixels.device).index_select(0, self.view_of_sample)

    @property
    def view_of_sample(self) -> Int[Tensor, " S"]:
        """Index of the view of each sample, ascending."""
        return self.sample_numbers.div(math.prod(self.sample_shape), rounding_mode="floor")

    @property
    def view_of_face(self) -> Int[Tensor, " G"]:
        """Index of the view of each seen face, ascending."""
        view = torch.zeros_like(self.faces)
        return view.index_copy_(0, self.sample_to_seen_face, self.view_of_sample)

    @cached_property
    def barycentric(self) -> Tensor:
        """Barycentric weights of the three corners at each of the S samples, shape (S, 3).

        The weights are float64 and add up to 1. They are computed from unrounded
        corners, but the rasterizer rounds corners. A sample may therefore lie
        slightly outside its face. Its weights are then clipped at 0.

        In a perspective image, a function that is linear on a face is a
        quotient of two linear functions of the image position (Heckbert and
        Moreton 1991). The weights are therefore divided by the depths of the
        corners and normalized.
        """
        # Axes: coordinates x and y, corner, seen face.
        outlines = self.outlines.permute(2, 1, 0)
        # Vectors from the first corner to the second (b) and to the third corner (c), with
        # the axes: coordinate, vector, seen face.
        edges = outlines[:, 1:] - outlines[:, :1]
        (bx, cx), (by, cy) = edges
        doubled_area = bx * cy - cx * by
        # Faces without area are divided by 1 instead of 0. They cover samples only because
        # the rasterizer rounds, so their weights do not matter.
        edges_by_area = edges / doubled_area.masked_fill(doubled_area == 0, 1)
        # Six rows: x and y of the first corner, then bx, cx, by and cy, each divided by the
        # doubled area. One column for each seen face.
        face_values = torch.cat([outlines[:, 0], edges_by_area.flatten(0, 1)])
        reciprocal_depths = None if self.depths is None else self.depths.T.reciprocal()
        weights = face_values.new_empty(3, len(self.sample_to_seen_face))
        # `weight` is a view of some columns of `weights`. Writing to it fills `weights`.
        for weight, sample_to_seen_face, position in split_samples(
            weights, self.sample_to_seen_face, self.positions().T
        ):
            # `gather` takes a third of the time of `index_select`.
            at_samples = face_values.gather(1, sample_to_seen_face.expand(len(face_values), -1))
            x0, y0, bx, cx, by, cy = at_samples
            # Position of the sample relative to the first corner.
            x = position[0] - x0
            y = position[1] - y0
            # The weight of a corner is the area of the triangle of the sample and the two
            # other corners, divided by the area of the face.
            weight[1] = x * cy - y * cx
            weight[2] = y * bx - x * by
            weight[0] = 1 - weight[1] - weight[2]
            weight.clamp_(0, 1)
            if reciprocal_depths is not None:
                weight.mul_(reciprocal_depths.gather(1, sample_to_seen_face.expand(3, -1)))
            weight.div_(weight.sum(0))
        return weights.T

    def positions(self) -> Float[Tensor, "S 2"]:
        """Compute the positions of the S covered samples in the image of their view.

        x points to the right and y up, and the image is [-1, 1] in x.
        """
        rows, columns = self.sample_shape
        # Dividing floating-point numbers takes a tenth of the time of dividing integers.
        numbers = self.sample_numbers.double()
        row = (numbers / columns).floor()
        column = numbers - row * columns
        if len(self.cameras) > 1:
            row = row % rows
        # The image is divided into square cells of width 2 / columns. A sample is the center of
        # its cell.
        x = (2 * column + 1) / columns - 1
        y = (2 * (rows - row) - 1) / columns - rows / columns
        return torch.stack([x, y]).T

    def by_sample(self, camera: Camera) -> "Fragments":
        """Return a copy for a finer image of another camera, in which each sample is a pixel.

        The samples keep their order, and the finer image has one sample per pixel. The camera
        differs only in its gradients.
        """
        sample_count = len(self.sample_numbers)
        finer = replace(
            self,
            shape=self.sample_shape,
            samples=1,
            pixels=self.sample_numbers,
            coverage=self.coverage.new_ones(sample_count),
            sample_to_pixel=torch.arange(sample_count, device=self.sample_numbers.device),
            cameras=(camera,),
        )
        # The copy does not compute the weights again.
        vars(finer)["barycentric"] = self.barycentric
        return finer

    def image_of_samples(self, values: Num[Tensor, " S"], empty: float) -> Num[Tensor, "_ _"]:
        """Arrange values at samples as an image with one pixel per sample.

        Samples that show no mesh get the value `empty`. Row 0 is at the top.
        """
        image = values.new_full((math.prod(self.sample_shape),), empty)
        return image.index_copy_(0, self.sample_numbers, values).view(self.sample_shape)

    def interpolate(self, corners: Float[Tensor, "G 3 D"]) -> Float[Tensor, "S D"]:
        """Interpolate values at the corners of faces to the S samples.

        The result is differentiable with respect to `corners`.
        """
        # One column for each seen face: the D values of its first corner, then those of
        # its second and its third corner.
        corner_rows = corners.permute(1, 2, 0).flatten(0, 1).contiguous()
        return _Interpolation.apply(corner_rows, self.sample_to_seen_face, self.barycentric.T).T

    def distribute(
        self, values: Float[Tensor, "N D"], samples: Int[Tensor, " N"]
    ) -> Float[Tensor, "D _"]:
        """Add up values at N of the samples for each corner of the faces that the samples show.

        Each value is multiplied by the barycentric weight of the corner at the
        sample. This is the transpose of `interpolate`, as in backpropagation. The columns are all
        first corners of the G seen faces, then all second and all third corners.
        """
        seen_face = self.sample_to_seen_face.index_select(0, samples)
        shape = (3 * values.shape[1], len(self.faces))
        corner_rows = _distribute(values.T, seen_face, self.barycentric[samples].T, shape)
        # The axes corner, value, seen face become value, corner and seen face.
        return corner_rows.unflatten(0, (3, -1)).transpose(0, 1).flatten(1)

    def merge(self, albedo: Float[Tensor, "S C"]) -> Float[Tensor, "R C"]:
        """Add up the albedo of each of the R `groups`, divided by the samples of a pixel.

        With flat normals, the samples of a group have the same normal, so they can be shaded
        together. The result is differentiable.
        """
        zeros = albedo.new_zeros(albedo.shape[1], len(self.groups.sample_count))
        return zeros.index_add(1, self.groups.sample_to_group, albedo.T / self.samples**2).T

    @cached_property
    def groups(self) -> PixelGroups:
        """Groups of successive samples that show the same face in the same pixel."""
        # Pixel and face are combined to one number.
        keys, sample_to_group, sample_count = torch.unique_consecutive(
            self.sample_to_pixel * len(self.faces) + self.sample_to_seen_face,
            return_inverse=True,
            return_counts=True,
        )
        pixel = keys.div(len(self.faces), rounding_mode="floor")
        seen_face = keys - pixel * len(self.faces)
        return PixelGroups(pixel, seen_face, sample_count, sample_to_group)

    def to(self, device: torch.device | str) -> "Fragments":
        """Return the fragments with all tensors on a device."""
        return self if self.pixels.device == torch.device(device) else on_device(self, device)


def on_device(parts: Any, device: torch.device | str) -> Any:
    """Return a copy of a dataclass with all tensors on a device."""
    values = {field.name: getattr(parts, field.name) for field in fields(parts)}
    moved = {name: value.to(device) for name, value in values.items() if hasattr(value, "to")}
    return replace(parts, **moved)


def split_views(
    pixels: Int[Tensor, " P"], view_count: int, view_size: int, *values: Shaped[Tensor, "*axes P"]
) -> list[tuple[Tensor, ...]]:
    """Split pixels of a tall image of several views, and values there, by view."""
    if view_count < 2:
        return [(pixels, *values)]
    view = pixels.div(view_size, rounding_mode="floor")
    sizes = view.bincount(minlength=view_count).tolist()
    split = [part.split(sizes, dim=-1) for part in (pixels % view_size, *values)]
    return list(zip(*split, strict=True))


class _Interpolation(torch.autograd.Function):
    """Differentiable interpolation of values at the corners of faces to samples.

    There are S samples, which are processed in blocks to save memory. G faces
    have D values at each of their three corners. The 3 · D values of a face are a
    column of a matrix, with the D values of the first corner first.
    """

    @staticmethod
    def forward(
        ctx: Any,
        corner_rows: Float[Tensor, "_ G"],
        sample_to_seen_face: Int[Tensor, " S"],
        weights: Float[Tensor, "3 S"],
    ) -> Float[Tensor, "D S"]:
        """Interpolate D values from the three corners of a face to each of S samples.

        The rows of `corner_rows` are D values at the first corners, then D at the second
        and D at the third ones.
        """
        ctx.save_for_backward(sample_to_seen_face, weights)
        ctx.corner_rows_shape = corner_rows.shape
        values = corner_rows.new_empty(len(corner_rows) // 3, len(sample_to_seen_face))
        # `value` is a view of some columns of `values`. Writing to it fills `values`.
        for value, seen_face, weight in split_samples(values, sample_to_seen_face, weights):
            # One column for each sample: the column of the face that the sample shows.
            at_corners = corner_rows.gather(1, seen_face.expand(len(corner_rows), -1))
            # Axes: corner, value, sample.
            at_corners = at_corners.unflatten(0, (3, -1))
            torch.sum(at_corners.mul_(weight[:, None]), 0, out=value)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Float[Tensor, "D S"]) -> tuple[Tensor, None, None]:
        """Compute the gradient with respect to the values at the corners of G faces."""
        sample_to_seen_face, weights = ctx.saved_tensors
        gradient = _distribute(upstream, sample_to_seen_face, weights, ctx.corner_rows_shape)
        return gradient, None, None


def _distribute(
    values: Float[Tensor, "D S"],
    sample_to_seen_face: Int[Tensor, " S"],
    weights: Float[Tensor, "3 S"],
    corner_rows_shape: Sequence[int],
) -> Float[Tensor, "_ G"]:
    """Add up values times barycentric weights at corners, in the layout of `corner_rows`."""
    corner_rows = values.new_zeros(corner_rows_shape)
    for value, seen_face, weight in split_samples(values, sample_to_seen_face, weights.to(values)):
        # Values times weights. Rows are pairs of corner and value, columns are samples.
        corner_rows.index_add_(1, seen_face, (weight[:, None] * value).flatten(0, 1))
    return corner_rows


def split_samples(*tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Split several tensors along their last axis, the samples, into blocks."""
    size = block_size(tensors[0].device)
    return zip(*(tensor.split(size, dim=-1) for tensor in tensors), strict=True)


def block_size(device: torch.device) -> int:
    """Return for how many samples values are computed at once.

    Few samples take a GPU as long as many.
    """
    return samples_on_gpu(device) if device.type == "cuda" else BLOCK_ON_CPU


@cache
def samples_on_gpu(device: torch.device) -> int:
    """Return how many samples a GPU shades at once. The number depends on its memory alone."""
    memory = torch.cuda.get_device_properties(device).total_memory
    return int(MEMORY_FRACTION * memory / SAMPLE_BYTES)


def views_at_once(settings: ImageSettings, device: torch.device, is_single: bool) -> int:
    """Return how many views are shaded at once. Few samples take as long as many.

    Rays and the gradients of silhouettes need single views.
    """
    if is_single:
        return 1
    samples = samples_on_gpu(device) if device.type == "cuda" else SAMPLES_ON_CPU
    return max(1, samples // (settings.pixel_count * settings.samples**2))


@without_autocast
def build_fragments(
    vertices: Float[np.ndarray, "V 3"] | Float[Tensor, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    cameras: Sequence[Camera],
    settings: ImageSettings,
    rasterizer: Rasterizer,
    closed: bool = False,
    at_once: int = 1,
) -> list[Fragments]:
    """Rasterize a mesh once for each camera to find the samples that show the mesh.

    Each result has `at_once` successive views, or the rest of them. Vertices are in world axes.
    Those on a GPU give fragments there, and all others on the CPU. With `closed` (see
    `Mesh.closed`), faces that are seen from behind are not drawn, except if the near plane cuts the
    mesh open. A mesh that reaches a perspective camera raises `InputError`.
    """
    require_finite(vertices=torch.as_tensor(vertices))
    points: Any = vertices
    if isinstance(vertices, Tensor):
        points = vertices.detach()
        points = points.double() if points.is_cuda else points.cpu().double().numpy()
    all_faces = torch.as_tensor(faces).to(torch.as_tensor(points).device, non_blocking=True)
    if any(camera.has_perspective for camera in cameras):
        # A vertex that no face uses may lie behind a camera. The first corner takes its place.
        corners = all_faces.flatten()
        vertex_of_row = corners[:1].repeat(len(points)).index_copy_(0, corners, corners)
        points = points[vertex_of_row]
    projected = torch.as_tensor(project_views(cameras, points))
    # The third coordinate is the depth. It is less than -1 in front of the near plane,
    # which would cut the mesh open.
    is_uncut = bool((projected[..., 2] >= -1).all())
    shape = tuple(side * settings.samples for side in settings.shape)
    face_ids = rasterizer.rasterize(projected, faces, shape, closed and is_uncut)
    views = []
    for first in range(0, len(cameras), at_once):
        some = slice(first, first + at_once)
        depths = depths_of_views(cameras[some], points)
        depths = None if depths is None else torch.as_tensor(depths).flatten()
        shown = tuple(cameras[some]), projected[some], depths, face_ids[some], all_faces
        views.append(_fragments_of_views(*shown, settings))
    return views


def _fragments_of_views(
    cameras: tuple[Camera, ...],
    projected: Float[Tensor, "N V 3"],
    depths: Float[Tensor, " _"] | None,
    face_ids: Int[Tensor, "N _ _"],
    faces: Int[Tensor, "F 3"],
    settings: ImageSettings,
) -> Fragments:
    """Create fragments of N views from face indices (-1: no face).

    The depths are those of all vertices in the first view, then in the second, and so on. None
    stands for no perspective.
    """
    view_count, vertex_count, _ = projected.shape
    height, width = settings.shape
    # Order in which the samples of a pixel follow each other.
    order = _samples_by_pixel((view_count * height, width), settings.samples, face_ids.device)
    ids_by_pixel = face_ids.flatten().index_select(0, order)
    is_covered = ids_by_pixel >= 0
    covered = is_covered.nonzero().squeeze(1)
    # Number of covered samples of each pixel.
    counts_of_all_pixels = is_covered.view(-1, settings.samples**2).sum(1)
    pixels = counts_of_all_pixels.nonzero().squeeze(1)
    sample_count = counts_of_all_pixels.index_select(0, pixels)
    shown = ids_by_pixel.index_select(0, covered).long()
    if view_count > 1:
        # Faces are numbered view by view.
        shown += len(faces) * covered.div(len(order) // view_count, rounding_mode="floor")
    is_seen = torch.zeros(view_count * len(faces), dtype=torch.bool, device=faces.device)
    is_seen.index_fill_(0, shown, True)
    seen = is_seen.nonzero().squeeze(1)
    view_of_seen = seen.div(len(faces), rounding_mode="floor") if view_count > 1 else 0
    seen_faces = seen - len(faces) * view_of_seen
    # One row for each corner, one column for each seen face. Rows are contiguous in
    # memory, because later code reads all first corners together.
    corners = faces.index_select(0, seen_faces).T.contiguous()
    projected_corners = (corners + vertex_count * view_of_seen).flatten()
    # Axes: coordinates x and y, corner, seen face.
    outlines = projected.flatten(0, 1).T[:2].index_select(1, projected_corners)
    outlines = outlines.unflatten(1, (3, -1))
    return Fragments(
        shape=settings.shape,
        samples=settings.samples,
        pixels=pixels,
        coverage=sample_count.double() / settings.samples**2,
        faces=seen_faces,
        corners=corners.T,
        # Corners of a face that is seen from behind are clockwise in the image, in which y is up.
        facing=torch.where(doubled_areas(outlines) < 0, -1.0, 1.0).double()[:, None],
        outlines=outlines.permute(2, 1, 0),
        sample_to_pixel=torch.repeat_interleave(sample_count, output_size=len(covered)),
        sample_to_seen_face=(is_seen.cumsum(0) - 1).index_select(0, shown),
        sample_numbers=order.index_select(0, covered),
        depths=None if depths is None else depths[projected_corners].view_as(corners).T,
        cameras=cameras,
    )


@lru_cache(maxsize=2)
def _samples_by_pixel(
    shape: tuple[int, int], samples: int, device: torch.device
) -> Int[Tensor, " N"]:
    """List the numbers of all samples: those of the first pixel, of the second pixel, and so on."""
    height, width = shape
    numbers = torch.arange(height * width * samples**2, device=device)
    return numbers.view(height, samples, width, samples).transpose(1, 2).flatten()
