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
from renderer.light.harmonics import bands, cache_tensors, degree_of
from renderer.settings import ImageSettings
from renderer.transport.lamp_paths import unoccluded
from renderer.transport.rays import NO_FACE, Rays, sphere

# Number D of directions in which rays are traced from a point of the table or the wall to
# the sky.
DIRECTIONS = 48
# The part of the sky that the object blocks is computed at points that are this many pixels
# apart. The shadow of the sky is soft, so it is interpolated between these points.
COARSE = 2
# Number of directions on the sphere with which `_split_at_horizon` computes integrals.
NODES = 2**12
# The distance from which the rays of an orthographic camera start, in world units.
FAR = 1e3
# Largest component of a camera ray along the normal of the table or the wall. A ray that is
# parallel to the surface or leaves it gets this component, so that it meets the surface far away.
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


@cache_tensors
def _split_at_horizon(degree: int) -> tuple[Tensor, Tensor]:
    """Compute how harmonics represent the light above the horizon and the light below.

    Args:
        degree: Degree of the harmonics. There are K = (degree + 1)² of them.

    Returns:
        Matrix (K, K) that multiplies the coefficients of a light and gives the coefficients of
        the part of this light above the horizon. Coefficients (K,) of a light with radiance 1 in
        all directions below the horizon and radiance 0 above.
    """
    directions = sphere(NODES)
    # Value of each harmonic in each direction, shape (NODES, K).
    values = Harmonics(degree).radiance(directions)
    values_above = values[directions[:, 2] > 0]
    # Solid angle of each direction.
    weight = 4 * math.pi / NODES
    # Harmonics are orthonormal, so each coefficient is the integral of the light times a harmonic.
    return (
        values_above.T @ values_above * weight,
        (values.sum(0) - values_above.sum(0)) * weight,
    )


