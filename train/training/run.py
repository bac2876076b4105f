"""One training run, from its settings to its scores.

`load_runs` makes and loads runs. Then `fit`, `score` and `export` are called in
this order.
"""

import json
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from augment import distributed
from augment.classifiers.adapter import (
    light_settings,
    unwrapped,
    with_normalized_light,
    without_normalized_light,
)
from augment.progress import progress
from augment.random_streams import stream_seed
from renderer.errors import InputError
from train import console
from train.class_names import class_name
from train.data.cache import TensorCache, cache_folder
from train.data.photographs import DESCRIPTION, find_photographs, require_outside
from train.data.sets import DataSet, Split, channel_statistics, held_out_rows, relabeled
from train.evaluation.laboratory.kept_aside import kept_aside_settings
from train.evaluation.laboratory.laboratory import write_laboratory
from train.evaluation.scores.metrics import METRICS
from train.evaluation.scores.predictions import BATCH, Model, Predictor, compute_logits
from train.evaluation.scores.scoring import Scores, evaluate_photographs, format_scores
from train.networks import CLASSIFIER, PYTHON, build_network, describe
from train.runs import checkpoint
from train.runs.run_config import require_same_run, write_config
from train.runs.run_log import BEFORE, RunLog, remove_run
from train.runs.saved_networks import NORMALIZE_LIGHT, WEIGHTS, export
from train.settings import KEPT_ASIDE, LABORATORY, ExperimentSettings, label_names
from train.system.device import (
    MixedPrecision,
    choose_device,
    choose_precision,
    choose_threads,
    set_deterministic,
)
from train.system.user_errors import keyed, keys_of
from train.training.data import load_data
from train.training.initial import (
    CachedModel,
    Initial,
    ValidationPart,
    choose_validation,
    load_initial,
)
from train.training.interpolation import (
    INTERPOLATION,
    agreement,
    interpolate,
    predict,
)
from train.training.loop import Trainer, evaluate
from train.training.recipe import freeze, learning_rate
from train.training.renders import build_service

# If the images are on disk, `build_trainer` measures the mean and the standard
# deviation of the channels on this many images.
SAMPLED = 1000


