"""The transfer of light from places: which function of it reaches which pixel, and where a mesh casts its shadow."""

import torch
from torch import Tensor

from renderer.basis import Placed, Reach
from renderer.fragments import Fragments
from renderer.harmonics import unit_vectors
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.normals import face_normals
from renderer.rays import Rays
from renderer.shading import smooth_normals


def placed_transfer(
    mesh: Mesh, fragments: Fragments, albedo: Tensor, settings: ImageSettings, basis: Placed
) -> tuple[Tensor, Tensor]:
    """((C, K, P) float64, the K functions of the basis that reach a pixel (K,)); albedo: (S, C), at the samples.

    Every sample of a view has a ray to each place, so that shadows are as sharp as the image's samples. What lies
    behind the place is no obstacle only if there is nothing: see the bases. InputError where Embree is not installed.
    """
    vertices = torch.from_numpy(mesh.vertices).double()
    planes = (face_normals(vertices, fragments.corners) * fragments.facing)[fragments.face]
    normals = planes
    if settings.normals == "smooth":
        normals = unit_vectors(smooth_normals(fragments, vertices, torch.from_numpy(mesh.faces)).T)[0].T
    points = fragments.interpolate(vertices[fragments.corners])
    reach = _lit(mesh, points, planes, basis.reach(points, normals))
    kept, row = reach.function.unique(return_inverse=True)
    pixels = len(fragments.pixels)
    place = row * pixels + fragments.pixel[reach.point]
    weights = (albedo[reach.point] * reach.irradiance[:, None] / fragments.samples**2).T
    transfer = weights.new_zeros(albedo.shape[1], len(kept) * pixels).index_add_(1, place, weights)
    return transfer.unflatten(1, (len(kept), pixels)), kept


def _lit(mesh: Mesh, points: Tensor, planes: Tensor, reach: Reach) -> Reach:
    """The ways on which no surface is met, nor the point's own from behind."""
    rays = Rays(mesh)
    origins = (points + planes * rays.offset)[reach.point]
    toward = reach.place - origins
    above = (toward * planes[reach.point]).sum(1) > 0
    lit = above & (rays.meet(origins, unit_vectors(toward.T)[0].T) < 0)
    return Reach(reach.point[lit], reach.function[lit], reach.place[lit], reach.irradiance[lit])
