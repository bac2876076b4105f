"""conf/train.yaml as dataclasses: the types, ranges and keys that a run accepts."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from augment.objects import ObjectSettings
from augment.scene import count_views
from augment.service import AugmentationSettings
from renderer.errors import InputError
from renderer.image import PictureSettings
from train.recipe import TrainSettings

# Where, how and with what a run was made: these do not decide its result, nor name a sweep's cell.
CIRCUMSTANCES = (
    *("run", "sweep", "launcher", "compare", "versions", "renderer.cache"),
    *("train.resume", "train.device", "train.threads", "train.compile", "train.checkpoint_every"),
)


@dataclass
class DataSettings:
    """What the choices of conf/data set between them; see the loader of each."""

    name: str = "shapes"
    validation: float = 0.1
    path: str = ""
    size: int = 32
    test_share: float = 0.1
    train_per_class: int = 300
    test_per_class: int = 60
    seed: int = 0
    pictures: str | None = None

    def __post_init__(self):
        if self.size < 1 or self.seed < 0:
            raise InputError(f"data.size={self.size} must be at least 1 and data.seed={self.seed} not negative")


@dataclass
class SceneSettings:
    """What is rendered. meshes: each a file, a `solid:NAME`, or a mapping with ObjectSettings' keys."""

    meshes: list = field(default_factory=list)
    backgrounds: list[float] = field(default_factory=list)
    views: int | None = None
    field_of_view: float = 2.0
    light: str = "grace"
    exposure: float = 1.0

    def __post_init__(self):
        if not 0 < self.exposure < math.inf:
            raise InputError(f"scene.exposure={self.exposure} must be positive")


@dataclass
class RendererSettings:
    """visibility: auto, opengl or software. samples per pixel side. encoding: linear or srgb. normals: flat or smooth.

    cache: the folder of what is rendered once, auto or None; see `renderer.cache.cache_folder`.
    """

    visibility: str = "auto"
    samples: int = 8
    encoding: str = "linear"
    normals: str = "flat"
    cache: str | None = "auto"

    def pictures(self, size: int) -> PictureSettings:
        """Of pictures with `size` pixels per side."""
        return PictureSettings(size, self.samples, self.encoding, self.normals)


@dataclass
class ModelSettings:
    """The WideResNet; its dropout acts between the two convolutions of a block."""

    depth: int = 16
    width: int = 4
    dropout: float = 0.3


@dataclass
class EvaluationSettings:
    """photos: a folder of photographs to score the network on. skip_unreadable: pass over those that are broken."""

    photos: str | None = None
    skip_unreadable: bool = False


@dataclass
class ExperimentSettings:
    """A whole run. run: its folder; sweep: that of a sweep. label: the class under study. compare: arms beside it."""

    run: str = ""
    sweep: str = ""
    seed: int = 0
    label: str = "orange"
    compare: list[str] = field(default_factory=list)
    data: DataSettings = field(default_factory=DataSettings)
    augment: AugmentationSettings = field(default_factory=AugmentationSettings)
    scene: SceneSettings = field(default_factory=SceneSettings)
    renderer: RendererSettings = field(default_factory=RendererSettings)
    model: ModelSettings = field(default_factory=ModelSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    evaluate: EvaluationSettings = field(default_factory=EvaluationSettings)

    def __post_init__(self):
        if self.seed < 0:
            raise InputError(f"seed={self.seed} must not be negative")
        if self.augment.renders:
            _ = self.views  # fails on an inconsistent product before any data is read

    @property
    def views(self) -> int:
        """Views per mesh; see `count_views`."""
        scene = self.scene
        return count_views(self.augment.examples, len(scene.meshes), len(scene.backgrounds), scene.views)


def read_settings(kind: type, config: DictConfig, parent: str = ""):
    """The dataclass from its configuration; InputError naming the key that is unknown, unset or of the wrong type."""
    if unset := OmegaConf.missing_keys(config):
        raise InputError(f"{min(unset)} is not set: give {min(unset)}=...")
    try:
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(kind), config))
    except OmegaConfBaseException as error:
        key = ".".join(filter(None, (parent, error.full_key)))
        raise InputError(": ".join(filter(None, (key, str(error.msg).splitlines()[0])))) from error


def decisive_settings(config: DictConfig) -> dict[str, object]:
    """What decides a run's result, by dotted key: all but the circumstances, with `${run}` for its own folder."""
    settings = OmegaConf.to_container(config, resolve=True)
    own = re.compile(f"^{re.escape(settings['run'])}(?=/|$)")
    return {
        key: own.sub("${run}", value) if isinstance(value, str) else value
        for key, value in _dotted(settings)
        if key not in CIRCUMSTANCES
    }


def _dotted(node: dict, prefix: str = "") -> Iterator[tuple[str, object]]:
    for key, value in node.items():
        if isinstance(value, dict) and prefix + key not in CIRCUMSTANCES:
            yield from _dotted(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def read_object(item: str | dict, label: str, index: int) -> ObjectSettings:
    """An entry of scene.meshes: a file or solid of the class `label`, or a mapping that may name its own."""
    keys = item if isinstance(item, dict) else {"mesh": item}
    return read_settings(ObjectSettings, OmegaConf.create({"label": label, **keys}), f"scene.meshes[{index}]")