class Run:
    """One training run: its data, its network, its folder and its scores.

    The steps are called in this order: `load`, `fit`, `score`, `export`. Wrong
    input raises an error in `load`, so that several runs can be checked before
    the first of them trains.

    Args:
        settings: Settings of the run.
        data: Data set of the run.
        folder: Folder that the run writes to.
        initial: Network with whose weights the run begins. None for random
            weights.
        command: Command that was given. The run records it.
    """

    trainer: Trainer
    log: RunLog | None
    held_out: Tensor

    def __init__(
        self,
        settings: ExperimentSettings,
        data: DataSet,
        folder: Path,
        initial: Initial | None = None,
        command: str = "",
    ):
        self.settings = settings
        self.data = data
        self.folder = folder
        self.initial = initial
        self.command = command
        self._scores: dict[str, float] = {}
        # The folders of photographs and renders on which the networks are scored.
        self.scored_folders = settings.evaluate.folders
        # The threads that the run trains with.
        self._threads = 1
        # The classes that the initial network gives the test images, shape (N,).
        self._initial_predictions: Tensor | None = None

    def load(self) -> None:
        """Check the inputs, build the network and its renders, and restore a checkpoint if asked.

        Raises:
            InputError: If the settings, the data, the folder or its checkpoint
                are wrong.
        """
        settings = self.settings
        # The labels of the data become indices into the classes of the network.
        self.data = _data_for(settings, self.data, self.initial)
        for name, photographs in settings.evaluate.folders.items():
            require_outside(self.folder / name, photographs)
            _require_names(settings, self.data)
            find_photographs(photographs, self.data.classes, settings.label)
        set_deterministic(settings.train.deterministic)
        # The settings of the run that is resumed. None for a new run.
        before = self._require_folder()
        part = choose_validation(settings, self.data, self.initial)
        with keyed(fraction="data.validation"):
            self.held_out = held_out_rows(self.data.train, part.fraction, seed=0)
        self.trainer = build_trainer(
            settings,
            self.data,
            self.folder,
            self.initial,
            part,
            self._asked_threads(before),
        )
        self._threads = torch.get_num_threads()
        if before is not None:
            self.trainer.resume()
            self._warn_of_stretched_schedule(before.train.epochs)
        elif settings.train.resume:
            console.info("nothing to resume in %s; starting at epoch 1", self.folder)
        if distributed.rank() == 0:
            self._write_config()

    def fit(self) -> None:
        """Score the initial network, if there is one, and train to the last epoch."""
        torch.set_num_threads(self._threads)  # Other runs may have been loaded since.
        console.debug(
            "%d images, %d classes; %s, %s, threads: %d, processes: %d",
            (~self.held_out).sum(),
            len(self.data.classes),
            self.trainer.device,
            self.trainer.model.precision,
            self._threads,
            distributed.world_size(),
        )
        is_first = distributed.rank() == 0
        self.log = RunLog(self.folder, self.trainer.history) if is_first else None
        if is_first:
            self._render_kept_aside()
        if self.trainer.initial:
            self._score_initial(self.trainer.initial)
        split = self.data.train.to(self.trainer.device)
        with keyed(**keys_of("train", self.settings.train)):
            self.trainer.fit(split, self.held_out, self.log)

    def score(self) -> dict[str, float]:
        """Score the selected network on the test images and the photographs, once.

        Returns:
            The scores by name, which are also the last line of metrics.jsonl.
        """
        trainer = self.trainer
        self._scores |= self._test_scores()
        if self._initial_predictions is not None and CLASSIFIER in trainer.architecture:
            self._scores["test/agreement"] = self._agreement(self._initial_predictions)
        if trainer.initial and self.settings.train.consistency_weight:
            self._scores |= self._relit_scores(trainer.initial)
        if self.log:
            for name in self.scored_folders:
                scores = self._score_photographs(trainer.selected, name, self.folder)
                console.debug("%s: %s", name, format_scores(scores))
                self._scores |= _photograph_scores(name, scores)
            self.log.scalars(self._scores)
        return self._scores

    def export(self) -> None:
        """Write the weights of a pretrained classifier in the format in which they were loaded."""
        if self.log and CLASSIFIER in self.trainer.architecture:
            path = self.folder / WEIGHTS
            export(path, self.trainer.selected.network)
            network = "network"
            name = self.trainer.architecture["name"]
            if name.startswith(PYTHON):
                # The weights have their names in the network that the function returns.
                function = name.removeprefix(PYTHON).replace(":", ".")
                network = f"{function}()[0]"
            console.info("%s.load_state_dict(torch.load(%r)) loads the result", network, str(path))
            light = light_settings(self.trainer.selected.network)
            if light is not None:
                given = json.dumps(asdict(light))
                console.info("it needs normalized light before it: normalize_light=%s", given)

    def _require_folder(self) -> DictConfig | None:
        """Check that the run may write to its folder.

        Returns:
            Settings of the run in the folder that is resumed. None for a new
            run.

        Raises:
            InputError: If the folder holds a run, and the settings neither
                resume it nor allow to overwrite it.
        """
        resumes = self.settings.train.resume
        begins_anew = self.settings.overwrite and not resumes
        if begins_anew or not checkpoint.exists(self.folder):
            return None
        if not resumes:
            raise InputError(
                f"run={self.folder} holds a run already: "
                "set train.resume=true to go on or overwrite=true to begin anew, "
                "or choose another run",
            )
        return require_same_run(self.folder, self.settings)

    def _asked_threads(self, before: DictConfig | None) -> int | None:
        """Return the number of threads that the run should train with.

        A resumed run keeps its number of threads unless the settings give one,
        because the number changes the last bits of sums.

        Args:
            before: Settings of the run that is resumed. None for a new run.

        Returns:
            The number. None if it is still to be chosen.
        """
        asked = self.settings.train.threads
        if asked or before is None:
            return asked
        recorded = OmegaConf.select(before, "hardware.threads")
        return recorded if isinstance(recorded, int) and recorded > 0 else None

    def _warn_of_stretched_schedule(self, planned: int) -> None:
        """Warn if a new number of epochs changes the learning rate of a resumed run.

        Args:
            planned: Number of epochs that the run had before it was stopped.
        """
        recipe = self.settings.train
        # Each epoch of a soup runs through the whole schedule, so that the number of
        # epochs does not change it.
        if recipe.epochs == planned or recipe.soup:
            return
        rate = learning_rate(recipe, self.trainer.epoch / recipe.epochs)
        rate_before = learning_rate(recipe, self.trainer.epoch / planned)
        change = f"train.epochs={recipe.epochs}, not {planned}"
        console.warning(
            "%s, stretches train.schedule=%s: the learning rate goes on at %.3g, not %.3g",
            change,
            recipe.schedule,
            rate,
            rate_before,
        )

    def _write_config(self) -> None:
        """Write the settings and the facts of the run into its folder."""
        if self.settings.overwrite and not self.settings.train.resume:
            remove_run(self.folder)
        hardware = {
            "device": str(self.trainer.device),
            "precision": self.trainer.model.precision,
            "threads": self._threads,
        }
        write_config(
            self.folder,
            self.settings,
            hardware=hardware,
            command=self.command,
            test_images=describe_test_images(self.settings, self.data),
        )

    def _score_initial(self, model: MixedPrecision) -> None:
        """Score the initial network on the test images and the photographs.

        If the data have no labels, the predictions of the initial network become
        the labels of the test images and of the images that validate.

        Args:
            model: The initial network.
        """
        settings = self.settings
        # The code of a foreign function may change unseen, so its logits are not stored.
        is_foreign = settings.model.name.startswith(PYTHON)
        cache = TensorCache(None if is_foreign else cache_folder(settings.train.cache))
        predict = CachedModel(model, self.trainer.device, cache)
        test = self.data.test
        self._initial_predictions = self._predicted_classes(predict, test)
        if not self.data.labeled:
            # The images that the network learns from need no labels here. The
            # loss computes the predictions of the initial network for them.
            labels = self.data.train.labels.clone()
            held_out = self.data.train[self.held_out]
            labels[self.held_out] = self._predicted_classes(predict, held_out)
            train = Split(self.data.train.images, labels)
            test = Split(test.images, self._initial_predictions)
            self.data = replace(self.data, train=train, test=test)
        if distributed.rank() > 0:
            return
        accuracy = (self._initial_predictions == test.labels).float().mean().item()
        if self.data.labeled:
            images = describe_test_images(settings, self.data)
            begun = settings.train.init_from
            console.debug("before: %s has accuracy %.4f on %s", begun, accuracy, images)
        for name in self.scored_folders:
            self._score_photographs(predict, name, self.folder / BEFORE)
        self._scores["test/accuracy_before"] = accuracy

    def _render_kept_aside(self) -> None:
        """Render test images of other instances and patterns than those of the training.

        Nothing is rendered if the settings name photographs, if they ask for no
        renders, or if a resumed run has rendered them already.
        """
        if self.scored_folders or not self.settings.evaluate.laboratory_setups:
            return
        folder = self.folder / KEPT_ASIDE
        is_complete = self.settings.train.resume and (folder / DESCRIPTION).exists()
        if not is_complete:
            classes = self.data.classes
            settings = kept_aside_settings(self.settings, classes, self.data.size, folder)
            try:
                write_laboratory(settings)
            except InputError as error:
                console.warning("no renders are kept aside: %s", error)
                return
        self.scored_folders = {LABORATORY: folder}

    def _predicted_classes(self, model: Model, split: Split) -> Tensor:
        """Predict the class of each image of a split.

        Args:
            model: Network, from images in [0, 1] to logits.
            split: N images.

        Returns:
            Index of the class with the largest logit, int64, shape (N,).
        """
        batches = torch.arange(len(split)).split(BATCH)
        count = len(self.trainer.architecture["classes"])
        classes = [
            compute_logits(model, images, count, self.trainer.device).argmax(1)
            for images in progress(split.squares(batches), "predictions", len(batches))
        ]
        return torch.cat(classes)

    def _test_scores(self) -> dict[str, float]:
        """Compute the test accuracy of the last network and of the selected network.

        The selected network is the one in best.pt. Afterwards,
        `self.trainer.selected` has its weights.

        Returns:
            "test/accuracy" of the selected network, "test/accuracy_last" of the
            last network, "test/epoch" with the epoch of the selected network
            and, if it was interpolated, "test/interpolation" with the factor.
        """
        trainer = self.trainer
        test = self.data.test.to(trainer.device)
        last = evaluate(trainer.selected, test)["accuracy"]
        selected = last
        best = checkpoint.load(self.folder / checkpoint.BEST)
        if self.settings.train.interpolate:
            best = self._interpolated(best)
        if best["epoch"] != trainer.epoch or INTERPOLATION in best:
            trainer.selected.network.load_state_dict(best["model"])
            selected = evaluate(trainer.selected, test)["accuracy"]
        console.debug(
            "accuracy %.4f (epoch %d, selected), %.4f (the last) on %s",
            selected,
            best["epoch"],
            last,
            describe_test_images(self.settings, self.data),
        )
        scores = {
            "test/accuracy": selected,
            "test/accuracy_last": last,
            "test/epoch": best["epoch"],
        }
        if INTERPOLATION in best:
            scores["test/interpolation"] = best[INTERPOLATION]
        return scores

    def _interpolated(self, best: dict[str, Any]) -> dict[str, Any]:
        """Interpolate between the initial and the trained weights, and write best.pt.

        Nothing changes if best.pt holds interpolated weights already, because
        the run was stopped after this step.

        Args:
            best: Checkpoint in best.pt.

        Returns:
            Copy of the checkpoint with the interpolated weights and their
            factor.
        """
        trainer = self.trainer
        if INTERPOLATION in best or trainer.initial is None:
            return best
        validation = self.data.train[self.held_out]
        recipe = self.settings.train
        weights, factor = interpolate(
            trainer.initial,
            trainer.selected,
            best["model"],
            validation,
            self.settings.seed,
            (recipe.distillation_weight or 1.0, recipe.consistency_weight or 1.0),
        )
        interpolated = best | {"model": weights, INTERPOLATION: factor}
        if distributed.rank() == 0:
            checkpoint.save(self.folder / checkpoint.BEST, interpolated)
        return interpolated

    def _agreement(self, initial_predictions: Tensor) -> float:
        """Compute how often the selected network predicts the class of the initial network.

        Args:
            initial_predictions: Class that the initial network predicts for each
                test image, shape (N,).

        Returns:
            Fraction of the test images, in [0, 1].
        """
        # The labels of unlabeled data are the predictions of the initial network,
        # so the accuracy is the agreement.
        agreement = self._scores["test/accuracy"]
        if self.data.labeled:
            answered = Split(self.data.test.images, initial_predictions).to(self.trainer.device)
            agreement = evaluate(self.trainer.selected, answered)["accuracy"]
        console.debug(
            "agreement with %s on %d held-out images: %.4f",
            self.settings.train.init_from,
            len(initial_predictions),
            agreement,
        )
        return agreement

    def _relit_scores(self, initial: MixedPrecision) -> dict[str, float]:
        """Compare predictions for relit test images with those for unchanged images.

        The reference is always the class that the initial network predicts for
        the unchanged image.

        Args:
            initial: Network before the training.

        Returns:
            Three fractions of the test images whose predicted class is that of
            the reference:

            - "test/agreement": selected network, unchanged images;
            - "test/relit_agreement_before": initial network, relit images;
            - "test/relit_agreement_after": selected network, relit images.
        """
        test = self.data.test
        wanted = predict(initial, test)
        scores = {"test/agreement": agreement(predict(self.trainer.selected, test), wanted)}
        for name, model in (("before", initial), ("after", self.trainer.selected)):
            predicted = predict(model, test, self.settings.seed, "test")
            scores[f"test/relit_agreement_{name}"] = agreement(predicted, wanted)
        console.info(
            "agreement with the original on %d photographs kept aside: unchanged %.3f; "
            "in the light of a projector %.3f before, %.3f after",
            len(test),
            *scores.values(),
        )
        return scores

    def _score_photographs(self, model: Model, name: str, folder: Path) -> Scores:
        """Score a model on one of the folders of photographs of this run.

        Args:
            model: Network, from images in [0, 1] to logits.
            name: Key of the folder of photographs in `self.scored_folders`.
            folder: The scores are written to the sub-folder `name` of this
                folder.

        Returns:
            The scores, as they are written.
        """
        asked = self.settings.evaluate
        return evaluate_photographs(
            Predictor(model, self.data.classes, self.data.size, self.trainer.device),
            self.scored_folders[name],
            self.settings.label,
            folder / name,
            asked.skip_unreadable,
        )


