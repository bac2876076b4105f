"""A table under an object and a wall behind it, as the background of an image.

Both are lit as the object is, and lie in its shadow. The sky's irradiance is exact except where
the object blocks the sky. There, as in `renderer.transport`, the radiance of the directions that
hit the object is taken away. A distant lamp casts a sharp shadow, and local lights cast theirs.
What the table reflects of sky and distant lamp lights the object from below. The object reflects
nothing onto the table, which would change the table by 0.1 to 1.4 of 255 on average at 32 pixels.

In this module, index 0 of a pair of surfaces is the table, and index 1 is the wall.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.camera import Camera, PerspectiveCamera
from renderer.geometry.mesh import Mesh
from renderer.light.basis import Harmonics, LocalBasis
from renderer.light.harmonics import bands, degree_of, per_degree
from renderer.settings import ImageSettings
from renderer.transport.lamp_paths import unoccluded
from renderer.transport.rays import Rays, sphere

# Number of directions in which rays are traced from a point of table or wall to
# the sky.
DIRECTIONS = 48
# Distance in pixels of the points at which the shadow of the sky is computed. The
# shadow is soft, so it is interpolated between them.
COARSE = 2
# Number of directions on the sphere with which integrals are computed.
NODES = 2**12
# The distance from which the rays of an orthographic camera start, in world units.
FAR = 1e3
# Largest component of a ray along the normal of a surface. A ray that is parallel to the surface
# or leaves it is changed to this value, so that it meets the surface far away.
FALLING = -1e-9


@dataclass(frozen=True)
class Room:
    """A table and a wall, and the object whose shadow lies on them.

    Attributes:
        rays: Traces rays among the faces of the object.
        radius: The object lies within this distance of the origin, in world units.
        height: The height z of the table, in world units.
        wall: The distance of the wall behind the origin, in world units. The wall faces the
            azimuth of the camera.
    """

    rays: Rays
    radius: float
    height: float
    wall: float


@dataclass(frozen=True)
class _SeenPoints:
    """The points of table and wall that a camera sees through S samples of each of P pixels.

    Attributes:
        points: The points, shape (S, P, 3).
        is_on_wall: Mask of the points on the wall, shape (S, P). The others are on the table.
    """

    points: Tensor
    is_on_wall: Tensor


@per_degree
def _upper(degree: int) -> tuple[Tensor, Tensor]:
    """Compute the harmonics of light from above and from below the horizon.

    Returns:
        Matrix (size, size) that multiplies the coefficients of a light and gives the coefficients
        of its part above the horizon. Coefficients (size,) of light with radiance 1 in all
        directions below the horizon.
    """
    directions = sphere(NODES)
    radiance = Harmonics(degree).radiance(directions)
    above = radiance[directions[:, 2] > 0]
    weight = 4 * math.pi / NODES
    return above.T @ above * weight, (radiance.sum(0) - above.sum(0)) * weight


def above_table(lights: Tensor, lamps: Tensor, albedo: Tensor) -> Tensor:
    """Compute the light of an object on an infinite table.

    Args:
        lights: The coefficients of the light without a table, shape (E, K, 3).
        lamps: The direction of a white distant lamp of irradiance 1, or zero for none, shape
            (E, 3).
        albedo: The albedo of the table, shape (E, 3).

    Returns:
        The coefficients of the light, shape (E, K, 3): the light from above, and the part of this
        light and of the lamp's that the table reflects.
    """
    harmonics = Harmonics(degree_of(lights[0]))
    upper, below = _upper(harmonics.degree)
    above = upper @ lights.cpu().double()
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    from_sky = harmonics.irradiance(up)[0] @ above[:, harmonics.nonzero]
    arriving = from_sky.clamp(min=0) + lamps[:, 2:].clamp(min=0)
    reflected = albedo.cpu() * arriving / math.pi
    return (above + below[:, None] * reflected[:, None]).to(lights)


def irradiance(
    room: Room,
    camera: Camera,
    image: ImageSettings,
    sky: Tensor,
    lamp: Tensor,
    lights: Sequence[tuple[LocalBasis, Tensor]] = (),
) -> Tensor:
    """Compute the irradiance of the table and the wall that a camera sees.

    Args:
        room: The table, the wall, and the object that casts the shadow.
        camera: The camera.
        image: The size of the image and the samples of a pixel, over which the irradiance is
            averaged.
        sky: The coefficients of the sky, shape (K, 3).
        lamp: The direction of a white distant lamp of irradiance 1, or zero for none, shape (3,).
        lights: Local lights, and the coefficients (size, 3) of each.

    Returns:
        The irradiance, shape (3, size, size).

    Raises:
        InputError: If Embree is not installed.
    """
    turn = _turn(camera)
    normals = torch.stack([turn[2], turn[0]])
    directions, radiance, irradiance_of_sky = _directions(degree_of(sky))
    sky = _turned(sky, camera.azimuth)

    # Shadows of lamps have sharp edges, which need several samples per pixel.
    fine = image if lamp.any() or lights else replace(image, samples=1)
    seen = _surfaces(camera, fine, room, normals)
    arriving = (irradiance_of_sky @ sky).clamp(min=0)
    fraction_on_wall = seen.is_on_wall.double().mean(0)[:, None]
    open_sky = arriving[0] + fraction_on_wall * (arriving[1] - arriving[0])
    from_lamp = _from_lamp(room, seen, normals, lamp).mean(0)[:, None]
    from_lights = _from_local_lights(room, seen, normals, lights).mean(0)
    lit = open_sky + (from_lamp + from_lights)

    coarse = replace(image, size=-(-image.size // COARSE), samples=1)
    seen = _surfaces(camera, coarse, room, normals)
    radiance_of_sky = radiance @ sky * (math.pi / DIRECTIONS)
    blocked = _blocked_sky(room, seen, normals, directions @ turn, radiance_of_sky)
    blocked_image = F.interpolate(
        blocked.T.unflatten(1, (coarse.size, -1))[None], image.size, mode="bilinear"
    )[0]
    return (lit.T.unflatten(1, (image.size, -1)) - blocked_image).clamp(min=0)


def _turn(camera: Camera) -> Tensor:
    """Return the rotation about the vertical whose first row is the wall's normal, (3, 3)."""
    azimuth = math.radians(camera.azimuth)
    sine = math.sin(azimuth)
    cosine = math.cos(azimuth)
    rows = [[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64)


def _from_lamp(room: Room, seen: _SeenPoints, normals: Tensor, lamp: Tensor) -> Tensor:
    """Return the irradiance of the seen points by a distant lamp, (S, P), 0 in the shadow."""
    surface_of_point = seen.is_on_wall.long()
    lit = (normals @ lamp).clamp(min=0)[surface_of_point]
    may_be_shaded = (lit > 0) & _near(seen.points, lamp, room.radius)
    shaded = torch.nonzero(may_be_shaded, as_tuple=True)
    offset = room.rays.offset * normals[surface_of_point[shaded]]
    starts = seen.points[shaded] + offset
    lit[shaded] *= room.rays.first_hit(starts, lamp.expand(len(starts), 3)) < 0
    return lit


def _from_local_lights(
    room: Room,
    seen: _SeenPoints,
    normals: Tensor,
    lights: Sequence[tuple[LocalBasis, Tensor]],
) -> Tensor:
    """Return the irradiance of the seen points by local lights, (S, P, 3)."""
    points = seen.points.flatten(0, 1)
    facing = normals[seen.is_on_wall.long()].flatten(0, 1)
    arriving = torch.zeros(len(points), 3, dtype=torch.float64)
    for basis, coefficients in lights:
        paths = unoccluded(room.rays, basis, points, facing, facing)
        sent = paths.irradiance[:, None] * coefficients[paths.function]
        arriving.index_add_(0, paths.point, sent)
    return arriving.unflatten(0, (len(seen.points), -1))


def _blocked_sky(
    room: Room, seen: _SeenPoints, normals: Tensor, directions: Tensor, radiance: Tensor
) -> Tensor:
    """Return the irradiance of the sky that the object blocks at the seen points, shape (P, 3).

    There is one point per pixel. The sky is sampled in D directions for the table and for the
    wall, shape (2, D, 3). The radiance, shape (2, D, 3), contains the weight of each direction.
    """
    points = seen.points[0]
    is_on_wall = seen.is_on_wall[0]
    blocked = torch.zeros(len(points), 3, dtype=torch.float64)
    for surface in range(2):
        pixels = torch.nonzero(is_on_wall == surface).squeeze(1)
        starts = points[pixels] + room.rays.offset * normals[surface]
        is_near = _near(starts, directions[surface].T, room.radius)
        start, direction = torch.nonzero(is_near, as_tuple=True)
        hit = room.rays.first_hit(starts[start], directions[surface, direction]) >= 0
        blocked.index_add_(0, pixels[start[hit]], radiance[surface, direction[hit]])
    return blocked


def project_along_light(
    room: Room, mesh: Mesh, camera: Camera, image: ImageSettings, towards: Tensor
) -> Tensor:
    """Compute where light from a direction meets what a camera sees.

    The camera sees the mesh, the table or the wall at the center of each pixel.

    Args:
        room: The table and the wall.
        mesh: The mesh, whose faces `room.rays` traces.
        camera: The camera.
        image: The size of the image.
        towards: The direction of the light, shape (3,).

    Returns:
        Coordinates across the light, in halves of the image's width from the middle, shape
        (2, size, size).
    """
    turn = _turn(camera)
    normals = torch.stack([turn[2], turn[0]])
    points = _surfaces(camera, replace(image, samples=1), room, normals).points[0]
    starts = points + FAR * torch.from_numpy(camera.axes()[2])
    if isinstance(camera, PerspectiveCamera):
        starts = torch.from_numpy(camera.pose()[:3, 3]).expand_as(points)
    forward = F.normalize(points - starts, dim=1)
    face = room.rays.first_hit(starts, forward)
    on_mesh = torch.nonzero(face >= 0).squeeze(1)
    corners = torch.from_numpy(mesh.vertices[mesh.faces[face[on_mesh].numpy()]])
    first, second, third = corners.unbind(1)
    planes = torch.linalg.cross(second - first, third - first)
    height = ((first - starts[on_mesh]) * planes).sum(1)
    length = height / (forward[on_mesh] * planes).sum(1)
    points[on_mesh] = starts[on_mesh] + length[:, None] * forward[on_mesh]

    # The light may come from straight above, where the small number gives a direction.
    right = torch.stack([-towards[1], towards[0] + 1e-9, towards.new_zeros(())])
    right = F.normalize(right, dim=0)
    axes = torch.stack([right, torch.linalg.cross(towards, right)])
    coordinates = points @ axes.T / (camera.width / 2)
    return coordinates.T.unflatten(1, (image.size, -1))


def _near(points: Tensor, directions: Tensor, radius: float) -> Tensor:
    """Return a mask of the rays that come nearer to the origin than a radius.

    The rays start at points (..., 3) in one direction (3,) or in D directions (3, D).
    """
    along = points @ directions
    squared = points.square().sum(-1)
    if directions.ndim > 1:
        squared = squared[..., None]
    return (along < 0) & (squared - along**2 < radius**2)


@per_degree
def _directions(degree: int) -> tuple[Tensor, Tensor, Tensor]:
    """Choose directions above a table and in front of a wall that faces +x.

    The density of the directions is proportional to the cosine (Malley's method).

    Returns:
        Directions for table and wall, shape (2, D, 3). Values of the harmonics in these
        directions, shape (2, D, size). Irradiance of both surfaces per unit of each harmonic,
        shape (2, size).
    """
    index = torch.arange(DIRECTIONS, dtype=torch.float64)
    squared = (index + 0.5) / DIRECTIONS
    angle = math.pi * (3 - math.sqrt(5)) * index
    radius = squared.sqrt()
    x = radius * angle.cos()
    y = radius * angle.sin()
    above_table = torch.stack([x, y, (1 - squared).sqrt()], dim=1)
    # The normal of the table is +z, the normal of the wall +x. The permutation of
    # (x, y, z) to (z, x, y) turns +z into +x.
    before_wall = above_table.roll(1, 1)
    directions = torch.stack([above_table, before_wall])
    harmonics = Harmonics(degree)
    normals = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    irradiance = torch.zeros(2, harmonics.size, dtype=torch.float64)
    irradiance[:, harmonics.nonzero] = harmonics.irradiance(normals)
    radiance = harmonics.radiance(directions.flatten(0, 1)).unflatten(0, (2, -1))
    return directions, radiance, irradiance


def _turned(sky: Tensor, azimuth: float) -> Tensor:
    """Turn the coefficients (size, 3) of a sky back by an azimuth in degrees.

    The harmonics Y_lm and Y_l-m depend on the azimuth φ as cos mφ and sin mφ.
    """
    l = bands(degree_of(sky))
    order = torch.arange(len(l)) - l * (l + 1)
    angle = (order * math.radians(azimuth)).double()[:, None]
    mirrored = l * (l + 1) - order
    return angle.cos() * sky + angle.sin() * sky[mirrored]


def _surfaces(camera: Camera, image: ImageSettings, room: Room, normals: Tensor) -> _SeenPoints:
    """Find where the camera's rays meet the table or the wall, whose normals are (2, 3)."""
    count = image.size * image.samples
    middles = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * camera.width
    # Positions in the image relative to the principal point.
    half_width = camera.width / 2
    up_of_rows = (-middles - camera.principal_up * half_width) / camera.pixel_aspect
    right_of_columns = middles - camera.principal_right * half_width
    up, right = torch.meshgrid(
        up_of_rows - camera.up, right_of_columns - camera.right, indexing="ij"
    )
    by_pixel = torch.stack([right, up]).view(
        2, image.size, image.samples, image.size, image.samples
    )
    right, up = by_pixel.permute(0, 2, 4, 1, 3).reshape(2, image.samples**2, -1, 1)
    axes = torch.from_numpy(camera.axes())
    ends = right * axes[0] + up * axes[1]
    starts = ends + FAR * axes[2]
    if isinstance(camera, PerspectiveCamera):
        starts = torch.from_numpy(camera.pose()[:3, 3]).expand_as(ends)
    forward = ends - starts
    levels = torch.tensor([room.height, -room.wall], dtype=torch.float64)
    falling = (forward @ normals.T).clamp(max=FALLING)
    lengths = (levels - starts @ normals.T) / falling
    points = starts + lengths.amin(2, keepdim=True) * forward
    return _SeenPoints(points, lengths[..., 1] < lengths[..., 0])
