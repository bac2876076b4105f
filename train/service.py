"""The renders that a run's settings ask for: the scene, its labels, and the service that regenerates them."""

import time

import torch

from augment.build import build_scene
from augment.classifiers.adapter import class_index
from augment.labels import complementary_label
from augment.scene import Scene
from augment.service import AugmentationService
from augment.utils import Phases, rank, world_size
from renderer.cache import OperatorCache
from renderer.light.harmonics import nonzero_coefficients
from renderer.transfer import COEFFICIENTS, DEGREE
from train.data import DataSet
from train.distributed import first_process_first
from train.run_folder.logs import console
from train.settings import OTHER, ExperimentSettings


def build_service(
    settings: ExperimentSettings, data: DataSet, device: torch.device, phases: Phases
) -> AugmentationService:
    scene, labels, label = None, torch.zeros(0, dtype=torch.int64), None
    if settings.augment.renders:
        with phases("operators"), first_process_first():
            scene = _build_scene(settings, data, device)
        under_study = class_index(data.classes, settings.label, "label")
        number = {OTHER: complementary_label(under_study)} | {name: index for index, name in enumerate(data.classes)}
        labels = torch.tensor([number[name] for name in scene.labels])
        label = under_study if settings.scene.hard_negatives else None
    labels = labels.to(device)
    return AugmentationService(settings.augment, scene, labels, settings.seed, phases, label, rank(), world_size())


def _build_scene(settings: ExperimentSettings, data: DataSet, device: torch.device) -> Scene:
    for key, item in settings.objects.items():
        if item.label != OTHER:
            class_index(data.classes, item.label, f"label of {key}")
    choices, start = settings.renderer.choices, time.perf_counter()
    console.info("rasterizer: %s", choices["rasterizer"].description)
    objects = list(settings.objects.values())
    built = build_scene(objects, data.size, settings.views, **settings.scene.choices, **choices, device=device)
    if settings.augment.relights:
        _log_skipped(built, choices["operators"], start)
    else:
        console.info("operators: none are kept, since views are rasterized in every epoch")
    return built


def _log_skipped(scene: Scene, cache: OperatorCache, start: float) -> None:
    """Say what the examples share and what was left out of them."""
    stacks, tally = scene.stacks, cache.tally
    covered = sum(len(stack.pixels) for stack in stacks) / len(stacks)
    console.info(
        "operators: %d views for %d examples, %d from the cache, %d built (%.2f s)%s",
        tally["views"],
        len(scene),
        tally["views"] - tally["built"],
        tally["built"],
        time.perf_counter() - start,
        f"; not kept: {cache.problem}" if cache.problem else "",
    )
    console.info(
        "skipped: rasterization in every epoch, %d of %d light coefficients, %.0f %% of the pixels (background), "
        "%.0f %% of the faces (seen by no sample), back faces in %d of %d views (closed meshes)",
        COEFFICIENTS - len(nonzero_coefficients(DEGREE)),
        COEFFICIENTS,
        100 * (1 - covered / scene.settings.size**2),
        100 * tally["unseen_faces"] / tally["faces"],
        tally["closed"],
        tally["views"],
    )
