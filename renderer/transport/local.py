"""Light from positions: which function of it reaches which pixel, and where a mesh casts its shadow."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from renderer.fragments import Fragments
from renderer.light.basis import LightPaths, LocalBasis
from renderer.light.harmonics import unit_vectors
from renderer.transport.rays import Rays
from renderer.transport.surface import Surface

SPARSE = 1 / 16  # of all entries, below which those that are not zero are multiplied one by one in less time,
SMALL = 2**16  # unless they are no more than this; see docs/performance.md


class SparseTransfer(NamedTuple):
    """N entries: function, pixel (N,) int64; weight (N, C), radiance per unit of the function's
    coefficient, of one channel or of three."""

    function: Tensor
    pixel: Tensor
    weight: Tensor

    def dense(self, pixels: int) -> tuple[Tensor, Tensor]:
        """((C, K, P), the K functions that reach a pixel (K,))."""
        kept, row = self.function.unique(return_inverse=True)
        whole = self.weight.new_zeros(self.weight.shape[1], len(kept) * pixels)
        return whole.index_copy_(1, row * pixels + self.pixel, self.weight.T).unflatten(1, (len(kept), pixels)), kept

    def few(self, pixels: int) -> bool:
        """Whether it takes less time to multiply them than all of `dense`."""
        whole = len(self.function.unique()) * pixels
        return whole > SMALL and len(self.function) < SPARSE * whole

    def taken(self, entries: Tensor) -> SparseTransfer:
        """Some of the entries (M,), or the same more than once."""
        return SparseTransfer(*(each[entries] for each in self))

    def to(self, device: torch.device | str) -> SparseTransfer:
        return SparseTransfer(*(each.to(device) for each in self))

    def radiance(self, lights: Tensor, image: Tensor, pixels: int) -> Tensor:
        """(B, 3, P) of B images in a light each, (B, size, 3): entries, of three channels, are of image (N,).
        Differentiable in the lights."""
        arriving = lights.flatten(0, 1).index_select(0, image * lights.shape[1] + self.function) * self.weight
        seen = arriving.new_zeros(len(lights) * pixels, 3).index_add(0, image * pixels + self.pixel, arriving)
        return seen.unflatten(0, (len(lights), pixels)).mT

    def light_gradient(self, upstream: Tensor, image: Tensor, size: int) -> Tensor:
        """(B, size, 3) of `radiance`, from a gradient by it (B, 3, P)."""
        images, _, pixels = upstream.shape
        arriving = upstream.mT.flatten(0, 1).index_select(0, image * pixels + self.pixel) * self.weight
        gradient = arriving.new_zeros(images * size, 3).index_add(0, image * size + self.function, arriving)
        return gradient.unflatten(0, (images, size))


def joined(*parts: SparseTransfer | None) -> SparseTransfer | None:
    """The entries of all; None where there are none."""
    there = [part for part in parts if part is not None]
    return SparseTransfer(*map(torch.cat, zip(*there, strict=True))) if there else None


def local_transfer(rays: Rays, surface: Surface, albedo: Tensor, basis: LocalBasis) -> SparseTransfer:
    """All that is not zero of it, in float64; albedo: (S, C), at the samples.

    Every sample of a view has a ray to each place, so that shadows are as sharp as the image's samples. InputError
    where Embree is not installed.
    """
    fragments = surface.fragments
    reach = lit(rays, surface, basis.connect(surface.points, surface.normals))
    place, entry = (fragments.pixel[reach.point] * basis.size + reach.function).unique(return_inverse=True)
    weights = albedo[reach.point] * reach.irradiance[:, None] / fragments.samples**2
    summed = weights.new_zeros(len(place), albedo.shape[1]).index_add_(0, entry, weights)
    return SparseTransfer(place % basis.size, place // basis.size, summed)


def local_radiance(fragments: Fragments, albedo: Tensor, reach: LightPaths, light: Tensor) -> Tensor:
    """(3, P) float64 of a view in a light (size, 3) that arrives on some ways; differentiable in the light, the albedo
    (S, 3) at the samples and what the ways' irradiance is."""
    arriving = reach.irradiance[:, None] * light[reach.function]
    weights = albedo[reach.point] / fragments.samples**2 * arriving
    return weights.new_zeros(len(fragments.pixels), 3).index_add(0, fragments.pixel[reach.point], weights).T


def lit(rays: Rays, surface: Surface, reach: LightPaths) -> LightPaths:
    """The ways on which no surface is met, nor the point's own from behind."""
    with torch.no_grad():
        planes = surface.planes[reach.point]
        origins = surface.points[reach.point] + rays.offset * planes
        directions, lengths = unit_vectors((reach.place - origins).T)
        above = (directions.T * planes).sum(1) > 0
        free = above & (rays.meet(origins, directions.T, lengths) < 0)
    return LightPaths(*(each[free] for each in reach))
