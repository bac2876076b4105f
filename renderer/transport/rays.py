"""The surface at a view's samples, and rays from there among the faces of a mesh, cast by Embree (Wald et al. 2014).

All pixels use the same directions and divide them among their samples: so edges of shadow, of albedo and of the mesh
are averaged alike, and the cost of a pixel does not depend on its number of samples. Pixels that can see no other
surface, such as all of a convex mesh, cast no rays.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.geometry.normals import face_normals
from renderer.light.harmonics import per_degree
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss, SampleGloss, sample_gloss, toward_camera
from renderer.surface.shading import normals_in_sight, smooth_normals
from renderer.vectors import unit
from renderer.visibility.fragments import Fragments

DIRECTIONS = 512  # over the whole sphere; a flat pixel casts rays in half of them
OFFSET = 1e-5  # of the mesh's extent: rays start so far above the surface, since Embree computes in float32
COMPARISONS = 2**30  # of faces with vertices: about a second
BENT = 1 / 1024  # of an even sky: a face that blocks no more of it from its smooth normals is taken for flat
BLOCK = 2**17  # directions of pixels at a time: bounds the memory


@dataclass(frozen=True)
class Surface:
    """Points and normals at the S samples of a view, in float64, as they are needed. moved: vertices (V, 3) in place
    of the mesh's; points and normals are differentiable in them. given_gloss: in place of the mesh's."""

    mesh: Mesh
    fragments: Fragments
    settings: ImageSettings
    moved: Tensor | None = None
    given_gloss: Gloss | None = None

    @cached_property
    def vertices(self) -> Tensor:
        """(V, 3)"""
        return torch.from_numpy(self.mesh.vertices) if self.moved is None else self.moved.double()

    @cached_property
    def planes(self) -> Tensor:
        """(S, 3) unit normals of their faces, on the side that the camera sees."""
        return self.face_planes[self.fragments.face]

    @cached_property
    def face_planes(self) -> Tensor:
        """(G, 3) the same of each visible face."""
        return face_normals(self.vertices, self.fragments.corners) * self.fragments.facing

    @cached_property
    def normals(self) -> Tensor:
        """(S, 3) unit normals to shade with."""
        if self.settings.normals == "flat":
            return self.planes
        if self.moved is None:
            normals = torch.from_numpy(self.mesh.vertex_normals)  # which all views of the mesh share
        else:
            normals = normals_in_sight(self.fragments, self.vertices, torch.from_numpy(self.mesh.faces))
        return unit(smooth_normals(self.fragments, normals).T).T

    @cached_property
    def points(self) -> Tensor:
        """(S, 3)"""
        return self.fragments.interpolate(self.vertices[self.fragments.corners])

    @cached_property
    def gloss(self) -> SampleGloss | None:
        return sample_gloss(self.mesh, self.fragments, self.given_gloss)

    @cached_property
    def toward(self) -> Tensor:
        """(S, 3) unit vectors to the camera, or (1, 3) where all samples have the same."""
        return toward_camera(self.fragments, self.vertices)


class RayHits(NamedTuple):
    """The faces of the mesh that B of a view's pixels see in D directions; sample, weight, face: (B, D).

    pixels: (B,), indices among the view's. sample: from which the ray starts. weight: of the radiance from there in the
    pixel's irradiance, solid angle × cosine × the number of the pixel's samples, and zero where nothing blocks it.
    face: the first that the ray hits; -1 for none, and where the sample's own face blocks light from below it, which
    smooth normals would receive.
    """

    pixels: Tensor
    sample: Tensor
    weight: Tensor
    face: Tensor


class Rays:
    """Rays among the faces of one mesh. InputError, when the first ray is cast, where Embree is not installed."""

    def __init__(self, mesh: Mesh):
        self._mesh = mesh

    @cached_property
    def offset(self) -> float:
        """How far above its surface a ray starts."""
        return OFFSET * float(np.abs(self._mesh.vertices).max())

    def hits(self, surface: Surface, directions: Tensor) -> Iterator[RayHits]:
        """Blocks of a view's pixels that may see another surface, in directions (D, 3) of a `sphere`.
        A sample's face blocks all light from below its plane, as it would in the solid that a closed mesh bounds."""
        fragments = surface.fragments
        pixels = self._pixels_to_cast(surface)
        if not len(pixels):
            return
        planes, normals = surface.planes, surface.normals
        count = fragments.pixel.bincount(minlength=len(fragments.pixels))
        first = count.cumsum(0) - count
        solid_angle = 4 * math.pi / len(directions)
        for some in pixels.split(max(1, BLOCK // len(directions))):
            of_pixel = count[some, None]
            sample = first[some, None] + (_shuffled(len(directions)) + some[:, None]) % of_pixel
            cosine = torch.einsum("bdi,di->bd", normals[sample], directions).clamp(min=0)
            above = torch.einsum("bdi,di->bd", planes[sample], directions)
            cast = torch.nonzero((cosine > 0) & (above > 0), as_tuple=True)
            start = sample[cast]
            face = self.first_hit(surface.points[start] + self.offset * planes[start], directions[cast[1]])
            face = torch.full_like(sample, -1).index_put_(cast, face)
            weight = (cosine * of_pixel * solid_angle).masked_fill((face < 0) & (above >= 0), 0)
            yield RayHits(some, sample, weight, face)

    @cached_property
    def _scene(self) -> Any:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            advice = "pip install embreex, or set shadows=false and no lights that stand in the scene"
            raise InputError(f"shadows are found by rays that Embree casts: {advice}") from error
        scene = EmbreeScene(robust=True)
        TriangleMesh(scene, self._mesh.vertices.astype(np.float32), self._mesh.faces.astype(np.int32))
        return scene

    @cached_property
    def _outermost(self) -> Tensor:
        """The vertices on the convex hull, or all where they lie in a plane."""
        from scipy.spatial import ConvexHull, QhullError  # takes long to import

        vertices = self._mesh.vertices[np.unique(self._mesh.faces)]
        with suppress(QhullError):
            vertices = vertices[ConvexHull(vertices).vertices]
        return torch.from_numpy(vertices).double()

    def _pixels_to_cast(self, surface: Surface) -> Tensor:
        """The pixels with a sample on a face above whose plane other vertices lie, or whose plane blocks light: of an
        even sky (1 - cos) / 2, by the angle to the normal. All, where comparing would take longer than the rays."""
        fragments, planes = surface.fragments, surface.face_planes
        if len(planes) * len(self._outermost) > COMPARISONS:
            return torch.arange(len(fragments.pixels))
        parts = planes.split(max(1, 8 * BLOCK // len(self._outermost)))
        highest = torch.cat([(part @ self._outermost.T).amax(1) for part in parts])
        corners = surface.vertices[fragments.corners[:, 0]]
        rises = highest - (planes * corners).sum(1) > self.offset
        bent = (surface.normals * surface.planes).sum(1) < 1 - 2 * BENT
        return fragments.pixel[rises[fragments.face] | bent].unique()

    def first_hit(self, origins: Tensor, directions: Tensor, lengths: Tensor | None = None) -> Tensor:
        """(N,) the first face that each ray (N, 3) hits, -1 for none. lengths: (N,) of the rays."""
        rays = [origins, directions] if lengths is None else [origins, directions, lengths]
        faces = self._scene.run(*(np.ascontiguousarray(array.numpy(), np.float32) for array in rays))
        return torch.from_numpy(faces).long()


@per_degree
def sphere(count: int) -> Tensor:
    """(count, 3) float64 directions that share the sphere equally: the spherical Fibonacci lattice."""
    index = torch.arange(count, dtype=torch.float64)
    z, azimuth = 1 - (2 * index + 1) / count, math.pi * (3 - math.sqrt(5)) * index
    radius = (1 - z**2).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=1)


@per_degree
def _shuffled(count: int) -> Tensor:
    """A fixed permutation of 0 to count - 1, so that each sample gets directions from all over the sphere."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))
