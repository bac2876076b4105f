"""Light from positions: which function of it reaches which pixel, and where a mesh casts its shadow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from renderer.geometry.mesh import Mesh
from renderer.light.basis import LightPaths, LocalBasis
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss, at_samples
from renderer.transport.rays import Rays, Surface
from renderer.vectors import unit, unit_vectors
from renderer.visibility.fragments import Fragments

SPARSE = 1 / 16  # fraction of nonzero entries below which multiplying them one by one takes less time,
SMALL = 2**16  # unless the dense matrix has no more entries than this


class SparseTransfer(NamedTuple):
    """N entries: function, pixel (N,) int64; weight (N, C), radiance per unit of the function's
    coefficient, of one channel or of three."""

    function: Tensor
    pixel: Tensor
    weight: Tensor

    def dense(self, pixels: int) -> tuple[Tensor, Tensor]:
        """((C, K, P), the K functions that reach a pixel (K,))."""
        functions, row = self.function.unique(return_inverse=True)
        whole = self.weight.new_zeros(self.weight.shape[1], len(functions) * pixels)
        dense = whole.index_copy_(1, row * pixels + self.pixel, self.weight.T).unflatten(1, (len(functions), pixels))
        return dense, functions

    def few(self, pixels: int) -> bool:
        """Whether multiplying the entries takes less time than multiplying `dense`."""
        whole = len(self.function.unique()) * pixels
        return whole > SMALL and len(self.function) < SPARSE * whole

    def to(self, device: torch.device | str) -> SparseTransfer:
        return SparseTransfer(*(field.to(device) for field in self))

    def radiance(self, lights: Tensor, image: Tensor, pixels: int) -> Tensor:
        """(B, 3, P) of B images in a light each, (B, size, 3). image: (N,), that of each entry, of three channels.
        Differentiable in the lights."""
        arriving = lights.flatten(0, 1).index_select(0, image * lights.shape[1] + self.function) * self.weight
        summed = arriving.new_zeros(len(lights) * pixels, 3).index_add(0, image * pixels + self.pixel, arriving)
        return summed.unflatten(0, (len(lights), pixels)).mT


def joined(parts: Sequence[SparseTransfer]) -> SparseTransfer | None:
    """The entries of all; None of no parts."""
    return SparseTransfer(*map(torch.cat, zip(*parts, strict=True))) if parts else None


def local_transfer(rays: Rays, surface: Surface, albedo: Tensor, basis: LocalBasis) -> SparseTransfer:
    """The nonzero entries of the transfer matrix, in float64; albedo: (S, C), at the samples.

    Each sample casts a ray to each source, so that shadows are as sharp as the image's samples. InputError where Embree
    is not installed.
    """
    fragments = surface.fragments
    paths = unoccluded(rays, basis, surface.points, surface.normals, surface.planes)
    index, entry = (fragments.pixel[paths.point] * basis.size + paths.function).unique(return_inverse=True)
    weights = _reflectance(surface, albedo, paths) * paths.irradiance[:, None] / fragments.samples**2
    summed = weights.new_zeros(len(index), albedo.shape[1]).index_add_(0, entry, weights)
    return SparseTransfer(index % basis.size, index // basis.size, summed)


def local_radiance(
    surface: Surface, albedo: Tensor, paths: LightPaths, light: Tensor, fragments: Fragments | None = None
) -> Tensor:
    """(3, P) float64 radiance of a view, or with its samples in the pixels of `fragments`, in a light (size, 3) along
    unoccluded paths; differentiable in the light, the albedo (S, 3) at the samples, the irradiance of the paths and the
    gloss."""
    fragments, arriving = fragments or surface.fragments, paths.irradiance[:, None] * light[paths.function]
    weights = _reflectance(surface, albedo, paths) / fragments.samples**2 * arriving
    return weights.new_zeros(len(fragments.pixels), 3).index_add(0, fragments.pixel[paths.point], weights).T


def _reflectance(surface: Surface, albedo: Tensor, paths: LightPaths) -> Tensor:
    """Compute the radiance per irradiance along E paths, shape (E, C), of the albedo (S, C) and of the gloss."""
    values, gloss, point = albedo[paths.point], surface.gloss, paths.point
    if gloss is None:
        return values
    directions = unit((paths.source - surface.points[point]).T).T
    normals = surface.normals[point]
    shine = gloss.at(point)
    colored, white = shine.along(normals, at_samples(surface.toward, point), directions)
    diffuse = gloss.diffuse(surface.normals, surface.toward)[point] * shine.entering((normals * directions).sum(1))
    return values * (diffuse + colored)[:, None] + white[:, None]


def unoccluded(
    rays: Rays, basis: LocalBasis, points: Tensor, normals: Tensor, planes: Tensor, positions: Tensor | None = None
) -> LightPaths:
    """The paths to points (S, 3), of unit normals for shading and of their planes, that no surface blocks and that
    arrive above the plane."""
    paths = basis.connect(points, normals, positions)
    with torch.no_grad():
        normal = planes[paths.point]
        origins = points[paths.point] + rays.offset * normal
        directions, lengths = unit_vectors((paths.source - origins).T)
        above = (directions.T * normal).sum(1) > 0
        free = above & (rays.first_hit(origins, directions.T, lengths) < 0)
    return LightPaths(*(field[free] for field in paths))


class LocalLightView:
    """A view of one shape in local light, computed on the CPU, where the rays are cast: once for lights that stay, and
    again for lamps that moved. Derivatives hold fixed which lamps and which pixel of a pattern reach a sample.

    rays: among the shape's faces. vertices: of the shape (V, 3), unless they are the mesh's. gloss: likewise.
    """

    def __init__(
        self,
        rays: Rays,
        mesh: Mesh,
        fragments: Fragments,
        settings: ImageSettings,
        vertices: Tensor | None = None,
        gloss: Gloss | None = None,
    ):
        vertices = None if vertices is None else vertices.cpu()
        self._rays, self._surface = rays, Surface(mesh, fragments.to("cpu"), settings, vertices, gloss)
        self._points = self._surface.points, self._surface.normals, self._surface.planes
        self._fixed: dict[LocalBasis, LightPaths] = {}

    def radiance(
        self,
        basis: LocalBasis,
        albedo: Tensor,
        light: Tensor,
        positions: Tensor | None = None,
        fragments: Fragments | None = None,
    ) -> Tensor:
        """(3, P) radiance of a light (size, 3), in its dtype and on its device; albedo: (S, 3), at the samples.
        positions: (L, 3) of lamps, None where the basis has them. fragments: the same samples in other pixels.
        Differentiable in all and in the vertices."""
        pixels = None if fragments is None else fragments.to("cpu")
        if basis.is_movable and positions is not None:
            paths = unoccluded(self._rays, basis, *self._points, positions.cpu().double())
        else:
            if basis not in self._fixed:
                self._fixed[basis] = unoccluded(self._rays, basis, *self._points)
            paths = self._fixed[basis]
        values = albedo.cpu().double(), paths, light.cpu().double()
        return local_radiance(self._surface, *values, pixels).to(light)
