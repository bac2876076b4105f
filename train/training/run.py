"""One training run, from its settings to its scores."""

import json
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Int
from omegaconf import OmegaConf
from torch import Tensor, nn

from augment import distributed, exposure
from augment import network as wrappers
from augment.random_streams import stream_seed
from augment.switch import LIT_NAME
from augment.tasks.classification import Classification
from augment.tasks.detection import Detection
from renderer.errors import InputError, keyed, keys_of
from renderer.image import to_unit
from renderer.io.files import remove
from train import checkpoints, console
from train.data import photographs
from train.data.sets import DataSet, Split, channel_statistics, held_out_rows
from train.device import MixedPrecision, choose_threads, place
from train.laboratory.laboratory import is_laboratory, kept_aside_settings, write_laboratory
from train.networks import CLASSIFIER, build_network, describe
from train.results.metrics import METRICS
from train.results.overwrite import remove_run
from train.results.predictions import SUMMARY
from train.results.scoring import Model, Predictor, evaluate_photographs, format_scores
from train.run_config import CONFIG, require_same_run, require_same_weights, write_config
from train.run_folder import BEFORE, BEST, WEIGHTS, find_original
from train.settings import KEPT_ASIDE, LABORATORY, WIDERESNET, ExperimentSettings, in_light
from train.training import inputs
from train.training.averages import INTERPOLATION, interpolate, predict, weights_on_cpu
from train.training.loop import Trainer, evaluate
from train.training.recipe import freeze, scale_learning_rate
from train.training.recognition import fit_recognizer, recognizing_layers
from train.training.run_log import Logger, RunLog

# If the training images are on disk, the mean and the standard deviation of their color
# channels are estimated from this number of images.
SAMPLED = 1000
# Number of training images with which the norm of the features of a network is measured.
NORM_IMAGES = 16


