"""Draw the lighting, the camera and the pose of the renders of pnb-lab at random.

World units: a mesh is normalized to [-1, 1]³ and then scaled. It stands on the
table z = 0 over the origin. Azimuths and elevations are in degrees. Radiance
and albedo are linear RGB. A radiance of 1 is white at an exposure of 1.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from augment.random_streams import stream_seed
from renderer.light.harmonics import equirectangular
from train.command_settings import LabSettings
from train.evaluation.laboratory.lab_patterns import draw_color, draw_pattern

# Field of view of the camera in degrees.
FOV = 25.0
# Pattern of which a shot is drawn before an environment replaces its lighting.
PLAIN_PATTERN = "solid"
# Range of the half-width of the image at the object, in world units.
HALF_WIDTHS = (1.2, 1.9)
# Range of the largest coordinate of the object, in world units.
SCALES = (0.75, 1)
# Height of the point that the projectors face, in units of the scale.
CENTER_HEIGHT = 0.8
# Largest offset of the point that the camera faces, per coordinate.
MAX_AIM_OFFSET = 0.25
# Range of the distance of a projector from the point that it faces, in world units.
PROJECTOR_DISTANCES = (5, 8)
# Range of the elevation of the camera in degrees.
CAMERA_ELEVATIONS = (18, 60)
# Largest Euler angles of the object's rotation about z, x and z in degrees.
MAX_EULER_ANGLES = (360, 60, 360)
# Largest angle between the wall and the direction away from the camera, in
# degrees of azimuth.
MAX_WALL_TURN = 30
# Range of the distance of a wall from the object, in world units.
WALL_DISTANCES = (1.8, 3.5)


@dataclass(frozen=True)
class Shot:
    """Lighting, camera, pose and table of a render of any object.

    Attributes:
        family: Name of the pattern or of the environment.
        brightness: Radiance of a white surface. With projectors, the surface
            faces all of them and their images are white. In an environment,
            the surface faces up.
        patterns: Image of each projector, linear RGB, shape (H, W, 3).
        ambient: Radiance from all directions, linear RGB, shape (3,).
        table: Albedo of the table and the wall, linear RGB, shape (3,).
        projectors: Position of each projector, shape (3,).
        camera: Position of the camera, shape (3,).
        center: Point that the projectors face, shape (3,).
        aim: Point that the camera faces, shape (3,).
        rotation: Rotation matrix of the object, shape (3, 3).
        scale: Largest coordinate of the object.
        roughness: Roughness of the surface of the object, in [0, 1].
        wall: Point of the wall that is nearest to `center`, shape (3,). None
            without a wall.
        environment: Radiance on the grid of `equirectangular`, shape
            (H, W, 3). It replaces the projectors and `ambient`. None if the
            projectors light the object.
    """

    family: str
    brightness: float
    patterns: Sequence[np.ndarray]
    ambient: np.ndarray
    table: np.ndarray
    projectors: Sequence[np.ndarray]
    camera: np.ndarray
    center: np.ndarray
    aim: np.ndarray
    rotation: np.ndarray
    scale: float
    roughness: float
    wall: np.ndarray | None = None
    environment: np.ndarray | None = None


def draw_shots(
    settings: LabSettings,
    environments: Mapping[str, np.ndarray],
    slides: Sequence[np.ndarray] = (),
) -> Iterator[Shot]:
    """Draw equally many shots of each pattern, and then of each environment.

    Within a pattern or an environment, the logarithms of the brightness are
    spread evenly over `settings.brightness`. An environment is rotated about
    the vertical axis by a random angle.

    Args:
        settings: Settings of pnb-lab. `settings.setups` is the number of shots.
        environments: Radiance by name, shape (H, W, 3).
        slides: Pictures of the pattern "slides", see `draw_pattern`.

    Yields:
        The shots.
    """
    dimmest, brightest = settings.brightness
    kinds = [*settings.patterns, *environments]
    per_kind = settings.setups // len(kinds)
    for kind, index in product(kinds, range(per_kind)):
        rng = np.random.default_rng(stream_seed(settings.seed, "shot", kind, index))
        extra_rng = np.random.default_rng(stream_seed(settings.seed, "more", kind, index))
        # Each shot has its own part of the range of log(brightness).
        position = (index + rng.uniform()) / per_kind
        brightness = dimmest * (brightest / dimmest) ** position
        pattern = PLAIN_PATTERN if kind in environments else kind
        shot = _draw_shot(pattern, brightness, settings, slides, rng, extra_rng)
        if kind in environments:
            radiance = _scale_environment(environments[kind], brightness, rng)
            shot = replace(shot, family=kind, environment=radiance, wall=None)
        yield shot


def _scale_environment(
    radiance: np.ndarray,
    brightness: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Rotate an environment map about the vertical axis by a random angle, and scale it.

    Args:
        radiance: Environment map, linear RGB, shape (H, W, 3).
        brightness: Radiance of a white diffuse surface that faces up in the
            scaled lighting.
        rng: Random number generator.

    Returns:
        Scaled map, float32, shape (H, W, 3).
    """
    directions, solid_angles = equirectangular(*radiance.shape[:2])
    weights = directions[..., 2].clamp(min=0) * solid_angles
    irradiance = (weights[..., None] * torch.from_numpy(radiance)).sum((0, 1))
    white_radiance = float(irradiance.mean()) / math.pi
    column_offset = rng.integers(radiance.shape[1])
    rotated = np.roll(radiance, column_offset, axis=1)
    return (brightness / white_radiance * rotated).astype(np.float32)


