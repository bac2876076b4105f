"""Random draws of light, camera and pose of the renders of pnb-lab.

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

from augment.random_streams import stream_seed
from renderer.light.harmonics import equirectangular
from train.command_settings import LabSettings
from train.evaluation.laboratory.lab_patterns import draw_color, draw_pattern

FOV = 25.0  # degrees, of the camera


@dataclass(frozen=True)
class Shot:
    """One light, camera, pose and table, for any object; positions, colors and albedo are (3,)."""

    family: str
    brightness: float  # radiance of a white surface that faces all projectors, where these are white, or up under a map
    patterns: Sequence[np.ndarray]  # the projected images (H, W, 3), of as many projectors
    ambient: np.ndarray  # radiance from everywhere
    table: np.ndarray  # albedo
    projectors: Sequence[np.ndarray]  # positions
    camera: np.ndarray  # position
    center: np.ndarray  # what the projectors look at
    aim: np.ndarray  # what the camera looks at
    rotation: np.ndarray  # (3, 3), of the object
    scale: float  # the object's largest coordinate
    roughness: float  # of the object's surface
    wall: np.ndarray | None = None  # the point of a wall that is nearest to `center`
    environment: np.ndarray | None = None  # radiance (H, W, 3) of `equirectangular`, for projectors and ambient


def draw_shots(
    settings: LabSettings, environments: Mapping[str, np.ndarray], slides: Sequence[np.ndarray] = ()
) -> Iterator[Shot]:
    """`setups` shots, equally many of each pattern and each environment (by name), in this order.

    Brightness rises evenly in ratios within each. An environment is turned about the vertical by a random angle.
    slides: as of `draw_pattern`.
    """
    dimmest, brightest = settings.brightness
    kinds = [*settings.patterns, *environments]
    per_kind = settings.setups // len(kinds)
    for kind, index in product(kinds, range(per_kind)):
        draws = [np.random.default_rng(stream_seed(settings.seed, key, kind, index)) for key in ("shot", "more")]
        radiance = dimmest * (brightest / dimmest) ** ((index + draws[0].uniform()) / per_kind)
        shot = _draw_shot("solid" if kind in environments else kind, radiance, settings, slides, *draws)
        if kind in environments:
            sky = environments[kind]
            directions, solid_angles = equirectangular(*sky.shape[:2])
            cosines = directions[..., 2].clamp(min=0) * solid_angles
            on_white = float((cosines[..., None] * torch.from_numpy(sky)).sum((0, 1)).mean()) / math.pi  # and facing up
            turned = (radiance / on_white * np.roll(sky, draws[0].integers(sky.shape[1]), axis=1)).astype(np.float32)
            shot = replace(shot, family=kind, environment=turned, wall=None)
        yield shot


def _draw_shot(
    kind: str, brightness: float, settings: LabSettings, slides: Sequence[np.ndarray], *draws: np.random.Generator
) -> Shot:
    """A shot under patterns of the families, joined by + in `kind`."""
    rng, more = draws  # the second is for what not every laboratory has: the others' draws stay the same
    first, *others = kind.split("+")
    azimuth, half_width, scale = rng.uniform(0, 360), rng.uniform(1.2, 1.9), rng.uniform(0.75, 1)
    center = np.array([0, 0, 0.8 * scale])
    aim = center + rng.uniform(-0.25, 0.25, 3)

    def projector(rng: np.random.Generator) -> np.ndarray:
        angles = azimuth + _between(settings.azimuth, rng), _between(settings.elevation, rng)
        return center + _position(*angles, rng.uniform(5, 8))

    roughness = _between(settings.roughness, more)
    shot = Shot(
        family=kind,
        brightness=brightness,
        patterns=[draw_pattern(first, rng, slides), *(draw_pattern(family, more, slides) for family in others)],
        ambient=_between(settings.ambient, rng) * draw_color(rng),
        table=_between(settings.albedo, rng) * draw_color(rng),
        projectors=[projector(rng), *(projector(more) for _ in others)],
        camera=aim + _position(azimuth, rng.uniform(18, 60), half_width / math.tan(math.radians(FOV / 2))),
        center=center,
        aim=aim,
        rotation=Rotation.from_euler("ZXZ", rng.uniform(0, (360, 60, 360)), degrees=True).as_matrix(),
        scale=scale,
        roughness=roughness,
    )
    behind = _position(azimuth + 180 + more.uniform(-30, 30), 0, more.uniform(1.8, 3.5))
    free = all((position - center) @ behind < behind @ behind for position in shot.projectors)
    return replace(shot, wall=center + behind) if more.uniform() < settings.walls and free else shot


def _between(limits: Sequence[float], rng: np.random.Generator) -> float:
    return rng.uniform(limits[0], limits[1])


def _position(azimuth: float, elevation: float, distance: float) -> np.ndarray:
    """(3,) from angles in degrees."""
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    horizontal = math.cos(elevation)
    return distance * np.array([horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(elevation)])
