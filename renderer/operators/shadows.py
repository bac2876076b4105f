"""Shadows and bounces of environment light, by precomputed radiance transfer.

The source is Sloan, Kautz and Snyder 2002. The transfer of a pixel is its
radiance per unit of each SH coefficient of the light. The transfer has three
parts:

- the transfer under an open sky, which has a closed form;
- minus the light from the directions that the mesh blocks;
- plus the light that the surfaces in these directions reflect.

The reflected light is found by radiosity (Goral et al. 1984), for each
coefficient of the light. The surface is divided into N patches. Patch i with
albedo ρ_i sends the radiance B_i per unit of each of the K coefficients:

    B_i = ρ_i / π (S_i + Σ_j F_ij B_j).

S_i is the irradiance of patch i from the part of the sky that the patch sees.
F_ij is the irradiance of patch i per unit radiance of patch j: the solid angle
of patch j times the cosine, found by rays. S and F depend on the shape alone,
so B is linear in the light. One bounce is B = ρ S / π. Each further bounce
inserts B on the right-hand side. A pixel receives Σ_j F_pixel,j B_j.

A patch consists of sides of faces. Small faces share a patch if they lie in one
cell of a grid and face the same way. Large faces are first divided into pieces.
S and F of a patch are computed like those of a pixel that shows only this
patch, with the rays of `renderer.operators.rays`.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix, vstack
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from renderer.errors import InputError
from renderer.light.basis import Basis, Harmonics
from renderer.mesh import Mesh, refine
from renderer.operators import rays
from renderer.operators.rays import BlockedRays, Rays, Surface, ray_directions
from renderer.settings import ImageSettings
from renderer.surface.albedo import surface_albedo
from renderer.surface.gloss import SampleGloss, at_samples
from renderer.visibility.fragments import Fragments

# Number of ray directions from each patch. They cover the whole sphere.
PATCH_DIRECTIONS = 2**9
# Approximate number of patches of the surface of a mesh, between which light bounces.
PATCHES = 2**11
# Largest number of patches. With more, bounces would take long.
MAX_PATCHES = 2**15
# Image positions (x, y) of the corners of a triangle around the image center. In the
# artificial view `Patches.view`, each piece of the mesh covers this triangle. A sample at
# the image center then shows the center of the piece.
AROUND_CENTER = [[-1.0, -1.0], [1.0, -1.0], [0.0, 2.0]]
# Values of `Fragments.facing` for the front and the back of a face.
FRONT = 1.0
BACK = -1.0


@dataclass(frozen=True)
class Patches:
    """Division of the surface of a mesh into N patches.

    The large faces of the mesh are first divided, which gives a mesh of F small
    faces, called pieces. A patch is a group of sides of pieces. A closed mesh
    has S = F sides, because only the fronts of its faces can be seen. Any other
    mesh has S = 2 F sides, the fronts and the backs.

    Attributes:
        pieces: Mesh of the F pieces.
        view: Artificial view that has one pixel for each patch, and one sample
            for each side of a piece. The sample shows the center of the piece
            and belongs to the pixel of its patch.
        fractions: Area of the piece that each sample shows, divided by the area
            of its patch, shape (S, 1).
        patch_of_side: Index of the patch of the front (row 0) and of the back
            (row 1) of each piece, int64, shape (2, F). Both rows are equal for
            a closed mesh.
        normals: Unit normals of the F pieces.
    """

    pieces: Mesh
    view: Fragments
    fractions: Float[Tensor, "S 1"]
    patch_of_side: Int[Tensor, "2 F"]
    normals: Float[Tensor, "F 3"]

    @staticmethod
    def from_mesh(mesh: Mesh, encoding: str) -> "Patches":
        """Divide the surface of a mesh into patches of about the same area.

        The faces are first divided into small faces, called pieces. A patch is a
        group of neighboring pieces. The fronts and the backs of the same pieces are
        different patches. The backs of a closed mesh are left out.
        """
        # Area of a side of the cells below, so that there are about PATCHES patches.
        patch_area = float(mesh.face_areas().sum()) / PATCHES
        pieces = refine(mesh, patch_area, encoding)
        piece_count = len(pieces.faces)
        sides = [FRONT] if pieces.closed else [FRONT, BACK]
        # One entry for each side: the fronts of all small faces (pieces), then all backs.
        facing = np.repeat(sides, piece_count)[:, None]
        piece_of_side = np.tile(np.arange(piece_count), len(sides))
        # Two sides belong to the same patch if the centers of their pieces lie in the same cell of
        # a cubic grid, if the normals are equal after each component is rounded to -1, 0 or 1, if
        # both sides are fronts or both are backs, and if the pieces are connected.
        centers = pieces.vertices[pieces.faces].mean(axis=1)
        cells = np.floor((centers - mesh.origin) / math.sqrt(patch_area))
        normals = pieces.face_normals()
        keys = np.hstack([cells, np.rint(normals)])[piece_of_side]
        _, patch_of_side = np.unique(np.hstack([keys, facing]), axis=0, return_inverse=True)
        # NumPy 2.0.0 returns the shape (S, 1), other versions return (S,).
        patch_of_side = _connected(pieces, piece_of_side, patch_of_side.ravel())
        # Each side becomes a sample. Sort them by patch, because `Fragments` needs the
        # samples of a pixel (here, a patch) next to each other.
        sample_to_side = np.argsort(patch_of_side, kind="stable")
        sample_to_patch = torch.from_numpy(patch_of_side[sample_to_side])
        sample_to_piece = torch.from_numpy(piece_of_side[sample_to_side])
        areas = torch.from_numpy(pieces.face_areas())[sample_to_piece]
        patch_count = int(sample_to_patch[-1]) + 1
        patch_areas = areas.new_zeros(patch_count).index_add_(0, sample_to_patch, areas)
        view = Fragments(
            shape=(1, 1),
            samples=1,
            pixels=torch.arange(patch_count),
            coverage=torch.ones_like(patch_areas),
            faces=sample_to_piece,
            corners=torch.from_numpy(pieces.faces)[sample_to_piece],
            facing=torch.from_numpy(facing[sample_to_side]),
            outlines=areas.new_tensor(AROUND_CENTER).expand(len(sample_to_piece), 3, 2),
            sample_to_pixel=sample_to_patch,
            # The tensor `faces` has one entry for each sample, so sample i shows entry i.
            sample_to_seen_face=torch.arange(len(sample_to_piece)),
            # The artificial image has a single sample position, where all samples lie.
            sample_numbers=torch.zeros_like(sample_to_piece),
        )
        fractions = areas / patch_areas.clamp(min=torch.finfo(areas.dtype).tiny)[sample_to_patch]
        # One row for the fronts of all faces, one for their backs. A closed mesh has no row
        # for backs, because rays never hit them. `expand` then repeats the first row.
        patch_by_side = torch.from_numpy(patch_of_side).view(len(sides), -1).expand(2, -1)
        return Patches(pieces, view, fractions[:, None], patch_by_side, torch.from_numpy(normals))

    def mean(self, values: Float[Tensor, "S D"]) -> Float[Tensor, "N D"]:
        """Average values over each of the N patches.

        A patch is a group of sides (fronts or backs) of pieces, the small faces of
        the mesh. The means are weighted with the areas of the pieces. The values are in the
        order of the samples of `view`.
        """
        patch_sums = values.new_zeros(len(self.view.pixels), values.shape[1])
        return patch_sums.index_add_(0, self.view.sample_to_pixel, values * self.fractions)

    def sum_by_patch(
        self, blocked: BlockedRays, directions: Float[Tensor, "D 3"], weights: Float[Tensor, " E"]
    ) -> csr_matrix:
        """Add up the weights of the rays from a pixel that hit the same patch.

        A patch is a group of pieces, the small faces of the mesh `pieces`. The result has
        one row for each pixel, and one column for each patch.
        """
        is_hit = blocked.face != rays.NO_FACE
        piece = blocked.face[is_hit]
        # A ray hits the back of a face if it goes in the direction of the outer normal.
        is_back = (self.normals[piece] * directions[blocked.direction[is_hit]]).sum(1) > 0
        patch = self.patch_of_side[is_back.long(), piece]
        # `csr_matrix` adds up entries with the same pixel and patch.
        entries = (weights[is_hit].numpy(), (blocked.row[is_hit].numpy(), patch.numpy()))
        return csr_matrix(entries, (len(blocked.pixels), len(self.view.pixels)))


def _connected(
    pieces: Mesh, piece_of_side: Int[np.ndarray, " S"], group_of_side: Int[np.ndarray, " S"]
) -> Int[np.ndarray, " S"]:
    """Divide groups of sides of pieces into connected ones, and return the index of each side.

    Without this, a surface just below another, such as that of a table below a book, would share
    its patches. Groups of a mesh of many small parts stay as they are, to limit the time.
    """
    corners = pieces.vertices[pieces.faces[piece_of_side]].reshape(-1, 3)
    _, corner = np.unique(corners, axis=0, return_inverse=True)
    # Nodes of the graph are the corners of each group. A side connects its three nodes.
    node = corner.reshape(-1, 3) * (group_of_side.max() + 1) + group_of_side[:, None]
    nodes, node = np.unique(node, return_inverse=True)
    node = node.reshape(-1, 3)
    starts, ends = node[:, [0, 1]].ravel(), node[:, [1, 2]].ravel()
    graph = csr_matrix((np.ones(len(starts)), (starts, ends)), (len(nodes), len(nodes)))
    count, part_of_node = connected_components(graph, directed=False)
    return part_of_node[node[:, 0]].astype(np.int64) if count <= MAX_PATCHES else group_of_side


class Transport:
    """Computes how shadows and bounced light change the images of a mesh.

    The mesh casts shadows on itself, and light bounces between its faces. The
    change of an image is linear in the light, so it is computed for each of the K
    SH coefficients of environment light.

    Attributes:
        has_colored_light: True if bounced light is colored. The change then differs
            between the three color channels.
        rays: Rays among the faces of the mesh.

    Args:
        mesh: Mesh that casts shadows on itself.
        settings: Settings of the image, with the number of bounces.
        albedo_scale: Factor for the albedo of the surfaces that light bounces
            off.
        basis: SH basis of the environment light.
    """

    def __init__(self, mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Harmonics):
        """Divide the mesh into patches, and compute the light that they send, if light bounces."""
        # Only bounces need patches. Rays then hit the small faces (pieces) of which the patches
        # consist.
        self._patches = Patches.from_mesh(mesh, settings.encoding) if settings.bounces else None
        self.rays = Rays(self._patches.pieces if self._patches else mesh)
        ray_count = max(rays.DIRECTIONS, rays.DIRECTIONS_PER_SAMPLE * settings.samples**2)
        # Ray directions of an exact image, and of a draft.
        self._directions = [ray_directions(count) for count in (ray_count, rays.DRAFT_DIRECTIONS)]
        # Radiance of the sky: one row for each ray direction, one column for each SH coefficient.
        self._skies = [basis.radiance(directions) for directions in self._directions]
        self.has_colored_light = False
        if self._patches:
            # Radiance that the patches send, with the axes: patch, SH coefficient, color. The
            # last axis has the size 1 if the three colors are equal.
            self._sent = _radiosity(self._patches, self.rays, settings, albedo_scale, basis)
            self.has_colored_light = self._sent.shape[2] > 1

    def change(
        self,
        surface: Surface,
        albedo: Float[Tensor, "S C"],
        light: Float[Tensor, "K 3"] | None = None,
        is_draft: bool = False,
    ) -> Float[Tensor, "C _ P"] | None:
        """Compute how shadows and bounces change the transfer matrix of a view.

        The second axis of the result has the K coefficients of the light, or the size 1 if a light
        is given.

        The albedo has 3 channels if `has_colored_light` is true, and otherwise 1 or 3. None
        means that no surface blocks light. A draft casts `rays.DRAFT_DIRECTIONS` rays from each
        pixel.
        """

        def in_light(radiance: Float[Tensor, "N K"], channel: int) -> Float[Tensor, "N _"]:
            """Return the radiance of each SH coefficient, or its sum in the light."""
            return radiance if light is None else radiance @ light[:, channel, None]

        change = None
        directions, sky = self._directions[is_draft], self._skies[is_draft]
        fragments = surface.fragments
        gloss = surface.gloss
        # Albedo divided by the number of samples of a pixel: one row for each channel, one
        # column for each sample.
        albedo_by_channel = albedo.T / fragments.samples**2
        diffuse_albedo = albedo_by_channel
        if gloss is not None:
            cosine = (surface.normals * surface.toward).sum(1)
            diffuse_albedo = albedo_by_channel * gloss.diffuse_factor(cosine)
            in_uniform_light = gloss.reflect_uniform_light(cosine)
        channels = range(len(albedo_by_channel))
        skies = [in_light(sky, channel) for channel in channels]
        if self._patches:
            colors = self._sent.expand(-1, -1, len(channels)).unbind(2)
            sent = [in_light(color, channel) for channel, color in enumerate(colors)]
        for blocked in self.rays.blocked(surface, directions):
            if change is None:
                change = sky.new_zeros(len(channels), skies[0].shape[1], len(fragments.pixels))
            if gloss is not None:
                shown = gloss, surface, in_uniform_light, blocked, directions
                metallic, white, transmittance = _reflect_rays(*shown)
            for channel, channel_change in enumerate(change):
                # Reflected radiance per irradiance, for light along each ray.
                reflectance = diffuse_albedo[channel][blocked.sample]
                if gloss is not None:
                    colored = albedo_by_channel[channel][blocked.sample] * metallic
                    specular = colored + white / fragments.samples**2
                    reflectance = reflectance * transmittance + specular
                weights = blocked.weight * reflectance
                # Subtract the light of the sky that the mesh blocks: one row for each column of
                # the sky, one column for each pixel.
                channel_change[:, blocked.pixels] = -blocked.add_light(weights, skies[channel]).T
                if self._patches:
                    # Add the light that the pixels receive from patches and reflect.
                    by_patch = self._patches.sum_by_patch(blocked, directions, weights)
                    added = torch.from_numpy(by_patch @ sent[channel].numpy())
                    channel_change[:, blocked.pixels] += added.T
        return change

    def radiance(
        self, surface: Surface, albedo: Float[Tensor, "S 3"], light: Float[Tensor, "K 3"]
    ) -> Float[Tensor, "3 P"]:
        """Compute how shadows and bounces change the radiance of a view under one light.

        The result is differentiable with respect to the light, but not with
        respect to the albedo. The change is multiplied by the fraction of each pixel that
        the mesh covers.
        """
        with torch.no_grad():
            change = self.change(surface, albedo.detach().cpu().double())
        if change is None:
            return light.new_zeros(3, len(surface.fragments.pixels))
        # Sum over the coefficients k of the light, for each channel c and pixel p.
        return torch.einsum("ckp,kc->cp", change.to(light), light)


def _reflect_rays(
    gloss: SampleGloss,
    surface: Surface,
    in_uniform_light: Float[Tensor, " S"],
    blocked: BlockedRays,
    directions: Float[Tensor, "D 3"],
) -> tuple[Float[Tensor, " E"], Float[Tensor, " E"], Float[Tensor, " E"]]:
    """Compute how a glossy surface reflects light from the directions of E rays.

    The first two results are specular reflectances: one that is multiplied by the albedo, because
    metals color reflections, and one that has the color of the light. The third is the fraction of
    the light that passes the coat to the diffuse layer below it.

    The specular reflection may be narrower than the angle between two of the D ray directions.
    The reflectances of a pixel are therefore scaled so that their sum over the directions is
    exact for uniform light (`SampleGloss.reflect_uniform_light`).
    """
    sample_of_ray = surface.samples_of_rays(blocked.pixels, len(directions))
    normals = surface.normals[sample_of_ray]
    cosine = torch.einsum("bdi,di->bd", normals, directions)
    to_camera = at_samples(surface.toward, sample_of_ray)
    colored, white = gloss.at(sample_of_ray).reflect_beams(normals, to_camera, directions)
    # Reflected radiance in uniform light of irradiance 1, that is, of radiance 1 / π. The
    # D directions have the solid angle 4π / D each. Sum · 4π / D · 1 / π is 4 · mean.
    sampled = ((colored + white) * cosine.clamp(min=0)).mean(1, keepdim=True) * 4
    smallest = torch.finfo(sampled.dtype).tiny
    scale = in_uniform_light[sample_of_ray].mean(1, keepdim=True) / sampled.clamp(min=smallest)
    at_rays = blocked.row, blocked.direction
    transmittance = gloss.at(blocked.sample).coat_transmittance(cosine[at_rays])
    return (colored * scale)[at_rays], (white * scale)[at_rays], transmittance


def build_transport(
    mesh: Mesh, settings: ImageSettings, albedo_scale: float, basis: Basis
) -> Transport | None:
    """Prepare the computation of shadows and bounces of environment light.

    The shadows of lamps and projectors are not included. They are computed in
    `renderer.operators.rays`. The result is None without shadows and bounces, or
    without environment light. Bounces with local lights raise `InputError`.
    """
    if basis.local_lights and settings.bounces:
        fault = f"bounces={settings.bounces} is not possible with {basis}"
        advice = "set bounces=0, and shadows=true if you want shadows"
        raise InputError(f"{fault}, because only environment light can bounce: {advice}")
    environment = basis.environment
    if environment is None or not settings.global_illumination:
        return None
    return Transport(mesh, settings, albedo_scale, environment.basis)


def _radiosity(
    patches: Patches, rays: Rays, settings: ImageSettings, albedo_scale: float, basis: Harmonics
) -> Float[Tensor, "N K _"]:
    """Compute the radiance that N patches send after `settings.bounces` bounces (radiosity).

    After one bounce, patch i with albedo ρ_i sends the radiance B_i = ρ_i / π S_i, where S_i is its
    irradiance from the sky. After each further bounce, it sends ρ_i / π (S_i + Σ_j F_ij B_j). F_ij
    is the irradiance of patch i per unit radiance of patch j. The last axis of the result has size
    1 if all patches are gray.
    """
    sample_albedo = surface_albedo(patches.pieces, patches.view, settings.encoding)
    # Mean albedo: one row for each patch, one column for each color.
    patch_albedo = patches.mean(sample_albedo) * albedo_scale
    channel_count = 3 if (patch_albedo != patch_albedo[:, :1]).any() else 1
    # Sent radiance per irradiance ρ_i / π. Axes: patch, one of size 1, color.
    reflectance = patch_albedo[:, None, :channel_count] / math.pi
    # Irradiance from the sky (N, K, 1), the patches that see others, and F (M, N) for these.
    from_sky, receiving, factors = _link_patches(patches, rays, basis)
    sent = from_sky * reflectance
    for _ in range(settings.bounces - 1):
        # Irradiance from other patches. Axes: patch that sees others, SH coefficient, color.
        from_patches = torch.from_numpy(factors @ sent.flatten(1).numpy()).view(-1, *sent.shape[1:])
        sent = from_sky.expand_as(sent).index_add(0, receiving, from_patches) * reflectance
    return sent


def _link_patches(
    patches: Patches, rays: Rays, basis: Harmonics
) -> tuple[Float[Tensor, "N K 1"], Int[Tensor, " M"], csr_matrix]:
    """Cast rays from all N patches to find which parts of the sky and which patches they see.

    The results are the irradiance from the visible part of the sky, per unit of each of the K SH
    coefficients; the indices of the M patches that see other patches; and the irradiance of each of
    these patches per unit radiance of each of the N patches, shape (M, N).
    """
    surface = Surface(patches.pieces, patches.view, ImageSettings(1, 1, normals="flat"))
    patch_count = len(patches.view.pixels)
    # One row for each patch, one column for each SH coefficient: the irradiance from the
    # whole sky. The loop below subtracts the directions that the mesh blocks.
    from_sky = surface.planes.new_zeros(patch_count, basis.size)
    from_sky[:, basis.nonzero] = patches.mean(basis.irradiance(surface.planes))
    directions = ray_directions(PATCH_DIRECTIONS)
    sky_radiance = basis.radiance(directions)
    receiving = [torch.arange(0)]
    factors = [csr_matrix((0, patch_count))]
    for blocked in rays.blocked(surface, directions):
        # A patch consists of several small faces (pieces). The weight of a ray contains
        # the area of the piece from which it starts, divided by the area of the patch.
        weights = blocked.weight * patches.fractions[blocked.sample, 0]
        from_sky[blocked.pixels] -= blocked.add_light(weights, sky_radiance)
        receiving.append(blocked.pixels)
        factors.append(patches.sum_by_patch(blocked, directions, weights))
    return from_sky[..., None], torch.cat(receiving), vstack(factors, format="csr")
