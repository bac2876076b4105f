"""A table under an object and a wall behind it, in the object's light and in its shadow, as a background of an image.

The sky's irradiance is exact but where the object blocks it: there, as in `renderer.transport`, the radiance of the
directions that hit the object is taken away. A distant lamp casts a sharp shadow, local lights those of their own. What
the table reflects of sky and distant lamp lights the object from below. The object reflects nothing onto the table,
which would change that by 0.1 to 1.4 of 255 on average at 32 pixels.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.camera import Camera, PerspectiveCamera
from renderer.image import ImageSettings
from renderer.light.basis import Harmonics, LocalBasis
from renderer.light.harmonics import bands, degree_of, per_degree
from renderer.mesh import Mesh
from renderer.transport.lamp_paths import unoccluded
from renderer.transport.rays import Rays, sphere

DIRECTIONS = 48  # of the sky, from a point
COARSE = 2  # pixels between the points where the sky's shadow is computed, which is soft
NODES = 2**12  # directions over the sphere, of integrals
FAR = 1e3


@per_degree
def _upper(degree: int) -> tuple[Tensor, Tensor]:
    """(size, size) what is above the horizon of a light's coefficients, and (size,) even light from below, radiance 1;
    projected onto the harmonics of the degree."""
    directions = sphere(NODES)
    radiance = Harmonics(degree).radiance(directions)
    above = radiance[directions[:, 2] > 0]
    whole, upper = radiance.sum(0), above.sum(0)
    return above.T @ above * (4 * math.pi / NODES), (whole - upper) * (4 * math.pi / NODES)


def above_table(lights: Tensor, lamps: Tensor, albedo: Tensor) -> Tensor:
    """Lights (E, K, 3) on infinite tables of albedo (E, 3): that from above, and what the tables reflect of it and of
    white lamps of irradiance 1 in directions (E, 3), or zero for none."""
    harmonics = Harmonics(degree_of(lights[0]))
    upper, below = _upper(harmonics.degree)
    above, albedo = upper @ lights.cpu().double(), albedo.cpu()
    normal, nonzero = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), harmonics.nonzero
    arriving = (harmonics.irradiance(normal)[0] @ above[:, nonzero]).clamp(min=0) + lamps[:, 2:].clamp(min=0)
    return (above + below[:, None] * (albedo * arriving / math.pi)[:, None]).to(lights)


def irradiance(
    rays: Rays,
    radius: float,
    height: float,
    wall: float,
    camera: Camera,
    image: ImageSettings,
    sky: Tensor,
    lamp: Tensor,
    lights: Sequence[tuple[LocalBasis, Tensor]] = (),
) -> Tensor:
    """(3, size, size) of the surfaces that a camera sees, averaged over each pixel's samples.

    rays: among the faces of the object, which lies within `radius` of the origin. height: of the table. wall: the
    distance of the wall behind the origin; it faces the camera's azimuth. sky: coefficients (K, 3). lamp: the
    direction (3,) of white light of irradiance 1, or zero for none. lights: local ones, and the coefficients
    (size, 3) of each. InputError: Embree is not installed.
    """
    sine, cosine = math.sin(camera.azimuth), math.cos(camera.azimuth)
    turn = torch.tensor([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    directions, radiance, irradiance = _directions(degree_of(sky))
    directions, sky = directions @ turn, _turned(sky, camera.azimuth)
    normals = torch.stack([turn[2], turn[0]])
    fine = image if lamp.any() or lights else replace(image, samples=1)  # a lamp's shadow has edges
    points, on_wall = _surfaces(camera, fine, height, wall, normals)
    arriving, fraction = (irradiance @ sky).clamp(min=0), on_wall.double().mean(0)[:, None]
    open_sky = arriving[0] + fraction * (arriving[1] - arriving[0])
    lit = (normals @ lamp).clamp(min=0)[on_wall.long()]
    shaded = torch.nonzero((lit > 0) & _near(points, lamp, radius), as_tuple=True)
    starts = points[shaded] + rays.offset * normals[on_wall[shaded].long()]
    lit[shaded] *= rays.first_hit(starts, lamp.expand(len(starts), 3)) < 0
    emitted, facing = torch.zeros(points.numel() // 3, 3, dtype=torch.float64), normals[on_wall.long()].flatten(0, 1)
    for basis, coefficients in lights:
        paths = unoccluded(rays, basis, points.flatten(0, 1), facing, facing)
        emitted.index_add_(0, paths.point, paths.irradiance[:, None] * coefficients[paths.function])
    lit = lit.mean(0)[:, None] + emitted.unflatten(0, (len(on_wall), -1)).mean(0)
    coarse = replace(image, size=-(-image.size // COARSE), samples=1)
    points, on_wall = (part[0] for part in _surfaces(camera, coarse, height, wall, normals))
    blocked = torch.zeros(len(points), 3, dtype=torch.float64)
    for surface, sent in enumerate(radiance @ sky * (math.pi / DIRECTIONS)):
        pixels = torch.nonzero(on_wall == surface).squeeze(1)
        starts = points[pixels] + rays.offset * normals[surface]
        row, number = torch.nonzero(_near(starts, directions[surface].T, radius), as_tuple=True)
        hit = rays.first_hit(starts[row], directions[surface, number]) >= 0
        blocked.index_add_(0, pixels[row[hit]], sent[number[hit]])
    blocked = F.interpolate(blocked.T.unflatten(1, (coarse.size, -1))[None], image.size, mode="bilinear")[0]
    return ((open_sky + lit).T.unflatten(1, (image.size, -1)) - blocked).clamp(min=0)


def across_light(
    rays: Rays, mesh: Mesh, height: float, wall: float, camera: Camera, image: ImageSettings, towards: Tensor
) -> Tensor:
    """(2, size, size) where light from a direction (3,) meets what a camera sees in the middle of each pixel, the
    mesh, the table or the wall: coordinates across the light, in halves of the image's width from the middle."""
    sine, cosine = math.sin(camera.azimuth), math.cos(camera.azimuth)
    normals = torch.tensor([[0.0, 0.0, 1.0], [cosine, sine, 0.0]], dtype=torch.float64)
    (points,), _ = _surfaces(camera, replace(image, samples=1), height, wall, normals)
    starts = points + FAR * torch.from_numpy(camera.axes()[2])
    if isinstance(camera, PerspectiveCamera):
        starts = torch.from_numpy(camera.pose()[:3, 3]).expand_as(points)
    forward = F.normalize(points - starts, dim=1)
    face = rays.first_hit(starts, forward)
    seen = torch.nonzero(face >= 0).squeeze(1)
    first, second, third = torch.from_numpy(mesh.vertices[mesh.faces[face[seen].numpy()]]).unbind(1)
    planes = torch.linalg.cross(second - first, third - first)
    length = ((first - starts[seen]) * planes).sum(1) / (forward[seen] * planes).sum(1)
    points[seen] = starts[seen] + length[:, None] * forward[seen]
    right = F.normalize(torch.stack([-towards[1], towards[0] + 1e-9, towards.new_zeros(())]), dim=0)
    axes = torch.stack([right, torch.linalg.cross(towards, right)])
    return (points @ axes.T / (camera.width / 2)).T.unflatten(1, (image.size, -1))