def load_runs(methods: Mapping[Path, ExperimentSettings], command: str) -> list[Run]:
    """Load runs with the same data set and the same initial network.

    All runs are loaded before the first one is trained, so that a mistake in
    any of them is reported at once.

    Args:
        methods: Settings of each run by its folder. They agree in the data set
            and in the initial network.
        command: Command that was given, which each run records.

    Returns:
        Runs that are ready for `Run.fit`.

    Raises:
        InputError: If the data set, the initial network, the settings or a
            folder cannot be used.
    """
    shared_settings = next(iter(methods.values()))
    initial = load_initial(shared_settings)
    data = load_data(shared_settings, initial)
    runs = [Run(settings, data, folder, initial, command) for folder, settings in methods.items()]
    for run in runs:
        run.load()
    return runs


def _require_names(settings: ExperimentSettings, data: DataSet) -> None:
    """Raise InputError if the label is the index of a class instead of its name.

    Scores on photographs know classes only by name.
    """
    for name in label_names(settings.label):
        known = class_name(data.classes, name, "label")
        if known != name:
            raise InputError(f"label={name} is an index: give the name, label={known}", "label")


def _data_for(settings: ExperimentSettings, data: DataSet, initial: Initial | None) -> DataSet:
    """Return a copy of the data whose labels are indices into the classes of the network.

    Args:
        settings: Settings of the run.
        data: Data set as it was loaded.
        initial: Network that the run begins with. None for random weights.

    Returns:
        The data set. If the data have no labels, only its classes change. With
        random weights, the data set stays the same.

    Raises:
        InputError: If the data have no labels and the run has no network to
            imitate, or if the network lacks a class of the data.
    """
    if not data.labeled:
        if not (initial and settings.train.distillation_weight):
            missing = "set train.init_from and train.distillation_weight"
            problem = (
                f"data.name={settings.data.name} has no labels, and requires a network to imitate"
            )
            raise InputError(f"{problem}: {missing}")
        return replace(data, classes=initial.classes)
    if initial and (data.rendered or initial.is_classifier):
        return relabeled(data, initial.classes, f"data.name={settings.data.name}")
    return data


