"""The schema of conf/train.yaml, a dataclass, and how a command's configuration is read into its dataclass."""

import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast, get_type_hints

import hydra
from hydra import initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from augment.build import RendererSettings, SceneSettings, count_views
from augment.classifiers.adapter import label_names
from augment.distributed import world_size
from augment.objects import ObjectSettings
from augment.progress import announced
from augment.service import AugmentationSettings
from renderer.errors import InputError, in_one_line, require_range
from renderer.image import LARGEST_SIZE
from renderer.rasterizer import Rasterizer, choose
from train.errors import one_sentence
from train.networks import WIDERESNET, published
from train.recipe import TrainSettings

Settings = TypeVar("Settings")
_schema = cache(OmegaConf.structured)  # since OmegaConf takes as long to make it as to read a configuration into it
REQUIRED = "${required:}"  # in a file of conf/: a value is to be given; ??? would leave the default of another file
OTHER = "other"  # in place of the class of a hard negative that the classifier has no class for
PHOTOGRAPHS = "photographs"  # the sub-folder of a run with the scores on a folder of photographs that has no other name
RESERVED = ("renders", "test", "before")  # other sub-folders and scores of a run
SMALLEST_SIZE = 5  # pixels per side: 4 are padded by reflection
MOST_IMAGES, MOST_WORKERS, LARGEST_SEED = 10**6, 1024, 2**63 - 1
TEXTS = {  # keys whose values are names or paths, also where they look like numbers
    *("run", "sweep", "init_from", "out", "photos", "path", "folder", "cache"),
    *("weights", "light", "label", "target", "classifier", "name", "reload"),
}


@dataclass
class DataSettings:
    """What the choices of conf/data set between them; see the loader of each."""

    name: str = "shapes"
    validation: float | None = None
    path: str = ""
    size: int | None = None
    test_fraction: float = 0.1
    workers: int = 2
    train_per_class: int = 300
    test_per_class: int = 60
    seed: int = 0

    def __post_init__(self) -> None:
        if self.size is not None:
            require_range("size", self.size, SMALLEST_SIZE, LARGEST_SIZE)
        require_range("seed", self.seed, 0, LARGEST_SEED)
        require_range("workers", self.workers, 0, MOST_WORKERS)
        for name in ("train_per_class", "test_per_class"):
            require_range(name, getattr(self, name), 1, MOST_IMAGES)


@dataclass
class TrainingSceneSettings(SceneSettings):
    """hard_negatives: like meshes, of other classes than `label`, or of one of several; of no class, unless a mapping
    names one."""

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
    """name: as `train.networks.build_network` takes it. The rest is the WideResNet's."""

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
    """photos: a folder of photographs to score the network on, or several by name. skip_unreadable: skip broken."""

    photos: Any = None  # str | dict[str, str] | None, a union that OmegaConf has no type for
    skip_unreadable: bool = False

    def __post_init__(self) -> None:
        photos = self.photos
        named = isinstance(photos, dict) and all(isinstance(folder, str) for folder in photos.values())
        if not (photos is None or isinstance(photos, str) or named):
            raise InputError(f"photos={photos} must be a folder, or a mapping of names to folders")
        for name in self.folders:
            if not re.fullmatch(r"\w[\w-]*", name) or name in RESERVED:
                raise InputError(f"photos: {name} must be a name of letters, digits, _ and -, not one of {RESERVED}")

    @property
    def folders(self) -> dict[str, Path]:
        """The folders of photographs by the name of the run's sub-folder that gets their scores."""
        named = self.photos if isinstance(self.photos, dict) else {PHOTOGRAPHS: self.photos} if self.photos else {}
        return {str(name): published(Path(folder)) for name, folder in named.items()}


