"""One run from its configuration: data, scene, network, training, scores on the test set and on photographs."""

import platform
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import torchvision
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from augment.phases import Phases
from augment.scene import ObjectSettings, Scene, build_objects, count_views
from augment.seeding import stream_seed
from augment.service import AugmentationService, AugmentationSettings
from renderer.errors import InputError
from renderer.lights import load_light
from renderer.transfer import Settings
from renderer.visibility import Backend, choose
from train import checkpoint
from train.data import (
    DataSet,
    channel_statistics,
    class_index,
    load_cifar100,
    load_folder,
    load_npz,
    stratified_split,
)
from train.device import choose_device
from train.fit import Trainer, TrainSettings, evaluate
from train.logs import RunLog, console
from train.photographs import evaluate_photographs, format_summary
from train.precision import MixedPrecision, choose_precision
from train.rendered_shapes import load_shapes, write_held_out
from train.wideresnet import WideResNet

CONFIG = "config.yaml"
PHOTOGRAPHS = "photographs"


@dataclass
class ModelSettings:
    """The WideResNet; its dropout acts between the two convolutions of a block."""

    depth: int = 16
    width: int = 4
    dropout: float = 0.3


@dataclass
class SceneSettings:
    """What is rendered. meshes: each a file, a `solid:NAME`, or a mapping with ObjectSettings' keys."""

    meshes: list
    backgrounds: list[float] = field(default_factory=list)
    views: int | None = None
    field_of_view: float = 2.0
    light: str = "grace"
    exposure: float = 1.0


@dataclass
class RendererSettings:
    """visibility: auto, opengl or software. samples per pixel side. encoding: linear or srgb."""

    visibility: str = "auto"
    samples: int = 8
    encoding: str = "linear"


def run(config: DictConfig, data: DataSet, folder: Path) -> None:
    """Train one arm into `folder` and score it; everything found out is in the folder's files."""
    settings = read_settings(TrainSettings, config.train, "train")
    device = choose_device(settings.device)
    trainer, log, (train, validation) = _prepare(config, settings, data, folder, device)
    trainer.fit(train, validation, log)
    scores = _test_scores(trainer, data, device)
    if config.evaluate.photos:
        scores |= _photograph_scores(config, trainer.model, data, folder, device)
    log.scalars(scores)
    log.close()


def load_data(config: DictConfig) -> DataSet:
    """The data set that `config.data` names."""
    data = config.data
    if data.name == "cifar100":
        return load_cifar100(data.path)
    if data.name == "npz":
        return load_npz(data.path)
    if data.name == "folder":
        return load_folder(data.path, data.size, data.test)
    return load_shapes(data.train, data.test, data.size, data.seed)


def write_pictures(config: DictConfig, size: int) -> None:
    """Write the rendered held-out pictures that `data=shapes` is scored on, where the configuration asks for them."""
    if config.data.name == "shapes" and config.data.pictures:
        write_held_out(Path(config.data.pictures), size, config.data.seed)


def read_settings(kind: type, node: DictConfig, key: str):
    """A settings dataclass from its configuration; InputError naming the key whose value has the wrong type."""
    try:
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(kind), node))
    except OmegaConfBaseException as error:
        raise InputError(f"{key}.{error.full_key or ''}: {str(error.msg).splitlines()[0]}") from error


def _prepare(config: DictConfig, settings: TrainSettings, data: DataSet, folder: Path, device: torch.device):
    """(trainer, log, (train, validation)), ready for the first epoch or, on resume, for the next."""
    phases = Phases(device)
    model_settings = read_settings(ModelSettings, config.model, "model")
    precision = choose_precision(settings.precision, device)
    torch.manual_seed(stream_seed(config.seed, "weights"))
    mean, std = channel_statistics(data.train.images)
    architecture = OmegaConf.to_container(OmegaConf.structured(model_settings))
    network = WideResNet(len(data.classes), **architecture, mean=mean, std=std).to(device)
    service = _build_service(config, data, device, phases)
    model = MixedPrecision(network, precision)
    checkpointed = {"classes": list(data.classes), **architecture}
    trainer = Trainer(settings, model, checkpointed, service, phases, folder, config.seed)
    train, validation = stratified_split(data.train, config.data.validation, seed=0)
    _open_folder(trainer, config)
    console.info("%s pictures, %s classes; %s, %s", len(train), len(data.classes), device, trainer.model.precision)
    return trainer, RunLog(folder, trainer.epoch), (train.to(device), validation.to(device))


