"""The transfer of light from places: which function of it reaches which pixel, and where a mesh casts its shadow."""

from torch import Tensor

from renderer.basis import Placed, Reach
from renderer.harmonics import unit_vectors
from renderer.lamps import Lamps, irradiance
from renderer.rays import Rays
from renderer.sparse import Sparse
from renderer.surface import Surface


def placed_transfer(rays: Rays, surface: Surface, albedo: Tensor, basis: Placed) -> Sparse:
    """All that is not zero of it, in float64; albedo: (S, C), at the samples.

    Every sample of a view has a ray to each place, so that shadows are as sharp as the image's samples. InputError
    where Embree is not installed.
    """
    fragments = surface.fragments
    reach = _lit(rays, surface, basis.reach(surface.points, surface.normals))
    place, entry = (fragments.pixel[reach.point] * basis.size + reach.function).unique(return_inverse=True)
    weights = albedo[reach.point] * reach.irradiance[:, None] / fragments.samples**2
    summed = weights.new_zeros(len(place), albedo.shape[1]).index_add_(0, entry, weights)
    return Sparse(place % basis.size, place // basis.size, summed)


def lamplight(rays: Rays, surface: Surface, albedo: Tensor, places: Tensor, powers: Tensor) -> Tensor:
    """(3, P) float64 radiance under lamps at places (L, 3) of powers (L, 3), differentiable in both; albedo: (S, 3).

    It is not linear in the places: rays are cast anew, and which of them are free is held in the derivative.
    """
    fragments = surface.fragments
    lamps, places = Lamps(tuple(map(tuple, places.tolist()))), places.double()
    lit = _lit(rays, surface, lamps.reach(surface.points, surface.normals))
    received = irradiance(places[lit.function] - surface.points[lit.point], surface.normals[lit.point])
    weights = albedo[lit.point] / fragments.samples**2 * received[:, None] * powers.double()[lit.function]
    return weights.new_zeros(len(fragments.pixels), 3).index_add(0, fragments.pixel[lit.point], weights).T


def _lit(rays: Rays, surface: Surface, reach: Reach) -> Reach:
    """The ways on which no surface is met, nor the point's own from behind."""
    planes = surface.planes[reach.point]
    origins = surface.points[reach.point] + rays.offset * planes
    directions, lengths = unit_vectors((reach.place - origins).T)
    above = (directions.T * planes).sum(1) > 0
    lit = above & (rays.meet(origins, directions.T, lengths) < 0)
    return Reach(reach.point[lit], reach.function[lit], reach.place[lit], reach.irradiance[lit])
