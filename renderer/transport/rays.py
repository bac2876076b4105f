"""Surface points at the samples of a view, and rays from these points among the faces of a mesh.

The library Embree casts the rays (Wald et al. 2014). All pixels use the same
directions, and each pixel divides the directions among its samples. The edges
of shadows, of albedo and of the mesh are therefore averaged in the same way,
and the cost of a pixel does not depend on its number of samples. Pixels that
can see no other surface, such as all pixels of a convex mesh, cast no rays.

Shapes use these letters: a mesh has V vertices and F faces. A view has S
covered samples in P pixels, and these samples show G of the F faces.
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
from renderer.light.harmonics import cache_tensors
from renderer.settings import ImageSettings
from renderer.shading.gloss import Gloss, SampleGloss, sample_gloss, toward_camera
from renderer.shading.shading import normals_in_sight, smooth_normals
from renderer.vectors import unit
from renderer.visibility.fragments import Fragments

# Number of ray directions, which cover the whole sphere. A pixel of a flat surface
# casts rays in about half of them, because the surface blocks the other half.
DIRECTIONS = 512
# Distance of the start of a ray from the surface, as a fraction of the largest
# vertex coordinate. Embree computes in float32, so a ray that starts on the
# surface could hit the surface itself.
OFFSET = 1e-5
# Largest number of pairs of a seen face and a vertex that `Rays._pixels_to_cast`
# compares, which takes about a second. With more pairs, all pixels cast rays.
COMPARISONS = 2**30
# With smooth shading, the face of a sample may block light that would reach the
# interpolated normal. `Rays._pixels_to_cast` ignores this if the face blocks at
# most this fraction of uniform environment light.
BENT = 1 / 1024
# Number of pairs of a pixel and a ray direction that `Rays.hits` processes at
# once. It limits the memory.
BLOCK = 2**17
# Face index of a ray that hits no face.
NO_FACE = -1


@dataclass(frozen=True)
class Surface:
    """Points, normals and gloss at the S covered samples of a view.

    Each property is computed when it is first read. Points and normals are
    float64, and differentiable with respect to `moved`.

    Attributes:
        mesh: Mesh that the view shows, with V vertices.
        fragments: Covered samples of the view.
        settings: Settings of the image. `settings.normals` chooses smooth or
            flat normals.
        moved: Vertex positions to use instead of `mesh.vertices`, shape (V, 3).
            None uses `mesh.vertices`.
        given_gloss: Gloss to use instead of the gloss of the mesh. None uses
            the gloss of the mesh.
    """

    mesh: Mesh
    fragments: Fragments
    settings: ImageSettings
    moved: Tensor | None = None
    given_gloss: Gloss | None = None

    @cached_property
    def vertices(self) -> Tensor:
        """Vertex positions of the V vertices, float64, shape (V, 3)."""
        if self.moved is None:
            return torch.from_numpy(self.mesh.vertices)
        return self.moved.double()

    @cached_property
    def planes(self) -> Tensor:
        """Unit normal of the face that each of the S samples shows, shape (S, 3).

        The normal points to the side of the face that the camera sees.
        """
        sample_to_seen_face = self.fragments.sample_to_seen_face
        return self.face_planes[sample_to_seen_face]

    @cached_property
    def face_planes(self) -> Tensor:
        """Unit normal of each of the G seen faces, shape (G, 3).

        The normal points to the side of the face that the camera sees.
        """
        return face_normals(self.vertices, self.fragments.corners) * self.fragments.facing

    @cached_property
    def normals(self) -> Tensor:
        """Unit normal with which each of the S samples is shaded, shape (S, 3).

        This is the normal of the face with flat normals, and the interpolated
        vertex normal with smooth normals.
        """
        if self.settings.normals == "flat":
            return self.planes
        if self.moved is None:
            # The mesh caches these normals, so all its views share them.
            vertex_normals = torch.from_numpy(self.mesh.vertex_normals)
        else:
            faces = torch.from_numpy(self.mesh.faces)
            vertex_normals = normals_in_sight(self.fragments, self.vertices, faces)
        # `unit` takes the three components along the first axis.
        return unit(smooth_normals(self.fragments, vertex_normals).T).T

    @cached_property
    def points(self) -> Tensor:
        """Position in world axes of each of the S samples, shape (S, 3)."""
        # Corners of the G seen faces, shape (G, 3 corners, 3 coordinates).
        corner_positions = self.vertices[self.fragments.corners]
        return self.fragments.interpolate(corner_positions)

    @cached_property
    def gloss(self) -> SampleGloss | None:
        """Gloss at the samples, or None for a matte surface."""
        return sample_gloss(self.mesh, self.fragments, self.given_gloss)

    @cached_property
    def toward(self) -> Tensor:
        """Unit vectors from the S samples to the camera, shape (S, 3).

        Without perspective, all samples share one vector, and the shape is
        (1, 3).
        """
        return toward_camera(self.fragments, self.vertices)


class RayHits(NamedTuple):
    """First faces that rays from B pixels of a view hit in D directions.

    Attributes:
        pixels: Index of each pixel in `Fragments.pixels`, shape (B,).
        sample_of_ray: Index of the sample from which each ray starts,
            shape (B, D).
        weight: Weight of the radiance from each direction in the irradiance of
            the pixel, shape (B, D). It is the solid angle of the direction,
            times the cosine to the shading normal, times the number n of
            samples of the pixel, because each sample casts only D / n of the
            rays. It is 0 if the sky is visible in the direction.
        face_of_ray: Index in the mesh of the first face that each ray hits, or
            `NO_FACE`, shape (B, D). It is also `NO_FACE` for directions below
            the plane of the sample's face. Such a direction has a positive
            weight if it lies above the plane of the shading normal, since the
            face of the sample then blocks the light.
    """

    pixels: Tensor
    sample_of_ray: Tensor
    weight: Tensor
    face_of_ray: Tensor


class Rays:
    """Rays among the faces of one mesh.

    The first ray raises `InputError` if Embree is not installed.

    Args:
        mesh: Mesh whose faces the rays hit.
    """

    def __init__(self, mesh: Mesh):
        self._mesh = mesh

    @cached_property
    def offset(self) -> float:
        """Distance above the surface at which rays start, in world units."""
        largest_coordinate = float(np.abs(self._mesh.vertices).max())
        return OFFSET * largest_coordinate

    def hits(self, surface: Surface, directions: Tensor) -> Iterator[RayHits]:
        """Cast rays in D directions from all pixels that may see another surface.

        Each ray starts at one sample of its pixel. The face of this sample
        blocks all light from below its plane, as in a solid that is bounded by
        a closed mesh.

        Args:
            surface: Points and normals at the S samples of the view.
            directions: Unit vectors that divide the sphere equally, from the
                function `sphere`, shape (D, 3).

        Yields:
            Hits of the next block of pixels.
        """
        fragments = surface.fragments
        pixels = self._pixels_to_cast(surface)
        if not len(pixels):
            return
        plane_normals = surface.planes
        # The samples of a pixel follow each other.
        sample_count = fragments.sample_to_pixel.bincount(minlength=len(fragments.pixels))
        first_sample = sample_count.cumsum(0) - sample_count
        solid_angle = 4 * math.pi / len(directions)
        pixels_per_block = max(1, BLOCK // len(directions))
        for block in pixels.split(pixels_per_block):
            # Tensors of rays have the shape (B, D): B pixels, D directions.
            samples_in_pixel = sample_count[block, None]
            # A pixel with n samples starts every n-th ray, in shuffled order,
            # at the same sample. Adding the pixel index makes neighboring pixels
            # use different samples for one direction.
            rank_in_pixel = (_shuffled(len(directions)) + block[:, None]) % samples_in_pixel
            sample_of_ray = first_sample[block, None] + rank_in_pixel
            cosine = _dot(surface.normals[sample_of_ray], directions).clamp(min=0)
            height = _dot(plane_normals[sample_of_ray], directions)
            # Only directions above both planes need a ray.
            cast = torch.nonzero((cosine > 0) & (height > 0), as_tuple=True)
            start_sample = sample_of_ray[cast]
            _, cast_direction = cast
            origins = surface.points[start_sample] + self.offset * plane_normals[start_sample]
            hit_face = self.first_hit(origins, directions[cast_direction])
            face_of_ray = torch.full_like(sample_of_ray, NO_FACE).index_put_(cast, hit_face)
            # Directions below the plane of the face are blocked without a ray.
            is_sky = (face_of_ray == NO_FACE) & (height >= 0)
            weight = (cosine * samples_in_pixel * solid_angle).masked_fill(is_sky, 0)
            yield RayHits(
                pixels=block, sample_of_ray=sample_of_ray, weight=weight, face_of_ray=face_of_ray
            )

    @cached_property
    def _scene(self) -> Any:
        """Embree scene with all faces of the mesh, in which rays are cast.

        Raises:
            InputError: If Embree is not installed.
        """
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise InputError(
                "shadows need the package embreex, which is not installed: "
                "pip install embreex, or set shadows=false and use no lamps and no projectors"
            ) from error
        scene = EmbreeScene(robust=True)
        vertices = self._mesh.vertices.astype(np.float32)
        # The constructor adds the triangles to the scene.
        TriangleMesh(scene, vertices, self._mesh.faces.astype(np.int32))
        return scene

    @cached_property
    def _outermost(self) -> Tensor:
        """Vertices on the convex hull of the mesh, float64, shape (H, 3) for H vertices.

        If all vertices lie in a plane, there is no hull, and all vertices are
        returned.
        """
        # scipy.spatial is imported here because the import takes long.
        from scipy.spatial import ConvexHull, QhullError

        vertices = self._mesh.vertices[np.unique(self._mesh.faces)]
        with suppress(QhullError):
            vertices = vertices[ConvexHull(vertices).vertices]
        return torch.from_numpy(vertices).double()

    def _pixels_to_cast(self, surface: Surface) -> Tensor:
        """Find the pixels from which a ray may hit another face, or is blocked by its own face.

        A pixel is returned if one of its samples fulfills one of two conditions.
        First, a vertex of the mesh lies above the plane of the sample's face.
        Second, the plane of the face blocks light that would reach the shading
        normal. If the two normals form the angle a, the face blocks the fraction
        (1 - cos a) / 2 of uniform light, which must exceed `BENT`.

        Args:
            surface: Points and normals at the S samples of the view.

        Returns:
            Indices in `Fragments.pixels`, ascending. These are all pixels if the
            test would need more than `COMPARISONS` comparisons and would take
            longer than the rays.
        """
        fragments = surface.fragments
        plane_normals = surface.face_planes
        hull_vertices = self._outermost
        if len(plane_normals) * len(hull_vertices) > COMPARISONS:
            return torch.arange(len(fragments.pixels))
        # Largest height of a hull vertex along the normal of each seen face,
        # shape (G,).
        parts = plane_normals.split(max(1, 8 * BLOCK // len(hull_vertices)))
        highest = torch.cat([(part @ hull_vertices.T).amax(1) for part in parts])
        first_corner = surface.vertices[fragments.corners[:, 0]]
        height_of_face = (plane_normals * first_corner).sum(1)
        is_below_a_vertex = highest - height_of_face > self.offset
        cosine_of_normals = (surface.normals * surface.planes).sum(1)
        is_bent = cosine_of_normals < 1 - 2 * BENT
        sample_to_seen_face = fragments.sample_to_seen_face
        casts_rays = is_below_a_vertex[sample_to_seen_face] | is_bent
        sample_to_pixel = fragments.sample_to_pixel
        return sample_to_pixel[casts_rays].unique()

    def first_hit(
        self, origins: Tensor, directions: Tensor, lengths: Tensor | None = None
    ) -> Tensor:
        """Find the first face that each of N rays hits.

        Args:
            origins: Starts of the rays in world axes, shape (N, 3).
            directions: Unit directions of the rays, shape (N, 3).
            lengths: Lengths of the rays in world units, shape (N,). None for
                infinite rays.

        Returns:
            Index in the mesh of the face that each ray hits, or `NO_FACE`,
            int64, shape (N,).
        """
        rays = [origins, directions] if lengths is None else [origins, directions, lengths]
        faces = self._scene.run(
            *(np.ascontiguousarray(array.numpy(), np.float32) for array in rays)
        )
        return torch.from_numpy(faces).long()


def _dot(vectors: Tensor, directions: Tensor) -> Tensor:
    """Compute the scalar products of the vectors of B pixels with D directions.

    Args:
        vectors: A vector for each pixel and direction, shape (B, D, 3).
        directions: The same directions for all pixels, shape (D, 3).

    Returns:
        Scalar products, shape (B, D).
    """
    return torch.einsum("bdi,di->bd", vectors, directions)


@cache_tensors
def sphere(count: int) -> Tensor:
    """Compute directions that divide the sphere equally (spherical Fibonacci lattice).

    Args:
        count: Number of directions.

    Returns:
        Unit vectors, float64, shape (count, 3).
    """
    index = torch.arange(count, dtype=torch.float64)
    golden_angle = math.pi * (3 - math.sqrt(5))
    z = 1 - (2 * index + 1) / count
    azimuth = golden_angle * index
    radius = (1 - z**2).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=1)


@cache_tensors
def _shuffled(count: int) -> Tensor:
    """Return a random permutation of 0 to count - 1, which is the same in every call.

    `sphere` sorts its directions by z. `Rays.hits` deals the directions to the
    samples of a pixel in this shuffled order, so that each sample gets
    directions from all over the sphere.

    Args:
        count: Number of ray directions.

    Returns:
        The permutation, int64, shape (count,).
    """
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))
