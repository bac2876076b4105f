"""Shadows and bounces of environment light: precomputed radiance transfer (Sloan, Kautz and Snyder 2002), per pixel.

A pixel's transfer is that under an open sky, in closed form, less the light from directions that the mesh blocks, plus
the light that the surface there reflects (`renderer.transport.radiosity`).
"""

import torch
from torch import Tensor

from renderer.errors import InputError
from renderer.image import ImageSettings
from renderer.light.basis import Basis, EnvironmentBasis, LocalBasis, parts_of
from renderer.mesh import Mesh
from renderer.transport import rays
from renderer.transport.radiosity import Patches, Radiosity
from renderer.transport.rays import Rays, sphere
from renderer.transport.surface import Surface


class Transport:
    """The shadows that a mesh casts on itself and the light that bounces within it, per unit of a basis.

    colors: whether bounced light has another color than the sky's. rays: among the mesh's faces.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: EnvironmentBasis):
        """albedo_scale: of the surfaces that light bounces off."""
        patches = Patches.of(mesh) if settings.bounces else None
        self.rays = Rays(patches.pieces if patches else mesh)
        self._radiosity = Radiosity(patches, self.rays, settings, albedo_scale, basis) if patches else None
        self._directions = sphere(rays.DIRECTIONS)
        self._sky = basis.radiance(self._directions)
        self.colors = self._radiosity is not None and self._radiosity.colors

    def change(self, surface: Surface, albedo: Tensor) -> Tensor | None:
        """(C, size, P) float64: the change of the radiance of a view's pixels per unit coefficient, weighted with
        coverage; None for no change. albedo: (S, C) linear, at the samples; C is 3 if the light has `colors`.
        """
        change, fragments = None, surface.fragments
        weights = albedo.T / fragments.samples**2
        for hits in self.rays.hits(surface, self._directions):
            if not hits.weight.any():
                continue
            if change is None:
                change = self._sky.new_zeros(len(weights), self._sky.shape[1], len(fragments.pixels))
            for channel, (added, weight) in enumerate(zip(change, weights, strict=True)):
                blocked = hits.weight * weight[hits.sample]
                added[:, hits.pixels] = -(blocked @ self._sky).T
                if self._radiosity is not None:
                    added[:, hits.pixels] += self._radiosity.gather(hits, blocked, channel).T
        return change

    def radiance(self, surface: Surface, albedo: Tensor, light: Tensor) -> Tensor:
        """(3, P) in the light's dtype: `change` in a light (size, 3); differentiable in it, not in the albedo."""
        change = self.change(surface, albedo.detach().cpu().double())
        if change is None:
            return light.new_zeros(3, len(surface.fragments.pixels))
        return torch.einsum("ckp,kc->cp", change.to(light), light)


def build_transport(mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis) -> Transport | None:
    """None without shadows and bounces of environment light; local lights cast their shadows by themselves. InputError:
    bounces of local lights."""
    parts = [part for _, part in parts_of(basis)]
    environment = [part for part in parts if not isinstance(part, LocalBasis)]
    if len(environment) < len(parts) and settings.bounces:
        raise InputError(f"bounces={settings.bounces}: light of {basis} does not bounce; set shadows")
    if not environment or not settings.global_illumination:
        return None
    return Transport(mesh, settings, albedo_scale, environment[0])
