"""One run from its configuration: data, scene, network, training, scores on the test set and on photographs."""

import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from augment import utils
from augment.utils import Phases, stream_seed
from renderer.cache import TensorCache, cache_folder
from renderer.errors import InputError, require_choice
from renderer.image import LARGEST_SIZE
from train.command_line.configuration import as_dict, read_settings
from train.command_line.entry_points import NO_ROOM
from train.data import DataSet, channel_statistics, load_cifar100, load_folder, load_npz, stratified_split
from train.device import MixedPrecision, choose_device, choose_precision, set_deterministic, set_threads
from train.distributed import first_process_first
from train.fit.evaluation import evaluate
from train.fit.resumption import resume
from train.fit.trainer import Trainer
from train.networks import build_network
from train.photographs.figures import FIGURES, find_figure
from train.photographs.folder import find_photographs, require_outside
from train.photographs.scoring import evaluate_photographs
from train.photographs.text import format_summary
from train.rendered_shapes import load_shapes, write_held_out
from train.run_folder import checkpoint
from train.run_folder.classifier import describe, start_from
from train.run_folder.continuation import INPUTS, fingerprints, require_same_inputs, require_same_settings
from train.run_folder.files import CONFIG, write_whole
from train.run_folder.logs import NoLog, RunLog, console
from train.service import build_service
from train.settings import SMALLEST_SIZE, ExperimentSettings


def load_data(config: DictConfig) -> DataSet:
    """The data set that `config.data` names; InputError also for a fault elsewhere in the configuration."""
    settings = read_settings(ExperimentSettings, config)
    data, cache = settings.data, TensorCache(cache_folder(settings.renderer.cache))
    loaders = {
        "cifar100": lambda: load_cifar100(data.path),
        "npz": lambda: load_npz(data.path),
        "folder": lambda: load_folder(data.path, data.size, data.test_share),
        "shapes": lambda: load_shapes(data.train_per_class, data.test_per_class, data.size, data.seed, cache),
    }
    require_choice("data.name", data.name, loaders)
    console.info("data: %s", data.name)
    with first_process_first():
        loaded = loaders[data.name]()
    if not SMALLEST_SIZE <= loaded.size <= LARGEST_SIZE:
        raise InputError(
            f"data.path={data.path} has images of {loaded.size} pixels per side: give {SMALLEST_SIZE} to {LARGEST_SIZE}"
        )
    return loaded


def write_images(config: DictConfig, size: int) -> None:
    """Write the rendered held-out images that `data=shapes` is scored on, where the configuration asks for them."""
    if config.data.name == "shapes" and config.data.images:
        console.info("writing held-out renders in hard light (not photographs) to %s", config.data.images)
        cache = TensorCache(cache_folder(config.renderer.cache))
        with _one_error_without_room(config.data.images):
            write_held_out(Path(str(config.data.images)), size, config.data.seed, cache)


def run(config: DictConfig, data: DataSet, folder: Path) -> None:
    """Train one arm into `folder` and score it; everything found out is in the folder's files."""
    prepare(config, data, folder)()


def prepare(config: DictConfig, data: DataSet, folder: Path) -> Callable[[], None]:
    """Everything of `run` that comes before the first epoch, where wrong input shows; the result is the rest of it."""
    settings = read_settings(ExperimentSettings, config)
    for name, photographs in settings.evaluate.folders.items():
        require_outside(folder / name, photographs)
        find_photographs(photographs, data.classes, settings.label)
    device = choose_device(settings.train.device)
    set_threads(settings.train.threads)
    set_deterministic(settings.train.deterministic)
    train, validation = stratified_split(data.train, settings.data.validation, seed=0)
    trainer = build_trainer(settings, data, folder, device)
    with _one_error_without_room(folder):
        _open_folder(trainer, config)

    @_one_error_without_room(folder)
    def train_and_score() -> None:
        console.info(
            "%s images, %s classes; %s, %s, %d threads, %d processes",
            len(train),
            len(data.classes),
            device,
            trainer.learner.model.precision,
            torch.get_num_threads(),
            utils.world_size(),
        )
        log = NoLog() if utils.rank() else RunLog(folder, trainer.history)
        trainer.fit(train.to(device), validation.to(device), log)
        log.scalars(_test_scores(trainer, data, device) | _photograph_scores(settings, trainer, data, device))

    return train_and_score


