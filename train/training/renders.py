"""The renders that a run trains on: the scene, its labels, and the service that makes them anew."""

from pathlib import Path

import torch
from torch import Tensor

from augment import distributed
from augment.classifiers.adapter import class_index
from augment.losses import complementary_label
from augment.progress import Phases
from augment.scene.build import build_scene
from augment.scene.scene import Scene
from augment.service import AugmentationService
from renderer.errors import InputError
from train import console
from train.class_names import require_others
from train.data.photographs import find_photographs, load_photographs
from train.data.sets import DataSet
from train.settings import OTHER, ExperimentSettings, label_names
from train.system.device import choose_rasterizer
from train.system.processes import main_process_first
from train.system.user_errors import keyed, keys_of


def build_service(
    settings: ExperimentSettings,
    data: DataSet,
    device: torch.device,
) -> AugmentationService:
    """Build the service that regenerates a run's renders, and log the rasterizer.

    Args:
        settings: The settings of the run.
        data: The data of the run, whose classes the renders share.
        device: The device that renders.

    Returns:
        The service. Without renders it has no examples.

    Raises:
        InputError: If a mesh, a background, a light or a class does not exist, or if no class is
            left for the negatives.
    """
    scene: Scene | None = None
    images: Tensor | None = None
    labels = torch.zeros(0, dtype=torch.int64, device=device)
    phases = Phases(device)
    names = label_names(settings.label)
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
        numbers = _class_numbers(settings, data)
        # Objects without a class have a complementary label: they belong to none
        # of the positive_classes classes.
        numbers[OTHER] = complementary_label(positive_classes[0])
        scene = _build_scene(settings, data.size, device, phases)
        labels = torch.tensor([numbers[name] for name in scene.labels], device=device)

    if len(positive_classes) == len(data.classes) and (labels < 0).any():
        raise InputError(
            f"label={settings.label} has all classes of the network, so that none is left "
            "for negatives without a class: remove them, or label them",
        )
    return AugmentationService(
        settings.augment,
        scene,
        labels,
        settings.seed,
        phases,
        positive_classes if is_ranked else (),
        distributed.rank(),
        distributed.world_size(),
        images,
    )


def _build_scene(
    settings: ExperimentSettings,
    size: int,
    device: torch.device,
    phases: Phases,
) -> Scene:
    """Build the scene with the meshes and hard negatives of a run.

    The first process builds the scene before the others.

    Args:
        settings: Settings of the run.
        size: Pixels per side of the renders.
        device: Device that renders.
        phases: Clock that adds the time to the phase "operators".
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


def _class_numbers(settings: ExperimentSettings, data: DataSet) -> dict[str, int]:
    """Return the index of each class that a mesh or a hard negative of the run has.

    Args:
        settings: Settings of the run, with its objects.
        data: Data of the run. The index counts its classes.

    Returns:
        Index by the name of the class. Objects of the class OTHER are left out.
    """
    return {
        item.label: class_index(data.classes, item.label, f"label of {key}")
        for key, item in settings.objects.items()
        if item.label != OTHER
    }


def load_renders(settings: ExperimentSettings, data: DataSet) -> tuple[Tensor, Tensor]:
    """Load the images of `augment.folder`, which take the place of renders.

    Args:
        settings: The settings of the run.
        data: The data of the run, whose classes the folders are named by.

    Returns:
        The images, uint8, shape (N, 3, size, size), and their class numbers, shape (N,).

    Raises:
        InputError: If the folder cannot be read, or it has no image of a positive class.
    """
    folder = Path(str(settings.augment.folder))
    positive_classes = label_names(settings.label)
    numbers = {name: index for index, name in enumerate(data.classes)}
    other = complementary_label(numbers[positive_classes[0]])
    with keyed("augment.folder"):
        found = find_photographs(folder, data.classes, positive_classes)
        found, images, _ = load_photographs(folder, found, data.size, advice="")
        missing = set(positive_classes) - {item.label for item in found}
        if missing:
            raise InputError(
                f"{folder} holds no image of label={min(missing)}: add a folder of them",
            )
    labels = torch.tensor([numbers.get(item.label, other) for item in found])
    return images, labels
