"""Rays from the samples of a view to other faces, and to lamps and projectors (local lights).

The library Embree casts the rays (Wald et al. 2014). All pixels use the same
directions, and each pixel divides the directions among its samples. No two
samples of a pixel share a direction, and each sample has at least
`DIRECTIONS_PER_SAMPLE` of them. The image therefore converges as the number of
samples grows. Pixels that can see no other surface, such as all pixels of a
convex mesh, cast no rays.

Each lamp, and each pixel of a projector's pattern, is one basis function of local
light. Its coefficient is its RGB power. Each sample of a view casts a ray to each
source. A ray that hits a face means that the sample is in shadow.

Shapes use these letters: a mesh has V vertices and F faces. A view has S
covered samples in P pixels, and these samples show G of the F faces.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderer.errors import import_package
from renderer.light.basis import LightPaths, LocalBasis
from renderer.light.harmonics import cache_tensors
from renderer.mesh import Mesh
from renderer.normals import face_normals
from renderer.operators.apply import SparseTransfer
from renderer.settings import ImageSettings
from renderer.surface.gloss import Gloss, SampleGloss, at_samples, sample_gloss, toward_camera
from renderer.surface.shading import normals_in_sight, smooth_normals
from renderer.vectors import unit, unit_vectors
from renderer.visibility.fragments import Fragments

# Smallest number of ray directions of a pixel, which cover the whole sphere. A pixel of a flat
# surface casts rays in about half of them, because the surface blocks the other half.
DIRECTIONS = 512
# Smallest number of ray directions of each sample of a pixel.
DIRECTIONS_PER_SAMPLE = 32
# Number of ray directions of a pixel of a draft, such as an image of a search.
DRAFT_DIRECTIONS = 128
# Rays start at this distance above the surface, as a fraction of the largest vertex
# coordinate. Otherwise, a ray could hit the surface on which it starts, because Embree
# computes in float32.
OFFSET = 1e-5
# Faces are compared with vertices to find the pixels that need rays. This is the largest
# number of comparisons, which takes about a second. With more, all pixels cast rays.
MAX_COMPARISONS = 2**30
# The plane of a face may block light that would reach an interpolated normal (smooth
# shading). This is ignored if at most this fraction of uniform environment light is blocked.
MAX_IGNORED_LIGHT = 1 / 1024
# Number of pairs of a pixel and a ray direction that `Rays.hits` processes at
# once. It limits the memory.
BLOCK = 2**17
# Stands for the index of the face that a ray hits if it hits no face.
NO_FACE = -1


@dataclass(frozen=True)
class Surface:
    """Points, normals and gloss at the S samples of a view that show the mesh.

    Each property is computed when it is first read. Points and normals are
    float64, and differentiable with respect to `moved`.

    Attributes:
        mesh: Mesh that the view shows, with V vertices.
        fragments: Samples of the view that show the mesh.
        settings: Settings of the image. `settings.normals` chooses smooth or
            flat normals.
        moved: Vertex positions to use instead of `mesh.vertices`, shape (V, 3).
            None uses `mesh.vertices`.
        given_gloss: Specular material (gloss) to use instead of the material of
            the mesh. None uses the material of the mesh.
    """

    mesh: Mesh
    fragments: Fragments
    settings: ImageSettings
    moved: Float[Tensor, "V 3"] | None = None
    given_gloss: Gloss | None = None

    @cached_property
    def vertices(self) -> Tensor:
        """Positions of the V vertices in world axes, float64, shape (V, 3)."""
        if self.moved is None:
            return torch.from_numpy(self.mesh.vertices)
        return self.moved.cpu().double()

    @cached_property
    def planes(self) -> Tensor:
        """Unit normal of the face that each of the S samples shows, shape (S, 3).

        The normal points to the side of the face that the camera sees.
        """
        return self.face_planes[self.fragments.sample_to_seen_face]

    @cached_property
    def face_planes(self) -> Tensor:
        """Unit normal of each of the G faces that samples show, shape (G, 3).

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
            corner_normals = torch.from_numpy(self.mesh.corner_normals)[self.fragments.faces]
        else:
            faces = torch.from_numpy(self.mesh.faces)
            normal_ids = torch.from_numpy(self.mesh.normal_ids)
            corner_normals = normals_in_sight(self.fragments, self.vertices, faces, normal_ids)
        # The function `unit` takes vectors with their components along the first axis.
        return unit(smooth_normals(self.fragments, corner_normals).T).T

    @cached_property
    def points(self) -> Tensor:
        """Position in world axes of each of the S samples, shape (S, 3)."""
        return self.fragments.interpolate(self.vertices[self.fragments.corners])

    @cached_property
    def gloss(self) -> SampleGloss | None:
        """Specular material (gloss) at the samples, or None for a matte surface."""
        return sample_gloss(self.mesh, self.fragments, self.given_gloss)

    @cached_property
    def toward(self) -> Tensor:
        """Unit vectors from the S samples to the camera, shape (S, 3).

        Without perspective, all samples have the same vector, and the shape is
        (1, 3).
        """
        return toward_camera(self.fragments, self.vertices)


