"""Rays from the samples of a view to other faces, and to lamps and projectors (local lights).

The library Embree casts the rays (Wald et al. 2014). All pixels use the same
directions, and each pixel divides the directions among its samples. No two
samples of a pixel share a direction, and each sample has at least
`DIRECTIONS_PER_SAMPLE` of them. The image therefore converges as the number of
samples grows. Pixels that can see no other surface, such as all pixels of a
convex mesh, cast no rays, and rays above the horizon of their face are not cast.

Each lamp, and each pixel of a projector's pattern, is one basis function of local
light. Its coefficient is its RGB power. Each sample of a view casts a ray to each
source. A ray that hits a face means that the sample is in shadow.

Shapes use these letters: a mesh has V vertices and F faces. A view has S
covered samples in P pixels, and these samples show G of the F faces.
"""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from torch import Tensor

from renderer.errors import import_package, require_bounded, require_shape
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
# Largest height of the mesh above a face whose horizon is computed, as a fraction of the largest
# vertex coordinate.
MAX_RISE = 0.1
# The horizon of a face is computed if at most this number of faces rise above it. A face counts
# once for each of its vertices above.
MAX_ABOVE = 384
# The horizons are computed if they need at most this number of comparisons for each ray.
COMPARISONS_PER_RAY = 4
# Sines of elevations are compared with this room for rounding.
ROUNDING = 1e-9
# The plane of a face may block light that would reach an interpolated normal (smooth
# shading). This is ignored if at most this fraction of uniform environment light is blocked.
MAX_IGNORED_LIGHT = 1 / 1024
# Number of pairs of a pixel and a ray direction that `Rays.blocked` processes at
# once. It limits the memory.
BLOCK = 2**17
# Pixels with the same number of samples form a group of their own if they have at least this
# number of such pairs.
SMALL_GROUP = 2**14
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
        given = torch.from_numpy(self.mesh.vertices) if self.moved is None else self.moved
        return given.to(self.fragments.coverage)

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
        moved = None if self.moved is None else self.vertices
        corner_normals = normals_in_sight(self.mesh, self.fragments, moved)
        # The function `unit` takes vectors with their components along the first axis.
        return unit(smooth_normals(self.fragments, corner_normals).T).T

    @cached_property
    def samples_of_pixels(self) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
        """Number of samples of each of the P pixels, and index of the first of them."""
        count = self.fragments.sample_to_pixel.bincount(minlength=len(self.fragments.pixels))
        return count, count.cumsum(0) - count

    def samples_of_rays(self, pixels: Int[Tensor, " B"], ray_count: int) -> Int[Tensor, "B D"]:
        """Return the sample from which each of the first D rays of B pixels starts.

        Adding the index of the pixel makes neighboring pixels use different samples for the same
        direction.
        """
        count, first = (values[pixels, None] for values in self.samples_of_pixels)
        return first + (torch.arange(ray_count) + pixels[:, None]) % count

    @cached_property
    def points(self) -> Tensor:
        """Position in world axes of each of the S samples, shape (S, 3)."""
        return self.fragments.interpolate(self.vertices[self.fragments.corners])

    @cached_property
    def gloss(self) -> SampleGloss | None:
        """Specular material (gloss) at the samples, or None for a matte surface."""
        return sample_gloss(self.mesh, self.fragments, self.given_gloss)

    @property
    def lobe_width(self) -> float:
        """Smallest width α of the specular lobes (`SampleGloss`). Infinite for a matte surface."""
        return math.inf if self.gloss is None else self.gloss.lobe_width

    @cached_property
    def toward(self) -> Tensor:
        """Unit vectors from the S samples to the camera, shape (S, 3).

        Without perspective, all samples have the same vector, and the shape is
        (1, 3).
        """
        return toward_camera(self.fragments, self.vertices)


