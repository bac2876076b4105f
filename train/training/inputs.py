"""The inputs of a run: its initial network, its data set, and the service that renders images."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from augment import distributed, files
from augment.classifier import TaskNetwork
from augment.exposure import light_settings, without_normalized_light
from augment.files import NetworkFacts, is_network_file, name_from_anywhere, require_no_facts
from augment.network import FROM_FILE, YOU, Inputs
from augment.progress import Phases
from augment.scene.build import build_scene
from augment.scene.scene import Scene
from augment.service import AugmentationService
from augment.settings import PYTHON, split_function
from augment.sources import load_source
from augment.switch import SWITCHES
from augment.tasks.classification import Classification, class_index, complementary_label
from augment.tasks.detection import Detection
from augment.tasks.task import Task
from renderer.errors import InputError, composed, is_whole, keyed, keys_of, require_range
from renderer.settings import MAX_SIZE
from train import checkpoints, console
from train.class_names import class_of_name, name_of_mesh, require_others, with_class_names
from train.data import sets
from train.data.photographs import find_photographs, load_photographs
from train.data.rendered_shapes import cache_folder, load_shapes
from train.device import choose_rasterizer, main_process_first
from train.networks import CLASSIFIER, DETECTOR, describe
from train.settings import MIN_SIZE, OTHER, UNLABELED, ExperimentSettings, published_folder

# Default fraction of the training images that validate the network.
VALIDATION = 0.1
# Pixels per side of the images if neither the setting `size` nor the network with
# whose weights a run begins gives a size.
SIZE = 32


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
        inputs: Who states the size and the normalization of its images.
        task: What its outputs mean.
    """

    source: Path
    architecture: dict[str, Any]
    weights: dict[str, Tensor]
    network: nn.Module | None = None
    inputs: Inputs = FROM_FILE
    task: Task = field(default_factory=Classification)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the outputs of the network."""
        return tuple(self.architecture["classes"])

    @property
    def size(self) -> int:
        """Pixels per side of the images that the network takes."""
        size = self.architecture["size"]
        if not is_whole(size):
            raise InputError(f"size={size} of {self.source} is no square: give one number", "size")
        return size

    @property
    def is_classifier(self) -> bool:
        """Whether the network is a classifier that the library did not train from random weights.

        It can come from torchvision, timm or a file of the user, and may have
        been trained by an earlier run.
        """
        return CLASSIFIER in self.architecture

    def copy_to(self, network: nn.Module, description: Mapping[str, Any]) -> None:
        """Copy the weights of the initial network to the network of the run.

        Networks that differ in classes, image size or architecture raise InputError.
        """
        if self.architecture["classes"] != description["classes"]:
            raise InputError(f"network={self.source} has other classes: give the same classes")
        own, of_data = self.architecture["size"], description["size"]
        if own != of_data:
            fault = f"network={self.source} takes {own} pixels, but the data has {of_data}"
            raise InputError(f"{fault}: give the same size")
        with checkpoints.checks_architecture(self.source):
            files.load_weights(network, self.weights)


def load_initial(settings: ExperimentSettings) -> Initial | None:
    """Load the initial network, with whose weights a run begins. None stands for random weights."""
    name = settings.network
    if not name:
        return None
    if name.startswith(SWITCHES):
        raise InputError(f"network={name} has two networks: train one of them", "network")
    # A classifier comes from a library or a file. Any other name is the folder of a training run.
    if checkpoints.is_classifier(name):
        return _load_classifier(settings, name)
    source = Path(name.removeprefix(checkpoints.RUN))
    # A file of weights alone does not say which network they belong to.
    if checkpoints.lacks_architecture(source):
        advice = f"give both, as in network=torchvision:resnet50 weights={source}"
        raise InputError(f"network={name} has weights, but no architecture: {advice}", "network")
    if settings.weights is not None:
        raise InputError(f"weights: network={name} has its own: leave weights out", "weights")
    # The network of a run has its own classes and its own normalization.
    stated_facts = NetworkFacts(settings.classes, None, settings.normalization, settings.prompt)
    require_no_facts(f"network={name}", stated_facts)
    with keyed(run="network"):
        path, state = checkpoints.load_selected(source)
    architecture = state["architecture"]
    if architecture.get("name") == DETECTOR:
        fault = f"network={name} is no classifier, but for detection"
        raise InputError(f"{fault}: train it by nb.harden in Python", "network")
    # A run of a network that a Python function built names this function. To call it means to run
    # code, which the user must allow.
    built_by = str(architecture.get("name"))
    is_named = split_function(settings.model.name) == split_function(built_by)
    if built_by.startswith(PYTHON) and not is_named and not settings.trust:
        advice = f"give model.name={built_by} to run that code"
        raise InputError(f"the network in {path} is built by {built_by}: {advice}", "network")
    # Who stated size and normalization of the network: its file, or nobody.
    stated = checkpoints.stated_inputs(architecture)
    return Initial(path, architecture, checkpoints.plain_weights(state), inputs=stated)


def with_label(settings: ExperimentSettings) -> ExperimentSettings:
    """Replace a missing label, or a label that is an index, by the names of the classes.

    The label lists the positive classes. If it is missing, these are the classes
    of the meshes. The names of the classes are known from the initial network. Without one, the
    settings stay.
    """
    names = settings.labels
    if len(names) == 1 and settings.augment.renders:
        files = [item for item in settings.meshes if isinstance(item, str)]
        others = [file for file in files if class_of_name(name_of_mesh(file), names) is None]
        if others:
            console.warning("label=%s is the class of %s", names[0], ", ".join(others))
    # A number can be the index of a class.
    may_have_index = any(name.isdecimal() for name in names)
    # Without a label, the run must train on objects of the positive classes, or score images of
    # them: the list of the classes of the meshes is the label then.
    is_scored = bool(settings.photos) or settings.evaluate.laboratory_setups > 0
    is_used = settings.augment.renders or settings.train.ranking_weight > 0 or is_scored
    has_meshes = bool(settings.meshes) and settings.augment.mode != "folder"
    if not (may_have_index or (settings.label is None and has_meshes and is_used)):
        return settings
    initial = load_initial(settings)
    # Without an initial network, `Run` checks the label when it knows the classes of the data.
    return with_class_names(settings, initial.classes) if initial else settings


def _load_classifier(settings: ExperimentSettings, name: str) -> Initial:
    """Load a classifier, from another library or from a file, as the initial network."""
    with keyed(name="network"):
        # A file may not record the size of its images, so it gets the size of the settings.
        # Any other classifier has a size of its own.
        given_size = settings.size if is_network_file(name) else None
        facts = NetworkFacts(settings.classes, given_size, settings.normalization, settings.prompt)
        weights = Path(settings.weights) if settings.weights else None
        classifier = load_source(name, weights, facts, settings.trust)
    if not isinstance(classifier.task, Classification):
        fault = f"network={name} is no classifier, but for {classifier.task.name}"
        is_detector = isinstance(classifier.task, Detection)
        advice = "train it by nb.harden in Python" if is_detector else "give a classifier"
        raise InputError(f"{fault}: {advice}", "network")
    if not list(classifier.network.parameters()):  # ONNX and quantized networks have none.
        advice = "give a file of TorchScript or torch.export"
        raise InputError(f"network={name} has no weights to train: {advice}", "network")
    # A run builds the network again, since modules of TorchScript cannot be copied.
    return replace(initial_of(classifier, settings.size), source=Path(name), network=None)


def initial_of(classifier: TaskNetwork, size: int | None) -> Initial:
    """Use a network in memory as the initial network of a run.

    `size` is None for the size that the network takes.
    """
    # The wrapper that normalizes light is described by its settings, and built again by the run.
    network = without_normalized_light(classifier.network)
    shape: dict[str, Any] = {"name": name_from_anywhere(classifier.name), CLASSIFIER: True}
    light = light_settings(classifier.network)
    if light is not None:
        shape[checkpoints.NORMALIZE_LIGHT] = asdict(light)
    architecture = describe(network, classifier.classes, size or classifier.size, "srgb", **shape)
    # A size that the caller gives is said to be stated by the user.
    inputs = classifier.inputs if size is None else replace(classifier.inputs, size=YOU)
    facts = Path(classifier.name), architecture, network.state_dict(), network
    return Initial(*facts, inputs, classifier.task)


def choose_validation(
    settings: ExperimentSettings, data: sets.DataSet, initial: Initial | None
) -> tuple[float, dict[str, Any] | None]:
    """Choose which fraction of the training images validates the network of a run.

    Networks of one data set leave out nested sets of images: a smaller fraction is a subset of a
    larger one. The smallest fraction of a network and of the networks with whose weights it began
    is therefore the fraction from which none of them has learned. Without `data.validation`, it is
    the fraction that the initial network left out, or else VALIDATION.

    Return the fraction, and the record of the images from which neither this network nor those with
    whose weights it began have learned. The record is stored with the weights. It is None if these
    images are unknown.
    """
    asked = settings.data.validation
    # Of data without labels, at most HELD_OUT images validate.
    default = VALIDATION if data.labeled else min(VALIDATION, sets.HELD_OUT / len(data.train))
    # What determines which training images the run leaves out for validation. Only a network that
    # was trained on rendered images records the entry "data".
    record = {"fraction": asked or default, "seed": 0, "images": data.train.content_hash}
    record |= {"data": "shapes"} if data.rendered else {}
    stored = initial.architecture.get("validation") if initial else None
    earlier: Any = stored if isinstance(stored, dict) else {}
    left_out = earlier.get("fraction")
    if initial is None or (data.rendered and earlier and "data" not in earlier):
        return asked or default, record
    # The records of the same images differ only in the fraction.
    is_known = record | {"fraction": left_out} == earlier
    fraction: float = asked or (left_out if is_known else default)
    if not is_known or fraction > left_out:
        console.debug("validation: %s may have learned from these images", settings.network)
    return fraction, record | {"fraction": min(fraction, left_out)} if is_known else None


def load_inputs(settings: ExperimentSettings) -> tuple[sets.DataSet, Initial | None]:
    """Load the data set of a run, and the initial network if the run has one."""
    initial = load_initial(settings)
    return load_data(settings, initial), initial


def load_data(settings: ExperimentSettings, initial: Initial | None = None) -> sets.DataSet:
    """Load the data set of a run.

    Without a size in the settings, the images get the size that `initial` takes.
    """
    data = settings.data
    size = settings.size or (initial.size if initial else SIZE)
    # The images without labels have a setting of their own outside of data.
    group = UNLABELED if data.name == UNLABELED else ""
    with main_process_first(), keyed(group, **keys_of("data", data)):
        if data.name == "cifar100":
            loaded = sets.load_cifar100(data.path)
        elif data.name == "npz":
            loaded = sets.load_npz(data.path)
        elif data.name == "shapes":
            counts = (data.train_per_class, data.test_per_class)
            loaded = load_shapes(*counts, size, data.seed, cache_folder(settings.train.cache))
        else:
            load = sets.load_folder if data.name == "folder" else sets.load_unlabeled
            path = data.path if data.name == "folder" else str(settings.unlabeled)
            skip = settings.evaluate.skip_unreadable
            loaded = load(path, size, data.test_fraction, skip, data.workers)
    with keyed("data.path"):
        require_range("image size", loaded.size, MIN_SIZE, MAX_SIZE)
    if settings.size not in (None, loaded.size):
        fault = f"size={settings.size}, but images of data={data.name} have {loaded.size} pixels"
        raise InputError(f"{fault}: set size={loaded.size}, or leave it out", "size")
    return loaded


def require_label(settings: ExperimentSettings, data: sets.DataSet) -> None:
    """Check that the positive class is known, and that photographs can have it as a folder.

    The sub-folders of photographs have names of classes, and no indices.
    """
    # Renders and the ranking loss are of a positive class.
    if settings.label is None and (settings.augment.renders or settings.train.ranking_weight > 0):
        advice = f"give a class of the meshes, such as {', '.join(data.classes[:5])}"
        raise InputError(f"label is not set: {advice}", "label")
    for label in settings.labels:
        name = data.classes[class_index(data.classes, label, "label")]
        if name != label and settings.scored_folders:
            raise InputError(f"label={label} is an index: give the name, label={name}", "label")


def relabel(
    settings: ExperimentSettings, data: sets.DataSet, initial: Initial | None
) -> sets.DataSet:
    """Convert the labels of the data to indices into the classes of the network.

    A data set and the initial network can have different lists of classes. Without an initial
    network, the network has the classes of the data.
    """
    if not data.labeled:
        recipe = settings.train
        if not (initial and (recipe.distillation_weight or recipe.consistency_weight)):
            raise InputError("data=unlabeled: set network and train.distillation_weight")
        return replace(data, classes=initial.classes)
    if initial and (data.rendered or initial.is_classifier):
        return sets.relabeled(data, initial.classes, f"data.name={settings.data.name}")
    return data


def describe_test_images(settings: ExperimentSettings, data: sets.DataSet) -> str:
    """Describe in words what the test accuracy of a run is measured on.

    An example is "rendered solids of 5 of the network's 1000 classes".
    """
    if not data.labeled:
        return f"the predictions of {settings.network} for held-out photographs"
    kind = "rendered solids" if data.rendered else f"the test images of {settings.data.name}"
    # Classes are counted in the training images, because the test images are not read
    # before the end of the run.
    class_count, all_count = len(data.train.labels.unique()), len(data.classes)
    is_part = class_count < all_count
    return f"{kind} of {class_count} of the network's {all_count} classes" if is_part else kind


def build_service(
    settings: ExperimentSettings, data: sets.DataSet, device: torch.device, task: Task
) -> AugmentationService:
    """Build the service that renders the training images of a run anew in each round.

    It has no images if the run trains without renders.
    """
    is_classifier = isinstance(task, Classification)
    # Renders come from a scene, or as images from a folder. Both are None without renders.
    scene: Scene | None = None
    images: Tensor | None = None
    labels = torch.zeros(0, dtype=torch.int64)
    phases = Phases(device)
    # The ranking loss compares images of a positive class with images of other classes. It
    # needs both.
    is_ranked = is_classifier and (bool(settings.hard_negatives) or len(settings.labels) > 1)
    positive_classes = [class_index(data.classes, name, "label") for name in settings.labels]
    if settings.augment.renders and settings.augment.mode == "folder":
        images, labels = load_renders(settings, data, positive_classes)
        images = images.to(device)
        is_ranked = len(labels.unique()) > 1
    elif settings.augment.renders:
        positive_names = [data.classes[index] for index in positive_classes]
        require_others(settings.negative_objects, positive_names, data.classes)
        # An object of no class of the network has a complementary label: the negative
        # number says only that it is not of a positive class.
        label_of_class: dict[str | int, int] = {OTHER: complementary_label(positive_classes[0])}
        for key, item in settings.objects.items():
            if item.label != OTHER:
                index = class_index(data.classes, item.label, f"label of {key}")
                label_of_class[item.label] = index
        scene = _build_scene(settings, data.size, device, phases)
        labels = torch.tensor([label_of_class[name] for name in scene.labels])
    # If all classes are positive, a render of no positive class shows no class at all.
    if is_classifier and len(positive_classes) == len(data.classes) and (labels < 0).any():
        fault = f"label={settings.label} has all classes of the network, but some renders none"
        raise InputError(f"{fault}: give all objects a label, or set hard_negatives=[]")
    rendered = (settings.augment, scene, labels.to(device), settings.seed, phases)
    ranked = positive_classes if is_ranked else ()
    # Each process of a run renders its own share.
    processes = (distributed.rank(), distributed.world_size())
    return AugmentationService(*rendered, ranked, *processes, images, task, data.classes)


def _build_scene(
    settings: ExperimentSettings, size: int, device: torch.device, phases: Phases
) -> Scene:
    """Build the scene with meshes and hard negatives, in the first process before the others."""
    options: dict[str, Any] = {"rasterizer": choose_rasterizer(settings.renderer)}
    options |= {"attack": settings.augment.attack, "vary": settings.augment.vary}
    options |= {"scene": settings.scene, "renderer": settings.renderer}
    objects = [*settings.objects.values()]
    # An error names an argument by its setting, such as scene.views.
    keys = keys_of("scene", settings.scene)
    # The first process comes first, so that the others find what it downloads or caches.
    with phases("operators"), main_process_first(), keyed("scene", **keys):
        scene = build_scene(objects, size, settings.views, device=device, **options)
        return scene.with_count(settings.render_count)


def load_renders(
    settings: ExperimentSettings, data: sets.DataSet, positive_classes: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Load images that are used as renders from the folder in the setting `augment.folder`.

    A label is the index of a class, or the complementary label in a subfolder that is no class.
    """
    folder = published_folder(Path(str(settings.augment.folder)))
    classes = [*map(composed, data.classes)]
    positive_names = [classes[index] for index in positive_classes]
    label_of_class = {name: index for index, name in enumerate(classes)}
    label_of_negative = complementary_label(positive_classes[0])
    skip = settings.evaluate.skip_unreadable
    with keyed("augment.folder"):
        # Photographs with the names of their subfolders as labels.
        found = find_photographs(folder, classes, positive_names)
        found, images, _ = load_photographs(folder, found, data.size, skip)
        # Training needs renders of each positive class.
        for name in sorted(set(positive_names) - {item.label for item in found}):
            raise InputError(f"{folder} has no image of label={name}: add a sub-folder {name}")
    labels = [label_of_class.get(item.label, label_of_negative) for item in found]
    return images, torch.tensor(labels)