def _draw_shot(
    family: str,
    brightness: float,
    settings: LabSettings,
    slides: Sequence[np.ndarray],
    rng: np.random.Generator,
    extra_rng: np.random.Generator,
) -> Shot:
    """Draw a shot under the light of projectors.

    Args:
        family: Names of the projected patterns, joined by "+". Each pattern has
            a projector.
        brightness: Brightness of the projected light, see `Shot`.
        settings: Settings of pnb-lab, with the ranges of the draws.
        slides: Pictures of the pattern "slides".
        rng: Random number generator.
        extra_rng: Random number generator of the things that earlier versions
            of the laboratory did not have, such as the wall. With a generator
            of their own, they leave all other draws as they were.
    """
    first_family, *other_families = family.split("+")
    azimuth = rng.uniform(0, 360)
    half_width = rng.uniform(*HALF_WIDTHS)
    scale = rng.uniform(*SCALES)
    center = np.array([0, 0, CENTER_HEIGHT * scale])
    aim = center + rng.uniform(-MAX_AIM_OFFSET, MAX_AIM_OFFSET, 3)
    roughness = _draw_between(settings.roughness, extra_rng)
    patterns = [draw_pattern(first_family, rng, slides)]
    patterns += [draw_pattern(name, extra_rng, slides) for name in other_families]
    ambient = _draw_between(settings.ambient, rng) * draw_color(rng)
    table = _draw_between(settings.albedo, rng) * draw_color(rng)
    projectors = [center + _draw_projector(settings, azimuth, rng)]
    projectors += [center + _draw_projector(settings, azimuth, extra_rng) for _ in other_families]
    camera_distance = half_width / math.tan(math.radians(FOV / 2))
    camera = aim + _from_angles(azimuth, rng.uniform(*CAMERA_ELEVATIONS), camera_distance)
    angles = rng.uniform(0, MAX_EULER_ANGLES)
    rotation = Rotation.from_euler("ZXZ", angles, degrees=True).as_matrix()
    wall = _draw_wall(azimuth, extra_rng)
    has_wall = extra_rng.uniform() < settings.walls
    # The wall is left out if it would stand between a projector and the object.
    is_hidden = any((position - center) @ wall >= wall @ wall for position in projectors)
    return Shot(
        family=family,
        brightness=brightness,
        patterns=patterns,
        ambient=ambient,
        table=table,
        projectors=projectors,
        camera=camera,
        center=center,
        aim=aim,
        rotation=rotation,
        scale=scale,
        roughness=roughness,
        wall=center + wall if has_wall and not is_hidden else None,
    )


def _draw_projector(settings: LabSettings, azimuth: float, rng: np.random.Generator) -> np.ndarray:
    """Draw the position of a projector, relative to the point that it faces.

    Args:
        settings: Settings of pnb-lab. The range of azimuths is relative to the
            azimuth of the camera.
        azimuth: Azimuth of the camera in degrees.
        rng: Random number generator.

    Returns:
        Position in world units, shape (3,).
    """
    projector_azimuth = azimuth + _draw_between(settings.azimuth, rng)
    elevation = _draw_between(settings.elevation, rng)
    return _from_angles(projector_azimuth, elevation, rng.uniform(*PROJECTOR_DISTANCES))


def _draw_wall(azimuth: float, rng: np.random.Generator) -> np.ndarray:
    """Draw the place of a wall behind the object, as seen from the camera.

    Args:
        azimuth: Azimuth of the camera in degrees.
        rng: Random number generator.

    Returns:
        Vector from the center of the object to the nearest point of the wall,
        in world units, shape (3,). It is normal to the wall.
    """
    wall_azimuth = azimuth + 180 + rng.uniform(-MAX_WALL_TURN, MAX_WALL_TURN)
    return _from_angles(wall_azimuth, 0, rng.uniform(*WALL_DISTANCES))


def _draw_between(limits: Sequence[float], rng: np.random.Generator) -> float:
    """Draw a number uniformly between two limits."""
    return rng.uniform(limits[0], limits[1])


def _from_angles(azimuth: float, elevation: float, distance: float) -> np.ndarray:
    """Convert an azimuth and an elevation in degrees and a distance to a position, shape (3,)."""
    azimuth_radians = math.radians(azimuth)
    elevation_radians = math.radians(elevation)
    horizontal = math.cos(elevation_radians)
    x = horizontal * math.cos(azimuth_radians)
    y = horizontal * math.sin(azimuth_radians)
    return distance * np.array([x, y, math.sin(elevation_radians)])