class RayHits(NamedTuple):
    """First faces that rays from B pixels of a view hit in D directions.

    Attributes:
        pixels: Index of each pixel in `Fragments.pixels`, shape (B,).
        sample_of_ray: Index of the sample from which each ray starts,
            shape (B, D).
        weight: Weight of the radiance from each direction in the irradiance that
            the mesh blocks, shape (B, D). It is 0 if the sky is visible in the
            direction. Otherwise, it is the solid angle of the direction, times the
            cosine to the shading normal, times the number n of samples of the
            pixel, because each sample casts only D / n of the rays.
        face_of_ray: Index in the mesh of the first face that each ray hits, or
            `NO_FACE`, shape (B, D). No ray is cast in directions below the plane
            of the face on which the sample lies. They have `NO_FACE`, and a
            positive weight if the angle to the shading normal is less than 90°.
    """

    pixels: Int[Tensor, " B"]
    sample_of_ray: Int[Tensor, "B D"]
    weight: Float[Tensor, "B D"]
    face_of_ray: Int[Tensor, "B D"]


class Rays:
    """Casts rays from the surface of a mesh, and finds the faces of this mesh that they hit.

    The first ray raises `InputError` if Embree is not installed.

    Args:
        mesh: Mesh whose faces the rays hit.
    """

    def __init__(self, mesh: Mesh):
        self._mesh = mesh

    @cached_property
    def offset(self) -> float:
        """Distance above the surface at which rays start, in world units."""
        return OFFSET * float(np.abs(self._mesh.vertices).max())

    def hits(self, surface: Surface, directions: Float[Tensor, "D 3"]) -> Iterator[RayHits]:
        """Cast rays in D directions from all pixels that may see another face of the mesh.

        Each ray starts at one sample of its pixel. The face of this sample
        blocks all light from below its plane, as if the mesh were the surface of a
        solid. The directions divide the sphere equally (see `sphere`), and each result is
        for the next block of pixels.
        """
        fragments = surface.fragments
        pixels, may_hit = self._pixels_to_cast(surface)
        if not len(pixels):
            return
        plane_normals = surface.planes
        # Number of samples of each pixel. The samples of a pixel follow each other.
        sample_count = fragments.sample_to_pixel.bincount(minlength=len(fragments.pixels))
        first_sample = sample_count.cumsum(0) - sample_count
        solid_angle = 4 * math.pi / len(directions)
        pixels_per_block = max(1, BLOCK // len(directions))
        for block in pixels.split(pixels_per_block):
            # Number of samples of each pixel of the block, with an axis of size 1 for the ray
            # directions.
            samples_in_pixel = sample_count[block, None]
            # Each ray of a pixel starts at one of its samples. Shuffled numbers spread the
            # directions over the samples. Adding the index of the pixel makes neighboring
            # pixels use different samples for the same direction.
            rank_in_pixel = (_shuffled(len(directions)) + block[:, None]) % samples_in_pixel
            sample_of_ray = first_sample[block, None] + rank_in_pixel
            # Cosine of each direction to the shading normal, and height of the direction above
            # the plane of the face, shape (pixels of the block, D).
            cosine = dot(surface.normals[sample_of_ray], directions).clamp(min=0)
            height = dot(plane_normals[sample_of_ray], directions)
            # Pairs of a pixel and a direction that need a ray: the direction is above the
            # face, and in front of the shading normal, and the ray may hit another face.
            is_above = (height > 0) & may_hit[sample_of_ray]
            cast = torch.nonzero((cosine > 0) & is_above, as_tuple=True)
            start_sample = sample_of_ray[cast]
            origins = surface.points[start_sample] + self.offset * plane_normals[start_sample]
            hit_face = self.first_hit(origins, directions[cast[1]])
            face_of_ray = torch.full_like(sample_of_ray, NO_FACE).index_put_(cast, hit_face)
            # The sky is not visible in directions below the plane of the face (height < 0).
            is_sky = (face_of_ray == NO_FACE) & (height >= 0)
            weight = (cosine * samples_in_pixel * solid_angle).masked_fill(is_sky, 0)
            yield RayHits(block, sample_of_ray, weight, face_of_ray)

    @cached_property
    def _scene(self) -> Any:
        """Embree scene with all faces of the mesh, in which rays are cast."""
        advice = "embreex, or set shadows=false and use no lamps and no projectors"
        scene = import_package("embreex.rtcore_scene", advice).EmbreeScene(robust=True)
        vertices = self._mesh.vertices.astype(np.float32)
        # The constructor of `TriangleMesh` adds the triangles to the scene.
        meshes = import_package("embreex.mesh_construction", advice)
        meshes.TriangleMesh(scene, vertices, self._mesh.faces.astype(np.int32))
        return scene

    @cached_property
    def _outermost(self) -> Tensor:
        """Positions (H, 3) of the convex hull's vertices, or of all if they lie in a plane."""
        # Only imported when it is needed, because the import takes long.
        from scipy.spatial import ConvexHull, QhullError

        vertices = self._mesh.vertices[np.unique(self._mesh.faces)]
        with suppress(QhullError):
            vertices = vertices[ConvexHull(vertices).vertices]
        return torch.from_numpy(vertices).double()

    def _pixels_to_cast(self, surface: Surface) -> tuple[Int[Tensor, " B"], Bool[Tensor, " S"]]:
        """Find the pixels for which the mesh may block light, and the samples whose rays may hit.

        A pixel is returned if one of its samples fulfills one of two conditions. First, a vertex of
        the mesh lies above the plane of the face on which the sample lies. Second, the shading
        normal differs from the normal of the face by an angle a, so that the plane of the face
        blocks the fraction (1 - cos a) / 2 of uniform light, and this exceeds `MAX_IGNORED_LIGHT`.
        A ray from a sample can only hit another face under the first condition. All are returned
        if the test would need more than `MAX_COMPARISONS` comparisons and would take longer than
        the rays.
        """
        fragments = surface.fragments
        plane_normals = surface.face_planes
        hull_vertices = self._outermost
        if len(plane_normals) * len(hull_vertices) > MAX_COMPARISONS:
            return torch.arange(len(fragments.pixels)), fragments.sample_to_pixel >= 0
        # The normals are processed in blocks to limit the memory.
        blocks = plane_normals.split(max(1, 8 * BLOCK // len(hull_vertices)))
        # Largest coordinate of a hull vertex along the normal of each seen face.
        highest = torch.cat([(block @ hull_vertices.T).amax(1) for block in blocks])
        first_corner = surface.vertices[fragments.corners[:, 0]]
        # Height of the face itself along its normal.
        height_of_face = (plane_normals * first_corner).sum(1)
        cosine_of_normals = (surface.normals * surface.planes).sum(1)
        blocks_light = cosine_of_normals < 1 - 2 * MAX_IGNORED_LIGHT
        may_hit = (highest - height_of_face > self.offset)[fragments.sample_to_seen_face]
        return fragments.sample_to_pixel[may_hit | blocks_light].unique(), may_hit

    def first_hit(
        self,
        origins: Float[Tensor, "N 3"],
        directions: Float[Tensor, "N 3"],
        lengths: Float[Tensor, " N"] | None = None,
    ) -> Int[Tensor, " N"]:
        """Find the first face that each of N rays hits, or `NO_FACE`, in world axes and units.

        Rays are infinite if `lengths` is None.
        """
        tensors = [origins, directions] if lengths is None else [origins, directions, lengths]
        rays = (np.ascontiguousarray(tensor.numpy(), np.float32) for tensor in tensors)
        return torch.from_numpy(self._scene.run(*rays)).long()


def dot(vectors: Float[Tensor, "B D 3"], directions: Float[Tensor, "D 3"]) -> Float[Tensor, "B D"]:
    """Compute scalar products of vectors, one for each pixel and direction, with directions."""
    return torch.einsum("bdi,di->bd", vectors, directions)


@cache_tensors
def sphere(count: int) -> Float[Tensor, "count 3"]:
    """Compute directions that divide the sphere equally (spherical Fibonacci lattice)."""
    index = torch.arange(count, dtype=torch.float64)
    golden_angle = math.pi * (3 - math.sqrt(5))
    z = 1 - (2 * index + 1) / count
    azimuth = golden_angle * index
    radius = (1 - z**2).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], dim=1)


@cache_tensors
def _shuffled(count: int) -> Int[Tensor, " count"]:
    """Return a random permutation of 0 to count - 1, which is the same in every call.

    The directions of `sphere` are sorted by z. In this shuffled order, each sample of a pixel gets
    ray directions from all over the sphere.
    """
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))


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
    weights = path_reflectance(surface, albedo, paths) * paths.irradiance[:, None]
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


