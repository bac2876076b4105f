"""Surface points at the samples of a view, and rays from these points among the faces of a mesh.

Rays are cast by Embree (Wald et al. 2014). All pixels use the same directions
and divide them among their samples. Edges of shadows, of albedo and of the mesh
are therefore averaged in the same way, and the cost of a pixel does not depend
on its number of samples. Pixels that can see no other surface, such as all
pixels of a convex mesh, cast no rays.

Shapes use these letters: a view has S samples in P pixels, which show G faces.
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
from renderer.shading.gloss import Gloss, SampleGloss, sample_gloss, toward_camera
from renderer.shading.shading import normals_in_sight, smooth_normals
from renderer.vectors import unit
from renderer.visibility.fragments import Fragments

# Directions of rays over the whole sphere. A flat pixel casts rays in half of them.
DIRECTIONS = 512
# Rays start this far above the surface, as a fraction of the mesh's extent,
# because Embree computes in float32.
OFFSET = 1e-5
# `Rays` compares faces with vertices to leave out pixels, unless there are more
# pairs. As many comparisons take about a second.
COMPARISONS = 2**30
# A face may block light from above the plane of a smooth normal. It counts as
# flat if it blocks at most this fraction of uniform environment light.
BENT = 1 / 1024
# `Rays` processes as many pairs of pixel and direction at once, which bounds the
# memory.
BLOCK = 2**17
# The face of a ray that hits nothing.
NO_FACE = -1


@dataclass(frozen=True)
class Surface:
    """Points, normals and gloss at the S samples of a view, computed when they are needed.

    Points and normals are float64, and differentiable in `moved`.

    Attributes:
        mesh: The mesh.
        fragments: The samples.
        settings: Settings of the image. They choose smooth or flat normals.
        moved: Vertex positions instead of those of the mesh, shape (V, 3). None
            for those of the mesh.
        given_gloss: Gloss instead of that of the mesh. None for that of the mesh.
    """

    mesh: Mesh
    fragments: Fragments
    settings: ImageSettings
    moved: Tensor | None = None
    given_gloss: Gloss | None = None

    @cached_property
    def vertices(self) -> Tensor:
        """Return the vertex positions, shape (V, 3)."""
        if self.moved is None:
            return torch.from_numpy(self.mesh.vertices)
        return self.moved.double()

    @cached_property
    def planes(self) -> Tensor:
        """Return the unit normal of each sample's face, on the side of the camera, shape (S, 3)."""
        return self.face_planes[self.fragments.face]

    @cached_property
    def face_planes(self) -> Tensor:
        """Return the unit normal of each seen face, on the side of the camera, shape (G, 3)."""
        return face_normals(self.vertices, self.fragments.corners) * self.fragments.facing

    @cached_property
    def normals(self) -> Tensor:
        """Return the unit normals that the samples are shaded with, shape (S, 3)."""
        if self.settings.normals == "flat":
            return self.planes
        if self.moved is None:
            # All views of the mesh share these normals.
            normals = torch.from_numpy(self.mesh.vertex_normals)
        else:
            faces = torch.from_numpy(self.mesh.faces)
            normals = normals_in_sight(self.fragments, self.vertices, faces)
        return unit(smooth_normals(self.fragments, normals).T).T

    @cached_property
    def points(self) -> Tensor:
        """Return the positions of the samples, shape (S, 3)."""
        return self.fragments.interpolate(self.vertices[self.fragments.corners])

    @cached_property
    def gloss(self) -> SampleGloss | None:
        """Return the gloss at the samples, or None for a matte surface."""
        return sample_gloss(self.mesh, self.fragments, self.given_gloss)

    @cached_property
    def toward(self) -> Tensor:
        """Return unit vectors to the camera, shape (S, 3), or (1, 3) if all are equal."""
        return toward_camera(self.fragments, self.vertices)


class RayHits(NamedTuple):
    """The faces that B pixels of a view see in D directions.

    Attributes:
        pixels: Indices of the pixels among the P pixels of the view, shape (B,).
        sample: Sample from which each ray starts, shape (B, D).
        weight: Weight of the radiance from each direction in the irradiance of
            the pixel, shape (B, D): solid angle times cosine times the number of
            samples of the pixel. It is 0 where nothing blocks the light of the
            sky.
        face: First face that each ray hits, or `NO_FACE`, shape (B, D). The face
            is `NO_FACE`, with a positive weight, where a smooth normal would
            receive light from below the sample's own face.
    """

    pixels: Tensor
    sample: Tensor
    weight: Tensor
    face: Tensor