@contextmanager
def _one_error_without_room(folder: Path | str) -> Iterator[None]:
    """InputError where the disk is full, whatever was being written."""
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        place = error.filename or folder
        raise InputError(
            f"{place} cannot be written ({error.strerror}): make room and go on with train.resume=true"
        ) from error


def build_trainer(settings: ExperimentSettings, data: DataSet, folder: Path, device: torch.device) -> Trainer:
    """The run's network, optimizer and scene, ready for `Trainer.fit`; nothing is written before."""
    phases = Phases(device)
    precision = choose_precision(settings.train.precision, device)
    mean, std = channel_statistics(data.train.images)
    shape = settings.model.shape
    torch.manual_seed(stream_seed(settings.seed, "weights"))
    network = build_network(data.classes, data.size, mean=mean, std=std, **shape)
    facts = {"classes": list(data.classes), "size": data.size, "encoding": settings.renderer.encoding, **shape}
    if settings.train.init_from:
        start_from(network, facts, Path(settings.train.init_from))
    service = build_service(settings, data, device, phases)
    model = MixedPrecision(network.to(device), precision)
    described = describe(network, **facts)
    return Trainer(settings.train, model, described, service, phases, folder, settings.seed)


def _open_folder(trainer: Trainer, config: DictConfig) -> None:
    """Resume from the folder, or start in it; InputError rather than writing over another run."""
    folder = trainer.folder
    if checkpoint.exists(folder):
        if not trainer.settings.resume:
            raise InputError(
                f"run={folder} holds a run already: set train.resume=true to go on, or choose another run="
            )
        require_same_settings(folder, config)
        require_same_inputs(folder, config)
        resume(trainer)
        console.info("resumed %s after epoch %d%s", folder, trainer.epoch, trainer.part_of_epoch)
    elif trainer.settings.resume:
        console.info("nothing to resume in %s; starting at epoch 1", folder)
    if utils.rank() == 0:
        _write_config(config, folder)


def _write_config(config: DictConfig, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    resolved = as_dict(config, resolve=True)
    resolved[INPUTS] = fingerprints(config)
    resolved["versions"] = {
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "torchvision": version("torchvision"),
        "numpy": version("numpy"),
    }
    write_whole(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create(resolved)).encode())


def _test_scores(trainer: Trainer, data: DataSet, device: torch.device) -> dict[str, float]:
    """The one look at the test set: the last epoch's network and the selected one, which stays loaded."""
    test = data.test.to(device)
    last = selected = evaluate(trainer.learner.selected, test)["accuracy"]
    best = checkpoint.load(trainer.folder / checkpoint.BEST)
    if best["epoch"] != trainer.epoch:
        trainer.learner.selected.network.load_state_dict(best["model"])
        selected = evaluate(trainer.learner.selected, test)["accuracy"]
    console.info("test accuracy %.4f (what is kept, epoch %d), %.4f (last)", selected, best["epoch"], last)
    return {"test/accuracy": selected, "test/accuracy_last": last, "test/epoch": best["epoch"]}


def _photograph_scores(
    settings: ExperimentSettings, trainer: Trainer, data: DataSet, device: torch.device
) -> dict[str, float]:
    """The network's figures on each folder of photographs, as NAME/FIGURE; empty without one."""
    scores: dict[str, float | None] = {}
    for name, photographs in settings.evaluate.folders.items() if utils.rank() == 0 else ():
        summary = evaluate_photographs(
            trainer.learner.selected,
            data.classes,
            photographs,
            settings.label,
            trainer.folder / name,
            size=data.size,
            skip_unreadable=settings.evaluate.skip_unreadable,
            device=device,
        )
        console.info("%s: %s", name, format_summary(summary))
        scores |= {f"{name}/{figure}": find_figure(summary, figure)["value"] for figure in ("top5", *FIGURES)}
    return {name: value for name, value in scores.items() if value is not None}
