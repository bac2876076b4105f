"""Transfer of which little is not zero: a pixel of a pattern reaches few of an image's."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

SPARSE = 1 / 16  # of all entries, below which those that are not zero are multiplied one by one in less time,
SMALL = 2**16  # unless they are no more than this; see docs/performance.md


class Sparse(NamedTuple):
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

    def taken(self, entries: Tensor) -> Sparse:
        """Some of the entries (M,), or the same more than once."""
        return Sparse(*(each[entries] for each in self))

    def to(self, device: torch.device | str) -> Sparse:
        return Sparse(*(each.to(device) for each in self))

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


def joined(*parts: Sparse | None) -> Sparse | None:
    """The entries of all; None where there are none."""
    there = [part for part in parts if part is not None]
    return Sparse(*map(torch.cat, zip(*there, strict=True))) if there else None
