"""What a mesh does to its own light: precomputed radiance transfer (Sloan, Kautz and Snyder 2002), per pixel.

A pixel's transfer is that under an open sky, in closed form, less the light from directions that the mesh blocks, plus
what the surface there sends instead (`renderer.transport.radiosity`).
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
    """The shadows that a mesh casts on itself and the light that it sends itself, per unit of a basis.

    colors: whether that light is of other colors than the sky's. rays: among the mesh's surfaces.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: EnvironmentBasis):
        """albedo_scale multiplies the albedo of what sends light."""
        patches = Patches.of(mesh) if settings.bounces else None
        self.rays = Rays(patches.pieces if patches else mesh)
        self._radiosity = (
            Radiosity(patches, self.rays, settings.encoding, albedo_scale, basis, settings.bounces) if patches else None
        )
        self._directions = sphere(rays.DIRECTIONS)
        self._sky = basis.radiance(self._directions)
        self.colors = self._radiosity is not None and self._radiosity.colors

    def change(self, surface: Surface, albedo: Tensor) -> Tensor | None:
        """(C, size, P) float64: what is added to the radiance of a view's pixels per unit coefficient, weighted with
        coverage; None where nothing is. albedo: (S, C) linear, at the samples; C is 3 where the light has `colors`.
        """
        change, fragments = None, surface.fragments
        weights = albedo.T / fragments.samples**2
        for looks in self.rays.looks(surface, self._directions):
            blocked = looks.blocked()
            if not blocked.any():
                continue
            if change is None:
                change = self._sky.new_zeros(len(weights), self._sky.shape[1], len(fragments.pixels))
            for channel, (added, weight) in enumerate(zip(change, weights, strict=True)):
                lost = blocked * weight[looks.sample]
                added[:, looks.pixels] = -(lost @ self._sky).T
                if self._radiosity is not None:
                    added[:, looks.pixels] += self._radiosity.gather(looks, lost, channel).T
        return change

    def radiance(self, surface: Surface, albedo: Tensor, light: Tensor) -> Tensor:
        """(3, P) in the light's dtype: what `change` makes of a light (size, 3); differentiable in it."""
        change = self.change(surface, albedo)
        if change is None:
            return light.new_zeros(3, len(surface.fragments.pixels))
        return torch.einsum("ckp,kc->cp", change.to(light), light)


def build_transport(mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis) -> Transport | None:
    """None where light goes from the sky to a surface and from there to the camera only, and where it comes from
    places: that throws shadows anyway. InputError: bounces of such light."""
    parts = [part for _, part in parts_of(basis)]
    distant = [part for part in parts if not isinstance(part, LocalBasis)]
    if len(distant) < len(parts) and settings.bounces:
        raise InputError(f"renderer.bounces={settings.bounces}: light of {basis} does not bounce; set renderer.shadows")
    return Transport(mesh, settings, albedo_scale, distant[0]) if distant and settings.global_illumination else None
