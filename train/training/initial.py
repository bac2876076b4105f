"""The network that a run begins with, and the images that neither it nor the run learns from."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from augment.classifiers import Classifier, load_classifier
from augment.classifiers.adapter import without_normalized_light
from augment.classifiers.files import is_network_file
from augment.classifiers.plain_networks import as_facts, require_no_facts
from renderer.errors import InputError
from train import console
from train.class_names import with_class_names, with_classes_of_meshes
from train.data.cache import TensorCache
from train.data.sets import HELD_OUT, DataSet
from train.networks import CLASSIFIER, describe
from train.runs.saved_networks import (
    NORMALIZE_LIGHT,
    RUN,
    is_classifier,
    is_state_dict,
    load_selected,
    of_one_architecture,
    plain_weights,
)
from train.settings import WIDERESNET, ExperimentSettings, label_names
from train.system.device import MixedPrecision
from train.system.hashing import content_hash
from train.system.user_errors import keyed

# Entries of its description that a network shares with a network that begins with
# its weights.
SHARED = ("classes", "size", "name", "depth", "width")
# Default fraction of the training images that validate.
VALIDATION = 0.1


@dataclass(frozen=True)
class Initial:
    """Network with whose weights a run begins. `train.init_from` names it.

    Attributes:
        source: File of the network of another run, or name of a classifier.
        architecture: Arguments that build the network (see
            `train.networks.describe`).
        weights: State dict of the network, without normalized light.
        network: The network itself, without normalized light. The run trains a
            copy. None if the name in the architecture builds it.
    """

    source: Path
    architecture: dict[str, Any]
    weights: dict[str, Tensor]
    network: nn.Module | None = None

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the names of the classes, in the order of the outputs of the network."""
        return tuple(self.architecture["classes"])

    @property
    def size(self) -> int:
        """Return the pixels per side of the images that the network takes."""
        return self.architecture["size"]

    @property
    def is_classifier(self) -> bool:
        """Return whether the network has the architecture of a classifier of another library."""
        return CLASSIFIER in self.architecture

    @property
    def name(self) -> str:
        """Return the name of the architecture."""
        return self.architecture["name"]

    @property
    def normalize_light(self) -> dict[str, float] | None:
        """Return how the network normalizes the light of images. None if it does not."""
        return self.architecture.get(NORMALIZE_LIGHT)

    @property
    def validation(self) -> dict[str, Any] | None:
        """Return the record of the images that it did not learn from. None if it is unknown."""
        stored = self.architecture.get("validation")
        return stored if isinstance(stored, dict) else None

    def copy_to(self, network: nn.Module, description: Mapping[str, Any]) -> None:
        """Copy the weights and the normalization to another network.

        Args:
            network: Network whose weights are replaced.
            description: Arguments that build this network.

        Raises:
            InputError: If the two networks differ in classes, image size or
                architecture.
        """
        stored = {"name": WIDERESNET, **self.architecture}
        wanted = {"name": WIDERESNET, **description}
        for key in SHARED:
            if key in stored and stored[key] != wanted.get(key):
                difference = f"{key} {stored[key]}, not {wanted.get(key)}"
                if key == "classes":
                    difference = "other classes"
                raise InputError(
                    f"train.init_from={self.source} was trained with {difference}: "
                    "give this run the same",
                )
        with of_one_architecture(self.source):
            network.load_state_dict(self.weights)


def load_initial(settings: ExperimentSettings) -> Initial | None:
    """Load the network with whose weights a run begins.

    Args:
        settings: Settings of the run. `train.init_from` names the network.

    Returns:
        The network. None if the run begins with random weights.

    Raises:
        InputError: If there is no such network, or if `weights` is set although
            `train.init_from` names a run. A run has its own weights.
    """
    name = settings.train.init_from
    if not name:
        return None
    if is_classifier(name):
        return _classifier(settings, name)
    source = Path(name.removeprefix(RUN))
    if is_state_dict(source):
        raise InputError(
            f"train.init_from={name} contains weights without their network: "
            "give its architecture and the weights, as in "
            f"train.init_from=torchvision:resnet50 weights={source}",
            "train.init_from",
        )
    if settings.weights is not None:
        raise InputError(
            f"weights={settings.weights} is not for train.init_from={name}, "
            "which has its own: leave it out",
            "weights",
        )
    require_no_facts(
        f"train.init_from={name}", as_facts(settings.classes, None, settings.normalization)
    )
    with keyed(run="train.init_from"):
        path, state = load_selected(source)
    return Initial(path, state["architecture"], plain_weights(state))


def with_label(settings: ExperimentSettings) -> ExperimentSettings:
    """Return settings with a label, in which each class has its name.

    Without a label, it is the classes of the meshes. An index is replaced by
    the name of the class, which tables and folders of photographs show.

    Args:
        settings: Settings of a run.

    Returns:
        The settings. If they had no label, the meshes name their classes, too.

    Raises:
        InputError: If an initial network is needed, because there is no label,
            or if it lacks a class.
    """
    names = [] if settings.label is None else label_names(settings.label)
    if names and not any(name.isdecimal() for name in names):
        return settings
    initial = load_initial(settings)
    if names:
        if initial is None:
            return settings
        return with_class_names(settings, initial.classes)
    if initial is None:
        raise InputError(
            "label is not set, and there is no train.init_from whose classes are known: "
            "set label=CLASS",
            "label",
        )
    return with_classes_of_meshes(settings, initial.classes)


