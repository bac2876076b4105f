"""The inputs of a run: its data set, and the service that renders its training images."""

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from augment import distributed
from augment.attacks.objective import complementary_label
from augment.classifier import class_index
from augment.progress import Phases
from augment.scene.build import build_scene
from augment.scene.scene import Scene
from augment.service import AugmentationService
from renderer.errors import InputError, require_range
from renderer.settings import MAX_SIZE
from train import console
from train.class_names import class_name, require_others
from train.data.photographs import find_photographs, load_photographs
from train.data.rendered_shapes import cache_folder, load_shapes
from train.data.sets import DataSet, load_cifar100, load_folder, load_npz, load_unlabeled, relabeled
from train.device import choose_rasterizer
from train.processes import main_process_first
from train.settings import MIN_SIZE, OTHER, UNLABELED, ExperimentSettings, label_names
from train.training.initial import Initial, load_initial
from train.user_errors import keyed, keys_of

# Pixels per side of the images if neither the setting `size` nor the network with
# whose weights a run begins gives a size.
SIZE = 32


def load_inputs(settings: ExperimentSettings) -> tuple[DataSet, Initial | None]:
    """Load the data set of a run, and the initial network if the run has one."""
    initial = load_initial(settings)
    return load_data(settings, initial), initial


def load_data(settings: ExperimentSettings, initial: Initial | None = None) -> DataSet:
    """Load the data set of a run.

    Without a size in the settings, the images get the size that `initial` takes.
    """
    name = settings.data.name
    console.debug("data: %s", name)
    group = UNLABELED if name == UNLABELED else ""
    with main_process_first(), keyed(group, **keys_of("data", settings.data)):
        data = _load(name, settings, initial)
    with keyed("data.path"):
        require_range("image size", data.size, MIN_SIZE, MAX_SIZE)
    return data


def _load(name: str, settings: ExperimentSettings, initial: Initial | None) -> DataSet:
    """Load a data set by its name."""
    data = settings.data
    if name == "cifar100":
        return load_cifar100(data.path)
    if name == "npz":
        return load_npz(data.path)
    size = settings.size or (initial.size if initial else SIZE)
    if name == "shapes":
        return load_shapes(
            train=data.train_per_class,
            test=data.test_per_class,
            size=size,
            seed=data.seed,
            cache=cache_folder(settings.train.cache),
        )
    is_labeled = name == "folder"
    load_images = load_folder if is_labeled else load_unlabeled
    return load_images(
        data.path if is_labeled else str(settings.unlabeled),
        size=size,
        test_fraction=data.test_fraction,
        skip_unreadable=settings.evaluate.skip_unreadable,
        workers=data.workers,
    )


def require_label(settings: ExperimentSettings, data: DataSet) -> None:
    """Check that the positive class is known, and that photographs can have it as a folder.

    The sub-folders of photographs have names of classes, and no indices.
    """
    needs_label = settings.augment.renders or settings.train.ranking_weight > 0
    if settings.label is None and needs_label:
        choices = ", ".join(data.classes[:5])
        raise InputError(
            f"label is not set: set it to the class of the meshes, one of the {len(data.classes)} "
            f"classes {choices}{', ...' if len(data.classes) > 5 else ''}",
            "label",
        )
    for label in () if settings.label is None else label_names(settings.label):
        name = class_name(data.classes, label, "label")
        if name != label and settings.scored_folders:
            raise InputError(f"label={label} is an index: give the name, label={name}", "label")


def relabel(settings: ExperimentSettings, data: DataSet, initial: Initial | None) -> DataSet:
    """Convert the labels of the data to indices into the classes of the network.

    A data set and the initial network can have different lists of classes. Without an initial
    network, the network has the classes of the data.
    """
    if not data.labeled:
        if not (initial and settings.train.distillation_weight):
            raise InputError(
                f"data.name={settings.data.name} has no labels, and requires a network to imitate: "
                "set network and train.distillation_weight"
            )
        return replace(data, classes=initial.classes)
    if initial and (data.rendered or initial.is_classifier):
        return relabeled(data, initial.classes, f"data.name={settings.data.name}")
    return data


def describe_test_images(settings: ExperimentSettings, data: DataSet) -> str:
    """Describe in words what the test accuracy of a run is measured on.

    An example is "rendered solids of 5 of the network's 1000 classes".
    """
    if not data.labeled:
        return f"the predictions of {settings.network} for held-out photographs"
    kind = "rendered solids" if data.rendered else f"the test images of {settings.data.name}"
    # Classes are counted in the training images, because the test images are not read
    # before the end of the run.
    class_count = len(data.train.labels.unique())
    if class_count == len(data.classes):
        return kind
    return f"{kind} of {class_count} of the network's {len(data.classes)} classes"