@dataclass(eq=False)
class Run:
    """One training run, which trains a network and scores it.

    Wrong input raises an error when the run is made, so that several runs can be checked before
    the first one trains. Then `begin` and `train` are called.

    Attributes:
        data: Data set. Its labels become indices into the classes of the network.
        scored_folders: Folders of photographs or renders on which the networks are scored, by name.
        held_out: Whether each training image validates the network.
    """

    settings: ExperimentSettings
    data: DataSet
    initial: inputs.Initial | None
    folder: Path
    command: str = ""

    def __post_init__(self) -> None:
        """Check all inputs and build the network. If the run is resumed, restore its checkpoint."""
        settings, folder, initial = self.settings, self.folder, self.initial
        self.data = inputs.relabel(settings, self.data, initial)
        self._inputs = initial.inputs if initial else wrappers.FROM_DATA
        self.scored_folders = settings.scored_folders
        # Class that the initial network predicts for each test image, shape (N,). None
        # if it was not computed.
        self._initial_predictions: Tensor | None = None
        inputs.require_label(settings, self.data)
        data = settings.data
        is_folder = data.name == "folder" or not self.data.labeled
        trained = Path(data.path if self.data.labeled else str(settings.unlabeled)).resolve()
        if data.name == "folder" and (trained / "train").is_dir():
            trained /= "train"  # The images beside it, in "test", are not trained on.
        vary = settings.augment.vary
        for taken in filter(None, (is_folder and trained, vary.backgrounds, vary.camera.slides)):
            photographs.require_outside(folder, Path(str(taken)))
        for name, scored in self.scored_folders.items():
            real = scored.resolve()
            if is_folder and (real.is_relative_to(trained) or trained.is_relative_to(real)):
                fault = f"photos={scored} has images of {trained}, which is trained on"
                wrappers.say_once(f"{fault}: score other photographs")
            photographs.require_outside(folder / name, scored)
            with keyed("photos"):
                labels = photographs.choose_labels(scored, self.data.classes, settings.label)
                photographs.find_photographs(scored, self.data.classes, labels)
        # Settings of the run that is resumed. Empty for a new run.
        earlier = OmegaConf.create({})
        if checkpoints.exists(folder):
            if settings.train.resume:
                earlier = require_same_run(folder, settings)
            elif not settings.overwrite:
                advice = "set train.resume=true or overwrite=true, or another folder"
                raise InputError(f"out={folder} holds a run already: {advice}")
        self._is_resumed = bool(earlier)
        self._hashes = {"network": checkpoints.hash_weights(initial.weights)} if initial else {}
        names = {"network": f"network={settings.network}"}
        require_same_weights(folder, self._hashes, names, earlier)
        # The number of threads changes the last bits of the results, so a resumed run keeps it.
        threads = settings.train.threads or OmegaConf.select(earlier, "hardware.threads")
        fraction, record = inputs.choose_validation(settings, self.data, initial)
        with keyed(fraction="data.validation"):
            self.held_out = held_out_rows(self.data.train, fraction)
        with keyed(**keys_of("train", settings.train)):
            self.trainer = self._build_trainer(record, threads)
            if settings.train.recognize:
                recognizing_layers(self.trainer.model.network, self.data.size)
        # The scores compare the trained network with this one.
        self.before = self.trainer.initial
        original = find_original(folder, settings.network)
        if self.before and original:
            self.before = deepcopy(self.before)
            network = exposure.without_normalized_light(self.before.network)
            network.load_state_dict(checkpoints.load(original)["model"])
        # Number of CPU threads with which the run trains.
        self._threads = torch.get_num_threads()
        if self._is_resumed:
            self.trainer.resume()
            # The schedule extends over all epochs, but each epoch of a soup has the whole schedule.
            recipe = settings.train
            if recipe.epochs != earlier.train.epochs and not recipe.soup:
                line = "train.epochs=%d, not %d, stretches train.schedule=%s"
                console.warning(line, recipe.epochs, earlier.train.epochs, recipe.schedule)
        elif settings.train.resume:
            console.info("nothing to resume in %s; starting at epoch 1", folder)

    def _build_trainer(self, validation: dict[str, Any] | None, threads: int | None) -> Trainer:
        """Build the network, the optimizer and the service of renders. No file is written.

        `validation` is the record of the validation images. Without `threads`, `choose_threads`
        chooses them.
        """
        settings, data, initial = self.settings, self.data, self.initial
        recipe = settings.train
        shape = _network_shape(settings, initial)
        stored = data.train.images
        # Images on disk: some of them tell mean and standard deviation.
        images = stored if isinstance(stored, Tensor) else data.train.sample(SAMPLED)
        mean, std = channel_statistics(images)
        torch.manual_seed(stream_seed(settings.seed, "weights"))
        # The shape of a classifier has the normalization of the classifier.
        network = self._build_network({"mean": mean, "std": std} | shape)
        encoding = settings.renderer.encoding
        facts = {"classes": list(data.classes), "size": data.size, "encoding": encoding, **shape}
        light = settings.normalize_light
        if initial:
            # The weights of the initial network, and its description in the checkpoint.
            initial.copy_to(network, facts)
            if initial.network is None:
                wrappers.say_inputs(str(settings.network), network, data.size, initial.inputs)
            # Facts about the images that nobody states, such as a usual normalization.
            assumed = [name for name, source in vars(initial.inputs).items() if source is None]
            facts |= {checkpoints.ASSUMED: assumed} if assumed else {}
            light = light or initial.architecture.get(checkpoints.NORMALIZE_LIGHT)
        if light is not None:
            facts[checkpoints.NORMALIZE_LIGHT] = light
        wrapped = exposure.with_normalized_light(network, light)
        if recipe.freeze:
            with keyed(stage="train.freeze"):
                freeze(wrappers.unwrapped(network), recipe.freeze, data.size)
        task = initial.task if initial else Classification()
        model = place(wrapped, recipe, isinstance(task, Detection))
        torch.set_num_threads(threads or choose_threads(model, recipe.batch_size, data.size))
        device = wrappers.device_of(model)
        # By default, pretrained classifiers keep the statistics of their normalizations.
        if recipe.eval_mode is None:
            recipe = replace(recipe, eval_mode=bool(initial and initial.is_classifier))
        rate = scale_learning_rate(recipe, model, to_unit(images[:NORM_IMAGES].to(device)))
        if rate != recipe.learning_rate:
            console.info("learning rate %.3g, by the norm of the features of the network", rate)
            recipe = replace(recipe, learning_rate=rate)
        # The checkpoint describes the network without the wrapper, and the wrapper by its settings.
        description = describe(network, **facts, validation=validation)
        service = inputs.build_service(settings, data, device, task)
        options = description, service, self.folder, data.labeled, initial is not None
        return Trainer(recipe, model, *options)

    def _build_network(self, shape: dict[str, Any]) -> nn.Module:
        """Build the network without its trained weights, or copy the one that the caller gave."""
        if self.initial and self.initial.network is not None:
            # The caller's network must not change.
            return deepcopy(self.initial.network).requires_grad_(True)
        classes, size = self.data.classes, self.data.size
        with keyed(**keys_of("model", self.settings.model)):
            return build_network(classes, size, trust_code=self.settings.trust, **shape)

    def begin(self) -> None:
        """Remove results of an earlier run, and write config.yaml. A resumed run loses its scores.

        All runs of a command begin before the first one is trained. Whatever stops the command,
        no result in their folders belongs to another run then.
        """
        if distributed.rank() > 0:
            return
        # Without `overwrite`, only a run that stopped before its first checkpoint can have left
        # config.yaml here: `__init__` resumes or refuses a run with a checkpoint.
        if self._is_resumed:
            # Folders that are no longer scored would keep the scores of an older network.
            remove(*self.folder.glob(f"*/{SUMMARY}"))
        elif self.settings.overwrite or (self.folder / CONFIG).is_file():
            remove_run(self.folder, with_others=not self.settings.train.resume)
        device, model = str(self.trainer.device), self.trainer.model
        hardware = {"device": device, "precision": model.precision, "threads": self._threads}
        images = self._inputs.describe(model, self.data.size)
        test_images = inputs.describe_test_images(self.settings, self.data)
        facts = {"images": images, "test_images": test_images, "hashes": self._hashes}
        write_config(self.folder, self.settings, hardware=hardware, command=self.command, **facts)

    def train(self, logger: Logger | None = None) -> dict[str, float]:
        """Train to the last epoch, score the network, and return the final scores by name.

        If the run has an initial network, it is scored, too. A logger replaces TensorBoard.
        """
        # Another run that was made in between may have set another number of threads.
        torch.set_num_threads(self._threads)
        trainer = self.trainer
        # Only the first process has a log.
        log = RunLog(self.folder, trainer.history, logger) if distributed.rank() == 0 else None
        if log:
            self._render_kept_aside()
        scores = self._score_initial(self.before) if self.before and not trainer.is_detector else {}
        # `_score_initial` may have replaced labels. An unreadable file is replaced in its own part.
        split = self.data.train.to(trainer.device)
        train, validation = (split.part(rows) for rows in (~self.held_out, self.held_out))
        with keyed(**keys_of("train", self.settings.train)):
            trainer.fit(train, validation, log)
            scores |= self._score()
            if self.settings.train.recognize and checkpoints.RECOGNIZER not in trainer.best:
                self._recognize()
        if log:
            scores |= self._score_photographs(trainer.selected, self.folder)
            self._export()
            # A run with scores counts as finished.
            log.scalars(scores, trainer.epoch + 1, is_final=True)
        return scores

    def _export(self) -> None:
        """Write the trained weights of a classifier of the user to weights.pt.

        The user can load this file into the classifier. A line on the console
        says how. Nothing is written if the run trains a network of this library.
        """
        if CLASSIFIER not in self.trainer.architecture:
            return
        path = self.folder / WEIGHTS
        # The weights have the names of the user's own network, without wrappers of this library.
        raw = wrappers.unwrapped(self.trainer.selected.network, own_alone=True)
        checkpoints.save(path, weights_on_cpu(raw))
        console.info("network.load_state_dict(torch.load(%r)) loads the result", str(path))
        # Settings of the wrapper that normalizes the light of images. None without one.
        light = exposure.light_settings(self.trainer.selected.network)
        if light is not None:
            given = json.dumps(asdict(light))
            console.info("it needs images with normalized light: normalize_light=%s", given)

    def _score_initial(self, model: MixedPrecision) -> dict[str, float]:
        """Score the initial network, whose predictions become labels if the data have none."""
        predictions = self._predict(model, self.data.test)
        self._initial_predictions = predictions
        if not self.data.labeled:
            # The loss computes such predictions for the training images itself.
            labels = self.data.train.labels.clone()
            labels[self.held_out] = self._predict(model, self.data.train[self.held_out])
            test = Split(self.data.test.images, predictions)
            self.data = replace(self.data, train=Split(self.data.train.images, labels), test=test)
        if distributed.rank() > 0:
            return {}
        # For data without labels, this is 1, as the labels are these predictions.
        accuracy = (predictions == self.data.test.labels).float().mean().item()
        self._score_photographs(model, self.folder / BEFORE)
        return {"test/accuracy_before": accuracy}

    def _predict(self, model: Model, split: Split, *light_key: int | str) -> Int[Tensor, " N"]:
        """Predict the class of each image of a split, as it is or in the light of training."""
        light = self.settings.train.augmentation
        return predict(model, split, self.trainer.device, *light_key, light=light).argmax(1)

    def _render_kept_aside(self) -> None:
        """Render test images of other objects and projected patterns than those of the training.

        Nothing is rendered if the settings name photographs to score, if they ask for no test
        renders, or if a resumed run has already rendered them with the same settings.
        """
        if self.scored_folders or not self.settings.evaluate.laboratory_setups:
            return
        folder = self.folder / KEPT_ASIDE
        settings = kept_aside_settings(self.settings, self.data.classes, self.data.size, folder)
        try:
            if not (self._is_resumed and is_laboratory(folder, settings)):
                write_laboratory(settings)
            self.scored_folders = {LABORATORY: folder}
        except InputError as error:
            console.warning("no renders are kept aside: %s", error)

    def _score(self) -> dict[str, float]:
        """Score the network after the last epoch and the selected one, whose weights remain."""
        trainer = self.trainer
        test = self.data.test.to(trainer.device)
        # `trainer.selected` has the weights of the last epoch until they are replaced below.
        last = selected = trainer.evaluate(test)["accuracy"]
        if self.settings.train.interpolate:
            self._interpolate()
        best = trainer.best
        epoch = best["epoch"]
        # The selected network differs from the last one.
        if epoch != trainer.epoch or INTERPOLATION in best:
            trainer.selected.network.load_state_dict(best["model"])
            selected = trainer.evaluate(test)["accuracy"]
        scores = {"test/accuracy": selected, "test/accuracy_last": last, "test/epoch": epoch}
        if INTERPOLATION in best:
            scores["test/interpolation"] = best[INTERPOLATION]
        predictions = self._initial_predictions
        has_consistency = bool(self.settings.train.consistency_weight)
        if predictions is not None and (has_consistency or CLASSIFIER in trainer.architecture):
            agreement = selected  # Of data without labels, the labels are these predictions.
            if self.data.labeled:
                before = Split(test.images, predictions.to(trainer.device))
                agreement = evaluate(trainer.selected, before)["accuracy"]
            scores["test/agreement"] = agreement
            if has_consistency:
                scores |= self._relit_agreement(predictions, agreement)
        return scores

    def _interpolate(self) -> None:
        """Write best.pt with weights between before and after, unless it has been interpolated."""
        trainer = self.trainer
        if INTERPOLATION in trainer.best or trainer.initial is None:
            return
        networks = (trainer.initial, trainer.selected, trainer.best["model"])
        validation = self.data.train[self.held_out]
        settings = self.settings
        weights, factor = interpolate(*networks, validation, settings.train, settings.seed)
        self._add_to_best({"model": weights, INTERPOLATION: factor})

    def _recognize(self) -> None:
        """Write to best.pt what recognizes the light of the training."""
        trainer, light = self.trainer, self.settings.train.augmentation
        splits = self.data.train[~self.held_out], self.data.train[self.held_out]
        network = trainer.selected.network
        network.load_state_dict(trainer.best["model"])
        fitted = fit_recognizer(network, *splits, self.settings.seed, light)
        self._add_to_best({checkpoints.RECOGNIZER: fitted})
        name = f"{LIT_NAME}ORIGINAL+{checkpoints.RUN}{self.folder}"
        console.info("network=%s shows this network images in the light of its training", name)

    def _add_to_best(self, entries: dict[str, Any]) -> None:
        """Add entries to the selected network, and write best.pt in the first process."""
        self.trainer.best |= entries
        if distributed.rank() == 0:
            checkpoints.save(self.folder / BEST, self.trainer.best)

    def _relit_agreement(self, targets: Int[Tensor, " N"], unchanged: float) -> dict[str, float]:
        """Measure on which fraction of the test images light does not change the prediction.

        Predictions before and after the training are compared with `targets`, those of the initial
        network for unchanged images.
        """
        scores = {}
        for name, model in (("before", self.before), ("after", self.trainer.selected)):
            relit = self._predict(cast(Model, model), self.data.test, self.settings.seed, "test")
            scores[f"test/relit_agreement_{name}"] = (relit == targets).double().mean().item()
        line = "agreement with the original on %d test images: unchanged %.3f; "
        line += f"{in_light(self.settings.train.augmentation)} %.3f before, %.3f after"
        console.info(line, len(targets), unchanged, *scores.values())
        return scores

    def _score_photographs(self, model: Model, out: Path) -> dict[str, float]:
        """Score a network on each folder of photographs, and return the metrics by their names.

        Several positive classes add names such as "photographs/orange/auc".
        """
        predictor = Predictor(model, self.data.classes, self.data.size, self.trainer.device)
        values = {}
        for name, folder in self.scored_folders.items():
            # Without a label, all classes that have a sub-folder are positive.
            label = photographs.choose_labels(folder, self.data.classes, self.settings.label)
            skip = self.settings.evaluate.skip_unreadable
            scores = evaluate_photographs(predictor, folder, label, out / name, skip)
            console.debug("%s: %s", name, format_scores(scores))
            by_label = [(f"{name}/{one}", metrics) for one, metrics in scores.by_label.items()]
            for prefix, metrics in [(name, scores.overall), *by_label]:
                for metric in ("top5", *METRICS):
                    estimate = metrics.find(metric)
                    if estimate is not None and estimate.value is not None:
                        values[f"{prefix}/{metric}"] = estimate.value
        return values


def _network_shape(settings: ExperimentSettings, initial: inputs.Initial | None) -> dict[str, Any]:
    """Return the arguments of `build_network` that choose the architecture of a run."""
    shape = settings.model.shape
    if initial is None or not initial.is_classifier:
        return shape
    own_name = initial.architecture.get("name", WIDERESNET)
    name = shape.get("name", own_name)
    if name != own_name:
        raise InputError(f"model.name={name} is not that of {initial.source}: leave it out")
    statistics = {key: initial.architecture.get(key) for key in ("mean", "std")}
    return {"name": own_name, CLASSIFIER: True, **statistics}
