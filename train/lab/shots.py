"""The random part of a photograph without its object: light, camera, pose and table.

World units: a normalized mesh spans [-1, 1]; it stands on the table z = 0 about the origin. Light and albedo are linear
RGB; a radiance of 1 is white at an exposure of 1.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from augment.utils import stream_seed
from renderer.light.harmonics import equirectangular
from train.lab.patterns import draw_color, draw_pattern

FOV = 25.0  # degrees, of the camera


@dataclass(frozen=True)
class Shot:
    """One light, camera and pose, for any object.

    brightness: radiance of a white surface that faces the projector where its image is white, or that faces up under an
    environment. pattern: the projected image (H, W, 3). environment: radiance (H, W, 3), laid out as in
    `renderer.light.environment`, in place of projector and ambient. ambient: radiance from everywhere (3,). table:
    albedo (3,). projector, camera: positions (3,). center, aim: the points (3,) that they look at. rotation: of the
    object (3, 3). scale: the object's largest coordinate.
    """

    family: str
    brightness: float
    pattern: np.ndarray
    ambient: np.ndarray
    table: np.ndarray
    projector: np.ndarray
    camera: np.ndarray
    center: np.ndarray
    aim: np.ndarray
    rotation: np.ndarray
    scale: float
    environment: np.ndarray | None = None


def draw_shots(
    setups: int, families: Sequence[str], brightness: Sequence[float], seed: int, environments: Mapping[str, np.ndarray]
) -> Iterator[Shot]:
    """`setups` shots, equally many of each pattern family and each environment (by name), in this order.

    Brightness rises evenly in ratios within each. An environment is turned about the vertical by a random angle.
    """
    dimmest, brightest = brightness
    kinds = [*families, *environments]
    per_kind = setups // len(kinds)
    for kind in kinds:
        for index in range(per_kind):
            rng = np.random.default_rng(stream_seed(seed, "shot", kind, index))
            radiance = dimmest * (brightest / dimmest) ** ((index + rng.uniform()) / per_kind)
            if kind not in environments:
                yield draw_shot(kind, radiance, rng)
                continue
            shot, sky = draw_shot("solid", radiance, rng), environments[kind]
            turned = np.roll(sky, rng.integers(sky.shape[1]), axis=1)
            yield replace(shot, family=kind, environment=(radiance / _on_white(sky) * turned).astype(np.float32))


def _on_white(environment: np.ndarray) -> float:
    """The mean radiance of a white surface that faces up; turning the environment about the vertical leaves it."""
    directions, solid_angles = equirectangular(*environment.shape[:2])
    cosines = directions[..., 2].clamp(min=0) * solid_angles
    return float((cosines[..., None] * torch.from_numpy(environment)).sum((0, 1)).mean()) / math.pi


def draw_shot(family: str, brightness: float, rng: np.random.Generator) -> Shot:
    """A shot under a pattern of the family. The projector stands on the camera's side, up to 70° off."""
    azimuth, half_width, scale = rng.uniform(0, 360), rng.uniform(1.2, 1.9), rng.uniform(0.75, 1)
    distance = half_width / math.tan(math.radians(FOV / 2))
    center = np.array([0, 0, 0.8 * scale])
    aim = center + rng.uniform(-0.25, 0.25, 3)
    return Shot(
        family=family,
        brightness=brightness,
        pattern=draw_pattern(family, rng),
        ambient=rng.uniform(0.01, 0.06) * draw_color(rng),
        table=rng.uniform(0.04, 0.16) * draw_color(rng),
        projector=center + _position(azimuth + rng.uniform(-70, 70), rng.uniform(25, 70), rng.uniform(5, 8)),
        camera=aim + _position(azimuth, rng.uniform(18, 60), distance),
        center=center,
        aim=aim,
        rotation=_turn(2, rng.uniform(0, 360)) @ _turn(0, rng.uniform(0, 60)) @ _turn(2, rng.uniform(0, 360)),
        scale=scale,
    )


def _position(azimuth: float, elevation: float, distance: float) -> np.ndarray:
    """(3,) from angles in degrees."""
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    horizontal = math.cos(elevation)
    return distance * np.array([horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(elevation)])


def _turn(axis: int, angle: float) -> np.ndarray:
    """(3, 3) about a coordinate axis, by degrees."""
    sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[first, first, second, second], [first, second, first, second]] = cosine, -sine, sine, cosine
    return matrix