def build_trainer(
    settings: ExperimentSettings,
    data: DataSet,
    folder: Path,
    initial: Initial | None,
    validation: ValidationPart,
    threads: int | None,
) -> Trainer:
    """Build a run's network, optimizer and scene. Nothing is written.

    Args:
        settings: The settings of the run.
        data: The data, in the classes of the network.
        folder: The folder of the run.
        initial: The network that the run begins with, if any.
        validation: The images that validate the network, whose record is stored with it.
        threads: The number of threads; None for `choose_threads`.

    Returns:
        The trainer, ready for `Trainer.fit`.

    Raises:
        InputError: If the network, the renders or the initial weights do not fit together.
    """
    keys = keys_of("train", settings.train)
    with keyed(**keys):
        device = choose_device(settings.train.device)
    shape = _network_shape(settings, initial)
    images = data.train.images
    if not isinstance(images, Tensor):
        images = data.train.sample(SAMPLED)
    mean, std = channel_statistics(images)
    torch.manual_seed(stream_seed(settings.seed, "weights"))
    if initial and initial.network is not None:
        network = deepcopy(initial.network).requires_grad_(True)
    else:
        with keyed(**keys_of("model", settings.model)):
            network = build_network(data.classes, data.size, mean=mean, std=std, **shape)
    facts = {
        "classes": list(data.classes),
        "size": data.size,
        "encoding": settings.renderer.encoding,
        **shape,
    }
    if initial:
        initial.copy_to(network, facts)
    light = settings.normalize_light or (initial.normalize_light if initial else None)
    if light is not None:
        facts[NORMALIZE_LIGHT] = light
        network = with_normalized_light(network, light)
    if settings.train.freeze:
        with keyed(stage="train.freeze"):
            freeze(unwrapped(network), settings.train.freeze)
    with keyed(**keys):
        precision = choose_precision(settings.train.precision, device, network)
    model = MixedPrecision(network.to(device), precision)
    torch.set_num_threads(threads or choose_threads(model, settings.train.batch_size, data.size))
    recipe = settings.train
    if recipe.eval_mode is None:
        recipe = replace(recipe, eval_mode=bool(initial and initial.is_classifier))
    description = describe(without_normalized_light(network), **facts, validation=validation.record)
    service = build_service(settings, data, device)
    with keyed(**keys):
        return Trainer(recipe, model, description, service, folder, data.labeled)


