"""The settings of pnb-lab, and the random draws of light, camera and pose.

World units: a normalized mesh spans [-1, 1]; it stands on the table z = 0 about the origin. Light and albedo are linear
RGB; a radiance of 1 is white at an exposure of 1.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import MISSING
from scipy.spatial.transform import Rotation

from augment.random_streams import stream_seed
from renderer.errors import FACTOR, InputError, require_choice, require_limits, require_range
from renderer.image import LARGEST_SIZE
from renderer.light.harmonics import equirectangular
from train.lab.patterns import FAMILIES, SLIDES, TRAINED, draw_color, draw_pattern
from train.settings import LARGEST_SEED

OTHERS = "apple:101 apple:102 pear:101 sweet_pepper:101 lemon:101 lemon:102 peach:101 peach:102 ball:101 ball:103"
SOLIDS = [*(f"orange:{seed}" for seed in range(101, 107)), *OTHERS.split()]
LIMITS: dict[str, tuple[float, float]] = {"azimuth": (-180, 180), "elevation": (1, 89), "ambient": (0, 1)}
LIMITS |= {"albedo": (0, 1), "roughness": (0.05, 1), "brightness": (1 / FACTOR, FACTOR)}
RANGES: dict[str, tuple[float, float]] = {"walls": (0, 1), "exposure": (1 / FACTOR, FACTOR), "seed": (0, LARGEST_SEED)}
RANGES |= {"setups": (1, 10**6), "size": (1, LARGEST_SIZE), "spp": (1, 10**5), "bounces": (1, 1000)}
FOV = 25.0  # degrees, of the camera


@dataclass
class LabSettings:
    """The settings of pnb-lab. A mesh is a file, `solid:NAME:SEED` or a mapping with the keys of ObjectSettings,
    whose label is a class, or other_NAME if the network lacks it."""

    out: str = MISSING  # a new folder, for photos= of pnb-evaluate
    label: Any = "orange"  # the class under study, or several: an object of each and one other stand in each setup
    meshes: list[Any] = field(default_factory=lambda: [f"solid:{name}" for name in SOLIDS])  # 6 oranges, 10 others
    setups: int = 180  # draws of light, camera and pose; with one label, two renders each
    patterns: list[str] = field(default_factory=lambda: list(TRAINED))  # projected, for as many setups each; two: a+b
    slides: list[str] = field(default_factory=list)  # image files that the pattern `slides` projects
    environments: list[str] = field(default_factory=list)  # maps (.npy, .hdr, .exr) instead, for as many setups each
    brightness: list[float] = field(default_factory=lambda: [0.2, 2.5])  # of white surfaces that face the light
    azimuth: list[float] = field(default_factory=lambda: [-70, 70])  # of a projector, degrees off the camera's
    elevation: list[float] = field(default_factory=lambda: [25, 70])  # of a projector, degrees above the table
    ambient: list[float] = field(default_factory=lambda: [0.01, 0.06])  # radiance from everywhere beside projectors
    albedo: list[float] = field(default_factory=lambda: [0.04, 0.16])  # of table and wall
    walls: float = 0.0  # fraction of the setups with a wall behind the object, where no projector stands behind it
    roughness: list[float] = field(default_factory=lambda: [0.5, 0.5])  # of the object: 0.1 is a gloss, 1 is dull
    exposure: float = 1.0  # multiplies radiance; at 1, a radiance of 1 is white
    size: int = 64  # pixels per side
    spp: int = 32  # paths per pixel and light
    bounces: int = 4  # of light, at most
    seed: int = 0
    overwrite: bool = False  # render into a folder that is not empty, in place of the renders in it

    def __post_init__(self) -> None:
        families = {family for pattern in self.patterns for family in pattern.split("+")}
        for family in sorted(families):
            require_choice("patterns", family, [*FAMILIES, SLIDES])
        if SLIDES in families and not self.slides:
            raise InputError(f"patterns has {SLIDES}: name image files in slides=")
        sources = [*self.patterns, *(Path(path).stem for path in self.environments)]
        if not sources or self.setups % len(sources):
            raise InputError(f"setups={self.setups} must be a multiple of the {len(sources)} patterns and maps")
        if len(set(sources)) < len(sources):
            raise InputError("patterns and environments must have different names, which are the renders' sources")
        for name, ends in LIMITS.items():
            require_limits(name, getattr(self, name), *ends)
        for name, ends in RANGES.items():
            require_range(name, getattr(self, name), *ends)


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