def path_reflectance(
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
        # A ray starts above the surface, so that it does not hit its own face.
        origins = points[paths.point] + rays.offset * plane_of_path
        directions, lengths = unit_vectors((paths.source - origins).T)
        is_above_plane = (directions.T * plane_of_path).sum(1) > 0
        hits_nothing = rays.first_hit(origins, directions.T, lengths) == NO_FACE
        is_unblocked = is_above_plane & hits_nothing
    return LightPaths(*(field[is_unblocked] for field in paths))


@dataclass(frozen=True, eq=False)
class LocalLightView:
    """A view of one mesh that is rendered many times under lamps and projectors.

    The light and the albedo may change between the renders. All computations run
    on the CPU, because rays are cast there. For lights that stay in place, rays
    are cast once. For lamps that move, rays are cast in every render. Derivatives
    hold fixed which lamps, and which pixels of a projected pattern, light a
    sample.

    Attributes:
        rays: Rays among the faces of the mesh.
        surface: Points, normals and gloss of the samples.
        fixed_paths: For each light that stays in place, its paths to samples that no
            face blocks.
    """

    rays: Rays
    surface: Surface
    fixed_paths: dict[LocalBasis, LightPaths] = field(default_factory=dict)

    def radiance(
        self,
        basis: LocalBasis,
        albedo: Float[Tensor, "S 3"],
        light: Float[Tensor, "K 3"],
        positions: Float[Tensor, "L 3"] | None = None,
        fragments: Fragments | None = None,
    ) -> Float[Tensor, "3 P"]:
        """Compute the radiance of the view under local light.

        The result is differentiable with respect to all tensors and to the vertices of the view.
        It is multiplied by the fraction of each pixel that the mesh covers. Lamps may have moved
        to `positions`, and `fragments` may assign the samples to other pixels.
        """
        surface = self.surface
        # None if the lights stay in place. Their paths to the samples are then kept for later
        # renders.
        moved = positions.cpu().double() if basis.is_movable and positions is not None else None
        paths = self.fixed_paths.get(basis) if moved is None else None
        if paths is None:
            samples = surface.points, surface.normals, surface.planes
            paths = unoccluded(self.rays, basis, *samples, moved)
        if moved is None:
            self.fixed_paths[basis] = paths
        shown = (fragments or surface.fragments).to("cpu")
        # Irradiance at the end of each path: one row for each path, one column for each color.
        irradiance = paths.irradiance[:, None] * light.cpu().double()[paths.function]
        radiance = path_reflectance(surface, albedo.cpu().double(), paths) / shown.samples**2
        radiance = radiance * irradiance
        zeros = radiance.new_zeros(len(shown.pixels), 3)
        pixel_of_path = shown.sample_to_pixel[paths.point]
        return zeros.index_add(0, pixel_of_path, radiance).T.to(light)