def _near(points: Tensor, directions: Tensor, radius: float) -> Tensor:
    """Whether rays from points (..., 3) in directions (3,) or (3, D) come nearer to the origin than the radius."""
    along, squared = points @ directions, points.square().sum(-1)
    return (along < 0) & ((squared[..., None] if directions.ndim > 1 else squared) - along**2 < radius**2)


@per_degree
def _directions(degree: int) -> tuple[Tensor, Tensor, Tensor]:
    """Above a table and a wall that faces +x: directions (2, D, 3), as dense as their cosine (Malley), the harmonics
    (2, D, size) there, and what each of these sends the surface (2, size)."""
    index = torch.arange(DIRECTIONS, dtype=torch.float64)
    squared, angle = (index + 0.5) / DIRECTIONS, math.pi * (3 - math.sqrt(5)) * index
    table = torch.stack([squared.sqrt() * angle.cos(), squared.sqrt() * angle.sin(), (1 - squared).sqrt()], dim=1)
    directions, harmonics = torch.stack([table, table.roll(1, 1)]), Harmonics(degree)
    irradiance = torch.zeros(2, harmonics.size, dtype=torch.float64)
    irradiance[:, harmonics.nonzero] = harmonics.irradiance(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]).double())
    return directions, harmonics.radiance(directions.flatten(0, 1)).unflatten(0, (2, -1)), irradiance


def _turned(sky: Tensor, azimuth: float) -> Tensor:
    """The coefficients (size, 3) of a sky turned back by an azimuth: Y_lm and Y_l-m are as cos mφ and sin mφ."""
    l = bands(degree_of(sky))
    order = torch.arange(len(l)) - l * (l + 1)
    angle = (order * azimuth).double()[:, None]
    return angle.cos() * sky + angle.sin() * sky[l * (l + 1) - order]


def _surfaces(
    camera: Camera, image: ImageSettings, height: float, wall: float, normals: Tensor
) -> tuple[Tensor, Tensor]:
    """Where a camera's rays through S samples of P pixels end: (S, P, 3), and whether on the wall (S, P); by the
    normals of table and wall (2, 3)."""
    count = image.size * image.samples
    middles = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5) * camera.width
    up, right = torch.meshgrid(-middles - camera.up, middles - camera.right, indexing="ij")
    by_pixel = torch.stack([right, up]).view(2, image.size, image.samples, image.size, image.samples)
    right, up = by_pixel.permute(0, 2, 4, 1, 3).reshape(2, image.samples**2, -1, 1)
    axes = torch.from_numpy(camera.axes())
    ends = right * axes[0] + up * axes[1]
    starts = ends + FAR * axes[2]
    if isinstance(camera, PerspectiveCamera):
        starts = torch.from_numpy(camera.pose()[:3, 3]).expand_as(ends)
    forward = ends - starts
    levels = torch.tensor([height, -wall], dtype=torch.float64)
    falling = (forward @ normals.T).clamp(max=-1e-9)  # of rays that never reach a surface, far away
    lengths = (levels - starts @ normals.T) / falling
    return starts + lengths.amin(2, keepdim=True) * forward, lengths[..., 1] < lengths[..., 0]
