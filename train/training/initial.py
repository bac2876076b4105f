"""The initial network, with whose weights a run begins, and the choice of validation images."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

from torch import Tensor, nn

from augment.classifier import Classifier
from augment.files import is_network_file
from augment.network import without_normalized_light
from augment.plain_networks import as_facts, require_no_facts
from augment.sources import load_source
from renderer.errors import InputError, as_path
from train import console
from train.checkpoints import (
    NORMALIZE_LIGHT,
    RUN,
    checks_architecture,
    is_classifier,
    is_state_dict,
    load_selected,
    plain_weights,
)
from train.class_names import class_of_name, name_of_mesh, with_class_names
from train.data.sets import HELD_OUT, DataSet
from train.networks import CLASSIFIER, PYTHON, describe
from train.settings import ExperimentSettings, label_names
from train.train_settings import WIDERESNET
from train.user_errors import keyed

# Entries in the description of a network. They must be equal in two networks if the
# weights of one are copied to the other.
SHARED = ("classes", "size", "name", "depth", "width")
# Default fraction of the training images that validate the network.
VALIDATION = 0.1


@dataclass(frozen=True)
class Initial:
    """Initial network: the network with whose weights a run begins.

    The setting `network` names the network. If the network has a wrapper
    that normalizes the light of images, `weights` and `network` are those inside
    the wrapper.

    Attributes:
        source: File of the network of another run, or name of a classifier.
        architecture: Description of the network, with the arguments of
            `build_network`.
        weights: State dict of the network.
        network: The network itself, of which the run trains a copy. None if
            `build_network` can build it from the description.
        assumed: Which of "size" and "normalization" are assumed.
    """

    source: Path
    architecture: dict[str, Any]
    weights: dict[str, Tensor]
    network: nn.Module | None = None
    assumed: Sequence[str] = ()

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the outputs of the network."""
        return tuple(self.architecture["classes"])

    @property
    def size(self) -> int:
        """Pixels per side of the images that the network takes."""
        return self.architecture["size"]

    @property
    def is_classifier(self) -> bool:
        """Whether the network is a classifier that the library did not train from random weights.

        It can come from torchvision, timm or a file of the user, and may have
        been trained by an earlier run.
        """
        return CLASSIFIER in self.architecture

    @property
    def name(self) -> str:
        """Name of the architecture, such as "torchvision:resnet18"."""
        return self.architecture.get("name", WIDERESNET)

    @property
    def normalize_light(self) -> dict[str, float] | None:
        """Settings with which the network normalizes the light of images. None if it does not."""
        return self.architecture.get(NORMALIZE_LIGHT)

    @property
    def validation(self) -> dict[str, Any] | None:
        """Record of the images that the network did not learn from. None if this is unknown.

        Its entry "fraction" is the fraction of the training images of each
        class, and "images" is a hash of all training images.
        """
        stored = self.architecture.get("validation")
        return stored if isinstance(stored, dict) else None

    def copy_to(self, network: nn.Module, description: Mapping[str, Any]) -> None:
        """Copy the weights of the initial network to the network of the run.

        Networks that differ in classes, image size or architecture raise InputError.
        """
        own = {"name": WIDERESNET, **self.architecture}
        other = {"name": WIDERESNET, **description}
        for key in SHARED:
            if key in own and own[key] != other.get(key):
                difference = f"{key} {own[key]}, not {other.get(key)}"
                if key == "classes":
                    difference = "other classes"
                raise InputError(
                    f"network={self.source} was trained with {difference}: "
                    f"give this run the same {key}",
                )
        with checks_architecture(self.source):
            network.load_state_dict(self.weights)


def load_initial(settings: ExperimentSettings) -> Initial | None:
    """Load the initial network, with whose weights a run begins. None stands for random weights."""
    name = settings.network
    if not name:
        return None
    if is_classifier(name):
        return _load_classifier(settings, name)
    source = Path(name.removeprefix(RUN))
    if is_state_dict(source):
        raise InputError(
            f"network={name} contains weights, but not their architecture: "
            "give the architecture and the weights, as in "
            f"network=torchvision:resnet50 weights={source}",
            "network",
        )
    if settings.weights is not None:
        raise InputError(
            f"weights={settings.weights} cannot replace the weights of "
            f"network={name}: leave weights out",
            "weights",
        )
    # The network of a run has its own classes and its own normalization.
    given = as_facts(settings.classes, None, settings.normalization)
    require_no_facts(f"network={name}", given)
    with keyed(run="network"):
        path, state = load_selected(source)
    built_by = str(state["architecture"].get("name"))
    if built_by.startswith(PYTHON) and settings.model.name != built_by and not settings.trust:
        raise InputError(
            f"the network in {path} is built by {built_by}: give model.name={built_by} to run "
            "that code",
            "network",
        )
    return Initial(path, state["architecture"], plain_weights(state))


def with_label(settings: ExperimentSettings) -> ExperimentSettings:
    """Replace a missing label, or a label that is an index, by the names of the classes.

    The label lists the positive classes. If it is missing, these are the classes
    of the meshes. The names of the classes are known from the initial network. Without one, the
    settings stay.
    """
    names = [] if settings.label is None else label_names(settings.label)
    # A number can be the index of a class.
    may_have_index = any(name.isdecimal() for name in names)
    if len(names) == 1 and settings.augment.renders:
        _print_assumed_class(settings.meshes, names[0])
    if not (may_have_index or settings.label_follows_from_meshes):
        return settings
    initial = load_initial(settings)
    if initial is None:
        # `Run.load` checks the label when it knows the classes of the data.
        return settings
    return with_class_names(settings, initial.classes)


