"""What light from places adds to one view while shape, colours or the lamps' places change."""

from torch import Tensor

from renderer.basis import Placed, Reach
from renderer.fragments import Fragments
from renderer.image import ImageSettings
from renderer.lamps import Lamps
from renderer.mesh import Mesh
from renderer.transport.placed import lit, placed_radiance
from renderer.transport.rays import Rays
from renderer.transport.surface import Surface


class PlacedView:
    """A view of one shape, computed on the CPU, which casts the rays: once for what stays in its place, and anew for
    lamps at other places. Which lamps and which pixel of a pattern reach a sample is held in derivatives."""

    def __init__(
        self, rays: Rays, mesh: Mesh, fragments: Fragments, settings: ImageSettings, vertices: Tensor | None = None
    ):
        """rays: among the shape's faces. vertices: the shape's (V, 3), where they are not the mesh's."""
        vertices = None if vertices is None else vertices.cpu()
        self._rays, self._surface = rays, Surface.of(mesh, fragments.to("cpu"), settings, vertices)
        self._standing: dict[Placed, Reach] = {}

    def radiance(self, basis: Placed, albedo: Tensor, light: Tensor, places: Tensor | None) -> Tensor:
        """(3, P) of one basis with a light (size, 3), in its dtype and device, and albedo (S, 3) at the samples;
        differentiable in both, in the vertices and in the places (L, 3) of lamps, None where they stand."""
        reach = self._reach(basis, places)
        return placed_radiance(self._surface.fragments, albedo.cpu().double(), reach, light.cpu().double()).to(light)

    def _reach(self, basis: Placed, places: Tensor | None) -> Reach:
        points, normals = self._surface.points, self._surface.normals
        if isinstance(basis, Lamps) and places is not None:
            return lit(self._rays, self._surface, basis.reach(points, normals, places.cpu().double()))
        if basis not in self._standing:
            self._standing[basis] = lit(self._rays, self._surface, basis.reach(points, normals))
        return self._standing[basis]
