"""Shadows and bounces of environment light: precomputed radiance transfer (Sloan, Kautz and Snyder 2002), per pixel.

A pixel's transfer is that under an open sky, in closed form, less the light from directions that the mesh blocks, plus
the light that the surface there reflects. That is radiosity (Goral et al. 1984), per coefficient of the light: with
albedo ρ_i, patch i sends the radiance B_i (size,) per unit of each coefficient,

    B_i = ρ_i / π (S_i + Σ_j F_ij B_j),

where S_i is the irradiance from the part of the sky that the patch sees and F_ij the irradiance of i per unit radiance
of j: the solid angle of j times the cosine, by rays. Both are constants of the shape, so B is linear in the light, and
N bounces are N − 1 substitutions of B on the right, from B = ρ S / π on. A pixel adds Σ_j F_pixel,j B_j.

A patch is one side of several small faces that lie in one cell of a grid and face the same way, or of a piece of a
large face. Its S and F are those of a pixel that shows the patch alone, so the code of `rays` serves both.
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
from renderer.surface.albedo import surface_albedo
from renderer.surface.gloss import SampleGloss, at_samples
from renderer.transport import rays
from renderer.transport.rays import RayHits, Rays, Surface, sphere
from renderer.visibility.fragments import Fragments

PATCH_DIRECTIONS = 2**9  # over the whole sphere, in which a patch looks
PATCHES = 2**11  # the mesh's area over that is about the area of a patch
MIDDLE = [[-1.0, -1.0], [1.0, -1.0], [0.0, 2.0]]  # a triangle around the only sample of an image


@dataclass(frozen=True)
class Patches:
    """N patches of a mesh's F pieces. view: a pixel for each patch, with the centers of its pieces as samples (S,).

    fractions: (S, 1), of a piece in the area of its patch. of_side: (2, F), the patches of each piece's front and back.
    """

    pieces: Mesh
    view: Fragments
    fractions: Tensor
    of_side: Tensor

    @staticmethod
    def of(mesh: Mesh) -> "Patches":
        area = float(mesh.face_areas().sum()) / PATCHES
        pieces = refine(mesh, area)
        count, sides = len(pieces.faces), [1.0] if pieces.closed else [1.0, -1.0]
        facing, faces = np.repeat(sides, count)[:, None], np.tile(np.arange(count), len(sides))
        middles = pieces.vertices[pieces.faces].mean(axis=1)[faces]
        alike = np.hstack([np.floor(middles / math.sqrt(area)), np.rint(pieces.face_normals()[faces]), facing])
        patch = np.unique(alike, axis=0, return_inverse=True)[1].ravel()  # NumPy 2.0.0 gives it a second axis
        order = np.argsort(patch, kind="stable")
        pixel, piece = torch.from_numpy(patch[order]), torch.from_numpy(faces[order])
        areas = torch.from_numpy(pieces.face_areas())[piece]
        totals = areas.new_zeros(int(pixel[-1]) + 1).index_add_(0, pixel, areas)
        view = Fragments(
            size=1,
            samples=1,
            pixels=torch.arange(len(totals)),
            coverage=torch.ones_like(totals),
            faces=piece,
            corners=torch.from_numpy(pieces.faces)[piece],
            facing=torch.from_numpy(facing[order]),
            outlines=areas.new_tensor(MIDDLE).expand(len(piece), 3, 2),
            pixel=pixel,
            face=torch.arange(len(piece)),
            sample=torch.zeros_like(piece),
        )
        fractions = areas / totals.clamp(min=torch.finfo(areas.dtype).tiny)[pixel]
        of_side = torch.from_numpy(patch).view(len(sides), -1).expand(2, -1)
        return Patches(pieces, view, fractions[:, None], of_side)

    def mean(self, values: Tensor) -> Tensor:
        """(N, D) of values (S, D) at the samples."""
        summed = values.new_zeros(len(self.view.pixels), values.shape[1])
        return summed.index_add_(0, self.view.pixel, values * self.fractions)

    def weights_by_patch(self, hits: RayHits, directions: Tensor, weights: Tensor) -> csr_matrix:
        """(B, N) sums of the weights (B, D) of directions (D, 3) over the patch that is hit there."""
        pixel, direction = torch.nonzero(weights * (hits.face >= 0), as_tuple=True)
        face = hits.face[pixel, direction]
        behind = (self._normals[face] * directions[direction]).sum(1) > 0
        entries = pixel.numpy(), self.of_side[behind.long(), face].numpy()
        return csr_matrix((weights[pixel, direction].numpy(), entries), (len(weights), len(self.view.pixels)))

    @cached_property
    def _normals(self) -> Tensor:
        return torch.from_numpy(self.pieces.face_normals())


class Transport:
    """The shadows that a mesh casts on itself and the light that bounces within it, per unit of a basis.
    colors: whether bounced light has another color than the sky's. rays: among the mesh's faces."""

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Harmonics):
        """albedo_scale: of the surfaces that light bounces off."""
        self._patches = Patches.of(mesh) if settings.bounces else None
        self.rays = Rays(self._patches.pieces if self._patches else mesh)
        self._directions = sphere(rays.DIRECTIONS)
        self._sky = basis.radiance(self._directions)
        self.colors = False
        if self._patches:
            self._sent = _radiosity(self._patches, self.rays, settings, albedo_scale, basis)
            self.colors = self._sent.shape[2] > 1

    def change(self, surface: Surface, albedo: Tensor) -> Tensor | None:
        """(C, size, P) float64: the change of the radiance of a view's pixels per unit coefficient, weighted with
        coverage; None for no change. albedo: (S, C) linear, at the samples; C is 3 if the light has `colors`.
        """
        change, fragments = None, surface.fragments
        weights, gloss = albedo.T / fragments.samples**2, surface.gloss
        diffuse = weights if gloss is None else weights * gloss.diffuse(surface.normals, surface.toward)
        for hits in self.rays.hits(surface, self._directions):
            if not hits.weight.any():
                continue
            if change is None:
                change = self._sky.new_zeros(len(weights), self._sky.shape[1], len(fragments.pixels))
            if gloss is not None:
                colored, white = self._lobes(gloss, surface, hits.sample)
                cosine = torch.einsum("bdi,di->bd", surface.normals[hits.sample], self._directions)
                entering = gloss.at(hits.sample).entering(cosine)
            for channel, added in enumerate(change):
                reflected = diffuse[channel][hits.sample]
                if gloss is not None:
                    shine = weights[channel][hits.sample] * colored + white / fragments.samples**2
                    reflected = reflected * entering + shine
                blocked = hits.weight * reflected
                added[:, hits.pixels] = -(blocked @ self._sky).T
                if self._patches:
                    sent = self._sent[..., channel if self.colors else 0].numpy()
                    received = self._patches.weights_by_patch(hits, self._directions, blocked) @ sent
                    added[:, hits.pixels] += torch.from_numpy(received).T
        return change

    def _lobes(self, gloss: SampleGloss, surface: Surface, sample: Tensor) -> tuple[Tensor, Tensor]:
        """(colored, white) radiance (B, D) per irradiance from the directions at samples (B, D). Lobes may be narrower
        than the directions are apart: they are scaled to reflect as much of an even sky as they do in closed form."""
        normals, toward = surface.normals[sample], at_samples(surface.toward, sample)
        colored, white = gloss.at(sample).along(normals, toward, self._directions)
        cosine = torch.einsum("bdi,di->bd", normals, self._directions).clamp(min=0)
        sampled = ((colored + white) * cosine).mean(1, keepdim=True) * 4
        colored_exact, exact = gloss.even(surface.normals, surface.toward)
        exact = exact if colored_exact is None else exact + colored_exact
        scale = exact[sample].mean(1, keepdim=True) / sampled.clamp(min=torch.finfo(sampled.dtype).tiny)
        return colored * scale, white * scale

    def radiance(self, surface: Surface, albedo: Tensor, light: Tensor) -> Tensor:
        """(3, P) in the light's dtype: `change` in a light (size, 3); differentiable in it, not in the albedo."""
        with torch.no_grad():
            change = self.change(surface, albedo.detach().cpu().double())
        if change is None:
            return light.new_zeros(3, len(surface.fragments.pixels))
        return torch.einsum("ckp,kc->cp", change.to(light), light)