def _network_shape(settings: ExperimentSettings, initial: Initial | None) -> dict[str, Any]:
    """Return the arguments of `build_network` by name.

    Args:
        settings: Settings of the run. Without an initial classifier, they
            decide.
        initial: Network that the run begins with. None for random weights.

    Raises:
        InputError: If the settings name another network than the initial
            classifier.
    """
    shape = settings.model.shape
    if initial is None or not initial.is_classifier:
        return shape
    if shape.get("name", initial.name) != initial.name:
        raise InputError(
            f"model.name={shape['name']}: "
            f"train.init_from={initial.source} has its own network: "
            "leave it out",
        )
    return {"name": initial.name, CLASSIFIER: True}


def describe_test_images(settings: ExperimentSettings, data: DataSet) -> str:
    """Name the images on which the test accuracy is measured.

    Args:
        settings: Settings of a run.
        data: Data set of the run, with the classes of its network.

    Returns:
        Text such as "the test images of cifar100".
    """
    if not data.labeled:
        return f"the predictions of {settings.train.init_from} for held-out photographs"
    kind = "rendered solids" if data.rendered else f"the test images of {settings.data.name}"
    # The test images are read only at the end of the run, so the classes are
    # counted in the training images.
    class_count = len(data.train.labels.unique())
    if class_count == len(data.classes):
        return kind
    return f"{kind} of {class_count} of the network's {len(data.classes)} classes"


def _photograph_scores(name: str, scores: Scores) -> dict[str, float]:
    """Name the metrics of a folder of photographs as metrics.jsonl has them.

    Args:
        name: Name of the folder of photographs, such as "photographs".
        scores: Scores on these photographs.

    Returns:
        Values of the known metrics by names such as "photographs/auc" and, with
        several labels, "photographs/orange/auc".
    """
    parts = {name: scores.overall}
    for label, metrics in scores.by_label.items():
        parts[f"{name}/{label}"] = metrics
    values = {}
    for part, metrics in parts.items():
        for metric in ("top5", *METRICS):
            estimate = metrics.find(metric)
            if estimate is not None and estimate.value is not None:
                values[f"{part}/{metric}"] = estimate.value
    return values