@dataclass
class ExperimentSettings:
    """A whole run. run: its folder; sweep: that of a sweep. label: the class under study, or several. weights: of the
    classifier that `train.init_from` names. compare: arms beside it."""

    run: str = ""
    sweep: str = "runs/sweep"
    overwrite: bool = False
    seed: int = 0
    label: Any = "orange"  # str | list[str], a union that OmegaConf has no type for
    weights: str | None = None
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
        label_names(self.label)
        if self.augment.renders and self.augment.arm != "folder":
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
        labels = label_names(self.label)
        objects = {
            f"scene.{key}[{index}]": read_object(item, label, index, f"scene.{key}")
            for key, label in (("meshes", labels[0] if len(labels) == 1 else ""), ("hard_negatives", OTHER))
            for index, item in enumerate(getattr(self.scene, key))
        }
        for key, item in objects.items():
            item.label = item.label or solid_name(item.mesh)
            if not item.label:
                raise InputError(f"{key} must name its class: give {{mesh: {item.mesh}, label: CLASS}}")
            if key.startswith("scene.hard_negatives") and [item.label] == labels:
                raise InputError(f"{key} is of the class {item.label}: name it in scene.meshes, or leave it out")
        missing = set(labels) - {item.label for item in objects.values()}
        if missing and len(labels) > 1:
            raise InputError(f"label={self.label} has no mesh of {min(missing)}: name one in scene.meshes")
        return objects


def read_object(item: str | dict[str, Any], label: str, index: int, key: str = "scene.meshes") -> ObjectSettings:
    """An entry of `key`: a file or solid of the class `label`, or a mapping that may name its own class."""
    keys = item if isinstance(item, dict) else {"mesh": item}
    return read_settings(ObjectSettings, OmegaConf.create({"label": label, **keys}), f"{key}[{index}]")


def solid_name(mesh: str) -> str:
    """The NAME of solid:NAME or solid:NAME:SEED; "" of a file."""
    kind, name, *_ = [*mesh.split(":"), ""]
    return name if kind == "solid" else ""


def quoted(text: str) -> str:
    """The text as a value that Hydra reads as it is."""
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", text)
    return "'" + re.sub(r"(\\+)$", r"\1\1", escaped) + "'"


def as_override(argument: str) -> str:
    """An argument of a command; names and paths are quoted where Hydra would read 1.10 as 1.1, or refuse an umlaut.

    InputError for an empty name, which would stand for the current folder, and for the removal of a setting.
    """
    if argument.startswith("~"):
        raise InputError(f"{argument}: a setting cannot be removed: set another value")
    key, equals, value = argument.partition("=")
    if not equals or TEXTS.isdisjoint(key.lstrip("+").split(".")):
        return argument
    if not value:
        raise InputError(f"{key} is empty: give a name, or leave it out")
    if value[0] in "'\"~":  # quoted already, or a home folder, which Hydra refuses
        return argument
    try:
        parsed = OverridesParser.create().parse_override(argument).value()
        as_given = parsed == value or not isinstance(parsed, str | int | float)  # otherwise null, a list, a sweep ...
    except HydraException:
        as_given = False
    return argument if as_given else f"{key}={quoted(value)}"


def program(name: str, as_called: bool = False) -> list[str]:
    """The words that start a command as this process was started: `pnb-NAME`, or `python` with a clone's file; for
    several processes by torchrun. as_called: with this machine's path of the interpreter or installed command."""
    called, count = Path(sys.argv[0]), world_size()
    installed, command = sys.flags.safe_path or called.stem.startswith("pnb-"), f"pnb-{name}"
    python = [sys.executable] if as_called else ["python"]
    if installed:
        words = [str(called) if as_called and called.stem == command else command]
    else:
        words = ["-m", "train"] if name == "train" else [f"scripts/{name}.py"]
    if count > 1:
        torchrun = [*python, "-m", "torch.distributed.run"] if as_called else ["torchrun"]
        return [*torchrun, f"--nproc_per_node={count}", *(["--no-python"] if installed else []), *words]
    return words if installed else [*python, *words]


def given_command(overrides: Sequence[str]) -> str:
    """The command of a training run, with these overrides but without the run's folder."""
    words = [text for text in overrides if not text.startswith(("run=", "train.resume="))]
    return shlex.join([*program("train"), *words])