def above_table(lights: Tensor, lamps: Tensor, albedo: Tensor) -> Tensor:
    """Compute the light of an object on an infinite table.

    Args:
        lights: Coefficients of the environment light of E examples without a table, in K
            harmonics, shape (E, K, 3).
        lamps: Unit direction towards a white distant lamp, shape (E, 3). A surface that faces
            the lamp has irradiance 1. Zero for no lamp.
        albedo: Linear albedo of the table, shape (E, 3).

    Returns:
        Coefficients of the light that reaches the object, without the direct light of the lamp,
        shape (E, K, 3). They are the light from above, and the light that the table reflects.
        The table reflects the environment light from above and the light of the lamp.
    """
    harmonics = Harmonics(degree_of(lights[0]))
    upper_part, below_horizon = _split_at_horizon(harmonics.degree)
    above = upper_part @ lights.cpu().double()
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    # Irradiance of the table, shape (E, 3). That of a distant lamp is the cosine to its
    # direction, which is the z component.
    from_sky = harmonics.irradiance(up)[0] @ above[:, harmonics.nonzero]
    arriving = from_sky.clamp(min=0) + lamps[:, 2:].clamp(min=0)
    # Radiance of a Lambertian table, the same in all directions, shape (E, 3).
    reflected = albedo.cpu() * arriving / math.pi
    return (above + below_horizon[:, None] * reflected[:, None]).to(lights)


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
        sky: The coefficients of the sky in K harmonics, shape (K, 3).
        lamp: Unit direction towards a white distant lamp, shape (3,). A surface that faces the
            lamp has irradiance 1. Zero for no lamp.
        lights: The basis of each local light, and its coefficients, shape (size of the basis, 3).

    Returns:
        The irradiance, shape (3, size, size).

    Raises:
        InputError: If Embree is not installed.
    """
    room_axes = _room_axes(camera)
    # Unit normals of the table and the wall in world axes.
    normals = torch.stack([room_axes[2], room_axes[0]])
    # In the axes of the room: D directions of table and wall, shape (2, D, 3), the values of
    # the harmonics there, shape (2, D, K), and the irradiance per harmonic, shape (2, K).
    directions, harmonic_values, irradiance_per_harmonic = _directions(degree_of(sky))
    sky = _sky_in_room_axes(sky, camera.azimuth)

    # Irradiance of all P pixels by the whole sky, the lamp and the local lights, shape (P, 3).
    # Shadows of lamps have sharp edges, which need several samples per pixel.
    fine = image if lamp.any() or lights else replace(image, samples=1)
    fine_points = _find_seen_points(camera, fine, room, normals)
    # Irradiance of table and wall, shape (2, 3).
    arriving = (irradiance_per_harmonic @ sky).clamp(min=0)
    fraction_on_wall = fine_points.is_on_wall.double().mean(0)[:, None]
    open_sky = arriving[0] + fraction_on_wall * (arriving[1] - arriving[0])
    from_lamp = _from_lamp(room, fine_points, normals, lamp).mean(0)[:, None]
    from_lights = _from_local_lights(room, fine_points, normals, lights).mean(0)
    lit = open_sky + (from_lamp + from_lights)

    # Irradiance of the part of the sky that the object blocks, in an image of fewer pixels.
    coarse_size = math.ceil(image.size / COARSE)
    coarse = replace(image, size=coarse_size, samples=1)
    coarse_points = _find_seen_points(camera, coarse, room, normals)
    # The density of the D directions is proportional to the cosine, so each has the same weight.
    # The integral of the cosine over the hemisphere is π.
    weighted_radiance = harmonic_values @ sky * (math.pi / DIRECTIONS)
    world_directions = directions @ room_axes
    blocked = _blocked_sky(room, coarse_points, normals, world_directions, weighted_radiance)
    blocked_image = F.interpolate(
        blocked.T.unflatten(1, (coarse.size, -1))[None], image.size, mode="bilinear"
    )[0]
    return (lit.T.unflatten(1, (image.size, -1)) - blocked_image).clamp(min=0)


def _room_axes(camera: Camera) -> Tensor:
    """Return the axes of the room as unit row vectors in world axes, shape (3, 3).

    The first axis is the normal of the wall. It is horizontal and points to the side of the
    camera. The third axis is the normal of the table, which is the vertical.
    """
    azimuth = math.radians(camera.azimuth)
    sine = math.sin(azimuth)
    cosine = math.cos(azimuth)
    rows = [[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64)


def _from_lamp(room: Room, seen: _SeenPoints, normals: Tensor, lamp: Tensor) -> Tensor:
    """Compute the irradiance of the seen points by a white distant lamp.

    Args:
        room: Table, wall and object.
        seen: Points that S samples of P pixels see.
        normals: Unit normals of table and wall, shape (2, 3).
        lamp: Unit direction towards the lamp, or zero for no lamp, shape (3,).

    Returns:
        Irradiance, shape (S, P). It is 0 in the shadow of the object.
    """
    # Index 0 or 1 of the surface of each point in `normals`, shape (S, P).
    point_to_surface = seen.is_on_wall.long()
    lit = (normals @ lamp).clamp(min=0)[point_to_surface]
    may_be_shaded = (lit > 0) & _passes_near_origin(seen.points, lamp, room.radius)
    # Indices of the R points from which rays are traced: sample and pixel, shape (R,) each.
    candidates = torch.nonzero(may_be_shaded, as_tuple=True)
    offset = room.rays.offset * normals[point_to_surface[candidates]]
    starts = seen.points[candidates] + offset
    is_lit = room.rays.first_hit(starts, lamp.expand(len(starts), 3)) == NO_FACE
    lit[candidates] *= is_lit
    return lit


def _from_local_lights(
    room: Room,
    seen: _SeenPoints,
    normals: Tensor,
    lights: Sequence[tuple[LocalBasis, Tensor]],
) -> Tensor:
    """Compute the irradiance of the seen points by local lights.

    Args:
        room: Table, wall and object.
        seen: Points that S samples of P pixels see.
        normals: Unit normals of table and wall, shape (2, 3).
        lights: The basis of each local light, and its coefficients, shape (size of the basis, 3).

    Returns:
        Irradiance, shape (S, P, 3). The object casts shadows.
    """
    # The samples of all pixels as one list of S · P points.
    points = seen.points.flatten(0, 1)
    point_normals = normals[seen.is_on_wall.long()].flatten(0, 1)
    arriving = torch.zeros(len(points), 3, dtype=torch.float64)
    for basis, coefficients in lights:
        # The table and the wall are flat, so the normals for shading are those of the surface.
        paths = unoccluded(room.rays, basis, points, point_normals, point_normals)
        # Each path leads from one basis function of the light to one point.
        irradiance_of_path = paths.irradiance[:, None] * coefficients[paths.function]
        arriving.index_add_(0, paths.point, irradiance_of_path)
    return arriving.unflatten(0, (len(seen.points), -1))


def _blocked_sky(
    room: Room, seen: _SeenPoints, normals: Tensor, directions: Tensor, radiance: Tensor
) -> Tensor:
    """Compute the irradiance that the seen points would have from the blocked part of the sky.

    The object blocks this part.

    Args:
        room: Table, wall and object.
        seen: Points that one sample of each of P pixels sees.
        normals: Unit normals of table and wall, shape (2, 3).
        directions: D unit directions to the sky, for the table and for the wall, in world axes,
            shape (2, D, 3).
        radiance: Radiance of the sky in these directions, shape (2, D, 3). Each is multiplied by
            the cosine to the normal times the solid angle of the direction.

    Returns:
        Irradiance of the blocked part of the sky, shape (P, 3).
    """
    points = seen.points[0]
    is_on_wall = seen.is_on_wall[0]
    blocked = torch.zeros(len(points), 3, dtype=torch.float64)
    for surface in range(2):
        # Pixels that show this surface.
        pixels = torch.nonzero(is_on_wall == surface).squeeze(1)
        starts = points[pixels] + room.rays.offset * normals[surface]
        may_hit = _passes_near_origin(starts, directions[surface].T, room.radius)
        # Index in `starts` and index of the direction of each ray that is traced.
        ray_to_start, ray_to_direction = torch.nonzero(may_hit, as_tuple=True)
        face_of_ray = room.rays.first_hit(
            starts[ray_to_start], directions[surface, ray_to_direction]
        )
        is_blocked = face_of_ray != NO_FACE
        blocked_pixels = pixels[ray_to_start[is_blocked]]
        blocked.index_add_(0, blocked_pixels, radiance[surface, ray_to_direction[is_blocked]])
    return blocked


def project_along_light(
    room: Room, mesh: Mesh, camera: Camera, image: ImageSettings, towards: Tensor
) -> Tensor:
    """Compute which point of a projected pattern reaches each pixel of an image.

    A projector far away shines in parallel rays along one direction. A pixel shows a point of
    the mesh, the table or the wall. The projector's ray through this point determines the point
    of the pattern.

    Args:
        room: The table and the wall.
        mesh: The mesh, whose faces `room.rays` traces.
        camera: The camera.
        image: The size of the image.
        towards: Unit vector from the scene towards the projector, shape (3,).

    Returns:
        Two coordinates of the point of the pattern for each pixel, shape (2, size, size). They
        are distances from the projector's ray through the origin, divided by half of the width
        that the camera sees.
    """
    room_axes = _room_axes(camera)
    # Unit normals of the table and the wall.
    normals = torch.stack([room_axes[2], room_axes[0]])
    # Points of table or wall that the P pixel centers see without the mesh, shape (P, 3).
    points = _find_seen_points(camera, replace(image, samples=1), room, normals).points[0]
    starts = points + FAR * torch.from_numpy(camera.axes()[2])
    if isinstance(camera, PerspectiveCamera):
        starts = torch.from_numpy(camera.pose()[:3, 3]).expand_as(points)
    forward = F.normalize(points - starts, dim=1)
    face_of_pixel = room.rays.first_hit(starts, forward)
    # The M pixels that show the mesh. Their points are moved to the faces that they show.
    mesh_pixels = torch.nonzero(face_of_pixel != NO_FACE).squeeze(1)
    corners = torch.from_numpy(mesh.vertices[mesh.faces[face_of_pixel[mesh_pixels].numpy()]])
    first, second, third = corners.unbind(1)
    # Normals of the faces, not of unit length, shape (M, 3).
    face_normals = torch.linalg.cross(second - first, third - first)
    # The ray meets the plane of the face after the distance `length`, shape (M,).
    height = ((first - starts[mesh_pixels]) * face_normals).sum(1)
    length = height / (forward[mesh_pixels] * face_normals).sum(1)
    points[mesh_pixels] = starts[mesh_pixels] + length[:, None] * forward[mesh_pixels]

    # A horizontal direction across the light. The small number keeps the vector from being
    # zero if the light comes from straight above.
    right = torch.stack([-towards[1], towards[0] + 1e-9, towards.new_zeros(())])
    right = F.normalize(right, dim=0)
    axes = torch.stack([right, torch.linalg.cross(towards, right)])
    coordinates = points @ axes.T / (camera.width / 2)
    return coordinates.T.unflatten(1, (image.size, -1))


def _passes_near_origin(points: Tensor, directions: Tensor, radius: float) -> Tensor:
    """Find the rays that pass the origin within a radius.

    Args:
        points: Starts of the rays, shape (..., 3).
        directions: Unit direction of all rays, shape (3,), or D unit directions in which a ray
            starts at each point, shape (3, D).
        radius: The radius.

    Returns:
        Mask of the rays, shape (...) for one direction and (..., D) for D directions.
    """
    # The point of a ray that is nearest to the origin lies at the distance -along from its start.
    along = points @ directions
    squared = points.square().sum(-1)
    if directions.ndim > 1:
        squared = squared[..., None]
    is_ahead = along < 0
    # By Pythagoras, this is the squared distance of the nearest point from the origin.
    return is_ahead & (squared - along**2 < radius**2)


@cache_tensors
def _directions(degree: int) -> tuple[Tensor, Tensor, Tensor]:
    """Choose directions above a table with normal +z and in front of a wall with normal +x.

    The density of the directions is proportional to the cosine to the normal (Malley's method).

    Args:
        degree: Degree of the light. It has K = (degree + 1)² harmonics.

    Returns:
        D directions for table and wall, shape (2, D, 3). Values of the harmonics in these
        directions, shape (2, D, K). Irradiance of table and wall per unit of each harmonic,
        shape (2, K).
    """
    index = torch.arange(DIRECTIONS, dtype=torch.float64)
    # Malley's method distributes points evenly over the unit disk and raises them to the
    # hemisphere. The golden angle from point to point and the square root make a spiral
    # (Fibonacci lattice) that covers the disk evenly.
    squared_radius = (index + 0.5) / DIRECTIONS
    golden_angle = math.pi * (3 - math.sqrt(5))
    angle = golden_angle * index
    radius = squared_radius.sqrt()
    x = radius * angle.cos()
    y = radius * angle.sin()
    above_table = torch.stack([x, y, (1 - squared_radius).sqrt()], dim=1)
    # `roll` permutes the coordinates (x, y, z) to (z, x, y), which rotates the normal of the
    # table, +z, to the normal of the wall, +x.
    before_wall = above_table.roll(1, 1)
    directions = torch.stack([above_table, before_wall])
    harmonics = Harmonics(degree)
    normals = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    irradiance = torch.zeros(2, harmonics.size, dtype=torch.float64)
    irradiance[:, harmonics.nonzero] = harmonics.irradiance(normals)
    radiance = harmonics.radiance(directions.flatten(0, 1)).unflatten(0, (2, -1))
    return directions, radiance, irradiance


def _sky_in_room_axes(sky: Tensor, azimuth: float) -> Tensor:
    """Rotate a sky about the vertical by minus an azimuth.

    Args:
        sky: Coefficients of the sky in world axes, shape (K, 3).
        azimuth: Azimuth of the camera in degrees, which is the azimuth of the wall's normal.

    Returns:
        Coefficients in axes in which the normal of the wall is +x, shape (K, 3).
    """
    # The harmonic of band l and order m, from -l to l, has the index l (l + 1) + m. With m > 0,
    # the harmonics of order m and -m depend on the azimuth φ as cos mφ and sin mφ. A rotation
    # about the vertical mixes only these two.
    l = bands(degree_of(sky))
    order = torch.arange(len(l)) - l * (l + 1)
    angle = (order * math.radians(azimuth)).double()[:, None]
    # Index of the harmonic with the same band and the opposite order.
    opposite_order = l * (l + 1) - order
    return angle.cos() * sky + angle.sin() * sky[opposite_order]


def _find_seen_points(
    camera: Camera, image: ImageSettings, room: Room, normals: Tensor
) -> _SeenPoints:
    """Find where the camera's rays meet the table or the wall.

    The object is ignored.

    Args:
        camera: The camera.
        image: Size of the image, which has P = size² pixels, and samples of a pixel. Each pixel
            has S = samples² rays.
        room: Table and wall.
        normals: Unit normals of table and wall, shape (2, 3).

    Returns:
        The points of the first surface that each ray meets.
    """
    # Samples along one side of the image. Their distances from the middle are in world units.
    count = image.size * image.samples
    middles = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * camera.width
    # Positions in the image relative to the principal point.
    half_width = camera.width / 2
    up_of_rows = (-middles - camera.principal_up * half_width) / camera.pixel_aspect
    right_of_columns = middles - camera.principal_right * half_width
    up, right = torch.meshgrid(
        up_of_rows - camera.up, right_of_columns - camera.right, indexing="ij"
    )
    # The axes are: right or up, row of pixels, row of samples, column of pixels, column of samples.
    by_pixel = torch.stack([right, up]).view(
        2, image.size, image.samples, image.size, image.samples
    )
    # Shape (S, P, 1) each.
    right, up = by_pixel.permute(0, 2, 4, 1, 3).reshape(2, image.samples**2, -1, 1)
    # The rays pass through points `ends` of the plane through the origin that faces the camera,
    # shape (S, P, 3). The rows of `axes` point right, up and towards the camera.
    axes = torch.from_numpy(camera.axes())
    ends = right * axes[0] + up * axes[1]
    starts = ends + FAR * axes[2]
    if isinstance(camera, PerspectiveCamera):
        starts = torch.from_numpy(camera.pose()[:3, 3]).expand_as(ends)
    forward = ends - starts
    # A point p lies on table or wall if its product with the normal has this value. A ray meets
    # the surface at starts + lengths · forward. The last axis is table and wall, shape (S, P, 2).
    levels = torch.tensor([room.height, -room.wall], dtype=torch.float64)
    falling = (forward @ normals.T).clamp(max=FALLING)
    lengths = (levels - starts @ normals.T) / falling
    points = starts + lengths.amin(2, keepdim=True) * forward
    is_on_wall = lengths[..., 1] < lengths[..., 0]
    return _SeenPoints(points, is_on_wall)
