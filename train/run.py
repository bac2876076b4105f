"""One run from its settings: data, network, augmentation service, training, scores on the test set and photographs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import OmegaConf

from augment import utils
from augment.build import build_scene
from augment.classifiers.adapter import class_index, label_names
from augment.losses import complementary_label
from augment.service import AugmentationService
from augment.utils import Phases, progress, stream_seed
from renderer.errors import InputError, require_choice, require_range
from renderer.image import LARGEST_SIZE
from train import checkpoint, console
from train.cache import TensorCache, cache_folder
from train.data import (
    HELD_OUT,
    DataSet,
    Split,
    channel_statistics,
    held_out_rows,
    load_cifar100,
    load_folder,
    load_npz,
    load_unlabeled,
    relabeled,
)
from train.device import MixedPrecision, choose_device, choose_precision, choose_threads, set_deterministic
from train.loop import Trainer, evaluate
from train.networks import (
    CLASSIFIER,
    PYTHON,
    WEIGHTS,
    build_network,
    describe,
    export,
    load_initial,
    start_from,
    without_normalization,
)
from train.photographs.folder import find_photographs, load_photographs, require_outside
from train.photographs.metrics import METRICS, find_metric
from train.photographs.predictions import BATCH, Model, compute_logits
from train.photographs.scoring import evaluate_photographs, format_summary
from train.processes import first_process_first
from train.recipe import freeze
from train.rendered_shapes import load_shapes
from train.run_folder import BEFORE, RunLog, remove_run, require_same_run, write_config
from train.settings import OTHER, SMALLEST_SIZE, ExperimentSettings, chosen_rasterizer, keyed

Base = tuple[Path, dict[str, Any]] | None  # the network to begin with, as `load_initial` gives it
Predict = Callable[[torch.Tensor], torch.Tensor]
UNLABELED = "unlabelled"  # data whose labels are the answers of the network begun with
SIZE = 32  # of the images of a folder, where neither data.size nor the network begun with says
SAMPLED = 1000  # images whose channels are measured where they are on disk
VALIDATION = 0.1  # of every class's images, where neither data.validation nor the network begun with says


def prepare(settings: ExperimentSettings, data: DataSet, folder: Path, command: str = "") -> Callable[[], dict]:
    """Begin a run of one arm: all that comes before the first epoch, where wrong input shows.

    Returns a function that trains, and returns the scores that it writes. command: as it was given, to be recorded.
    """
    base = _initial(settings)
    if settings.data.name == UNLABELED and not (base and settings.train.distillation):
        missing = "set train.init_from and train.distillation"
        raise InputError(f"data={UNLABELED}: a network keeps its answers on it: {missing}")
    architecture = base[1]["architecture"] if base else {}
    if settings.data.name == UNLABELED:
        data = replace(data, classes=tuple(architecture["classes"]))
    elif base and (settings.data.name == "shapes" or CLASSIFIER in architecture):
        data = relabeled(data, architecture["classes"], f"data={settings.data.name}")
    for name, photographs in settings.evaluate.folders.items():
        require_outside(folder / name, photographs)
        find_photographs(photographs, data.classes, settings.label)
    set_deterministic(settings.train.deterministic)
    anew = settings.overwrite and not settings.train.resume
    threads, begun = settings.train.threads, checkpoint.exists(folder) and not anew
    if begun and not settings.train.resume:
        advice = "set train.resume=true to go on or overwrite=true to begin anew, or choose another run"
        raise InputError(f"run={folder} holds a run already: {advice}")
    if begun:
        before = require_same_run(folder, settings)
        recorded = OmegaConf.select(before, "hardware.threads")
        threads = threads or (recorded if isinstance(recorded, int) and recorded > 0 else None)
    fraction, left_out = _validation(settings, data.train, base)
    held_out = held_out_rows(data.train, fraction, seed=0)
    trainer = build_trainer(settings, data, folder, base, left_out, threads)
    threads = torch.get_num_threads()
    if begun:
        trainer.resume()
        epochs, planned = settings.train.epochs, before.train.epochs
        if epochs != planned and not settings.train.soup:  # each of whose epochs has the whole schedule
            rates = [settings.train.rate(trainer.epoch / count) for count in (epochs, planned)]
            stretched = f"train.epochs={epochs}, not {planned}, stretches train.schedule={settings.train.schedule}"
            console.warning("%s: the learning rate goes on at %.3g, not %.3g", stretched, *rates)
    elif settings.train.resume:
        console.info("nothing to resume in %s; starting at epoch 1", folder)
    if utils.rank() == 0:
        if anew:
            remove_run(folder)
        hardware = {"device": str(trainer.device), "precision": trainer.model.precision, "threads": threads}
        write_config(folder, settings, hardware=hardware, command=command, test_images=_test_images(settings, data))

    def train_and_score() -> dict[str, float]:
        torch.set_num_threads(threads)  # of this run, after others were prepared
        console.info(
            f"{(~held_out).sum()} images, {len(data.classes)} classes; {trainer.device}, {trainer.model.precision}, "
            f"threads: {threads}, processes: {utils.world_size()}"
        )
        log, labeled = None if utils.rank() else RunLog(folder, trainer.history), data
        before: dict[str, float] = {}
        if trainer.initial:
            predict = _initial_predictor(settings, trainer)
            answers = _answers(predict, trainer, data.test)
            answered = Split(data.test.images, answers)
            if settings.data.name == UNLABELED:
                labels = data.train.labels.clone()  # of the others, the loss asks the teacher
                labels[held_out] = _answers(predict, trainer, data.train[held_out])
                labeled = DataSet(data.classes, Split(data.train.images, labels), answered)
            if utils.rank() == 0:
                before = _scores_before(settings, trainer, labeled, predict, answers)
        trainer.fit(labeled.train.to(trainer.device), held_out, log)
        scores = before | _test_scores(trainer, labeled, _test_images(settings, data))
        if CLASSIFIER in trainer.architecture:
            kept = scores["test/accuracy"]
            if labeled is data:
                kept = evaluate(trainer.selected, answered.to(trainer.device))["accuracy"]
            scores["test/agreement"] = kept
            name, count = settings.train.init_from, len(data.test)
            console.info("agreement with %s on %d held-out images: %.4f", name, count, kept)
            if log:
                export(folder / WEIGHTS, trainer.selected.network)
                console.info("network.load_state_dict(torch.load(%r)) loads the result", str(folder / WEIGHTS))
        summaries = _score_photographs(settings, trainer.selected, data, folder, trainer.device)
        for name, summary in summaries.items():
            console.info("%s: %s", name, format_summary(summary))
            parts = {name: summary} | {f"{name}/{label}": part for label, part in summary.get("by_label", {}).items()}
            for key, part in parts.items():
                metrics = {metric: find_metric(part, metric).get("value") for metric in ("top5", *METRICS)}
                scores |= {f"{key}/{metric}": value for metric, value in metrics.items() if value is not None}
        if log:
            log.scalars(scores)
        return scores

    return train_and_score


def load_data(settings: ExperimentSettings) -> DataSet:
    """The data set that `settings.data` names; InputError naming a key where it cannot be had."""
    data, cache = settings.data, TensorCache(cache_folder(settings.train.cache))
    skip = settings.evaluate.skip_unreadable

    def size() -> int:
        base = None if data.size else _initial(settings)
        return data.size or (base[1]["architecture"]["size"] if base else SIZE)

    loaders = {
        "cifar100": lambda: load_cifar100(data.path),
        "npz": lambda: load_npz(data.path),
        "folder": lambda: load_folder(data.path, size(), data.test_fraction, skip, data.workers),
        UNLABELED: lambda: load_unlabeled(data.path, size(), data.test_fraction, skip, data.workers),
        "shapes": lambda: load_shapes(data.train_per_class, data.test_per_class, size(), data.seed, cache),
    }
    require_choice("data.name", data.name, loaders)
    console.info("data: %s", data.name)
    with first_process_first():
        loaded = loaders[data.name]()
    with keyed("data.path"):
        require_range("image size", loaded.size, SMALLEST_SIZE, LARGEST_SIZE)
    return loaded


def _initial(settings: ExperimentSettings) -> Base:
    init_from = settings.train.init_from
    return load_initial(init_from, settings.weights, settings.data.size) if init_from else None


def _answers(predict: Predict, trainer: Trainer, split: Split) -> torch.Tensor:
    """(N,) the classes that the network begun with gives."""
    batches, classes = torch.arange(len(split)).split(BATCH), len(trainer.architecture["classes"])
    images = progress(split.squares(batches), "predictions", len(batches))
    logits = [compute_logits(predict, batch, classes, trainer.device) for batch in images]
    return torch.cat(logits).argmax(1)


def _validation(settings: ExperimentSettings, split: Split, base: Base) -> tuple[float, dict[str, Any] | None]:
    """The fraction of the training images to validate on, and what to store as the part that no weight learned from:
    the smallest along its ancestors, since parts of one seed are nested, or None where `base` does not know its own."""
    asked, init_from = settings.data.validation, settings.train.init_from
    most = HELD_OUT / len(split) if settings.data.name == UNLABELED else 1.0
    fraction = min(VALIDATION, most) if asked is None else asked
    rendered = {"data": "shapes"} if settings.data.name == "shapes" else {}
    own = {"fraction": fraction, "seed": 0, "images": split.content_hash, **rendered}
    if base is None:
        return fraction, own
    stored = base[1]["architecture"].get("validation")
    known = stored.get("fraction") if isinstance(stored, dict) else None
    if rendered and known is not None and "data" not in stored:  # it learned from other images than rendered ones
        return fraction, own
    if not isinstance(known, float) or own | {"fraction": known} != stored:
        console.info("validation: %s does not say whether it learned from these images, too", init_from)
        return fraction, None
    fraction = known if asked is None else asked
    if fraction > known:
        console.info("validation: %s learned from part of it: it left out only data.validation=%s", init_from, known)
    return fraction, own | {"fraction": min(fraction, known)}


def build_trainer(
    settings: ExperimentSettings, data: DataSet, folder: Path, base: Base, left_out: dict | None, threads: int | None
) -> Trainer:
    """The run's network, optimizer and scene, ready for `Trainer.fit`; nothing is written before.

    left_out: the part that validates the network, stored with it. threads: None for those of `choose_threads`.
    """
    device, shape = choose_device(settings.train.device), settings.model.shape
    foreign = bool(base and CLASSIFIER in base[1]["architecture"])
    if base and foreign:
        name = base[1]["architecture"]["name"]
        if shape.get("name", name) != name:
            raise InputError(f"model={shape['name']}: train.init_from={base[0]} has its own network: leave it out")
        shape = {"name": name, CLASSIFIER: True}
    images = data.train.images
    mean, std = channel_statistics(images if isinstance(images, torch.Tensor) else data.train.sample(SAMPLED))
    torch.manual_seed(stream_seed(settings.seed, "weights"))
    network = build_network(data.classes, data.size, mean=mean, std=std, **shape)
    facts = {"classes": list(data.classes), "size": data.size, "encoding": settings.renderer.encoding, **shape}
    if base:
        start_from(network, facts, *base)
    if settings.train.freeze:
        freeze(without_normalization(network), settings.train.freeze)
    model = MixedPrecision(network.to(device), choose_precision(settings.train.precision, device, network))
    torch.set_num_threads(threads or choose_threads(model, settings.train.batch_size, data.size))
    service = build_service(settings, data, device)
    labeled, recipe = settings.data.name != UNLABELED, settings.train
    if recipe.eval_mode is None:
        recipe = replace(recipe, eval_mode=foreign)
    return Trainer(recipe, model, describe(network, **facts, validation=left_out), service, folder, labeled)


def build_service(settings: ExperimentSettings, data: DataSet, device: torch.device) -> AugmentationService:
    """The scene, its labels and the service that regenerates its renders; logs the rasterizer."""
    scene, images, labels = None, None, torch.zeros(0, dtype=torch.int64, device=device)
    phases, process = Phases(device), (utils.rank(), utils.world_size())
    names = label_names(settings.label)
    ranks = bool(settings.scene.hard_negatives) or len(names) > 1
    studied = [class_index(data.classes, name, "label") for name in names if ranks or settings.augment.renders]
    if settings.augment.renders and settings.augment.arm == "folder":
        images, labels = (part.to(device) for part in load_renders(settings, data))
        ranks = len(labels.unique()) > 1
    elif settings.augment.renders:
        objects = settings.objects
        named = {item.label: key for key, item in objects.items() if item.label != OTHER}
        numbers = {name: class_index(data.classes, name, f"label of {key}") for name, key in named.items()}
        numbers[OTHER] = complementary_label(studied[0])  # the service and the loss know the others
        rasterizer = chosen_rasterizer(settings.renderer)
        console.info("rasterizer: %s", rasterizer.description)
        options: dict[str, Any] = {"scene": settings.scene, "renderer": settings.renderer, "rasterizer": rasterizer}
        with phases("operators"), first_process_first(), keyed("scene", vars(settings.scene)):
            options |= {"attack": settings.augment.attack, "vary": settings.augment.vary}
            scene = build_scene(list(objects.values()), data.size, settings.views, **options, device=device)
        labels = torch.tensor([numbers[name] for name in scene.labels], device=device)
    if len(studied) == len(data.classes) and (labels < 0).any():
        raise InputError(f"label={settings.label} leaves no class of the network for other things: leave these out")
    towards = studied if ranks else ()
    return AugmentationService(settings.augment, scene, labels, settings.seed, phases, towards, *process, images)


def load_renders(settings: ExperimentSettings, data: DataSet) -> tuple[torch.Tensor, torch.Tensor]:
    """The images (N, 3, size, size) uint8 of the folder `augment.folder`, and their labels (N,) by the names of its
    folders. InputError: as `find_photographs` and `load_photographs`, or no image of a class under study."""
    folder, studied = Path(str(settings.augment.folder)), label_names(settings.label)
    with keyed("augment.folder"):
        found = find_photographs(folder, data.classes, studied)
        found, images, _ = load_photographs(folder, found, data.size, advice="")
        numbers = {name: index for index, name in enumerate(data.classes)}
        foreign = complementary_label(numbers[studied[0]])
        labels = torch.tensor([numbers.get(item.label, foreign) for item in found])
        if missing := set(studied) - {item.label for item in found}:
            raise InputError(f"{folder} holds no image of label={min(missing)}: add a folder of them")
    return images, labels


def _test_images(settings: ExperimentSettings, data: DataSet) -> str:
    """What the test accuracy is of, in words."""
    if settings.data.name == UNLABELED:
        return f"the answers of {settings.train.init_from} to held-out photographs"
    kind = "rendered solids" if settings.data.name == "shapes" else f"the test images of {settings.data.name}"
    others = len(data.classes) - len(data.train.labels.unique())  # the test's labels are looked at once, later
    return f"{kind}, not of the network's {others} other classes" if others else kind


def _initial_predictor(settings: ExperimentSettings, trainer: Trainer) -> Predict:
    """The network begun with, whose logits are cached under a hash of weights and images, for all runs."""
    model, device = cast(MixedPrecision, trainer.initial), trainer.device
    is_foreign = settings.model.name.startswith(PYTHON)  # whose code may change unseen
    cache = TensorCache(None if is_foreign else cache_folder(settings.train.cache))
    key = checkpoint.content_hash([torch.__version__, str(model), model.precision, str(device), model.state_dict()])

    def predict(images: torch.Tensor) -> torch.Tensor:
        batch = checkpoint.content_hash([key, images])
        if (stored := cache.read(batch)) is None:
            stored = {"logits": model(images).cpu().contiguous()}
            cache.write(batch, stored)
        return stored["logits"]

    return predict


def _scores_before(
    settings: ExperimentSettings, trainer: Trainer, data: DataSet, predict: Predict, answers: torch.Tensor
) -> dict[str, float]:
    """Score the network of train.init_from by its answers (N,) to the test set and, in the folder BEFORE, on the
    photographs."""
    accuracy = (answers == data.test.labels).float().mean().item()
    if settings.data.name != UNLABELED:  # whose labels are these answers
        images = _test_images(settings, data)
        console.info("before: %s has accuracy %.4f on %s", settings.train.init_from, accuracy, images)
    _score_photographs(settings, predict, data, trainer.folder / BEFORE, trainer.device)
    return {"test/accuracy_before": accuracy}


def _test_scores(trainer: Trainer, data: DataSet, images: str) -> dict[str, float]:
    """The one look at the test set: the last epoch's network and the selected one, which stays loaded."""
    test = data.test.to(trainer.device)
    last = selected = evaluate(trainer.selected, test)["accuracy"]
    best = checkpoint.load(trainer.folder / checkpoint.BEST)
    if best["epoch"] != trainer.epoch:
        trainer.selected.network.load_state_dict(best["model"])
        selected = evaluate(trainer.selected, test)["accuracy"]
    console.info("accuracy %.4f (epoch %d, selected), %.4f (the last) on %s", selected, best["epoch"], last, images)
    return {"test/accuracy": selected, "test/accuracy_last": last, "test/epoch": best["epoch"]}


def _score_photographs(
    settings: ExperimentSettings, model: Model, data: DataSet, folder: Path, device: torch.device
) -> dict[str, Any]:
    """Score a model on each folder of photographs, in a sub-folder of its name; the summaries of the first process."""
    label, skip = settings.label, settings.evaluate.skip_unreadable
    return {
        name: evaluate_photographs(model, data.classes, photographs, label, folder / name, data.size, skip, device)
        for name, photographs in settings.evaluate.folders.items()
        if utils.rank() == 0
    }