class BlockedRays(NamedTuple):
    """E rays from B pixels, in whose directions the mesh blocks the light of the sky.

    Attributes:
        pixels: Index of each pixel in `Fragments.pixels`, shape (B,).
        row: Index in `pixels` of the pixel of each ray, shape (E,).
        direction: Index of the direction of each ray, shape (E,).
        sample: Index of the sample from which it starts, shape (E,).
        weight: Weight of the radiance from its direction in the irradiance of its pixel,
            shape (E,). It is the solid angle of the direction, times the cosine to the shading
            normal, times the number n of samples of the pixel, because each sample has only
            1 / n of the directions.
        face: Index in the mesh of the first face that it hits, shape (E,). No ray is cast in
            directions below the plane of the face on which the sample lies. They have `NO_FACE`.
    """

    pixels: Int[Tensor, " B"]
    row: Int[Tensor, " E"]
    direction: Int[Tensor, " E"]
    sample: Int[Tensor, " E"]
    weight: Float[Tensor, " E"]
    face: Int[Tensor, " E"]

    def add_light(
        self, weights: Float[Tensor, " E"], sky: Float[Tensor, "D K"]
    ) -> Float[Tensor, "B K"]:
        """Add up the light from the directions of the rays of each pixel, times their weights."""
        matrix = weights.new_zeros(len(self.pixels), len(sky))
        return matrix.index_put_((self.row, self.direction), weights) @ sky


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
        corners = self._mesh.vertices[self._mesh.faces]
        return OFFSET * float(np.abs(corners - self._mesh.origin).max())

    def blocked(self, surface: Surface, directions: Float[Tensor, "D 3"]) -> Iterator[BlockedRays]:
        """Find the rays that the mesh blocks, among those in D directions (`ray_directions`).

        The face of a sample blocks all light from below its plane, as if the mesh were the surface
        of a solid. Pixels that can see no other surface are left out. Each result has some pixels.
        """
        pixels, horizon = self._pixels_to_cast(surface, len(directions))
        if not len(pixels):
            return
        normals, planes = surface.normals, surface.planes
        starts = surface.points + self.offset * planes
        sample_count, _ = surface.samples_of_pixels
        # The directions form turns, in each of which a pixel goes once through its samples. So
        # those in one place of all turns start at the same sample. Pixels with a rare number of
        # samples form a group together, with all directions in a single turn.
        places_of_pixel = sample_count[pixels].clamp(max=len(directions))
        is_rare = places_of_pixel.bincount()[places_of_pixel] * len(directions) < SMALL_GROUP
        places_of_pixel[is_rare] = len(directions)
        for places in places_of_pixel.unique().tolist():
            turns = -(-len(directions) // places)
            # The last turn is filled up with zeros, which are blocked nowhere.
            in_turns = F.pad(directions, (0, 0, 0, turns * places - len(directions)))
            at_places = in_turns.view(turns, places, 3).transpose(0, 1)
            for block in pixels[places_of_pixel == places].split(max(1, BLOCK // len(directions))):
                sample = surface.samples_of_rays(block, places).T
                # Cosine of each direction to the shading normal, and height of the direction above
                # the plane of the face, shape (places, turns, pixels of the block).
                cosine = at_places @ normals[sample].mT
                height = cosine if normals is planes else at_places @ planes[sample].mT
                is_in_front = cosine > 0
                # A ray is only cast above the face, and if it may hit another face.
                is_low = (height > 0) & (height <= horizon[sample][:, None])
                cast = torch.nonzero(is_in_front & is_low)
                place, turn, row = cast.T
                face = self.first_hit(starts[sample[place, row]], in_turns[turn * places + place])
                is_hit = face != NO_FACE
                below = torch.nonzero(is_in_front & (height < 0))
                place, turn, row = torch.cat([cast[is_hit], below]).T
                faces = F.pad(face[is_hit], (0, len(below)), value=NO_FACE)
                solid_angle = sample_count[block[row]].double() * 4 * math.pi / len(directions)
                weight = cosine[place, turn, row] * solid_angle
                seen, row_of_ray = row.unique(return_inverse=True)
                rays = row_of_ray, turn * places + place, sample[place, row], weight, faces
                if len(seen):
                    yield BlockedRays(block[seen], *rays)

    @cached_property
    def _scene(self) -> Any:
        """Embree scene with all faces of the mesh, in which rays are cast."""
        advice = "embreex, or set shadows=false and use no lamps and no projectors"
        scene = import_package("embreex.rtcore_scene", advice).EmbreeScene(robust=True)
        vertices = (self._mesh.vertices - self._mesh.origin).astype(np.float32)
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

    def _pixels_to_cast(
        self, surface: Surface, direction_count: int
    ) -> tuple[Int[Tensor, " B"], Float[Tensor, " S"]]:
        """Find the pixels for which the mesh may block light, and the horizon of each sample.

        A pixel is returned if one of its samples fulfills one of two conditions. First, a vertex of
        the mesh lies above the plane of the face on which the sample lies. Second, the shading
        normal differs from the normal of the face by an angle a, so that the plane of the face
        blocks the fraction (1 - cos a) / 2 of uniform light, and this exceeds `MAX_IGNORED_LIGHT`.
        A ray from a sample can only hit another face if the sine of its elevation above the plane
        is at most the horizon, which is 0 without the first condition. All pixels are returned if
        the test would need more than `MAX_COMPARISONS` comparisons.
        """
        fragments = surface.fragments
        plane_normals = surface.face_planes
        hull_vertices = self._outermost
        if len(plane_normals) * len(hull_vertices) > MAX_COMPARISONS:
            return torch.arange(len(fragments.pixels)), torch.full((len(surface.planes),), math.inf)
        # The normals are processed in blocks to limit the memory.
        blocks = plane_normals.split(max(1, 8 * BLOCK // len(hull_vertices)))
        # Largest coordinate of a hull vertex along the normal of each seen face.
        highest = torch.cat([(block @ hull_vertices.T).amax(1) for block in blocks])
        corners = surface.vertices[fragments.corners]
        # Height of the face itself along its normal.
        height_of_face = (plane_normals * corners[:, 0]).sum(1)
        rise = (highest - height_of_face) / self.offset
        sines = (rise > 1).double()
        # Little of the mesh rises above these faces, so their horizons are low and soon found.
        is_low = (rise > 1) & (rise < MAX_RISE / OFFSET)
        face_of_sample = fragments.sample_to_seen_face
        pixel_count = is_low[face_of_sample].double().mean() * len(fragments.pixels)
        most = COMPARISONS_PER_RAY * pixel_count * direction_count
        if 0 < is_low.sum() * len(self._mesh.vertices) <= most:
            sines[is_low] = self._horizons(corners[is_low], plane_normals[is_low])
        horizon = sines[face_of_sample]
        blocks_light = (surface.normals * surface.planes).sum(1) < 1 - 2 * MAX_IGNORED_LIGHT
        pixels = fragments.sample_to_pixel[(horizon > 0) | blocks_light].unique()
        return pixels, horizon + ROUNDING

    def _horizons(
        self, corners: Float[Tensor, "G 3 3"], normals: Float[Tensor, "G 3"]
    ) -> Float[Tensor, " G"]:
        """Bound the sine of the elevation at which points of G faces see the rest of the mesh.

        A plane contains an edge of the seen face, and rises beyond it with the slope t. If another
        face lies below this plane, all rays from the seen face to it have at most the slope t. The
        edge with the smallest t counts for this pair, and the steepest pair gives the bound. The
        bound is 1 if more than `MAX_ABOVE` faces rise above the seen face.
        """
        origin = torch.from_numpy(self._mesh.origin)
        corners = corners - origin
        vertices = F.pad(torch.from_numpy(self._mesh.vertices) - origin, (0, 1), value=1.0)
        faces = torch.from_numpy(self._mesh.faces).long()
        entries = np.ones(faces.numel(), bool), (faces.ravel(), np.arange(faces.numel()) // 3)
        faces_of_vertex = csr_matrix(entries, (len(vertices), len(faces)))
        face_count = np.diff(faces_of_vertex.indptr)
        # Each seen face has four planes: its own, and one at a right angle to it through each edge.
        # A row has the unit normal, which points up or outward, and minus the coordinate along it.
        outward = torch.linalg.cross(corners.roll(-1, 1) - corners, normals[:, None])
        inside = ((corners.roll(-2, 1) - corners) * outward).sum(2, keepdim=True)
        outward = F.normalize(outward * -inside.sign(), dim=2)
        axes = torch.cat([normals[:, None], outward], 1)
        coordinate = (axes * corners[:, [0, 0, 1, 2]]).sum(2, keepdim=True)
        # Rays start at the offset above the face.
        coordinate[:, 0] += self.offset
        sines = []
        for block in torch.cat([axes, -coordinate], 2).split(8 * BLOCK // len(vertices) + 1):
            above = csr_matrix((block[:, 0] @ vertices.T > 0).numpy())
            has_few = above @ face_count <= MAX_ABOVE
            pairs = (above.multiply(has_few[:, None]) @ faces_of_vertex).nonzero()
            row, other = (torch.from_numpy(index).long() for index in pairs)
            sine = torch.from_numpy(~has_few).double()
            # Height of each vertex of the other face, and its distance beyond each edge.
            coordinates = torch.einsum("evd,eld->lev", vertices[faces[other]], block[row])
            height, beyond = coordinates[0], coordinates[1:]
            slope = height / beyond
            # A plane through an edge lies above all three vertices if its slope is between these.
            minimum = slope.where(beyond > 0, math.inf).where(height > 0, 0.0).amax(2)
            maximum = slope.where((height <= 0) & (beyond < 0), math.inf).amin(2)
            bound = minimum.where(minimum <= maximum, math.inf).amin(0).atan().sin()
            sines.append(sine.scatter_reduce(0, row, bound, "amax"))
        return torch.cat(sines)

    def first_hit(
        self,
        origins: Float[Tensor, "N 3"],
        directions: Float[Tensor, "N 3"],
        lengths: Float[Tensor, " N"] | None = None,
    ) -> Int[Tensor, " N"]:
        """Find the first face that each of N rays hits, or `NO_FACE`, in world axes and units.

        Rays are infinite if `lengths` is None.
        """
        rays = [origins - torch.from_numpy(self._mesh.origin), directions, lengths]
        given = [each.numpy() for each in rays if each is not None]
        arrays = [np.ascontiguousarray(each, np.float32) for each in given]
        return torch.from_numpy(self._scene.run(*arrays)).long()


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
def ray_directions(count: int) -> Float[Tensor, "count 3"]:
    """Return the directions of `sphere` in a random order, which is the same in every call.

    Those of `sphere` are sorted by z. In this order, each sample of a pixel gets directions from
    all over the sphere.
    """
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0)).argsort()
    return sphere(count)[order]


def local_transfer(
    rays: Rays, surface: Surface, albedo: Float[Tensor, "S C"], basis: LocalBasis
) -> SparseTransfer:
    """Compute the matrix from coefficients of local light to the radiance of a view.

    Each sample casts a ray to each source, so the edges of shadows are as sharp
    as those of the mesh.
    """
    fragments = surface.fragments
    samples = surface.points, surface.normals, surface.planes
    paths = unoccluded(rays, basis, *samples, lobe_width=surface.lobe_width)
    # One row for each path, one column for each channel: radiance of the sample at the end
    # of the path, per unit of the coefficient of its light.
    weights = path_reflectance(surface, albedo, paths) * paths.irradiance[:, None]
    weights = weights / fragments.samples**2
    # The paths of a pixel that come from the same basis function are added up to one entry.
    # Pixel and function are combined to one number, because sorting numbers is faster.
    key_of_path = fragments.sample_to_pixel[paths.point] * basis.size + paths.function
    keys, path_to_entry = key_of_path.unique(return_inverse=True)
    weight = weights.new_zeros(len(keys), albedo.shape[1]).index_add_(0, path_to_entry, weights)
    return SparseTransfer(function=keys % basis.size, pixel=keys // basis.size, weight=weight)


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
    # The reflection of metals (colored) is multiplied by the albedo. All other specular
    # reflection (white) has the color of the light.
    colored, white = path_gloss.reflect_beams(normals, at_samples(surface.toward, sample), to_light)
    diffuse_factor = gloss.diffuse_factor((surface.normals * surface.toward).sum(1))[sample]
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
    lobe_width: float = math.inf,
) -> LightPaths:
    """Find the paths from local lights to surface points that no face of the mesh blocks.

    A path must also arrive above the plane of the face on which the point lies. `positions`
    are the places to which lamps have moved. None leaves them where the basis has them. The
    `lobe_width` is that of the narrowest highlights (`LocalBasis.connect`).
    """
    paths = basis.connect(points, normals, positions, lobe_width)
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
    hold fixed which lamps light a sample, and without silhouettes also which pixels
    of a projected pattern do.

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
        if moved is not None:
            require_shape("positions", moved, len(light), 3)
            require_bounded(positions=moved)
        paths = self.fixed_paths.get(basis) if moved is None else None
        if paths is None:
            samples = surface.points, surface.normals, surface.planes
            paths = unoccluded(self.rays, basis, *samples, moved, surface.lobe_width)
        if moved is None:
            self.fixed_paths[basis] = paths
        shown = (fragments or surface.fragments).to("cpu")
        # With silhouettes, gradients include how surfaces move past the camera and the projector.
        is_moving = shown.cameras is not surface.fragments.cameras
        if surface.gloss is not None and is_moving:
            surface = replace(surface, fragments=replace(surface.fragments, cameras=shown.cameras))
        points = surface.points if is_moving else surface.points.detach()
        arriving = basis.arriving(light.cpu().double(), paths, points)
        # Irradiance at the end of each path: one row for each path, one column for each color.
        irradiance = paths.irradiance[:, None] * arriving
        radiance = path_reflectance(surface, albedo.cpu().double(), paths) / shown.samples**2
        radiance = radiance * irradiance
        zeros = radiance.new_zeros(len(shown.pixels), 3)
        return zeros.index_add(0, shown.sample_to_pixel[paths.point], radiance).T.to(light)
