"""What lamps that are moved add to one view of a mesh that stays as it is."""

import torch
from torch import Tensor

from renderer.fragments import Fragments
from renderer.image import ImageSettings
from renderer.mesh import Mesh
from renderer.placed import lamplight
from renderer.rays import Rays
from renderer.surface import Surface


class Lamplit:
    """Computed on the CPU, which casts the rays."""

    def __init__(self, rays: Rays, mesh: Mesh, fragments: Fragments, albedo: Tensor, settings: ImageSettings):
        """rays: of the mesh. fragments, albedo (S, 3): of the view."""
        self._rays, self._surface = rays, Surface.of(mesh, fragments.to("cpu"), settings)
        self._albedo = albedo.cpu().double()

    def radiance(self, places: Tensor, powers: Tensor, pixels: Tensor) -> Tensor:
        """(3, P) at pixels (P,), ascending, some of which the mesh covers: all that it does. Lamps are at places (L, 3)
        with powers (L, 3); differentiable in both."""
        seen = lamplight(self._rays, self._surface, self._albedo, places.cpu(), powers.cpu()).to(powers)
        covered = torch.searchsorted(pixels, self._surface.fragments.pixels.to(pixels.device))
        return seen.new_zeros(3, len(pixels)).index_copy(1, covered, seen)
