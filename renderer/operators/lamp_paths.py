"""Light from lamps and projectors: which samples of a view it reaches, and how bright they are.

A local light is a lamp or a projector. Each lamp, and each pixel of a
projector's pattern, is one basis function of local light. Its coefficient is
its RGB power. Each sample of a view casts a ray to each source. A ray that hits
a face means that the sample is in shadow.

Shapes use these letters: a view has S covered samples in P pixels of a mesh
with V vertices. A basis has K functions.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from renderer.light.basis import LightPaths, LocalBasis
from renderer.mesh import Mesh
from renderer.operators.rays import NO_FACE, Rays, Surface
from renderer.operators.sparse import SparseTransfer
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss, at_samples
from renderer.vectors import unit, unit_vectors
from renderer.visibility.fragments import Fragments


def local_transfer(
    rays: Rays, surface: Surface, albedo: Float[Tensor, "S C"], basis: LocalBasis
) -> SparseTransfer:
    """Compute the matrix from coefficients of local light to the radiance of a view.

    Each sample casts a ray to each source, so the edges of shadows are as sharp
    as those of the mesh.
    """
    fragments = surface.fragments
    paths = unoccluded(rays, basis, surface.points, surface.normals, surface.planes)
    # One row for each path, one column for each channel: radiance of the sample at the end
    # of the path, per unit of the coefficient of its light.
    weights = _reflectance(surface, albedo, paths) * paths.irradiance[:, None]
    weights = weights / fragments.samples**2
    # The paths of a pixel that come from the same basis function are added up to one entry.
    # Pixel and function are combined to one number, because sorting numbers is faster.
    pixel_of_path = fragments.sample_to_pixel[paths.point]
    key_of_path = pixel_of_path * basis.size + paths.function
    keys, path_to_entry = key_of_path.unique(return_inverse=True)
    zeros = weights.new_zeros(len(keys), albedo.shape[1])
    return SparseTransfer(
        function=keys % basis.size,
        pixel=keys // basis.size,
        weight=zeros.index_add_(0, path_to_entry, weights),
    )


def local_radiance(
    surface: Surface,
    albedo: Float[Tensor, "S 3"],
    paths: LightPaths,
    light: Float[Tensor, "K 3"],
    fragments: Fragments | None = None,
) -> Float[Tensor, "3 P"]:
    """Compute the radiance of a view under local light.

    The result is differentiable with respect to the light, the albedo, the
    irradiance of the paths and the gloss. The radiance is multiplied by the fraction of
    each pixel that the mesh covers. `fragments` may assign the same samples to other
    pixels.
    """
    fragments = fragments or surface.fragments
    # Irradiance at the end of each path: one row for each path, one column for each color.
    irradiance = paths.irradiance[:, None] * light[paths.function]
    radiance = _reflectance(surface, albedo, paths) / fragments.samples**2 * irradiance
    pixel_of_path = fragments.sample_to_pixel[paths.point]
    zeros = radiance.new_zeros(len(fragments.pixels), 3)
    return zeros.index_add(0, pixel_of_path, radiance).T


def _reflectance(
    surface: Surface, albedo: Float[Tensor, "S C"], paths: LightPaths
) -> Float[Tensor, "E C"]:
    """Compute the reflected radiance, per irradiance, at the ends of E paths of light.

    A matte sample reflects its albedo.
    """
    sample = paths.point
    path_albedo = albedo[sample]
    gloss = surface.gloss
    if gloss is None:
        return path_albedo
    # The function `unit` takes vectors with their components along the first axis.
    to_light = unit((paths.source - surface.points[sample]).T).T
    normals = surface.normals[sample]
    path_gloss = gloss.at(sample)
    to_camera = at_samples(surface.toward, sample)
    # The reflection of metals (colored) is multiplied by the albedo. All other specular
    # reflection (white) has the color of the light.
    colored, white = path_gloss.reflect_beams(normals, to_camera, to_light)
    diffuse_factor = gloss.diffuse_factor(surface.normals, surface.toward)[sample]
    # The transmittance is the fraction of light that passes the coat to the diffuse layer.
    diffuse = diffuse_factor * path_gloss.coat_transmittance((normals * to_light).sum(1))
    return path_albedo * (diffuse + colored)[:, None] + white[:, None]


def unoccluded(
    rays: Rays,
    basis: LocalBasis,
    points: Float[Tensor, "S 3"],
    normals: Float[Tensor, "S 3"],
    planes: Float[Tensor, "S 3"],
    positions: Float[Tensor, "L 3"] | None = None,
) -> LightPaths:
    """Find the paths from local lights to surface points that no face of the mesh blocks.

    A path must also arrive above the plane of the face on which the point lies. `positions`
    are the places to which lamps have moved. None leaves them where the basis has them.
    """
    paths = basis.connect(points, normals, positions)
    # Whether a path is blocked has no gradient, so no operations are recorded.
    with torch.no_grad():
        plane_of_path = planes[paths.point]
        origins = points[paths.point] + rays.offset * plane_of_path
        directions, lengths = unit_vectors((paths.source - origins).T)
        is_above_plane = (directions.T * plane_of_path).sum(1) > 0
        hits_nothing = rays.first_hit(origins, directions.T, lengths) == NO_FACE
        is_unblocked = is_above_plane & hits_nothing
    return LightPaths(
        point=paths.point[is_unblocked],
        function=paths.function[is_unblocked],
        source=paths.source[is_unblocked],
        irradiance=paths.irradiance[is_unblocked],
    )


class LocalLightView:
    """A view of one mesh that is rendered many times under lamps and projectors.

    The light and the albedo may change between the renders. All computations run
    on the CPU, because rays are cast there. For lights that stay in place, rays
    are cast once. For lamps that move, rays are cast in every render. Derivatives
    hold fixed which lamps, and which pixels of a projected pattern, light a
    sample.

    Args:
        rays: Rays among the faces of the mesh.
        mesh: Mesh that the view shows, with V vertices.
        fragments: Samples of the view that show the mesh.
        settings: Settings of the image.
        vertices: Vertex positions to use instead of `mesh.vertices`,
            shape (V, 3). None uses `mesh.vertices`.
        gloss: Gloss to use instead of the gloss of the mesh. None uses the gloss
            of the mesh.
    """

    def __init__(
        self,
        rays: Rays,
        mesh: Mesh,
        fragments: Fragments,
        settings: ImageSettings,
        vertices: Tensor | None = None,
        gloss: Gloss | None = None,
    ):
        """Compute the points and normals at the samples. Rays are cast in the first render."""
        self._rays = rays
        vertices = None if vertices is None else vertices.cpu()
        self._surface = Surface(mesh, fragments.to("cpu"), settings, vertices, gloss)
        # Reading these properties computes them now, and not in the first render.
        self._points = self._surface.points
        self._normals = self._surface.normals
        self._planes = self._surface.planes
        # For each light that stays in place, its paths to samples that no face blocks.
        self._fixed_paths: dict[LocalBasis, LightPaths] = {}

    def radiance(
        self,
        basis: LocalBasis,
        albedo: Float[Tensor, "S 3"],
        light: Float[Tensor, "K 3"],
        positions: Float[Tensor, "L 3"] | None = None,
        fragments: Fragments | None = None,
    ) -> Float[Tensor, "3 P"]:
        """Compute the radiance of the view under local light.

        The result is differentiable with respect to all tensors and to the
        vertices of the view. The arguments are those of `local_radiance` and `unoccluded`.
        """
        fragments = None if fragments is None else fragments.to("cpu")
        if basis.is_movable and positions is not None:
            paths = self._find_paths(basis, positions.cpu().double())
        else:
            if basis not in self._fixed_paths:
                self._fixed_paths[basis] = self._find_paths(basis, None)
            paths = self._fixed_paths[basis]
        radiance = local_radiance(
            self._surface, albedo.cpu().double(), paths, light.cpu().double(), fragments
        )
        return radiance.to(light)

    def _find_paths(self, basis: LocalBasis, positions: Float[Tensor, "L 3"] | None) -> LightPaths:
        """Find the paths from a local light to the samples of the view that no face blocks."""
        return unoccluded(self._rays, basis, self._points, self._normals, self._planes, positions)