def compose(command: str, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of a command under overrides; InputError with the text of Hydra, which names the override."""
    singleton = GlobalHydra.instance()
    running, singleton.hydra = singleton.hydra, None  # that of `pnb-train`
    try:
        with initialize_config_module("conf", version_base="1.3"):
            return hydra.compose(command, [as_override(override) for override in overrides])
    except Exception as error:  # Hydra raises several types for what it cannot read
        raise InputError(one_sentence(error) or in_one_line(error)) from error
    finally:
        singleton.hydra = running


def read_settings(kind: type[Settings], config: DictConfig, key: str = "") -> Settings:
    """The dataclass from its configuration, which stands at a key; InputError naming the key that is unknown, unset, of
    the wrong type or, by the dataclass's own check, out of range."""
    try:
        plain = cast(dict[str, Any], OmegaConf.to_container(config))
        unset = {name for name, value in dotted(plain) if value == REQUIRED}
        merged: Any = OmegaConf.merge(_schema(kind), config)  # type: ignore[arg-type]  # types are hashable
        if unset := unset or OmegaConf.missing_keys(config) | OmegaConf.missing_keys(merged):
            raise InputError(f"{_join(key, min(unset))} is not set: give {_join(key, min(unset))}=...")
        _check(merged, key)
        return cast(Settings, OmegaConf.to_object(merged))
    except (OmegaConfBaseException, OverflowError) as error:  # the latter for a whole number that no float holds
        name = _wrong_key(kind, config) or getattr(error, "full_key", None) or ""
        reason = str(getattr(error, "msg", error)).splitlines()[0]
        raise InputError(f"{_join(key, name)}: {reason}".removeprefix(": ")) from error


def _check(node: DictConfig, key: str) -> None:
    """InputError with the key of the innermost dataclass that refuses its values, or of a list's wrong item."""
    types: dict[Any, Any] = get_type_hints(OmegaConf.get_type(node))
    for name, child in node.items():
        items = {_join(key, str(name)): child}
        if isinstance(child, ListConfig):
            items = {f"{_join(key, str(name))}[{index}]": item for index, item in enumerate(child)}
        for inner, item in items.items():
            if isinstance(item, DictConfig) and OmegaConf.get_type(item) is not dict:
                _check(item, inner)
            elif types[name] in (list[str], list[float]) and OmegaConf.is_config(item):  # OmegaConf lets it pass
                raise InputError(f"{inner}: give a plain value, not a list or mapping")
    with keyed(key, types):
        OmegaConf.to_object(node)


def _wrong_key(kind: type, config: DictConfig) -> str:
    """The key of the first value that is wrong by itself, which OmegaConf names for most values alone; "" for none."""
    settings, plain = deepcopy(_schema(kind)), cast(dict[str, Any], OmegaConf.to_container(config))
    for name, value in dotted(plain):
        try:
            OmegaConf.update(settings, name, value)
        except AssertionError:  # OmegaConf's, within a group that is null by default
            continue
        except (OmegaConfBaseException, OverflowError):
            return name
    return ""


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


@contextmanager
def keyed(key: str, names: Collection[str] = ()) -> Iterator[None]:
    """Add the key to an InputError, whose message begins with one of a dataclass's names or with another text."""
    try:
        yield
    except InputError as error:
        message = str(error)
        if not key or message.startswith(key):
            raise
        name = re.match(r"\w*", message)[0]  # type: ignore[index]
        if name in names:
            key, message = _join(key, name), message.removeprefix(f"{name}: ")
        raise InputError(f"{key}: {message}") from error


def chosen_rasterizer(settings: RendererSettings) -> Rasterizer:
    """The rasterizer of the settings; InputError naming the key where it does not start."""
    with keyed("renderer.rasterizer"), announced("starting the rasterizer"):
        return choose(settings.rasterizer)


def dotted(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested settings, by dotted keys."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def mapped(value: Any, change: Callable[[str], str]) -> Any:
    """Nested settings with another text in place of each."""
    if isinstance(value, dict):
        return {key: mapped(item, change) for key, item in value.items()}
    if isinstance(value, list):
        return [mapped(item, change) for item in value]
    return change(value) if isinstance(value, str) else value
