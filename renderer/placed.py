"""The transfer of light from places: which function of it reaches which pixel, and where a mesh casts its shadow."""

from torch import Tensor

from renderer.basis import Placed, Reach
from renderer.harmonics import unit_vectors
from renderer.rays import Rays
from renderer.surface import Surface


def placed_transfer(rays: Rays, surface: Surface, albedo: Tensor, basis: Placed) -> tuple[Tensor, Tensor]:
    """((C, K, P) float64, the K functions of the basis that reach a pixel (K,)); albedo: (S, C), at the samples.

    Every sample of a view has a ray to each place, so that shadows are as sharp as the image's samples. What lies
    behind the place is no obstacle only if there is nothing: see the bases. InputError where Embree is not installed.
    """
    fragments = surface.fragments
    reach = _lit(rays, surface, basis.reach(surface.points, surface.normals))
    kept, row = reach.function.unique(return_inverse=True)
    pixels = len(fragments.pixels)
    place = row * pixels + fragments.pixel[reach.point]
    weights = (albedo[reach.point] * reach.irradiance[:, None] / fragments.samples**2).T
    transfer = weights.new_zeros(albedo.shape[1], len(kept) * pixels).index_add_(1, place, weights)
    return transfer.unflatten(1, (len(kept), pixels)), kept


def _lit(rays: Rays, surface: Surface, reach: Reach) -> Reach:
    """The ways on which no surface is met, nor the point's own from behind."""
    planes = surface.planes[reach.point]
    origins = surface.points[reach.point] + rays.offset * planes
    toward = reach.place - origins
    above = (toward * planes).sum(1) > 0
    lit = above & (rays.meet(origins, unit_vectors(toward.T)[0].T) < 0)
    return Reach(reach.point[lit], reach.function[lit], reach.place[lit], reach.irradiance[lit])
