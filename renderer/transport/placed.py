"""Light from places: which function of it reaches which pixel, and where a mesh casts its shadow."""

import torch
from torch import Tensor

from renderer.basis import Placed, Reach
from renderer.fragments import Fragments
from renderer.harmonics import unit_vectors
from renderer.sparse import Sparse
from renderer.transport.rays import Rays
from renderer.transport.surface import Surface


def placed_transfer(rays: Rays, surface: Surface, albedo: Tensor, basis: Placed) -> Sparse:
    """All that is not zero of it, in float64; albedo: (S, C), at the samples.

    Every sample of a view has a ray to each place, so that shadows are as sharp as the image's samples. InputError
    where Embree is not installed.
    """
    fragments = surface.fragments
    reach = lit(rays, surface, basis.reach(surface.points, surface.normals))
    place, entry = (fragments.pixel[reach.point] * basis.size + reach.function).unique(return_inverse=True)
    weights = albedo[reach.point] * reach.irradiance[:, None] / fragments.samples**2
    summed = weights.new_zeros(len(place), albedo.shape[1]).index_add_(0, entry, weights)
    return Sparse(place % basis.size, place // basis.size, summed)


def placed_radiance(fragments: Fragments, albedo: Tensor, reach: Reach, light: Tensor) -> Tensor:
    """(3, P) float64 of a view in a light (size, 3) that arrives on some ways; differentiable in the light, the albedo
    (S, 3) at the samples and what the ways' irradiance is."""
    arriving = reach.irradiance[:, None] * light[reach.function]
    weights = albedo[reach.point] / fragments.samples**2 * arriving
    return weights.new_zeros(len(fragments.pixels), 3).index_add(0, fragments.pixel[reach.point], weights).T


def lit(rays: Rays, surface: Surface, reach: Reach) -> Reach:
    """The ways on which no surface is met, nor the point's own from behind."""
    with torch.no_grad():
        planes = surface.planes[reach.point]
        origins = surface.points[reach.point] + rays.offset * planes
        directions, lengths = unit_vectors((reach.place - origins).T)
        above = (directions.T * planes).sum(1) > 0
        free = above & (rays.meet(origins, directions.T, lengths) < 0)
    return Reach(*(each[free] for each in reach))
