"""Hardening of any network in one call."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from augment.augmentation_settings import AugmentationSettings
from augment.classifier import UNIT_RANGE, Classifier, Normalization, TaskNetwork, as_network
from augment.network import device_of, keep_text_vectors, unwrapped
from augment.settings import NormalizeLight, RendererSettings
from augment.switch import Recognizer, Switch
from augment.tasks.classification import Classification
from augment.tasks.detection import Detection
from augment.tasks.task import Task
from renderer.errors import InputError, as_path, describe, require_kind
from renderer.settings import Settings, Size
from train import class_names, console
from train.__main__ import main
from train.checkpoints import RECOGNIZER
from train.cli import read_settings
from train.results.overwrite import require_new_run
from train.results.page import report_of
from train.run_folder import folder_or_temporary, sole_writer
from train.settings import DataSettings, ExperimentSettings, TrainingSceneSettings, TrainSettings
from train.training.detection import require_losses
from train.training.inputs import initial_of, load_data
from train.training.run import Run
from train.training.run_log import Logger

# Values of some settings of a group, such as "train", by name. None for the defaults.
Section = Mapping[str, Any] | None
# Settings of `train` that a detector cannot use, because they need logits or move what a box
# surrounds. Of the values that are texts, only UNFIT_TEXTS are refused.
UNFIT_SETTINGS = (
    *("augmentation", "freeze", "interpolate"),
    *("label_smoothing", "ranking_weight", "relight_steps"),
)
UNFIT_TEXTS = "all_but_last", "augmix", "color_jitter+augmix", "pgd", "trivial_augment"


@torch.inference_mode(False)  # Training needs autograd.
def harden(
    network: nn.Module,
    meshes: Sequence[class_names.MeshItem],
    unlabeled: str | Path,
    label: str | int | None = None,
    *,
    hard_negatives: Sequence[class_names.MeshItem] | None = None,
    classes: Sequence[str] | None = None,
    size: Size | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    normalize_light: NormalizeLight = None,
    train: TrainSettings | Section = None,
    augment: AugmentationSettings | Section = None,
    scene: TrainingSceneSettings | Section = None,
    renderer: RendererSettings | Section = None,
    data: DataSettings | Section = None,
    task: Task | None = None,
    logger: Logger | None = None,
    seed: int = 0,
    device: torch.device | str | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
) -> nn.Module:
    """Train a copy of a network to recognize objects under unusual lighting.

    This is `pnb-train experiment=classifier`: the last layer of the network
    learns from renders, while the predictions for photographs stay nearly the
    same.

    A detector in the format of torchvision learns its own losses on the renders
    (experiment=detector). On the photographs, it keeps the boxes that it finds
    before the training, also in the light of a projector and in low light. A raw
    network with `nb.Detection(decode=...)` keeps the scores and boxes of all its
    candidates there. It has no losses, and takes no meshes.

    `train.freeze` alone decides which weights are trained: those without `requires_grad`, such as
    the first layers of detectors of torchvision, are trained, too.

    Args:
        network: A plain network from images to logits, in evaluation mode, or
            a `Classifier` that contains one. Or a detector that takes images
            and targets in training mode, and returns its losses by name. It
            stays as it is.
        meshes: Meshes of the class: files, solids such as "solid:orange",
            `nb.Mesh`, or pairs of these and the class. Meshes of several
            classes harden all of them.
        unlabeled: Folder of any photographs, with labels or without.
        label: Class of all meshes, by name or index. None if each mesh is given
            in a pair with its class, or if its name is the class, as in
            "orange.glb". A detector may be trained without meshes.
        hard_negatives: Meshes of other classes, which the network must not
            confuse with the class. None for generated fruit or, for a detector,
            none.
        classes: Names of the classes of a plain network, in the order of its
            outputs. None for "0", "1" and so on.
        size: Pixels per side of the images of a plain network. None for its own, or 224.
        normalization: "imagenet", or mean and standard deviation, as `attack`
            takes it.
        value_range: Values of black and white that a plain network takes before
            normalization.
        normalize_light: Normalization of the light of each image before it
            enters the network, with values as for `load_classifier`. The
            returned copy of a plain network does not normalize the light
            itself, so give this argument to the other functions, too.
        train: Training settings that replace those of the experiment: a mapping
            of some fields of `TrainSettings`, such as {"epochs": 5}, or
            `TrainSettings` for all fields.
        augment: Fields of `AugmentationSettings`, given in the same way.
        scene: Fields of `TrainingSceneSettings`, such as {"views": 4}.
        renderer: Fields of `RendererSettings`.
        data: Fields of `DataSettings`.
        task: Task of the network, such as `nb.Detection(threshold=0.5)`. None
            recognizes it by the outputs.
        logger: Object with a method log(values, step=...), which gets the metrics
            of each epoch instead of TensorBoard, such as a run of Weights &
            Biases. For MLflow, such a method calls `mlflow.log_metrics`.
        seed: Seed of all random draws.
        device: Device that computes. None for the device of the network.
        out: Folder for the files of the training. None for a temporary folder.
        overwrite: Whether to replace results in `out`.

    Returns:
        The hardened copy, of the same class and in evaluation mode. Its state
        dict has the names and shapes of the state dict of `network`, and text
        vectors of a zero-shot network, which are its last layer, even if they
        are plain tensors there.

    Raises:
        InputError: If an input cannot be read, if the network lacks a class, or
            if a setting is wrong. The message about a setting begins with its
            key, such as "train.epochs".

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> hardened = nb.harden(
        ...     network,
        ...     ["orange.glb"],
        ...     "photos",
        ...     classes=classes,
        ...     normalization="imagenet",
        ... )  # doctest: +SKIP
        >>> torch.save(hardened.state_dict(), "hardened.pth")  # doctest: +SKIP
    """
    require_kind("network", network, nn.Module, "a torch.nn.Module, whose weights are trained")
    require_kind("logger", logger, Logger | None, "an object with a method log(values, step)")
    device = device_of(network) if device is None else device
    options = (size, classes, normalization, value_range, device)
    with folder_or_temporary(out) as folder:
        trainable = _trainable_copy(network)
        classifier = as_network(trainable, *options, normalize_light=normalize_light, task=task)
        if isinstance(classifier.network, Switch):
            raise InputError("network has two networks: train one of them")
        is_detector = isinstance(classifier.task, Detection)
        if not (is_detector or isinstance(classifier.task, Classification)):
            raise InputError(f"network is for {classifier.task.name}: give another")
        if next(classifier.parameters(), None) is None:
            raise InputError("network has no parameters: give a network that can be trained")
        # Text vectors of a zero-shot network become buffers, so that they are copied and saved.
        keep_text_vectors(classifier.network, len(classifier.classes))
        items = class_names.as_mappings("meshes", meshes)
        # Settings by which this call differs from the experiment.
        changes: dict[str, Any] = {"seed": seed, "overwrite": overwrite, "meshes": items}
        changes |= {"network": classifier.name, "unlabeled": str(as_path("unlabeled", unlabeled))}
        changes |= {"data": {"name": "unlabeled"}, "train": {"device": str(device)}}
        changes |= {"out": str(folder.absolute()), "label": label}
        if is_detector:
            with torch.random.fork_rng():
                require_losses(classifier, bool(meshes))
            if not meshes:
                changes["augment"] = {"mode": "none"}
        if hard_negatives is not None:
            changes["hard_negatives"] = class_names.as_mappings("hard_negatives", hard_negatives)
        if out is None:
            # Nothing is written outside of the temporary folder.
            changes["train"]["cache"] = None
        sections: dict[str, Any] = {"train": train, "augment": augment, "scene": scene}
        sections |= {"renderer": renderer, "data": data}
        settings = _read_settings("detector" if is_detector else "classifier", changes, sections)
        if settings.train.recognize and not isinstance(network, TaskNetwork):
            fault = "train.recognize=true needs a network that keeps what recognizes the light"
            raise InputError(f"{fault}: give an nb.Classifier instead", "train.recognize")
        for name in UNFIT_SETTINGS if is_detector else ():
            value = getattr(settings.train, name)
            if value in UNFIT_TEXTS if isinstance(value, str) else value:
                fault = f"train.{name}={value} is for classifiers"
                raise InputError(f"{fault}: choose another value", f"train.{name}")
        require_new_run(folder, "out", overwrite, settings.train.resume)
        if meshes or label is not None:
            settings = class_names.with_class_names(settings, classifier.classes)
        # Training changes threads, random generators and cuDNN's choices, which are restored.
        with sole_writer(folder), ExitStack() as at_end, torch.random.fork_rng():
            cudnn = torch.backends.cudnn
            at_end.callback(torch.set_num_threads, torch.get_num_threads())
            at_end.callback(setattr, cudnn, "benchmark", cudnn.benchmark)
            initial = initial_of(classifier, settings.size)
            run = Run(settings, load_data(settings, initial), initial, folder)
            run.begin()
            run.train(logger)
            if out is not None:
                console.info("%s", report_of([folder], folder))
    # The network of the caller stays as it is, so a new copy gets the trained weights.
    copy = _trainable_copy(network)
    keep_text_vectors(copy, len(classifier.classes))
    target = copy
    if isinstance(network, Classifier) and isinstance(classifier, Classifier):
        # A returned classifier has no operating points, because its logits differ.
        target = deepcopy(classifier.network)
        copy = classifier.with_network(target)
    unwrapped(target).load_state_dict(unwrapped(run.trainer.selected.network).state_dict())
    if isinstance(copy, TaskNetwork) and RECOGNIZER in run.trainer.best:
        copy.recognizer = Recognizer(copy.network, **run.trainer.best[RECOGNIZER])
    return copy


def _trainable_copy(network: nn.Module) -> nn.Module:
    """Copy a network, and check that the weights of the copy can be trained."""
    # Vectors of texts may be results of a text encoder, which have a graph and cannot be copied.
    values = [value for module in network.modules() for value in vars(module).values()]
    results = [value for value in values if isinstance(value, Tensor) and not value.is_leaf]
    copy = deepcopy(network, {id(value): value.detach().clone() for value in results})
    # An optimizer can change a parameter only if it is a leaf of the autograd graph.
    if not all(weight.is_leaf for weight in copy.parameters()):
        advice = "save it, and give norm_balls.load_classifier(FILE, trust_code=True)"
        raise InputError(f"network has a module of torch.jit, which cannot be trained: {advice}")
    return copy


def _read_settings(
    experiment: str, changes: Mapping[str, Any], sections: Mapping[str, Settings | Section]
) -> ExperimentSettings:
    """Combine the settings of an experiment with the arguments of `harden`.

    `sections`, which the caller gave, win over `changes`, and these win over the experiment.
    """
    config = main.compose([f"experiment={experiment}"])
    # `harden` returns only the network, so scores on test renders are not needed.
    config.evaluate.laboratory_setups = 0
    given = {}
    for name, section in sections.items():
        values = asdict(cast(Any, section)) if isinstance(section, Settings) else section or {}
        if not isinstance(values, Mapping):
            raise InputError(f"{name} is {describe(section)}: give a mapping, or settings")
        given[name] = values
    return read_settings(ExperimentSettings, config, changes, given)
