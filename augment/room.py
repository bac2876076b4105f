"""A table under an object and a wall behind it, in the object's light and in its shadow, as a background of an image.

The sky's irradiance is exact but where the object blocks it: there, as in `renderer.transport`, the radiance of the
directions that hit the object is taken away. A distant lamp casts a sharp shadow. What the table reflects lights the
object from below; the object reflects nothing onto the table.
"""

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.camera import Camera, PerspectiveCamera
from renderer.image import ImageSettings
from renderer.light.basis import HARMONICS
from renderer.light.harmonics import per_degree
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
    radiance = type(HARMONICS)(degree).radiance(directions)
    above = radiance[directions[:, 2] > 0]
    whole, upper = radiance.sum(0), above.sum(0)
    return above.T @ above * (4 * math.pi / NODES), (whole - upper) * (4 * math.pi / NODES)


def above_table(lights: Tensor, lamps: Tensor, albedo: Tensor) -> Tensor:
    """Lights (E, 49, 3) on infinite tables of albedo (E, 3): that from above, and what the tables reflect of it and of
    white lamps of irradiance 1 in directions (E, 3), or zero for none."""
    upper, below = _upper(HARMONICS.degree)
    above = upper @ lights.double()
    normal, nonzero = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), HARMONICS.nonzero
    arriving = (HARMONICS.irradiance(normal)[0] @ above[:, nonzero]).clamp(min=0) + lamps[:, 2:].clamp(min=0)
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
) -> Tensor:
    """(3, size, size) of the surfaces that a camera sees, averaged over each pixel's samples.

    rays: among the faces of the object, which lies within `radius` of the origin. height: of the table. wall: the
    distance of the wall behind the origin; it faces the camera's azimuth. sky: coefficients (49, 3). lamp: the
    direction (3,) of white light of irradiance 1, or zero for none. InputError: Embree is not installed.
    """
    fine = image if lamp.any() else replace(image, samples=1)  # a lamp's shadow has edges
    points, on_wall, normals = _surfaces(camera, fine, height, wall)
    arriving = (HARMONICS.irradiance(normals) @ sky[HARMONICS.nonzero]).clamp(min=0)
    fraction = on_wall.double().mean(0)[:, None]
    open_sky = arriving[0] + fraction * (arriving[1] - arriving[0])
    lit = (normals @ lamp).clamp(min=0)[on_wall.long()]
    shaded = torch.nonzero((lit > 0) & _near(points, lamp, radius), as_tuple=True)
    starts = points[shaded] + rays.offset * normals[on_wall[shaded].long()]
    lit[shaded] *= rays.first_hit(starts, lamp.expand(len(starts), 3)) < 0
    coarse = replace(image, size=-(-image.size // COARSE), samples=1)
    blocked = _blocked_sky(rays, radius, sky, *_surfaces(camera, coarse, height, wall))
    blocked = F.interpolate(blocked.T.unflatten(1, (1, coarse.size, -1)).swapaxes(0, 1), image.size, mode="bilinear")[0]
    return ((open_sky.T + lit.mean(0)).unflatten(1, (image.size, -1)) - blocked).clamp(min=0)


def _blocked_sky(rays: Rays, radius: float, sky: Tensor, points: Tensor, on_wall: Tensor, normals: Tensor) -> Tensor:
    """(P, 3) of the sky's irradiance at points (1, P, 3) that the object keeps off them."""
    blocked = torch.zeros(points.shape[1], 3, dtype=torch.float64)
    for surface, normal in enumerate(normals):
        pixels = torch.nonzero(on_wall[0] == surface).squeeze(1)
        directions, radiance = _table_directions(HARMONICS.degree)
        if surface:
            directions = directions @ torch.stack([normals[0], torch.linalg.cross(normal, normals[0]), normal])
        starts = points[0, pixels] + rays.offset * normal
        row, number = torch.nonzero(_near(starts, directions.T, radius), as_tuple=True)
        hit = rays.first_hit(starts[row], directions[number]) >= 0
        if hit.any():
            lost = (HARMONICS.radiance(directions) if surface else radiance) @ sky * (math.pi / DIRECTIONS)
            blocked.index_add_(0, pixels[row[hit]], lost[number[hit]])
    return blocked


def _near(points: Tensor, directions: Tensor, radius: float) -> Tensor:
    """Whether rays from points (..., 3) in directions (3,) or (3, D) come nearer to the origin than the radius."""
    along, squared = points @ directions, points.square().sum(-1)
    return (along < 0) & ((squared[..., None] if directions.ndim > 1 else squared) - along**2 < radius**2)


@per_degree
def _table_directions(degree: int) -> tuple[Tensor, Tensor]:
    """Directions (D, 3) above a table, as dense as their cosine (Malley), and the harmonics (D, size) there."""
    index = torch.arange(DIRECTIONS, dtype=torch.float64)
    squared, angle = (index + 0.5) / DIRECTIONS, math.pi * (3 - math.sqrt(5)) * index
    across = squared.sqrt()
    directions = torch.stack([across * angle.cos(), across * angle.sin(), (1 - squared).sqrt()], dim=1)
    return directions, type(HARMONICS)(degree).radiance(directions)


def _surfaces(camera: Camera, image: ImageSettings, height: float, wall: float) -> tuple[Tensor, Tensor, Tensor]:
    """Where a camera's rays through S samples of P pixels end: (S, P, 3), on the wall (S, P) or the table, with the
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
    towards = [math.cos(camera.azimuth), math.sin(camera.azimuth), 0.0]
    normals = torch.tensor([[0.0, 0.0, 1.0], towards], dtype=torch.float64)
    levels = torch.tensor([height, -wall], dtype=torch.float64)
    falling = (forward @ normals.T).clamp(max=-1e-9)  # of rays that never reach a surface, far away
    lengths = (levels - starts @ normals.T) / falling
    return starts + lengths.amin(2, keepdim=True) * forward, lengths[..., 1] < lengths[..., 0], normals