def build_transport(mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis) -> Transport | None:
    """None without shadows and bounces of environment light; local lights cast their shadows by themselves. InputError:
    bounces of local lights."""
    if basis.local_lights and settings.bounces:
        raise InputError(f"bounces={settings.bounces}: light of {basis} does not bounce; set shadows")
    environment = basis.environment
    if environment is None or not settings.global_illumination:
        return None
    return Transport(mesh, settings, albedo_scale, environment.basis)


def _radiosity(patches: Patches, rays: Rays, settings: ImageSettings, albedo_scale: float, basis: Harmonics) -> Tensor:
    """B (N, size, 3), or (N, size, 1) where all patches are gray. rays: among the patches' pieces."""
    albedo = patches.mean(surface_albedo(patches.pieces, patches.view, settings.encoding)) * albedo_scale
    colors = bool((albedo != albedo[:, :1]).any())
    reflected = albedo[:, None, : 3 if colors else 1] / math.pi
    from_sky, receiving, links = _first_bounce(patches, rays, basis)
    sent = from_sky * reflected
    for _ in range(settings.bounces - 1):
        arriving = torch.from_numpy(links @ sent.flatten(1).numpy()).view(-1, *sent.shape[1:])
        sent = from_sky.expand_as(sent).index_add(0, receiving, arriving) * reflected
    return sent


def _first_bounce(patches: Patches, rays: Rays, basis: Harmonics) -> tuple[Tensor, Tensor, csr_matrix]:
    """S (N, size, 1), the irradiance of the patches from the sky; the M patches that see others; their F (M, N)."""
    surface = Surface(patches.pieces, patches.view, ImageSettings(1, 1, normals="flat"))
    from_sky = surface.planes.new_zeros(len(patches.view.pixels), basis.size)
    from_sky[:, basis.nonzero] = patches.mean(basis.irradiance(surface.planes))
    directions = sphere(PATCH_DIRECTIONS)
    receiving, links, radiance = [], [], basis.radiance(directions)
    for hits in rays.hits(surface, directions):
        weights = hits.weight * patches.fractions[hits.sample, 0]
        from_sky[hits.pixels] -= weights @ radiance
        receiving.append(hits.pixels)
        links.append(patches.weights_by_patch(hits, directions, weights))
    if not links:
        return from_sky[..., None], torch.arange(0), csr_matrix((0, len(from_sky)))
    return from_sky[..., None], torch.cat(receiving), vstack(links, format="csr")
