"""Shadows and bounces of environment light, by precomputed radiance transfer.

The source is Sloan, Kautz and Snyder 2002. The transfer of a pixel is its
radiance per unit of each SH coefficient of the light. It has three parts: the
transfer under an open sky, which has a closed form; minus the light from
directions that the mesh blocks; plus the light that the surface in these
directions reflects.

The reflected light is found by radiosity (Goral et al. 1984), for each
coefficient of the light. The surface is divided into N patches. Patch i with
albedo ρ_i sends the radiance B_i (size,) per unit of each coefficient:

    B_i = ρ_i / π (S_i + Σ_j F_ij B_j).

S_i (size,) is the irradiance from the part of the sky that the patch sees. F_ij
is the irradiance of patch i per unit radiance of patch j: the solid angle of j
times the cosine, found by rays. Both depend on the shape alone, so B is linear
in the light. One bounce is B = ρ S / π, and each further bounce substitutes B
on the right. A pixel receives Σ_j F_pixel,j B_j.

A patch is one side of several small faces that lie in one cell of a grid and
face the same way, or of a piece of a large face. Its S and F are those of a
pixel that shows the patch alone, so `rays` computes both.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_matrix, vstack
from torch import Tensor

from renderer.errors import InputError
from renderer.geometry.mesh import Mesh, refine
from renderer.light.basis import Basis, Harmonics
from renderer.settings import ImageSettings
from renderer.shading.gloss import SampleGloss, at_samples
from renderer.surface.albedo import surface_albedo
from renderer.transport import rays
from renderer.transport.rays import RayHits, Rays, Surface, sphere
from renderer.visibility.fragments import Fragments

# Directions of rays from a patch, over the whole sphere.
PATCH_DIRECTIONS = 2**9
# The area of a patch is about the area of the mesh divided by this number.
PATCHES = 2**11
# Projected corners of a triangle around the center of an image, in which each
# piece of a patch is seen.
AROUND_CENTER = [[-1.0, -1.0], [1.0, -1.0], [0.0, 2.0]]
FRONT = 1.0
BACK = -1.0


@dataclass(frozen=True)
class Patches:
    """The N patches of a mesh, which are made of the sides of its F pieces.

    A closed mesh has S = F sides, since its backs are never seen. Any other mesh
    has S = 2 F sides.

    Attributes:
        pieces: The mesh after large faces were divided into pieces.
        view: A view with a pixel for each patch, and a sample at the center of
            each side of a piece in it.
        fractions: Area of the piece of each sample, divided by the area of its
            patch, shape (S, 1).
        of_side: Patches of the front and of the back of each piece, shape (2, F).
    """

    pieces: Mesh
    view: Fragments
    fractions: Tensor
    of_side: Tensor

    @staticmethod
    def of(mesh: Mesh) -> "Patches":
        """Divide a mesh into patches."""
        largest_area = float(mesh.face_areas().sum()) / PATCHES
        pieces = refine(mesh, largest_area)
        piece_count = len(pieces.faces)
        sides = [FRONT] if pieces.closed else [FRONT, BACK]
        # All fronts, and then all backs, if there are any.
        facing = np.repeat(sides, piece_count)[:, None]
        piece_of_side = np.tile(np.arange(piece_count), len(sides))
        patch_of_side = _group_sides(pieces, piece_of_side, facing, math.sqrt(largest_area))
        # A view needs its samples in the order of its pixels.
        order = np.argsort(patch_of_side, kind="stable")
        pixel = torch.from_numpy(patch_of_side[order])
        piece = torch.from_numpy(piece_of_side[order])
        areas = torch.from_numpy(pieces.face_areas())[piece]
        patch_areas = areas.new_zeros(int(pixel[-1]) + 1).index_add_(0, pixel, areas)
        view = Fragments(
            size=1,
            samples=1,
            pixels=torch.arange(len(patch_areas)),
            coverage=torch.ones_like(patch_areas),
            faces=piece,
            corners=torch.from_numpy(pieces.faces)[piece],
            facing=torch.from_numpy(facing[order]),
            outlines=areas.new_tensor(AROUND_CENTER).expand(len(piece), 3, 2),
            pixel=pixel,
            face=torch.arange(len(piece)),
            sample=torch.zeros_like(piece),
        )
        smallest = torch.finfo(areas.dtype).tiny
        fractions = areas / patch_areas.clamp(min=smallest)[pixel]
        # A closed mesh has no backs. Their patches are then those of the fronts.
        of_side = torch.from_numpy(patch_of_side).view(len(sides), -1).expand(2, -1)
        return Patches(pieces, view, fractions[:, None], of_side)

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean (N, D) over each patch, weighted with area, of values (S, D)."""
        summed = values.new_zeros(len(self.view.pixels), values.shape[1])
        return summed.index_add_(0, self.view.pixel, values * self.fractions)

    def weights_by_patch(self, hits: RayHits, directions: Tensor, weights: Tensor) -> csr_matrix:
        """Sum the weights of directions over the patch that is hit there.

        Args:
            hits: Hits of B pixels.
            directions: The directions, shape (D, 3).
            weights: Weight of each pixel and direction, shape (B, D).

        Returns:
            Sums, sparse, shape (B, N).
        """
        pixel, direction = torch.nonzero(weights * (hits.face >= 0), as_tuple=True)
        face = hits.face[pixel, direction]
        is_back = (self._normals[face] * directions[direction]).sum(1) > 0
        patch = self.of_side[is_back.long(), face]
        entries = (weights[pixel, direction].numpy(), (pixel.numpy(), patch.numpy()))
        return csr_matrix(entries, (len(weights), len(self.view.pixels)))

    @cached_property
    def _normals(self) -> Tensor:
        """Return the unit normals of the pieces, shape (F, 3)."""
        return torch.from_numpy(self.pieces.face_normals())


