"""Light from local sources: which basis function reaches which pixel, and where it is blocked.

A basis function of local light is a lamp or a pixel of a projector's pattern.
Each sample of a view casts a ray to the sources, which finds shadows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from renderer.geometry.mesh import Mesh
from renderer.light.basis import LightPaths, LocalBasis
from renderer.settings import ImageSettings
from renderer.shading.gloss import Gloss, at_samples
from renderer.transport.rays import NO_FACE, Rays, Surface
from renderer.vectors import unit, unit_vectors
from renderer.visibility.fragments import Fragments

# Below this fraction of nonzero entries, multiplying them one by one takes less
# time than multiplying a dense matrix.
SPARSE = 1 / 16
# A dense matrix with at most as many entries is always faster.
SMALL = 2**16


class SparseTransfer(NamedTuple):
    """The N nonzero entries of a transfer matrix.

    Attributes:
        function: Index of the basis function of each entry, int64, shape (N,).
        pixel: Index of the pixel of each entry, int64, shape (N,).
        weight: Radiance per unit of the function's coefficient, in C = 1 or 3
            channels, shape (N, C).
    """

    function: Tensor
    pixel: Tensor
    weight: Tensor

    def dense(self, pixels: int) -> tuple[Tensor, Tensor]:
        """Write the entries as a dense matrix.

        Args:
            pixels: Number of pixels, P.

        Returns:
            The matrix of the K functions that reach a pixel, shape (C, K, P),
            and the indices of these functions, shape (K,).
        """
        functions, row = self.function.unique(return_inverse=True)
        zeros = self.weight.new_zeros(self.weight.shape[1], len(functions) * pixels)
        flat = zeros.index_copy_(1, row * pixels + self.pixel, self.weight.T)
        return flat.unflatten(1, (len(functions), pixels)), functions

    def few(self, pixels: int) -> bool:
        """Return whether multiplying single entries is faster than multiplying `dense`.

        Args:
            pixels: Number of pixels.
        """
        dense_size = len(self.function.unique()) * pixels
        return dense_size > SMALL and len(self.function) < SPARSE * dense_size

    def to(self, device: torch.device | str) -> SparseTransfer:
        """Return the same entries on another device.

        Args:
            device: The device, such as "cuda".
        """
        return SparseTransfer(*(field.to(device) for field in self))

    def radiance(self, lights: Tensor, image: Tensor, pixels: int) -> Tensor:
        """Compute the radiance of B images in a light each, differentiable in the lights.

        The entries have three channels.

        Args:
            lights: Coefficients, shape (B, size, 3).
            image: Index of the image of each entry, shape (N,).
            pixels: Number of pixels of an image, P.

        Returns:
            Radiance, shape (B, 3, P).
        """
        function_row = image * lights.shape[1] + self.function
        arriving = lights.flatten(0, 1).index_select(0, function_row) * self.weight
        pixel_row = image * pixels + self.pixel
        summed = arriving.new_zeros(len(lights) * pixels, 3).index_add(0, pixel_row, arriving)
        return summed.unflatten(0, (len(lights), pixels)).mT


def joined(parts: Sequence[SparseTransfer]) -> SparseTransfer | None:
    """Return the entries of all parts in order, or None without parts."""
    if not parts:
        return None
    return SparseTransfer(*map(torch.cat, zip(*parts, strict=True)))


def local_transfer(
    rays: Rays, surface: Surface, albedo: Tensor, basis: LocalBasis
) -> SparseTransfer:
    """Compute the transfer matrix of local light in a view.

    Each sample casts a ray to each source, so shadows are as sharp as the
    samples of the image.

    Args:
        rays: Rays among the faces of the mesh.
        surface: Samples of the view.
        albedo: Linear albedo at the samples, shape (S, C).
        basis: Basis of the light.

    Returns:
        The nonzero entries, float64.

    Raises:
        InputError: If Embree is not installed.
    """
    fragments = surface.fragments
    paths = unoccluded(rays, basis, surface.points, surface.normals, surface.planes)
    weights = _reflectance(surface, albedo, paths) * paths.irradiance[:, None]
    weights = weights / fragments.samples**2
    # All paths with the same pixel and the same function belong to one entry. The
    # pair of both is written as one number, which is sorted faster.
    pair_of_path = fragments.pixel[paths.point] * basis.size + paths.function
    pairs, entry_of_path = pair_of_path.unique(return_inverse=True)
    zeros = weights.new_zeros(len(pairs), albedo.shape[1])
    return SparseTransfer(
        function=pairs % basis.size,
        pixel=pairs // basis.size,
        weight=zeros.index_add_(0, entry_of_path, weights),
    )


def local_radiance(
    surface: Surface,
    albedo: Tensor,
    paths: LightPaths,
    light: Tensor,
    fragments: Fragments | None = None,
) -> Tensor:
    """Compute the radiance of a view in local light.

    The result is differentiable in the light, the albedo, the irradiance of the
    paths and the gloss.

    Args:
        surface: Samples of the view.
        albedo: Linear albedo at the samples, shape (S, 3).
        paths: Unoccluded paths from the light to the samples.
        light: Coefficients, shape (size, 3).
        fragments: The same samples in other pixels. None for those of the
            surface.

    Returns:
        Radiance of P pixels, weighted with coverage, float64, shape (3, P).
    """
    fragments = fragments or surface.fragments
    arriving = paths.irradiance[:, None] * light[paths.function]
    weights = _reflectance(surface, albedo, paths) / fragments.samples**2 * arriving
    pixel = fragments.pixel[paths.point]
    return weights.new_zeros(len(fragments.pixels), 3).index_add(0, pixel, weights).T


def _reflectance(surface: Surface, albedo: Tensor, paths: LightPaths) -> Tensor:
    """Return the reflected radiance per irradiance along E paths, shape (E, C).

    `albedo` (S, C) is given at the samples.
    """
    point = paths.point
    path_albedo = albedo[point]
    gloss = surface.gloss
    if gloss is None:
        return path_albedo
    to_light = unit((paths.source - surface.points[point]).T).T
    normals = surface.normals[point]
    path_gloss = gloss.at(point)
    colored, white = path_gloss.along(normals, at_samples(surface.toward, point), to_light)
    leaving = gloss.diffuse(surface.normals, surface.toward)[point]
    diffuse = leaving * path_gloss.entering((normals * to_light).sum(1))
    return path_albedo * (diffuse + colored)[:, None] + white[:, None]


def unoccluded(
    rays: Rays,
    basis: LocalBasis,
    points: Tensor,
    normals: Tensor,
    planes: Tensor,
    positions: Tensor | None = None,
) -> LightPaths:
    """Find the paths from a local light to points that no surface blocks.

    A path must also arrive above the plane of the point's face.

    Args:
        rays: Rays among the faces of the mesh.
        basis: Basis of the light.
        points: Positions, shape (S, 3).
        normals: Unit normals that the points are shaded with, shape (S, 3).
        planes: Unit normals of the faces of the points, shape (S, 3).
        positions: Positions of the lamps, shape (L, 3). None for those of the
            basis.

    Returns:
        The paths.
    """
    paths = basis.connect(points, normals, positions)
    with torch.no_grad():
        plane = planes[paths.point]
        origins = points[paths.point] + rays.offset * plane
        directions, lengths = unit_vectors((paths.source - origins).T)
        is_above = (directions.T * plane).sum(1) > 0
        is_free = is_above & (rays.first_hit(origins, directions.T, lengths) == NO_FACE)
    return LightPaths(*(field[is_free] for field in paths))


class LocalLightView:
    """A view of one shape in local light, for lights that change.

    It is computed on the CPU, where rays are cast. Rays are cast once for lights
    that stay in place, and again for lamps that moved. Derivatives hold fixed
    which lamps, and which pixel of a pattern, reach a sample.

    Args:
        rays: Rays among the faces of the shape.
        mesh: The mesh.
        fragments: Samples of the view.
        settings: Settings of the image.
        vertices: Vertices of the shape, (V, 3). None for those of the mesh.
        gloss: Gloss of the shape. None for that of the mesh.
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
        self._rays = rays
        vertices = None if vertices is None else vertices.cpu()
        self._surface = Surface(mesh, fragments.to("cpu"), settings, vertices, gloss)
        # Rays are cast from these. Derivatives by the vertices pass through them.
        self._points = self._surface.points
        self._normals = self._surface.normals
        self._planes = self._surface.planes
        self._fixed_paths: dict[LocalBasis, LightPaths] = {}

    def radiance(
        self,
        basis: LocalBasis,
        albedo: Tensor,
        light: Tensor,
        positions: Tensor | None = None,
        fragments: Fragments | None = None,
    ) -> Tensor:
        """Compute the radiance, differentiable in all tensors and in the vertices.

        Args:
            basis: Basis of the light.
            albedo: Linear albedo at the samples, shape (S, 3).
            light: Coefficients, shape (size, 3).
            positions: Positions of the lamps, shape (L, 3). None for those of
                the basis.
            fragments: The same samples in other pixels. None for those of the
                view.

        Returns:
            Radiance of P pixels, weighted with coverage, shape (3, P), in the
            dtype and on the device of the light.
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

    def _find_paths(self, basis: LocalBasis, positions: Tensor | None) -> LightPaths:
        """Return the unoccluded paths for lamps at given positions (L, 3)."""
        return unoccluded(self._rays, basis, self._points, self._normals, self._planes, positions)
