"""conf/attack.yaml as dataclasses: the types, ranges and keys that an attack accepts."""

from dataclasses import dataclass, field
from typing import Any

from augment.attacks.attack import AttackSettings
from augment.attacks.evaluate import require_renderers, require_transferable
from augment.build import LampsSettings, ProjectorSettings, RendererSettings, SceneSettings
from renderer.camera import MOST_VIEWS
from renderer.errors import FACTOR, InputError, require_range
from train.settings import LARGEST_SEED

MOST_RADII = 100
LIT = 2.0  # power of the default lamps whose places alone are attacked


@dataclass
class AttackCommandSettings(AttackSettings):
    """shared: the views share what is attacked. force: go on where nothing is clean-correct. checks: see `Checks`.

    radius_scales: of the radii to draw success against; see `augment.success_by_radius`.
    verify: what renders the adversaries anew from their files, "reload" or "mitsuba" or both joined by +; or None.
    """

    shared: bool = False
    force: bool = False
    checks: bool = True
    radius_scales: list[float] = field(default_factory=list)
    verify: str | None = "reload"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_renderers(self.renderers)
        require_range("radius_scales: their number", len(self.radius_scales), 0, MOST_RADII)
        for scale in self.radius_scales:
            require_range("radius_scales", scale, 1 / FACTOR, FACTOR)

    @property
    def renderers(self) -> list[str]:
        """Those of `verify`."""
        return self.verify.split("+") if self.verify else []


@dataclass
class AttackSceneSettings(SceneSettings):
    """search: how many cameras to try where the classifier does not recognize the mesh; see `train.attacks.search`."""

    views: int = 1
    search: int = 10

    def __post_init__(self) -> None:
        if not self.meshes or not self.backgrounds:
            raise InputError("meshes and backgrounds must not be empty: name one mesh and one background")
        require_range("search", self.search, 0, MOST_VIEWS)
        super().__post_init__()


@dataclass
class TransferSettings:
    """Where else what fools is shown. classifiers: as `classifier`, or {classifier, weights}. azimuths: degrees by
    which cameras are turned. meshes: as those of a scene."""

    classifiers: list[Any] = field(default_factory=list)
    azimuths: list[float] = field(default_factory=list)
    meshes: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        for angle in self.azimuths:
            require_range("transfer.azimuths", angle, -360, 360)


@dataclass
class AttackExperimentSettings:
    """One attack on one classifier. target: None, a class, least_likely, or a class per view. reload: an adversary's
    folder, to render or to attack instead of the scene. A projector or lamps that are attacked stand in the scene,
    where it names none with their defaults."""

    classifier: str = "efficientnet_lite0"
    weights: str | None = None
    label: str = "orange"
    target: Any = None
    seed: int = 0
    out: str = ""
    reload: str | None = None
    device: str = "auto"
    attack: AttackCommandSettings = field(default_factory=AttackCommandSettings)
    transfer: TransferSettings = field(default_factory=TransferSettings)
    scene: AttackSceneSettings = field(default_factory=AttackSceneSettings)
    renderer: RendererSettings = field(default_factory=lambda: RendererSettings(shadows=True))

    def __post_init__(self) -> None:
        require_range("seed", self.seed, 0, LARGEST_SEED)
        names = self.target if isinstance(self.target, list) else [self.target]
        if any(isinstance(name, dict | list) for name in names):
            raise InputError("target: give a class, least_likely, or a list of classes, one per view")
        require_transferable(self.attack.parameters, self.transfer.azimuths, self.transfer.meshes)
        if self.attack.projector is not None and self.scene.projector is None:
            self.scene.projector = ProjectorSettings()
        if self.attack.lamps is not None and self.scene.lamps is None:
            self.scene.lamps = LampsSettings()
        if self.attack.positions is not None and self.scene.lamps is None:
            self.scene.lamps = LampsSettings(start=LIT)
