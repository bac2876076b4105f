"""The renders of a training run: their scene, their labels, and the service that renders them."""

from pathlib import Path

import torch
from torch import Tensor

from augment import distributed
from augment.losses import complementary_label
from augment.network import class_index
from augment.progress import Phases
from augment.scene.build import build_scene
from augment.scene.scene import Scene
from augment.service import AugmentationService
from renderer.errors import InputError
from train import console
from train.class_names import require_others
from train.data.photographs import find_photographs, load_photographs
from train.data.sets import DataSet
from train.device import choose_rasterizer
from train.processes import main_process_first
from train.settings import OTHER, ExperimentSettings, label_names
from train.system.user_errors import keyed, keys_of


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
    is_ranked = bool(settings.scene.hard_negatives) or len(names) > 1
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
        require_others(settings.hard_negatives, positive_names, data.classes)
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
    """Build the scene with the meshes and hard negatives of a run, and log the rasterizer.

    If the run has several processes, the first one builds the scene before the
    others, which then find its files.
    """
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
        found, images, _ = load_photographs(folder, found, data.size, advice="")
        missing = set(positive_classes) - {item.label for item in found}
        if missing:
            name = min(missing)
            raise InputError(
                f"{folder} has no image of label={name}: "
                f"add a sub-folder {name} with images of this class",
            )
    labels = [label_of_class.get(item.label, label_of_negative) for item in found]
    return images, torch.tensor(labels)
