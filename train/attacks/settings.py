"""conf/attack.yaml as dataclasses: the types, ranges and keys that an attack accepts."""

import math
from dataclasses import dataclass, field
from typing import Any

from augment.attacks.settings import AttackSettings
from renderer.errors import InputError
from train.settings import RendererSettings


@dataclass
class AttackCommandSettings(AttackSettings):
    """shared: the views share what is attacked. force: go on where nothing is recognised. checks: see `Checks`."""

    shared: bool = False
    force: bool = False
    checks: bool = True


@dataclass
class AttackSceneSettings:
    """What is rendered. meshes: as in training. polar: degrees. vertices: subdivide until there are more."""

    meshes: list = field(default_factory=lambda: ["solid:orange:0"])
    backgrounds: list = field(default_factory=lambda: [0.5])
    views: int = 1
    polar: float = 60.0
    field_of_view: float = 2.0
    vertices: int = 0
    light: str = "grace"
    exposure: float = 1.0

    def __post_init__(self):
        if not self.meshes or not self.backgrounds:
            raise InputError("scene.meshes and scene.backgrounds must not be empty: name one mesh and one background")
        if self.views < 1:
            raise InputError(f"scene.views={self.views} must be at least 1")
        if not 0 < self.exposure < math.inf:
            raise InputError(f"scene.exposure={self.exposure} must be positive")


@dataclass
class AttackExperimentSettings:
    """One attack on one classifier. target: None, a class, least_likely, or a class per view."""

    classifier: str = "efficientnet_lite0"
    weights: str | None = None
    label: str = "orange"
    target: Any = None
    seed: int = 0
    out: str = ""
    device: str = "auto"
    attack: AttackCommandSettings = field(default_factory=AttackCommandSettings)
    scene: AttackSceneSettings = field(default_factory=AttackSceneSettings)
    renderer: RendererSettings = field(default_factory=RendererSettings)

    def __post_init__(self):
        if self.seed < 0:
            raise InputError(f"seed={self.seed} must not be negative")