class Rays:
    """Rays among the faces of one mesh.

    The first ray raises `InputError` if Embree is not installed.

    Args:
        mesh: The mesh.
    """

    def __init__(self, mesh: Mesh):
        self._mesh = mesh

    @cached_property
    def offset(self) -> float:
        """Return how far above the surface a ray starts, in world units."""
        return OFFSET * float(np.abs(self._mesh.vertices).max())

    def hits(self, surface: Surface, directions: Tensor) -> Iterator[RayHits]:
        """Cast rays from all pixels that may see another surface.

        The face of a sample blocks all light from below its plane, as it would
        in the solid that a closed mesh bounds.

        Args:
            surface: Samples of the view.
            directions: Directions of a `sphere`, shape (D, 3).

        Yields:
            The hits of a block of pixels.
        """
        fragments = surface.fragments
        pixels = self._pixels_to_cast(surface)
        if not len(pixels):
            return
        planes = surface.planes
        sample_count = fragments.pixel.bincount(minlength=len(fragments.pixels))
        first_sample = sample_count.cumsum(0) - sample_count
        solid_angle = 4 * math.pi / len(directions)
        for block in pixels.split(max(1, BLOCK // len(directions))):
            count = sample_count[block, None]
            # Neighboring pixels give a direction to different samples.
            rank = (_shuffled(len(directions)) + block[:, None]) % count
            sample = first_sample[block, None] + rank
            cosine = _dot(surface.normals[sample], directions).clamp(min=0)
            height = _dot(planes[sample], directions)
            cast = torch.nonzero((cosine > 0) & (height > 0), as_tuple=True)
            start = sample[cast]
            _, direction = cast
            origins = surface.points[start] + self.offset * planes[start]
            hit = self.first_hit(origins, directions[direction])
            face = torch.full_like(sample, NO_FACE).index_put_(cast, hit)
            is_open = (face == NO_FACE) & (height >= 0)
            weight = (cosine * count * solid_angle).masked_fill(is_open, 0)
            yield RayHits(block, sample, weight, face)

    @cached_property
    def _scene(self) -> Any:
        """Build Embree's search structure."""
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise InputError(
                "shadows are found by rays that Embree casts: "
                "pip install embreex, or set shadows=false and no lights that stand in the scene"
            ) from error
        scene = EmbreeScene(robust=True)
        vertices = self._mesh.vertices.astype(np.float32)
        TriangleMesh(scene, vertices, self._mesh.faces.astype(np.int32))
        return scene

    @cached_property
    def _outermost(self) -> Tensor:
        """Return the vertices on the convex hull, or all vertices if they lie in a plane."""
        # Importing scipy.spatial takes long.
        from scipy.spatial import ConvexHull, QhullError

        vertices = self._mesh.vertices[np.unique(self._mesh.faces)]
        with suppress(QhullError):
            vertices = vertices[ConvexHull(vertices).vertices]
        return torch.from_numpy(vertices).double()

    def _pixels_to_cast(self, surface: Surface) -> Tensor:
        """Return the pixels that may see another surface.

        These are the pixels with a sample on a face above whose plane other
        vertices lie, or whose plane blocks light from above the plane of the
        smooth normal. The blocked fraction of uniform light is (1 - cos) / 2, by
        the angle between the two normals. All pixels are returned if comparing
        would take longer than the rays.
        """
        fragments = surface.fragments
        planes = surface.face_planes
        if len(planes) * len(self._outermost) > COMPARISONS:
            return torch.arange(len(fragments.pixels))
        parts = planes.split(max(1, 8 * BLOCK // len(self._outermost)))
        highest = torch.cat([(part @ self._outermost.T).amax(1) for part in parts])
        corners = surface.vertices[fragments.corners[:, 0]]
        is_face_below = highest - (planes * corners).sum(1) > self.offset
        is_bent = (surface.normals * surface.planes).sum(1) < 1 - 2 * BENT
        return fragments.pixel[is_face_below[fragments.face] | is_bent].unique()

    def first_hit(
        self, origins: Tensor, directions: Tensor, lengths: Tensor | None = None
    ) -> Tensor:
        """Find the first face that each ray hits.

        Args:
            origins: Starts of the rays, shape (N, 3).
            directions: Unit directions of the rays, shape (N, 3).
            lengths: Lengths of the rays, shape (N,). None for infinite rays.

        Returns:
            Indices of faces, or `NO_FACE`, int64, shape (N,).
        """
        rays = [origins, directions] if lengths is None else [origins, directions, lengths]
        faces = self._scene.run(
            *(np.ascontiguousarray(array.numpy(), np.float32) for array in rays)
        )
        return torch.from_numpy(faces).long()


def _dot(vectors: Tensor, directions: Tensor) -> Tensor:
    """Return the products (B, D) of vectors (B, D, 3) and directions (D, 3)."""
    return torch.einsum("bdi,di->bd", vectors, directions)


@per_degree
def sphere(count: int) -> Tensor:
    """Return directions that divide the sphere equally: the spherical Fibonacci lattice.

    Args:
        count: Number of directions.

    Returns:
        Unit vectors, shape (count, 3), float64.
    """
    index = torch.arange(count, dtype=torch.float64)
    golden_angle = math.pi * (3 - math.sqrt(5))
    z = 1 - (2 * index + 1) / count
    azimuth = golden_angle * index
    radius = (1 - z**2).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=1)


@per_degree
def _shuffled(count: int) -> Tensor:
    """Return a fixed permutation of 0 to count - 1.

    With it, each sample gets directions from all over the sphere.
    """
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))