def _group_sides(
    pieces: Mesh, piece_of_side: np.ndarray, facing: np.ndarray, cell: float
) -> np.ndarray:
    """Return the patch (S,) of each side, given its piece (S,) and its facing (S, 1).

    Sides share a patch if their centers lie in one cell of a grid with cells of
    the given width, and if they face the same way.
    """
    centers = pieces.vertices[pieces.faces].mean(axis=1)[piece_of_side]
    normals = pieces.face_normals()[piece_of_side]
    keys = np.hstack([np.floor(centers / cell), np.rint(normals), facing])
    _, patch_of_side = np.unique(keys, axis=0, return_inverse=True)
    # NumPy 2.0.0 gives the inverse a second axis.
    return patch_of_side.ravel()


class Transport:
    """The shadows that a mesh casts on itself, and the light that bounces within it.

    Both are stored per unit of the coefficients of an SH basis.

    Attributes:
        colors: Whether bounced light has another color than the light of the sky.
        rays: Rays among the faces of the mesh.

    Args:
        mesh: The mesh.
        settings: Settings of the image, with the number of bounces.
        albedo_scale: Factor of the albedo of the surfaces that light bounces off.
        basis: Basis of the light.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Harmonics):
        # Patches are only needed for bounces. Rays then hit the pieces of patches.
        self._patches = Patches.of(mesh) if settings.bounces else None
        self.rays = Rays(self._patches.pieces if self._patches else mesh)
        self._directions = sphere(rays.DIRECTIONS)
        self._sky = basis.radiance(self._directions)
        self.colors = False
        if self._patches:
            # The radiance that patches send, shape (N, size, 3), or (N, size, 1) if gray.
            self._sent = _radiosity(self._patches, self.rays, settings, albedo_scale, basis)
            self.colors = self._sent.shape[2] > 1

    def change(self, surface: Surface, albedo: Tensor) -> Tensor | None:
        """Compute how shadows and bounces change the transfer of a view.

        Args:
            surface: Samples of the view.
            albedo: Linear albedo at the samples, shape (S, C). C is 3 if
                `colors` is true.

        Returns:
            Change of the radiance of P pixels per unit coefficient, weighted
            with coverage, float64, shape (C, size, P). None if nothing changes.
        """
        change = None
        fragments = surface.fragments
        gloss = surface.gloss
        weights = albedo.T / fragments.samples**2
        diffuse = weights
        if gloss is not None:
            diffuse = weights * gloss.diffuse(surface.normals, surface.toward)
        for hits in self.rays.hits(surface, self._directions):
            if not hits.weight.any():
                continue
            if change is None:
                shape = (len(weights), self._sky.shape[1], len(fragments.pixels))
                change = self._sky.new_zeros(shape)
            if gloss is not None:
                colored, white = self._lobes(gloss, surface, hits.sample)
                entering = gloss.at(hits.sample).entering(self._cosines(surface, hits.sample))
            for channel, added in enumerate(change):
                reflected = diffuse[channel][hits.sample]
                if gloss is not None:
                    tinted = weights[channel][hits.sample] * colored
                    reflected = reflected * entering + (tinted + white / fragments.samples**2)
                blocked = hits.weight * reflected
                added[:, hits.pixels] = -(blocked @ self._sky).T
                if self._patches:
                    added[:, hits.pixels] += self._received(self._patches, hits, blocked, channel)
        return change

    def _received(self, patches: Patches, hits: RayHits, blocked: Tensor, channel: int) -> Tensor:
        """Return the light (size, B) that B pixels receive from patches in one channel.

        `blocked` (B, D) is the radiance of the pixel per radiance from each
        direction.
        """
        sent = self._sent[..., channel if self.colors else 0].numpy()
        received = patches.weights_by_patch(hits, self._directions, blocked) @ sent
        return torch.from_numpy(received).T

    def _cosines(self, surface: Surface, sample: Tensor) -> Tensor:
        """Return the cosines (B, D) between the normals at samples (B, D) and the directions."""
        return torch.einsum("bdi,di->bd", surface.normals[sample], self._directions)

    def _lobes(self, gloss: SampleGloss, surface: Surface, sample: Tensor) -> tuple[Tensor, Tensor]:
        """Return the colored and the white reflection (B, D) at samples (B, D).

        This is the radiance per irradiance from each direction. Lobes may be
        narrower than the directions are apart. They are therefore scaled such
        that their sum over the directions, under uniform light, is exact.
        """
        to_camera = at_samples(surface.toward, sample)
        normals = surface.normals[sample]
        colored, white = gloss.at(sample).along(normals, to_camera, self._directions)
        cosine = self._cosines(surface, sample).clamp(min=0)
        sampled = ((colored + white) * cosine).mean(1, keepdim=True) * 4
        colored_exact, exact = gloss.even(surface.normals, surface.toward)
        if colored_exact is not None:
            exact = exact + colored_exact
        smallest = torch.finfo(sampled.dtype).tiny
        scale = exact[sample].mean(1, keepdim=True) / sampled.clamp(min=smallest)
        return colored * scale, white * scale

    def radiance(self, surface: Surface, albedo: Tensor, light: Tensor) -> Tensor:
        """Compute how shadows and bounces change the radiance of a view in one light.

        The result is differentiable in the light, but not in the albedo.

        Args:
            surface: Samples of the view.
            albedo: Linear albedo at the samples, shape (S, 3).
            light: Coefficients, shape (size, 3).

        Returns:
            Change of the radiance of P pixels, weighted with coverage, shape
            (3, P), in the dtype of the light.
        """
        with torch.no_grad():
            change = self.change(surface, albedo.detach().cpu().double())
        if change is None:
            return light.new_zeros(3, len(surface.fragments.pixels))
        return torch.einsum("ckp,kc->cp", change.to(light), light)


def build_transport(
    mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis
) -> Transport | None:
    """Compute the shadows and bounces of environment light.

    Local lights are left out here, because they cast their shadows by
    themselves.

    Args:
        mesh: The mesh.
        settings: Settings of the image.
        albedo_scale: Factor of the albedo of the surfaces that light bounces off.
        basis: Basis of the light.

    Returns:
        Shadows and bounces, or None if the settings turn both off or the basis
        has no environment light.

    Raises:
        InputError: If the basis has local lights and light is to bounce.
    """
    if basis.local_lights and settings.bounces:
        raise InputError(
            f"bounces={settings.bounces}: light of {basis} does not bounce; set shadows"
        )
    environment = basis.environment
    if environment is None or not settings.global_illumination:
        return None
    return Transport(mesh, settings, albedo_scale, environment.basis)


def _radiosity(
    patches: Patches, rays: Rays, settings: ImageSettings, albedo_scale: float, basis: Harmonics
) -> Tensor:
    """Return the radiance B (N, size, 3) that patches send, or (N, size, 1) if all are gray."""
    sample_albedo = surface_albedo(patches.pieces, patches.view, settings.encoding)
    albedo = patches.mean(sample_albedo) * albedo_scale
    has_colors = bool((albedo != albedo[:, :1]).any())
    reflected = albedo[:, None, : 3 if has_colors else 1] / math.pi
    links = _PatchLinks.of(patches, rays, basis)
    sent = links.from_sky * reflected
    for _ in range(settings.bounces - 1):
        arriving = torch.from_numpy(links.factors @ sent.flatten(1).numpy())
        arriving = arriving.view(-1, *sent.shape[1:])
        from_sky = links.from_sky.expand_as(sent)
        sent = from_sky.index_add(0, links.receiving, arriving) * reflected
    return sent


@dataclass(frozen=True)
class _PatchLinks:
    """Irradiance of N patches from the sky and from each other.

    Attributes:
        from_sky: S, the irradiance from the sky per unit of each coefficient,
            shape (N, size, 1).
        receiving: Indices of the M patches that see other patches, shape (M,).
        factors: F, the irradiance of these patches per unit radiance of every
            patch, sparse, shape (M, N).
    """

    from_sky: Tensor
    receiving: Tensor
    factors: csr_matrix

    @staticmethod
    def of(patches: Patches, rays: Rays, basis: Harmonics) -> "_PatchLinks":
        """Trace rays from all patches to find the sky and the patches that they see."""
        surface = Surface(patches.pieces, patches.view, ImageSettings(1, 1, normals="flat"))
        from_sky = surface.planes.new_zeros(len(patches.view.pixels), basis.size)
        from_sky[:, basis.nonzero] = patches.mean(basis.irradiance(surface.planes))
        directions = sphere(PATCH_DIRECTIONS)
        radiance = basis.radiance(directions)
        receiving = []
        factors = []
        for hits in rays.hits(surface, directions):
            weights = hits.weight * patches.fractions[hits.sample, 0]
            from_sky[hits.pixels] -= weights @ radiance
            receiving.append(hits.pixels)
            factors.append(patches.weights_by_patch(hits, directions, weights))
        if not factors:
            nothing = csr_matrix((0, len(from_sky)))
            return _PatchLinks(from_sky[..., None], torch.arange(0), nothing)
        return _PatchLinks(from_sky[..., None], torch.cat(receiving), vstack(factors, format="csr"))
