"""conf/attack.yaml as dataclasses: the types, ranges and keys that an attack accepts."""

from dataclasses import dataclass, field
from typing import Any

from augment.attack import DescentSettings
from augment.parameters import KINDS, StepSettings
from renderer.errors import FACTOR, InputError, require_range
from train.settings import LARGEST_SEED, MOST_VIEWS, RendererSettings

MOST_VERTICES = 10**7  # some 5 GB


@dataclass
class SkylightSettings(StepSettings):
    """Where the sky begins: zenith and azimuth in degrees, turbidity."""

    zenith: float = 45.0
    azimuth: float = 0.0
    turbidity: float = 3.0


@dataclass
class AttackSettings:
    """What is changed, by which steps, and for how long; None for what stays as it is. See conf/attack.yaml."""

    lighting: StepSettings | None = None
    skylight: SkylightSettings | None = None
    geometry: StepSettings | None = None
    albedo: StepSettings | None = None
    pixels: StepSettings | None = None
    max_steps: int = 30
    shorten: bool = False
    restarts: int = 0
    shared: bool = False
    batch_size: int = 32
    force: bool = False
    checks: bool = True

    def __post_init__(self):
        if self.lighting and self.skylight:
            raise InputError("attack: lighting and skylight both set the light: choose one of them")
        if self.restarts < 0:
            raise InputError(f"attack.restarts={self.restarts} must not be negative")
        if self.restarts and any(settings.radius is None for settings in self.kinds.values()):
            raise InputError("attack.restarts draws from the norm-balls: set the radius of every kind, or restarts=0")
        self.descent()

    @property
    def kinds(self) -> dict[str, StepSettings]:
        """The settings of what is changed, by name."""
        return {name: settings for name in KINDS if (settings := getattr(self, name)) is not None}

    def require_kinds(self) -> None:
        """InputError where nothing is to be changed."""
        if not self.kinds:
            raise InputError(f"attack: name what to change, such as attack=lighting; there are {', '.join(KINDS)}")

    def descent(self) -> DescentSettings:
        """How long a descent lasts."""
        return DescentSettings(self.max_steps, self.shorten, self.batch_size)


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
        require_range("scene.views", self.views, 1, MOST_VIEWS)
        require_range("scene.vertices", self.vertices, 0, MOST_VERTICES)
        require_range("scene.exposure", self.exposure, 1 / FACTOR, FACTOR)


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
    attack: AttackSettings = field(default_factory=AttackSettings)
    scene: AttackSceneSettings = field(default_factory=AttackSceneSettings)
    renderer: RendererSettings = field(default_factory=RendererSettings)

    def __post_init__(self):
        require_range("seed", self.seed, 0, LARGEST_SEED)