def build_service(
    settings: ExperimentSettings,
    data: DataSet,
    device: torch.device,
) -> AugmentationService:
    """Build the service that renders the training images of a run anew in each round.

    It has no images if the run trains without renders.
    """
    scene: Scene | None = None
    images: Tensor | None = None
    labels = torch.zeros(0, dtype=torch.int64, device=device)
    phases = Phases(device)
    names = [] if settings.label is None else label_names(settings.label)
    # The ranking loss compares images of a positive class with images of other classes. It
    # needs both.
    is_ranked = bool(settings.hard_negatives) or len(names) > 1
    positive_classes: list[int] = []
    if is_ranked or settings.augment.renders:
        positive_classes = [class_index(data.classes, name, "label") for name in names]

    if settings.augment.renders and settings.augment.mode == "folder":
        images, labels = load_renders(settings, data)
        images = images.to(device)
        labels = labels.to(device)
        is_ranked = len(labels.unique()) > 1
    elif settings.augment.renders:
        positive_names = [data.classes[index] for index in positive_classes]
        require_others(settings.negative_objects, positive_names, data.classes)
        label_of_class = _class_indices(settings, data)
        # An object of no class of the network has a complementary label: the negative
        # number says only that it is not of a positive class.
        label_of_class[OTHER] = complementary_label(positive_classes[0])
        scene = _build_scene(settings, data.size, device, phases)
        labels = torch.tensor([label_of_class[name] for name in scene.labels], device=device)

    has_complementary_labels = (labels < 0).any()
    if len(positive_classes) == len(data.classes) and has_complementary_labels:
        raise InputError(
            f"label={settings.label} has all classes of the network, but some renders show none "
            "of them: remove the objects without a class, or give them a label",
        )
    return AugmentationService(
        settings.augment,
        scene,
        labels,
        settings.seed,
        phases,
        positive_classes=positive_classes if is_ranked else (),
        rank=distributed.rank(),
        world_size=distributed.world_size(),
        images=images,
    )


def _build_scene(
    settings: ExperimentSettings,
    size: int,
    device: torch.device,
    phases: Phases,
) -> Scene:
    """Build the scene with meshes and hard negatives, in the first process before the others."""
    with keyed(**keys_of("renderer", settings.renderer)):
        rasterizer = choose_rasterizer(settings.renderer)
    console.debug("rasterizer: %s", rasterizer.description)
    with (
        phases("operators"),
        main_process_first(),
        keyed("scene", **keys_of("scene", settings.scene)),
    ):
        return build_scene(
            list(settings.objects.values()),
            size,
            settings.views,
            scene=settings.scene,
            renderer=settings.renderer,
            rasterizer=rasterizer,
            attack=settings.augment.attack,
            vary=settings.augment.vary,
            device=device,
        )


def _class_indices(settings: ExperimentSettings, data: DataSet) -> dict[str | int, int]:
    """Return the index of each class that a mesh or a hard negative of a run has.

    The class "other", which no network has, is left out.
    """
    indices: dict[str | int, int] = {}
    for key, item in settings.objects.items():
        if item.label != OTHER:
            indices[item.label] = class_index(data.classes, item.label, f"label of {key}")
    return indices


def load_renders(settings: ExperimentSettings, data: DataSet) -> tuple[Tensor, Tensor]:
    """Load images that are used as renders from the folder in the setting `augment.folder`.

    A label is the index of a class, or the complementary label in a subfolder that is no class.
    """
    folder = Path(str(settings.augment.folder))
    positive_classes = label_names(settings.label)
    label_of_class = {name: index for index, name in enumerate(data.classes)}
    label_of_negative = complementary_label(label_of_class[positive_classes[0]])
    with keyed("augment.folder"):
        found = find_photographs(folder, data.classes, positive_classes)
        found, images, _ = load_photographs(
            folder, found, data.size, settings.evaluate.skip_unreadable
        )
        missing = set(positive_classes) - {item.label for item in found}
        if missing:
            name = min(missing)
            raise InputError(
                f"{folder} has no image of label={name}: "
                f"add a sub-folder {name} with images of this class",
            )
    labels = [label_of_class.get(item.label, label_of_negative) for item in found]
    return images, torch.tensor(labels)
