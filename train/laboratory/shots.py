"""Draw the lighting, the camera and the pose of each render of pnb-lab at random.

A mesh is normalized to [-1, 1]³ and then scaled. These are the world units. It
stands on the table z = 0, above the origin. Azimuths and elevations are in
degrees. Radiance and albedo are linear RGB. At an exposure of 1, a radiance of 1
is white in the image.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from augment.random_streams import stream_seed
from augment.scene.patterns import draw_lab_color, draw_lab_pattern
from renderer.light.harmonics import equirectangular
from train.command_settings import LabSettings

# Horizontal field of view of the camera in degrees.
FOV = 25.0
# A setup in an environment map is drawn with projectors of this pattern first. The
# environment map then replaces the projectors.
PLAIN_PATTERN = "solid"
# Range of the random draw of half of the width that the camera sees at the object, in
# world units.
HALF_WIDTHS = (1.2, 1.9)
# Factor by which the normalized object is scaled: range of the random draw.
SCALES = (0.75, 1)
# The projectors face a point above the origin. Its height is 0.8 times the scale of
# the object.
CENTER_HEIGHT = 0.8
# The camera faces a random point near the object. Each coordinate differs by at most
# this from the point that the projectors face, in world units.
MAX_AIM_OFFSET = 0.25
# Distance of a projector from the point that it faces: range of the random draw, in
# world units.
PROJECTOR_DISTANCES = (5, 8)
# Elevation of the camera above the table: range of the random draw, in degrees.
CAMERA_ELEVATIONS = (18, 60)
# The object is rotated by three random Euler angles, about z, x and z. Each is drawn
# between 0 and its maximum, in degrees.
MAX_EULER_ANGLES = (360, 60, 360)
# The wall stands behind the object. The azimuth of its direction from the object
# differs by at most this from the direction opposite to the camera, in degrees.
MAX_WALL_TURN = 30
# Distance of the wall from the object: range of the random draw, in world units.
WALL_DISTANCES = (1.8, 3.5)
# Radiance of an environment map, linear RGB.
Panorama = Float[np.ndarray, "H W 3"]


@dataclass(frozen=True)
class Shot:
    """Lighting, camera, pose and surroundings in which an object is rendered.

    Attributes:
        lighting: Name of the projected patterns, or of the environment map.
        brightness: Radiance of a white surface. With projectors, the surface
            faces all of them and their images are white. In an environment
            map, the surface faces up.
        patterns: Image of each projector, linear RGB, shape (H, W, 3).
        ambient: Radiance of uniform light from all directions, linear RGB,
            shape (3,).
        table: Albedo of the table and of the wall, linear RGB, shape (3,).
        projectors: Position of each projector, shape (3,).
        camera: Position of the camera, shape (3,).
        center: Point that the projectors face, shape (3,).
        aim: Point that the camera faces, shape (3,).
        rotation: Rotation matrix of the object, shape (3, 3).
        scale: Factor by which the normalized object is scaled.
        roughness: Roughness of the surface of the object, in [0, 1].
        wall: Point of the wall that is nearest to `center`, shape (3,). None
            without a wall.
        environment: Radiance of an environment map, linear RGB, shape
            (H, W, 3). Its pixels have the directions of `equirectangular`. It
            replaces the projectors and `ambient`. None with projectors.
    """

    lighting: str
    brightness: float
    patterns: Sequence[np.ndarray]
    ambient: Float[np.ndarray, " 3"]
    table: Float[np.ndarray, " 3"]
    projectors: Sequence[np.ndarray]
    camera: Float[np.ndarray, " 3"]
    center: Float[np.ndarray, " 3"]
    aim: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    scale: float
    roughness: float
    wall: Float[np.ndarray, " 3"] | None = None
    environment: Panorama | None = None


def draw_shots(
    settings: LabSettings, environments: Mapping[str, np.ndarray], slides: Sequence[np.ndarray] = ()
) -> Iterator[Shot]:
    """Draw the same number of random shots for each pattern and each environment map.

    The shots of a pattern, or of an environment map, have evenly spread
    logarithms of the brightness. An environment map is rotated about the
    vertical axis by a random angle. `environments` and `slides` are linear RGB.
    """
    dimmest, brightest = settings.brightness
    lightings = [*settings.patterns, *environments]
    shots_per_lighting = settings.setups // len(lightings)
    for lighting, index in product(lightings, range(shots_per_lighting)):
        rng = np.random.default_rng(stream_seed(settings.seed, "shot", lighting, index))
        # For what later versions added: the draws of `rng` stay those of earlier versions.
        extra_rng = np.random.default_rng(stream_seed(settings.seed, "more", lighting, index))
        # The range of log(brightness) is divided into equal intervals, one for each of
        # the shots in a lighting. A shot draws its brightness from its interval.
        position = (index + rng.uniform()) / shots_per_lighting
        brightness = dimmest * (brightest / dimmest) ** position
        pattern = PLAIN_PATTERN if lighting in environments else lighting
        first_pattern, *other_patterns = pattern.split("+")
        # The first pattern and its generator, and further projectors with another generator, so
        # that they do not change the other draws of the shot.
        sources = [(first_pattern, rng), *((name, extra_rng) for name in other_patterns)]
        azimuth = rng.uniform(0, 360)
        half_width = rng.uniform(*HALF_WIDTHS)
        scale = rng.uniform(*SCALES)
        center = np.array([0, 0, CENTER_HEIGHT * scale])
        aim = center + rng.uniform(-MAX_AIM_OFFSET, MAX_AIM_OFFSET, 3)
        roughness = _between(settings.roughness, extra_rng)
        patterns = [draw_lab_pattern(name, draws, slides) for name, draws in sources]
        ambient = _between(settings.ambient, rng) * draw_lab_color(rng)
        table = _between(settings.albedo, rng) * draw_lab_color(rng)
        projectors = []
        for _, draws in sources:
            projector_azimuth = azimuth + _between(settings.azimuth, draws)
            elevation = _between(settings.elevation, draws)
            distance = draws.uniform(*PROJECTOR_DISTANCES)
            projectors.append(center + _from_angles(projector_azimuth, elevation, distance))
        # At this distance, the image shows `half_width` to each side of its center.
        camera_distance = half_width / math.tan(math.radians(FOV / 2))
        camera = aim + _from_angles(azimuth, rng.uniform(*CAMERA_ELEVATIONS), camera_distance)
        angles = rng.uniform(0, MAX_EULER_ANGLES)
        rotation = Rotation.from_euler("ZXZ", angles, degrees=True).as_matrix()
        # The wall stands behind the object, as seen from the camera. `to_wall` leads from the
        # center of the object to the nearest point of the wall.
        wall_azimuth = azimuth + 180 + extra_rng.uniform(-MAX_WALL_TURN, MAX_WALL_TURN)
        to_wall = _from_angles(wall_azimuth, 0, extra_rng.uniform(*WALL_DISTANCES))
        wants_wall = extra_rng.uniform() < settings.walls and lighting not in environments
        # `to_wall` is normal to the wall, so its dot product with a vector is larger than
        # its squared length only if the vector ends behind the wall.
        is_behind_wall = [(place - center) @ to_wall >= to_wall @ to_wall for place in projectors]
        # A wall between a projector and the object would block the light.
        wall = center + to_wall if wants_wall and not any(is_behind_wall) else None
        radiance = None
        if lighting in environments:
            radiance = _scale_environment(environments[lighting], brightness, rng)
        values: tuple[Any, ...] = (patterns, ambient, table, projectors, camera, center)
        values += (aim, rotation, scale, roughness, wall, radiance)
        yield Shot(lighting, brightness, *values)


def _scale_environment(radiance: Panorama, brightness: float, rng: np.random.Generator) -> Panorama:
    """Rotate an environment map about the vertical axis by a random angle, and scale it.

    `brightness` is the radiance of a white diffuse surface that faces up.
    """
    directions, solid_angles = equirectangular(*radiance.shape[:2])
    # Light from a direction counts by its cosine to the vertical. Light from below does not count.
    weights = directions[..., 2].clamp(min=0) * solid_angles
    irradiance = (weights[..., None] * torch.from_numpy(radiance)).sum((0, 1))
    # A white diffuse surface has the radiance irradiance / π.
    white_radiance = float(irradiance.mean()) / math.pi
    # A map whose columns are shifted is rotated about the vertical axis.
    rotated = np.roll(radiance, rng.integers(radiance.shape[1]), axis=1)
    return (brightness / white_radiance * rotated).astype(np.float32)


def _between(limits: Sequence[float], rng: np.random.Generator) -> float:
    """Draw a random number from the uniform distribution between two limits."""
    return rng.uniform(limits[0], limits[1])


def _from_angles(azimuth: float, elevation: float, distance: float) -> Float[np.ndarray, " 3"]:
    """Convert azimuth (from +x to +y) and elevation (above z = 0), in degrees, to x, y and z."""
    turn, rise = math.radians(azimuth), math.radians(elevation)
    x, y = math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn)
    return distance * np.array([x, y, math.sin(rise)])
