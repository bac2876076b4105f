"""The schema of conf/train.yaml: the types, ranges, keys and defaults of a run."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from augment.build import RendererSettings, SceneSettings, count_views
from augment.objects import ObjectSettings, PropSettings
from augment.service import AugmentationSettings
from renderer.errors import InputError, require_range
from renderer.image import LARGEST_SIZE
from train.configuration import read_settings
from train.networks import WIDERESNET
from train.recipe import TrainSettings

OTHER = "other"  # in place of the class of a hard negative that the classifier has no class for
PHOTOGRAPHS = "photographs"  # the sub-folder of a run with the scores on a folder of photographs that has no other name
RESERVED = ("renders", "rendered_images", "test")  # other sub-folders and scores of a run
SMALLEST_SIZE = 5  # pixels per side: 4 are padded by reflection
MOST_IMAGES, LARGEST_SEED = 10**6, 2**63 - 1


@dataclass
class DataSettings:
    """What the choices of conf/data set between them; see the loader of each."""

    name: str = "shapes"
    validation: float = 0.1
    path: str = ""
    size: int = 32
    test_fraction: float = 0.1
    train_per_class: int = 300
    test_per_class: int = 60
    seed: int = 0
    images: str | None = None

    def __post_init__(self) -> None:
        require_range("size", self.size, SMALLEST_SIZE, LARGEST_SIZE)
        require_range("seed", self.seed, 0, LARGEST_SEED)
        for name in ("train_per_class", "test_per_class"):
            require_range(name, getattr(self, name), 1, MOST_IMAGES)


@dataclass
class TrainingSceneSettings(SceneSettings):
    """hard_negatives: like meshes, of other classes than `label`; of no class, unless a mapping names one."""

    meshes: list[Any] = field(default_factory=lambda: ["solid:orange:0", "solid:orange:1"])
    backgrounds: list[Any] = field(default_factory=lambda: [0.0, 0.25, 0.5, 0.75, 1.0])
    views: int | None = None
    hard_negatives: list[Any] = field(default_factory=list)

    @property
    def objects(self) -> int:
        """The number of meshes and hard negatives; 0 without a mesh."""
        return len(self.meshes) + len(self.hard_negatives) if self.meshes else 0


@dataclass
class ModelSettings:
    """name: as `train.networks.build_network` takes it. The rest is the WideResNet's; its dropout acts between the two
    convolutions of a block.
    """

    name: str = WIDERESNET
    depth: int = 16
    width: int = 4
    dropout: float = 0.3

    @property
    def shape(self) -> dict[str, Any]:
        """What a network of this name is built from, and what is stored beside its weights."""
        if self.name == WIDERESNET:
            return {"depth": self.depth, "width": self.width, "dropout": self.dropout}
        return {"name": self.name}


@dataclass
class EvaluationSettings:
    """photos: a folder of photographs to score the network on, or several by name. skip_unreadable: skip those that are
    broken."""

    photos: Any = None  # str | dict[str, str] | None, a union that OmegaConf has no type for
    skip_unreadable: bool = False

    def __post_init__(self) -> None:
        photos = self.photos
        named = isinstance(photos, dict) and all(isinstance(folder, str) for folder in photos.values())
        if not (photos is None or isinstance(photos, str) or named):
            raise InputError(f"photos={photos} must be a folder, or a mapping of names to folders")
        for name in self.folders:
            if not re.fullmatch(r"\w[\w-]*", name) or name in RESERVED:
                raise InputError(
                    f"photos: {name} must be a name of letters, digits, _ and -, and none of {', '.join(RESERVED)}, "
                    "since it becomes a sub-folder of the run"
                )

    @property
    def folders(self) -> dict[str, Path]:
        """The folders of photographs by the name of the run's sub-folder that gets their scores."""
        named = self.photos if isinstance(self.photos, dict) else {PHOTOGRAPHS: self.photos} if self.photos else {}
        return {str(name): Path(folder) for name, folder in named.items()}


@dataclass
class ExperimentSettings:
    """A whole run. run: its folder; sweep: that of a sweep. label: the class under study. compare: arms beside it."""

    run: str = ""
    sweep: str = "runs/sweep"
    seed: int = 0
    label: str = "orange"
    compare: list[str] = field(default_factory=list)
    data: DataSettings = field(default_factory=DataSettings)
    augment: AugmentationSettings = field(default_factory=AugmentationSettings)
    scene: TrainingSceneSettings = field(default_factory=TrainingSceneSettings)
    renderer: RendererSettings = field(default_factory=lambda: RendererSettings(samples=8, normals="flat"))
    model: ModelSettings = field(default_factory=ModelSettings)
    train: TrainSettings = field(default_factory=TrainSettings)
    evaluate: EvaluationSettings = field(default_factory=EvaluationSettings)

    def __post_init__(self) -> None:
        require_range("seed", self.seed, 0, LARGEST_SEED)
        if self.augment.renders:
            self.augment.examples = self.views * self.scene.objects * len(self.scene.backgrounds)
            require_range("meshes × views × backgrounds", self.augment.examples, 1, MOST_IMAGES)

    @property
    def views(self) -> int:
        """Views per mesh; see `count_views`."""
        scene = self.scene
        return count_views(self.augment.examples, scene.objects, len(scene.backgrounds), scene.views)

    @property
    def objects(self) -> dict[str, ObjectSettings]:
        """By their keys, the meshes of the scene, and its hard negatives, of the class OTHER where they name none."""
        objects = {}
        for key, label in (("meshes", self.label), ("hard_negatives", OTHER)):
            for index, item in enumerate(getattr(self.scene, key)):
                objects[f"scene.{key}[{index}]"] = read_object(item, label, index, f"scene.{key}")
        for key, item in objects.items():
            if key.startswith("scene.hard_negatives") and item.label == self.label:
                raise InputError(f"{key} is of the class {self.label}: name it in scene.meshes, or leave it out")
        return objects


def read_object(item: str | dict[str, Any], label: str, index: int, key: str = "scene.meshes") -> ObjectSettings:
    """An entry of `key`: a file or solid of the class `label`, or a mapping that may name its own class."""
    entry, keys = f"{key}[{index}]", dict(item) if isinstance(item, dict) else {"mesh": item}
    props: Any = keys.pop("props", [])
    if not (isinstance(props, list) and all(isinstance(prop, dict) for prop in props)):
        raise InputError(f"{entry}.props: give a list of mappings, as in [{{mesh: solid:cup, at: [0.9, 0]}}]")
    props = [
        read_settings(PropSettings, OmegaConf.create(prop), f"{entry}.props[{number}]")
        for number, prop in enumerate(props)
    ]
    return replace(read_settings(ObjectSettings, OmegaConf.create({"label": label, **keys}), entry), props=props)
