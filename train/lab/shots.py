"""Random draws of light, camera and pose for the laboratory.

World units: a normalized mesh spans [-1, 1]; it stands on the table z = 0 about the origin. Light and albedo are linear
RGB; a radiance of 1 is white at an exposure of 1.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from augment.utils import stream_seed
from renderer.light.harmonics import equirectangular
from train.lab.patterns import draw_color, draw_pattern

FOV = 25.0  # degrees, of the camera


@dataclass(frozen=True)
class Shot:
    """One light, camera, pose and table, for any object.

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
    for kind, index in product(kinds, range(per_kind)):
        rng = np.random.default_rng(stream_seed(seed, "shot", kind, index))
        radiance = dimmest * (brightest / dimmest) ** ((index + rng.uniform()) / per_kind)
        if kind not in environments:
            yield _draw_shot(kind, radiance, rng)
            continue
        shot, sky = _draw_shot("solid", radiance, rng), environments[kind]
        directions, solid_angles = equirectangular(*sky.shape[:2])
        cosines = directions[..., 2].clamp(min=0) * solid_angles
        on_white = float((cosines[..., None] * torch.from_numpy(sky)).sum((0, 1)).mean()) / math.pi  # and facing up
        turned = np.roll(sky, rng.integers(sky.shape[1]), axis=1)
        yield replace(shot, family=kind, environment=(radiance / on_white * turned).astype(np.float32))


def _draw_shot(family: str, brightness: float, rng: np.random.Generator) -> Shot:
    """A shot under a pattern of the family. The projector stands on the camera's side, up to 70° off."""
    azimuth, half_width, scale = rng.uniform(0, 360), rng.uniform(1.2, 1.9), rng.uniform(0.75, 1)
    center = np.array([0, 0, 0.8 * scale])
    aim = center + rng.uniform(-0.25, 0.25, 3)
    return Shot(
        family=family,
        brightness=brightness,
        pattern=draw_pattern(family, rng),
        ambient=rng.uniform(0.01, 0.06) * draw_color(rng),
        table=rng.uniform(0.04, 0.16) * draw_color(rng),
        projector=center + _position(azimuth + rng.uniform(-70, 70), rng.uniform(25, 70), rng.uniform(5, 8)),
        camera=aim + _position(azimuth, rng.uniform(18, 60), half_width / math.tan(math.radians(FOV / 2))),
        center=center,
        aim=aim,
        rotation=Rotation.from_euler("ZXZ", rng.uniform(0, (360, 60, 360)), degrees=True).as_matrix(),
        scale=scale,
    )


def _position(azimuth: float, elevation: float, distance: float) -> np.ndarray:
    """(3,) from angles in degrees."""
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    horizontal = math.cos(elevation)
    return distance * np.array([horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(elevation)])
