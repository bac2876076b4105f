"""conf/lab.yaml as a dataclass: the types and ranges that a laboratory accepts."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from renderer.errors import FACTOR, InputError, require_choice, require_limits, require_range
from renderer.image import LARGEST_SIZE
from train.laboratory.patterns import FAMILIES
from train.settings import LARGEST_SEED

MOST_LIGHTS = 10**6


def environment_name(path: str) -> str:
    """By which photographs under a map are told from others."""
    return Path(path).stem


@dataclass
class LabSettings:
    """What is photographed, and how. meshes: each a file, a `solid:NAME`, or a mapping with ObjectSettings' keys.

    lights: draws of light, camera and pose, each shown with one object of `label` and one other. environments: files of
    maps, beside or in place of the projector's patterns. brightness: of either, from dim to bright; see `Shot`.
    """

    out: str
    meshes: list[Any]
    label: str = "orange"
    lights: int = 180
    patterns: list[str] = field(default_factory=lambda: list(FAMILIES))
    environments: list[str] = field(default_factory=list)
    brightness: list[float] = field(default_factory=lambda: [0.2, 2.5])
    exposure: float = 1.0
    size: int = 64
    samples: int = 32
    bounces: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for name in self.patterns:
            require_choice("patterns", name, FAMILIES)
        kinds = [*self.patterns, *map(environment_name, self.environments)]
        if not kinds or self.lights < 1 or self.lights % len(kinds):
            raise InputError(
                f"lights={self.lights} must be a positive multiple of the {len(kinds)} patterns and environments"
            )
        if repeated := next((name for name in kinds if kinds.count(name) > 1), None):
            raise InputError(f"patterns and environments: {repeated} is named twice, and names the photographs' source")
        require_limits("brightness", self.brightness, 1 / FACTOR, FACTOR)
        require_range("exposure", self.exposure, 1 / FACTOR, FACTOR)
        require_range("seed", self.seed, 0, LARGEST_SEED)
        for name, most in {"lights": MOST_LIGHTS, "size": LARGEST_SIZE, "samples": 10**5, "bounces": 1000}.items():
            require_range(name, getattr(self, name), 1, most)