def _open_folder(trainer: Trainer, config: DictConfig) -> None:
    """Resume from the folder, or start in it; InputError rather than writing over another run."""
    folder = trainer.folder
    if (folder / checkpoint.LAST).exists():
        if not trainer.settings.resume:
            raise InputError(
                f"run={folder} holds a run already: set train.resume=true to go on, or choose another run="
            )
        trainer.resume()
        console.info("resumed %s after epoch %d", folder, trainer.epoch)
    elif trainer.settings.resume:
        console.info("nothing to resume in %s; starting at epoch 1", folder)
    folder.mkdir(parents=True, exist_ok=True)
    resolved = OmegaConf.to_container(config, resolve=True)
    resolved["versions"] = {
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "torchvision": str(torchvision.__version__),
        "numpy": np.__version__,
    }
    OmegaConf.save(OmegaConf.create(resolved), folder / CONFIG)


def _build_service(config: DictConfig, data: DataSet, device: torch.device, phases: Phases) -> AugmentationService:
    settings = read_settings(AugmentationSettings, config.augment, "augment")
    scene_settings = read_settings(SceneSettings, config.scene, "scene")
    light = load_light(scene_settings.light) * scene_settings.exposure
    scene, labels = None, torch.zeros(0, dtype=torch.int64)
    if settings.renders:
        with phases("operators"):
            scene = _build_scene(scene_settings, config, data, settings.examples, device)
        labels = torch.tensor([class_index(data.classes, label, "scene.meshes") for label in scene.labels])
    return AugmentationService(settings, scene, labels.to(device), light.to(device), config.seed, phases)


def _build_scene(scene: SceneSettings, config: DictConfig, data: DataSet, examples: int, device: torch.device) -> Scene:
    renderer = read_settings(RendererSettings, config.renderer, "renderer")
    objects = [_read_object(item, config.label, index) for index, item in enumerate(scene.meshes)]
    for item in objects:
        class_index(data.classes, item.label, "scene.meshes")
    views = count_views(examples, len(objects), len(scene.backgrounds), scene.views)
    backend = _choose_backend(renderer.visibility)
    settings = Settings(data.size, renderer.samples, renderer.encoding)
    return Scene(
        build_objects(objects, views, scene.field_of_view, settings, backend), scene.backgrounds, settings, device
    )


def _choose_backend(visibility: str) -> Backend:
    backend = choose(visibility)
    console.info("visibility: %s", backend.description)
    return backend


def _read_object(item, label: str, index: int) -> ObjectSettings:
    node = item if isinstance(item, dict) else {"mesh": item}
    return read_settings(ObjectSettings, OmegaConf.create({"label": label, **node}), f"scene.meshes[{index}]")


def _test_scores(trainer: Trainer, data: DataSet, device: torch.device) -> dict[str, float]:
    """The one look at the test set: the last epoch's network and the selected one, which stays loaded."""
    test = data.test.to(device)
    last = evaluate(trainer.model, test)["accuracy"]
    best = checkpoint.load(trainer.folder / checkpoint.BEST)
    trainer.model.network.load_state_dict(best["model"])
    selected = evaluate(trainer.model, test)["accuracy"]
    console.info("test accuracy %.4f (epoch %d, selected on validation), %.4f (last)", selected, best["epoch"], last)
    return {"test/accuracy": selected, "test/accuracy_last": last, "test/epoch": best["epoch"]}


def _photograph_scores(
    config: DictConfig, model: MixedPrecision, data: DataSet, folder: Path, device: torch.device
) -> dict[str, float]:
    summary = evaluate_photographs(
        model,
        data.classes,
        Path(config.evaluate.photos),
        config.label,
        folder / PHOTOGRAPHS,
        size=data.size,
        skip_unreadable=config.evaluate.skip_unreadable,
        device=device,
    )
    console.info("%s", format_summary(summary))
    shares = {f"photographs/{name}": summary[name]["value"] for name in ("recall", "top5", "false_alarms")}
    return {name: value for name, value in shares.items() if value is not None}
