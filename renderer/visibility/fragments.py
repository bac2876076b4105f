"""What a view sees of a mesh: the covered samples of an image, each with its pixel and its face.

Rasterized once and then fixed, while light, albedo or the positions of the vertices are differentiated.
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

BLOCK = 2**14  # samples at a time


class Runs(NamedTuple):
    """R runs of neighboring samples that see one face in one pixel, in the samples' order.

    Attributes:
        pixel: Index into `Fragments.pixels`, ascending, (R,) int64.
        face: Index into `Fragments.faces`, (R,) int64.
        sample_count: The number of samples, (R,) int64.
    """

    pixel: Tensor
    face: Tensor
    sample_count: Tensor


@dataclass(frozen=True)
class Fragments:
    """S covered samples of an image of size² pixels; they see G faces in P pixels. samples: per side of a pixel.

    pixels: (P,) int64, row-major indices of the covered pixels, ascending; row 0 is the top of the image.
    coverage: (P,) float64 in (0, 1], the fraction of a pixel's samples that the mesh covers.
    faces: (G,) int64, the mesh's faces that any sample sees, ascending; the others are neither shaded nor moved.
    corners: (G, 3) int64, their vertices. facing: (G, 1) float64, -1 where the camera sees a face from behind.
    outlines: (G, 3, 2) float64, their corners as projected, x right and y up in [-1, 1].
    pixel, face: (S,) int64, indices into `pixels` and `faces`; samples of a pixel lie together.
    sample: (S,) int64, their position in the image: pixel by pixel, and row by row within a pixel.
    depths: (G, 3) float64 of the corners, by which perspective divides (`Camera.depths`); None without perspective.
    camera: whose view it is; None of surface that is gathered without one.
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
        """(4,) homogeneous: the camera's position and 1, or the direction to it and 0. Only gloss asks for it."""
        return torch.zeros(4) if self.camera is None else torch.from_numpy(self.camera.eye())

    @cached_property
    def barycentric(self) -> Tensor:
        """(S, 3) float64 weights of the faces' corners at the samples, clipped into the face: corners were snapped.

        Under perspective, a function that is linear on a face is a quotient of two linear functions in the image, which
        are interpolated there (Heckbert and Moreton 1991).
        """
        outlines = self.outlines.permute(2, 1, 0)
        edges = outlines[:, 1:] - outlines[:, :1]
        (bx, cx), (by, cy) = edges
        area = bx * cy - cx * by
        scaled = edges / area.masked_fill(area == 0, 1)
        faces = torch.cat([outlines[:, 0], scaled.flatten(0, 1)])
        nearness = None if self.depths is None else self.depths.T.reciprocal()
        weights = faces.new_empty(3, len(self.face))
        for weight, face, at in _blocks(weights, self.face, self.positions().T):
            x0, y0, bx, cx, by, cy = faces.gather(1, face.expand(len(faces), -1))  # index_select takes thrice as long
            x, y = at[0] - x0, at[1] - y0
            weight[1], weight[2] = x * cy - y * cx, y * bx - x * by
            weight[0] = 1 - weight[1] - weight[2]
            weight.clamp_(0, 1)
            if nearness is not None:
                weight.mul_(nearness.gather(1, face.expand(3, -1)))
            weight.div_(weight.sum(0))
        return weights.T

    def positions(self) -> Tensor:
        """(S, 2) float64 positions of the samples, in the same coordinates as `outlines`."""
        pixel, within = _divide(self.sample.double(), self.samples**2)  # as floats: integers divide ten times as slowly
        (row, column), (down, across) = _divide(pixel, self.size), _divide(within, self.samples)
        resolution = self.size * self.samples
        column, row = column * self.samples + across, row * self.samples + down
        return torch.stack([2 * column + 1, 2 * (resolution - row) - 1]).T / resolution - 1

    def by_sample(self) -> "Fragments":
        """The same samples, in the same order, as pixels of an image of size · samples pixels per side."""
        resolution = self.size * self.samples
        cells = torch.arange(resolution**2, device=self.sample.device).view(self.size, self.samples, self.size, -1)
        sample = cells.transpose(1, 2).flatten().index_select(0, self.sample)
        pixel, coverage = torch.arange(len(sample), device=sample.device), self.coverage.new_ones(len(sample))
        finer: dict[str, Any] = {"pixels": sample, "pixel": pixel, "sample": sample, "coverage": coverage}
        return self._like(replace(self, size=resolution, samples=1, **finer), slice(None))

    def select(self, samples: Tensor) -> "Fragments":
        """Some of the samples (N,), in the same pixels."""
        names = "pixel", "face", "sample"
        chosen: dict[str, Any] = {name: getattr(self, name).index_select(0, samples) for name in names}
        return self._like(replace(self, **chosen), samples)

    def _like(self, view: "Fragments", samples: Tensor | slice) -> "Fragments":
        """A view with samples of this one, and with their weights, if these are there already."""
        if "barycentric" in vars(self):
            vars(view)["barycentric"] = self.barycentric[samples]
        return view

    def image_of_samples(self, values: Tensor, empty: float) -> Tensor:
        """Values (S,) where the samples lie in the image, (size · samples, size · samples), and `empty` elsewhere."""
        image = values.new_full((self.size**2 * self.samples**2,), empty).index_copy_(0, self.sample, values)
        by_row = image.view(self.size, self.size, self.samples, self.samples).transpose(1, 2)
        return by_row.reshape(self.size * self.samples, -1)

    def of_image(self, image: Tensor) -> Tensor:
        """(S,) the values of an image of samples, (size · samples, size · samples), at the samples."""
        by_pixel = image.view(self.size, self.samples, self.size, self.samples).transpose(1, 2)
        return by_pixel.flatten().index_select(0, self.sample)

    def interpolate(self, corners: Tensor) -> Tensor:
        """(S, D) values at the samples of faces whose corners have values (G, 3, D); differentiable in them."""
        rows = corners.permute(1, 2, 0).flatten(0, 1).contiguous()
        return _Interpolation.apply(rows, self.face, self.barycentric.T).T

    def distribute(self, values: Tensor) -> Tensor:
        """(G, 3, D) sums of values (S, D) over the samples, weighted for each corner: `interpolate` transposed."""
        rows = _distribute(values.T, self.face, self.barycentric.T, (3 * values.shape[1], len(self.faces)))
        return rows.unflatten(0, (3, -1)).permute(2, 0, 1)

    def merge(self, albedo: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(pixel (R,), face (R,), albedo (R, C)): neighboring samples of one face in one pixel as one, since they
        share a normal, with the sum of their albedos (S, C) over samples². Differentiable in them."""
        if self.samples == 1 or not len(self.pixel):
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
        """The runs of samples that lie next to each other in memory and see one face in one pixel."""
        is_start = torch.ones(len(self.pixel) + 1, dtype=torch.bool, device=self.pixel.device)
        torch.ne(self.pixel[1:], self.pixel[:-1], out=is_start[1:-1])
        is_start[1:-1] |= self.face[1:] != self.face[:-1]
        # NumPy finds them in a quarter of the time of torch. The last is the end of all samples.
        found = np.flatnonzero(is_start.cpu().numpy())
        starts = torch.from_numpy(found).to(self.pixel.device)
        pixel = self.pixel.index_select(0, starts[:-1])
        face = self.face.index_select(0, starts[:-1])
        return Runs(pixel, face, starts.diff())

    def to(self, device: torch.device | str) -> "Fragments":
        """The same on another device."""
        values = ((field.name, getattr(self, field.name)) for field in fields(self))
        moved: dict[str, Any] = {name: value.to(device) for name, value in values if isinstance(value, Tensor)}
        return replace(self, **moved)


class _Interpolation(torch.autograd.Function):
    """Values (D, S) of corners' (3 D, G), all of a corner together, by blocks of samples that stay in the cache."""

    @staticmethod
    def forward(ctx: Any, corners: Tensor, face: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(face, weights)
        ctx.corners = corners.shape
        values = corners.new_empty(len(corners) // 3, len(face))
        for value, index, weight in _blocks(values, face, weights):
            at_corners = corners.gather(1, index.expand(len(corners), -1)).unflatten(0, (3, -1))
            torch.sum(at_corners.mul_(weight[:, None]), 0, out=value)
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        face, weights = ctx.saved_tensors
        return _distribute(upstream, face, weights, ctx.corners), None, None


def _distribute(values: Tensor, face: Tensor, weights: Tensor, corners: Sequence[int]) -> Tensor:
    """Values (D, S) of samples, to the corners (3 D, G) of their faces."""
    by_corners = values.new_zeros(corners)
    for value, index, weight in _blocks(values, face, weights.to(values)):
        by_corners.index_add_(1, index, (weight[:, None] * value).flatten(0, 1))
    return by_corners


def build_fragments(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: Sequence[Camera],
    settings: ImageSettings,
    rasterizer: Rasterizer,
    closed: bool = False,
) -> list[Fragments]:
    """Rasterize a mesh of vertices (V, 3) and faces (F, 3), once per camera.

    closed: the mesh is watertight and its faces are counter-clockwise from outside (`Mesh.closed`), so that the ones
    seen from behind need not be drawn, unless the near plane cuts the mesh open. A mesh outside the image has no
    fragments; that is no error. InputError: NaN, or a perspective camera that the mesh is not all in front of.
    """
    require_finite(vertices=torch.from_numpy(vertices))
    rows = np.stack([camera.project(vertices).T for camera in cameras])  # each coordinate side by side in memory
    points = rows.swapaxes(1, 2)
    closed = closed and bool((points[..., 2] >= -1).all())
    ids = rasterizer.rasterize(points, faces, settings.size * settings.samples, closed=closed)
    depths = [camera.depths(vertices) for camera in cameras]
    return [_fragments(*view, faces, settings) for view in zip(cameras, points, depths, ids, strict=True)]


def _fragments(
    camera: Camera,
    projected: np.ndarray,
    depths: np.ndarray | None,
    ids: np.ndarray,
    faces: np.ndarray,
    settings: ImageSettings,
) -> Fragments:
    size, samples = settings.size, settings.samples
    within = ids.view(f"V{samples * ids.itemsize}").reshape(size, samples, size)  # a pixel's row of samples as one item
    by_pixel = within.swapaxes(1, 2).reshape(-1).view(ids.dtype)
    hits = np.flatnonzero(by_pixel >= 0)
    visible, face = _compact(by_pixel[hits], len(faces))
    if samples == 1:  # a sample is a pixel
        pixels, pixel, counts = hits, np.arange(len(hits)), np.ones(len(hits), dtype=np.int64)
    else:
        counts = np.bincount(hits // samples**2, minlength=size**2)
        pixels = np.flatnonzero(counts > 0)
        counts = counts[pixels]
        pixel = np.repeat(np.arange(len(pixels)), counts)
    corners = np.ascontiguousarray(faces.take(visible, axis=0).T)
    outlines = projected[:, :2].T.take(corners, axis=1)
    (ax, bx, cx), (ay, by, cy) = outlines
    behind = (bx - ax) * (cy - ay) < (cx - ax) * (by - ay)
    return Fragments(
        size=size,
        samples=samples,
        pixels=torch.from_numpy(pixels),
        coverage=torch.from_numpy(counts / samples**2),
        faces=torch.from_numpy(visible),
        corners=torch.from_numpy(corners).T,  # with all first corners side by side in memory, as they are read
        facing=torch.from_numpy(np.where(behind, -1.0, 1.0))[:, None],
        outlines=torch.from_numpy(outlines.T),
        pixel=torch.from_numpy(pixel),
        face=torch.from_numpy(face),
        sample=torch.from_numpy(hits),
        depths=None if depths is None else torch.from_numpy(depths.take(corners)).T,
        camera=camera,
    )


def _compact(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(the distinct values below `count`, ascending, and where in them each value is): np.unique without a sort."""
    values = values.astype(np.intp)  # Otherwise each of the two lookups converts them.
    present = np.zeros(count, dtype=bool)
    present[values] = True
    distinct = np.flatnonzero(present)
    place = np.empty(count, dtype=np.intp)  # only the entries of distinct values are ever touched
    place[distinct] = np.arange(len(distinct))
    return distinct, place.take(values)


def _blocks(*tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Blocks of samples, along the last axis of each tensor."""
    return zip(*(tensor.split(BLOCK, dim=-1) for tensor in tensors), strict=True)


def _divide(numbers: Tensor, by: int) -> tuple[Tensor, Tensor]:
    """(quotient, remainder) of whole numbers, as floats."""
    quotient = (numbers / by).floor()
    return quotient, numbers - quotient * by
