"""A table under an object and a wall behind it, as the background of an image.

Table and wall together are called a room. They have the same light as the object, and the object
casts its shadow on them. The light consists of the environment light (the sky), a distant lamp,
and local lights (projector and lamps).

- The irradiance from the sky is exact where the object blocks nothing of the sky. Elsewhere, the
  radiance of `DIRECTIONS` directions that hit the object is subtracted.
- The distant lamp casts a sharp shadow.
- The table reflects sky and distant lamp to the object (`above_table`). The reflection from the
  object to the table is ignored. It would change the table by 0.1 to 1.4 of 255 on average in
  images of 32 pixels.

In arrays with a pair of surfaces, index 0 is the table, and index 1 is the wall.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from renderer.camera import Camera, PerspectiveCamera
from renderer.light.basis import Harmonics, LitBasis
from renderer.light.harmonics import cache_tensors, degree_of
from renderer.mesh import Mesh
from renderer.operators.rays import NO_FACE, Rays, sphere, unoccluded
from renderer.settings import ImageSettings

# Number of directions of the sky that are traced from each point of the table or the wall, to find
# out whether the object blocks them.
DIRECTIONS = 48
# The soft shadow of the object in the light of the sky is computed at every second pixel along each
# side, and interpolated between them.
COARSE = 2
# Number of directions on the sphere over which `_split_at_horizon` sums to approximate integrals.
NODES = 2**12
# Distance from which the rays of an orthographic camera start, in world units.
FAR = 1e3
# A camera ray that never meets the table or the wall gets this component along the normal of the
# surface. It then meets the surface very far away, and no division by zero occurs.
FALLING = -1e-9
# Indices of the two surfaces in arrays such as `normals`.
TABLE = 0
WALL = 1


@dataclass(frozen=True)
class Room:
    """A table and a wall, and the object that casts its shadow on them.

    Attributes:
        rays: Ray tracer of the faces of the object.
        radius: Largest distance of the object from the origin, in world units.
        height: Height z of the table, in world units.
        wall: Distance of the wall from the origin, in world units. The wall is vertical, behind
            the object, and faces the camera.
    """

    rays: Rays
    radius: float
    height: float
    wall: float


class _SeenPoints(NamedTuple):
    """The points of table and wall that a camera sees, S points in each of P pixels.

    Attributes:
        points: Positions in world units.
        normals: Unit normals of the surfaces.
        is_on_wall: Mask of the points on the wall. The others are on the table.
    """

    points: Float[Tensor, "S P 3"]
    normals: Float[Tensor, "S P 3"]
    is_on_wall: Bool[Tensor, "S P"]


@cache_tensors
def _split_at_horizon(degree: int) -> tuple[Tensor, Tensor]:
    """Split light in spherical harmonics into the part above and the part below the horizon.

    Return the matrix (K, K) from the coefficients of a light to those of its part above the
    horizon, and the coefficients (K,) of radiance 1 below the horizon and 0 above.
    """
    directions = sphere(NODES)
    # Value of each harmonic in each direction, shape (NODES, K).
    values = Harmonics(degree).radiance(directions)
    values_above = values[directions[:, 2] > 0]
    # Solid angle of each direction.
    weight = 4 * math.pi / NODES
    # Harmonics are orthonormal. A coefficient is therefore the integral of the light times the
    # harmonic, which is approximated by the sum over the directions.
    upper_part = values_above.T @ values_above * weight
    below_horizon = (values.sum(0) - values_above.sum(0)) * weight
    return upper_part, below_horizon


def above_table(
    lights: Float[Tensor, "E K 3"], lamps: Float[Tensor, "E 3"], albedo: Float[Tensor, "E _"]
) -> Float[Tensor, "E K 3"]:
    """Compute the light that reaches an object on an infinite table.

    It is the environment light from above, and from below the light that the table reflects. The
    table reflects the environment light from above and the light of a distant lamp. `lights` are
    before the table is added. `lamps` are unit directions towards white lamps of irradiance 1, or
    zero for no lamp, and the albedo is linear. The result is without the direct light of the lamp.
    """
    harmonics = Harmonics(degree_of(lights[0]))
    upper_part, below_horizon = _split_at_horizon(harmonics.degree)
    above = upper_part @ lights.cpu().double()
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    # Irradiance of the table from the environment, shape (E, 3). Only the harmonics with the
    # indices `nonzero` contribute irradiance.
    from_sky = harmonics.irradiance(up)[0] @ above[:, harmonics.nonzero]
    # The irradiance from the lamp is the cosine of the angle between its direction and the
    # vertical, which is the z component of the direction.
    arriving = from_sky.clamp(min=0) + lamps[:, 2:].clamp(min=0)
    # Radiance of a Lambertian table, the same in all directions, shape (E, 3).
    reflected = albedo.cpu() * arriving / math.pi
    return (above + below_horizon[:, None] * reflected[:, None]).to(lights)


def irradiance(
    room: Room,
    camera: Camera,
    image: ImageSettings,
    sky: Float[Tensor, "K 3"],
    lamp: Float[Tensor, " 3"],
    lights: Sequence[LitBasis] = (),
) -> Float[Tensor, "3 height width"]:
    """Compute an image of the irradiance of a table and a wall, with the shadow of an object.

    The object itself is invisible. `lamp` is the unit direction towards a white lamp of irradiance
    1, or zero for no lamp. `lights` are local lights with their RGB coefficients.
    """
    harmonics = Harmonics(degree_of(sky))
    normals = _normals(camera)
    # Shadows of lamps have sharp edges, which need several samples per pixel.
    fine = image if lamp.any() or lights else replace(image, samples=1)
    fine_points = _find_seen_points(camera, fine, room, image.shape)
    # Irradiance from the whole sky of the table, in row 0, and of the wall, in row 1. Only the
    # harmonics with the indices `nonzero` contribute irradiance.
    from_whole_sky = harmonics.irradiance(normals) @ sky[harmonics.nonzero]
    from_table_sky, from_wall_sky = from_whole_sky.clamp(min=0)
    # The following values are averages over the samples of each of the P pixels.
    fraction_on_wall = fine_points.is_on_wall.double().mean(0)[:, None]
    # Irradiance if nothing blocked the sky, shape (P, 3).
    open_sky = from_table_sky + fraction_on_wall * (from_wall_sky - from_table_sky)
    from_lamp = _from_lamp(room, fine_points, lamp).mean(0)[:, None]
    from_lights = _from_local_lights(room, fine_points, lights).mean(0)
    lit = open_sky + (from_lamp + from_lights)

    # Irradiance from the part of the sky that the object blocks, in an image of fewer pixels.
    size = tuple(math.ceil(side / COARSE) for side in image.shape)
    coarse = replace(image, size=size, samples=1)
    coarse_points = _find_seen_points(camera, coarse, room, image.shape)
    # The irradiance is the integral of radiance times cosine. The density of the directions is
    # proportional to the cosine, so each direction has the same share of π, the integral of the
    # cosine.
    directions = _directions(normals)
    radiance = harmonics.radiance(directions.flatten(0, 1)) @ sky * (math.pi / DIRECTIONS)
    blocked = _blocked_sky(room, coarse_points, directions, radiance.unflatten(0, (2, -1)))
    coarse_image = blocked.T.unflatten(1, coarse.shape)[None]
    blocked_image = F.interpolate(coarse_image, image.shape, mode="bilinear")[0]
    return (lit.T.unflatten(1, image.shape) - blocked_image).clamp(min=0)


def _normals(camera: Camera) -> Float[Tensor, "2 3"]:
    """Return the normals of a table, which points up, and of a wall that faces the camera."""
    azimuth = math.radians(camera.azimuth)
    rows = [[0.0, 0.0, 1.0], [math.cos(azimuth), math.sin(azimuth), 0.0]]
    return torch.tensor(rows, dtype=torch.float64)


def _from_lamp(room: Room, seen: _SeenPoints, lamp: Float[Tensor, " 3"]) -> Float[Tensor, "S P"]:
    """Compute the irradiance of points on a table and a wall from a white distant lamp.

    The result is 0 in the shadow of the object.
    """
    lit = (seen.normals @ lamp).clamp(min=0)
    # Rays are traced only from points that the object can shade, since tracing takes most time.
    # Indices of the samples, and of the pixels, of the points that may be shaded.
    may_be_shaded = (lit > 0) & _passes_near_origin(seen.points, lamp, room.radius)
    candidates = torch.nonzero(may_be_shaded, as_tuple=True)
    # Rays start slightly above the surface, so that rounding cannot move their starts below it.
    starts = seen.points[candidates] + room.rays.offset * seen.normals[candidates]
    lit[candidates] *= room.rays.first_hit(starts, lamp.expand(len(starts), 3)) == NO_FACE
    return lit


def _from_local_lights(
    room: Room, seen: _SeenPoints, lights: Sequence[LitBasis]
) -> Float[Tensor, "S P 3"]:
    """Compute the irradiance of points on a table and a wall from projector and lamps.

    The object casts shadows. There are S points in each of P pixels.
    """
    # One list of all points, shape (S · P, 3).
    points = seen.points.flatten(0, 1)
    normals = seen.normals.flatten(0, 1)
    arriving = torch.zeros(len(points), 3, dtype=torch.float64)
    for basis, coefficients in lights:
        # `unoccluded` needs the normals of faces and those for shading. On flat surfaces, both
        # are the same.
        paths = unoccluded(room.rays, basis, points, normals, normals)
        # A path goes from one function of the basis, such as a pixel of the projector, to one
        # point.
        irradiance_of_path = paths.irradiance[:, None] * coefficients[paths.function]
        arriving.index_add_(0, paths.point, irradiance_of_path)
    return arriving.unflatten(0, (len(seen.points), -1))


def _blocked_sky(
    room: Room, seen: _SeenPoints, directions: Float[Tensor, "2 D 3"], radiance: Tensor
) -> Float[Tensor, "P 3"]:
    """Compute how much irradiance an object takes from a table and a wall by blocking the sky.

    From each point, rays are traced in D directions. The radiance of the directions in which a ray
    hits the object is summed. Directions are in world axes, D for points of the table (row 0) and D
    for points of the wall. `radiance` is the irradiance that each contributes if it is not blocked.
    """
    # Rays start slightly above the surface.
    points = seen.points[0] + room.rays.offset * seen.normals[0]
    blocked = torch.zeros(len(points), 3, dtype=torch.float64)
    for surface in (TABLE, WALL):
        # Indices of the pixels that show this surface, the table or the wall.
        pixels = torch.nonzero(seen.is_on_wall[0] == surface).squeeze(1)
        starts = points[pixels]
        may_hit = _passes_near_origin(starts, directions[surface].T, room.radius)
        # Each traced ray has an index of its start and an index of its direction.
        ray_to_start, ray_to_direction = torch.nonzero(may_hit, as_tuple=True)
        ray_directions = directions[surface, ray_to_direction]
        is_blocked = room.rays.first_hit(starts[ray_to_start], ray_directions) != NO_FACE
        blocked_pixels = pixels[ray_to_start[is_blocked]]
        blocked.index_add_(0, blocked_pixels, radiance[surface, ray_to_direction[is_blocked]])
    return blocked


def project_along_light(
    room: Room, mesh: Mesh, camera: Camera, image: ImageSettings, towards: Float[Tensor, " 3"]
) -> Float[Tensor, "2 height width"]:
    """Compute which point of a projected pattern each pixel of an image shows.

    A projector far away shines a pattern along parallel rays. A pixel shows a point of the object,
    the table or the wall. The ray of the projector through this point tells which point of the
    pattern lights it. The coordinates are 0 on the ray through the origin, and their unit is half
    of the width that the camera sees. `towards` is the unit vector towards the projector.
    """
    # Points of table or wall that the pixels would show without the object, shape (P, 3).
    points = _find_seen_points(camera, replace(image, samples=1), room, image.shape).points[0]
    starts = _ray_starts(camera, points)
    forward = F.normalize(points - starts, dim=1)
    face_of_pixel = room.rays.first_hit(starts, forward)
    # M of the pixels show the object. Replace the point of each by the point of the face of the
    # object that the ray of the pixel hits.
    mesh_pixels = torch.nonzero(face_of_pixel != NO_FACE).squeeze(1)
    corners = torch.from_numpy(mesh.vertices[mesh.faces[face_of_pixel[mesh_pixels].numpy()]])
    first, second, third = corners.unbind(1)
    # Normals of the faces, not of unit length, shape (M, 3).
    face_normals = torch.linalg.cross(second - first, third - first)
    # Intersect each ray with the plane of its face. `length` is the distance to it, shape (M,).
    height = ((first - starts[mesh_pixels]) * face_normals).sum(1)
    length = height / (forward[mesh_pixels] * face_normals).sum(1)
    points[mesh_pixels] = starts[mesh_pixels] + length[:, None] * forward[mesh_pixels]
    # Axes of the pattern, to the right and down, perpendicular to the rays of the projector. If the
    # rays are vertical, the small number keeps the vector from being zero.
    right = F.normalize(torch.stack([-towards[1], towards[0] + 1e-9, towards.new_zeros(())]), dim=0)
    axes = torch.stack([right, torch.linalg.cross(right, towards)])
    return (points @ axes.T / (camera.width / 2)).T.unflatten(1, image.shape)


def _passes_near_origin(points: Tensor, directions: Tensor, radius: float) -> Bool[Tensor, " ..."]:
    """Find the rays that pass through a sphere around the origin.

    Starts may lie in the sphere, such as below an object that overhangs its table. Directions are
    one for all rays, shape (3,), or D for each start as columns, shape (3, D).
    """
    # A ray comes nearest to the origin after the distance -along from its start.
    along = points @ directions
    squared = points.square().sum(-1, keepdim=directions.ndim > 1)
    # Pythagoras gives the squared distance between the ray and the origin.
    comes_near = (along < 0) & (squared - along**2 < radius**2)
    return comes_near | (squared < radius**2)


def _directions(normals: Float[Tensor, "2 3"]) -> Float[Tensor, "2 D 3"]:
    """Choose unit directions in front of a table and of a wall, with these normals.

    The density of the D = `DIRECTIONS` directions is proportional to the cosine of the angle to the
    normal (Malley's method).
    """
    index = torch.arange(DIRECTIONS, dtype=torch.float64)
    # Distribute points evenly over the unit disk, along a spiral of the golden angle (Fibonacci
    # lattice). Malley's method then projects them onto the hemisphere.
    squared_radius = (index + 0.5) / DIRECTIONS
    angle = math.pi * (3 - math.sqrt(5)) * index
    radius = squared_radius.sqrt()
    on_disk = radius * angle.cos(), radius * angle.sin()
    on_hemisphere = torch.stack([*on_disk, (1 - squared_radius).sqrt()], dim=1)
    # Axes of both hemispheres, whose third axis is the normal, in world axes.
    up, forward = normals
    right = torch.linalg.cross(up, forward)
    axes = torch.stack([forward, right, up]), torch.stack([right, up, forward])
    return on_hemisphere @ torch.stack(axes)


def _find_seen_points(
    camera: Camera, image: ImageSettings, room: Room, frame: tuple[int, int]
) -> _SeenPoints:
    """Find where the rays of a camera meet a table or a wall, if no object is in the way.

    Each of the P pixels has S = samples² rays. The image shows what one of the height and the
    width `frame` shows.
    """
    # Each ray passes through a point of the plane through the origin that faces the camera. The
    # rows of `axes` point right, up and towards the camera.
    axes = torch.from_numpy(camera.axes())
    right, up = _sample_positions(camera, image, frame[0] / frame[1])
    ends = right * axes[0] + up * axes[1]
    starts = _ray_starts(camera, ends)
    forward = ends - starts
    # Table and wall are the planes normal · p = level.
    normals = _normals(camera)
    levels = torch.tensor([room.height, -room.wall], dtype=torch.float64)
    # Component of each ray along both normals, which is negative if the ray meets the plane.
    falling = (forward @ normals.T).clamp(max=FALLING)
    # Length at which a ray p = starts + length · forward meets each plane, shape (S, P, 2).
    lengths = (levels - starts @ normals.T) / falling
    # The nearer of both surfaces hides the other.
    points = starts + lengths.amin(2, keepdim=True) * forward
    is_on_wall = lengths[..., WALL] < lengths[..., TABLE]
    return _SeenPoints(points, normals[is_on_wall.long()], is_on_wall)


def _ray_starts(camera: Camera, points: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
    """Return the points at which the rays of a camera through some points start."""
    if isinstance(camera, PerspectiveCamera):
        return torch.from_numpy(camera.pose()[:3, 3]).expand_as(points)
    return points + FAR * torch.from_numpy(camera.axes()[2])


def _sample_positions(camera: Camera, image: ImageSettings, ratio: float) -> tuple[Tensor, Tensor]:
    """Compute where the samples of an image lie in the plane through the origin.

    The plane faces the camera. `ratio` is the height of what the image shows, divided by its width.
    Return the distances to the right and up in world units, each of shape (S, P, 1) for S samples
    of each of P pixels.
    """
    # Distances of the rows down, and of the columns to the right, from the center of the image in
    # world units.
    counts = [side * image.samples for side in image.shape]
    down, right = (
        ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * extent
        for count, extent in zip(counts, (camera.width * ratio, camera.width), strict=True)
    )
    # Measure from the principal point, which may be off the center of the image.
    half_width = camera.width / 2
    rows = (-down - camera.principal_up * half_width) / camera.pixel_aspect - camera.up
    columns = right - camera.principal_right * half_width - camera.right
    samples = torch.stack(torch.meshgrid(columns, rows, indexing="xy"))
    # Split rows and columns of samples: (2, pixel row, sample row, pixel column, sample column).
    height, width = image.shape
    by_pixel = samples.view(2, height, image.samples, width, image.samples)
    # Bring the two axes of samples to the front, and join each pair of axes.
    right, up = by_pixel.permute(0, 2, 4, 1, 3).reshape(2, image.samples**2, -1, 1)
    return right, up