def _classifier(settings: ExperimentSettings, name: str) -> Initial:
    """Load a classifier of another library or a file as the initial network.

    Args:
        settings: Settings of the run, with the weights, the classes and the
            size of the images. Without a size, the images have the size that
            the classifier takes.
        name: Value of `train.init_from`.

    Raises:
        InputError: If there is no such classifier, or if it has no weights that
            can be trained.
    """
    size = settings.data.size
    is_file = is_network_file(name)
    with keyed(name="train.init_from", size="data.size"):
        # A file does not always record the size of its images.
        known_size = size if is_file else None
        classifier = load_classifier(
            name, settings.weights, settings.classes, known_size, settings.normalization
        )
    network = cast(nn.Module, classifier.function)
    if not list(network.parameters()):
        raise InputError(
            f"train.init_from={name} is a network without weights that can be trained: "
            "give its file of TorchScript or of torch.export",
            "train.init_from",
        )
    # The network is built again from its file, also from another folder.
    shape = {"name": str(Path(name).absolute()) if is_file else name, CLASSIFIER: True}
    architecture = describe(network, classifier.classes, size or classifier.size, "srgb", **shape)
    return Initial(Path(name), architecture, network.state_dict())


def initial_of(classifier: Classifier, size: int | None) -> Initial:
    """Create the initial network of a run from a classifier in memory.

    Args:
        classifier: The classifier.
        size: The pixels per side of the images. None for those of the classifier.

    Returns:
        The network.
    """
    network = without_normalized_light(classifier.function)
    shape: dict[str, Any] = {"name": classifier.name, CLASSIFIER: True}
    if classifier.normalized_light is not None:
        shape[NORMALIZE_LIGHT] = asdict(classifier.normalized_light)
    architecture = describe(network, classifier.classes, size or classifier.size, "srgb", **shape)
    return Initial(Path(classifier.name), architecture, network.state_dict(), network)


@dataclass(frozen=True)
class ValidationPart:
    """The part of the training images that validates a network.

    Attributes:
        fraction: The fraction of every class's images.
        record: What is stored beside the weights: the part that neither this network nor any
            network before it learned from. None if that is unknown.
    """

    fraction: float
    record: dict[str, Any] | None


def choose_validation(
    settings: ExperimentSettings,
    data: DataSet,
    initial: Initial | None,
) -> ValidationPart:
    """Choose the part of the training images that validates a network.

    The parts of one seed are nested. The smallest part among a network and those that it began
    with is therefore the part that none of them learned from.

    Args:
        settings: The settings of the run.
        data: The data of the run.
        initial: The network that the run begins with, if any.

    Returns:
        The part.
    """
    asked = settings.data.validation
    fraction = asked
    if fraction is None:
        most = 1.0 if data.labeled else HELD_OUT / len(data.train)
        fraction = min(VALIDATION, most)
    # The record of the part that this run leaves out.
    own = {"fraction": fraction, "seed": 0, "images": data.train.content_hash}
    if data.rendered:
        own["data"] = "shapes"
    if initial is None:
        return ValidationPart(fraction, own)

    # The part that the initial network did not learn from, and its fraction.
    stored = initial.validation
    known = stored.get("fraction") if stored else None
    if data.rendered and stored and known is not None and "data" not in stored:
        # The initial network learned from other images than rendered ones.
        return ValidationPart(fraction, own)
    begun = settings.train.init_from
    if not isinstance(known, float) or own | {"fraction": known} != stored:
        console.debug(
            "validation: %s does not say whether it learned from these images, too", begun
        )
        return ValidationPart(fraction, None)
    if asked is None:
        fraction = known
    if fraction > known:
        left_out = f"it left out only data.validation={known}"
        console.debug("validation: %s learned from part of it: %s", begun, left_out)
    return ValidationPart(fraction, own | {"fraction": min(fraction, known)})


class CachedModel:
    """A model whose logits are stored on disk, so that later runs need not compute them again.

    Args:
        model: The model.
        device: The device that computes.
        cache: Where the logits are stored, under a hash of weights and images.
    """

    def __init__(self, model: MixedPrecision, device: torch.device, cache: TensorCache):
        self._model = model
        self._cache = cache
        facts = [torch.__version__, str(model), model.precision, str(device), model.state_dict()]
        self._key = content_hash(facts)

    def __call__(self, images: Tensor) -> Tensor:
        """Return the logits (B, classes) of images (B, 3, size, size) in [0, 1]."""
        key = content_hash([self._key, images])
        stored = self._cache.read(key)
        if stored is None:
            stored = {"logits": self._model(images).cpu().contiguous()}
            self._cache.write(key, stored)
        return stored["logits"]