def _print_assumed_class(meshes: Sequence[Any], label: str) -> None:
    """Print which mesh files are taken for objects of a class that their names do not tell."""
    others = [
        item
        for item in meshes
        if isinstance(item, str) and class_of_name(name_of_mesh(item), [label]) is None
    ]
    if others:
        console.warning("label=%s is the class of %s", label, ", ".join(others))


def _load_classifier(settings: ExperimentSettings, name: str) -> Initial:
    """Load a classifier, from another library or from a file, as the initial network."""
    size = settings.size
    is_file = is_network_file(name)
    with keyed(name="network", size="size"):
        # A file may not record the size of its images, so it gets the size of the settings.
        # Any other classifier has a size of its own.
        known_size = size if is_file else None
        facts = as_facts(settings.classes, known_size, settings.normalization)
        weights = None if settings.weights is None else as_path("weights", settings.weights)
        classifier = load_source(name, weights, facts, settings.trust)
    network = cast(nn.Module, classifier.network)
    if not list(network.parameters()):
        raise InputError(
            f"network={name} is a network without weights that can be trained: "
            "give a file of the network in the format of TorchScript or torch.export",
            "network",
        )
    # The absolute path of a file is recorded, so that it is found from any folder.
    shape = {"name": str(Path(name).absolute()) if is_file else name, CLASSIFIER: True}
    architecture = describe(network, classifier.classes, size or classifier.size, "srgb", **shape)
    assumed = [fact for fact in classifier.assumed if size is None or fact != "size"]
    return Initial(Path(name), architecture, network.state_dict(), assumed=assumed)


def initial_of(classifier: Classifier, size: int | None) -> Initial:
    """Use a classifier in memory as the initial network of a run.

    `size` is None for the size that the classifier takes.
    """
    network = without_normalized_light(classifier.network)
    shape: dict[str, Any] = {"name": classifier.name, CLASSIFIER: True}
    if classifier.normalized_light is not None:
        shape[NORMALIZE_LIGHT] = asdict(classifier.normalized_light)
    architecture = describe(network, classifier.classes, size or classifier.size, "srgb", **shape)
    return Initial(Path(classifier.name), architecture, network.state_dict(), network)


@dataclass(frozen=True)
class ValidationPart:
    """Choice of the validation images: training images from which the network does not learn.

    Attributes:
        fraction: Fraction of the training images of each class.
        record: Record of the training images from which neither this network nor the networks
            with whose weights it began have learned. It is stored with the weights. None if these
            images are unknown.
    """

    fraction: float
    record: dict[str, Any] | None


def choose_validation(
    settings: ExperimentSettings,
    data: DataSet,
    initial: Initial | None,
) -> ValidationPart:
    """Choose which fraction of the training images validates the network of a run.

    Networks of one data set leave out nested sets of images: a smaller fraction is a subset of a
    larger one. The smallest fraction of a network and of the networks with whose weights it began
    is therefore the fraction from which none of them has learned. Without `data.validation`, it is
    the fraction that the initial network left out, or else VALIDATION.
    """
    asked = settings.data.validation
    fraction = _default_fraction(data) if asked is None else asked
    # Numbers that determine which training images the run leaves out for validation.
    record = {"fraction": fraction, "seed": 0, "images": data.train.content_hash}
    if data.rendered:
        record["data"] = "shapes"
    if initial is None or _learned_from_other_kind(initial, data):
        return ValidationPart(fraction, record)
    name = settings.network
    left_out = _fraction_left_out(initial, record)
    if left_out is None:
        console.debug("validation: %s does not say whether it learned from these images, too", name)
        return ValidationPart(fraction, None)
    if asked is None:
        fraction = left_out
    if fraction > left_out:
        fault = f"it left out only data.validation={left_out}"
        console.debug("validation: %s learned from part of it: %s", name, fault)
    return ValidationPart(fraction, record | {"fraction": min(fraction, left_out)})


def _default_fraction(data: DataSet) -> float:
    """Return the default fraction of the training images that validate the network.

    It is VALIDATION, or less for data without labels, of which at most HELD_OUT images validate.
    """
    largest = 1.0 if data.labeled else HELD_OUT / len(data.train)
    return min(VALIDATION, largest)


def _learned_from_other_kind(initial: Initial, data: DataSet) -> bool:
    """Return whether a run trains on rendered images, and its initial network did not."""
    record = initial.validation or {}
    is_known = record.get("fraction") is not None
    # Only a network that was trained on rendered images records the entry "data".
    is_of_rendered = "data" in record
    return data.rendered and is_known and not is_of_rendered


def _fraction_left_out(initial: Initial, record: Mapping[str, Any]) -> float | None:
    """Return the fraction of the training images from which the initial network did not learn.

    None if this network was trained on another or an unknown data set.
    """
    initial_record = initial.validation or {}
    fraction = initial_record.get("fraction")
    if not isinstance(fraction, float):
        return None
    # The two records may differ only in the fraction.
    is_same_data = {**record, "fraction": fraction} == initial_record
    return fraction if is_same_data else None
