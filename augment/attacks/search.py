"""The search for a scene in which a classifier is right to begin with."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from typing import TypeVar

import torch
from torch import Tensor

from augment.attacks.attack import AttackSettings, logits_of
from augment.build import SceneSettings
from augment.classifiers import Classifier
from augment.progress import progress
from augment.scene import Scene
from renderer.light.basis import harmonics_of
from renderer.light.presets import PROBES, UNIFORM, load_light

POLAR, WIDTH = (20.0, 100.0), (1.8, 3.5)  # degrees and world units, from which cameras are drawn
CLOSEST = 2.0  # world units from the middle of a mesh, which all of it is within
FOV = 45.0  # degrees, of every other camera that is drawn where the scene is orthographic
LIGHT_GRAY = 0.9  # as things are shown in catalogs
EXPOSURES = (1.0, 0.5, 0.7, 1.5, 2.5, 4.0)  # times the scene's own
SURE = 0.5  # confidence, in every image, at which the search ends

Settings = TypeVar("Settings", bound=SceneSettings)


def find_scene(
    classifier: Classifier,
    settings: Settings,
    attack: AttackSettings,
    build: Callable[[Settings], Scene],
    cameras: int,
    draws: torch.Generator,
) -> Settings:
    """The settings of a scene, changed so that the classifier is right in every image where the attack would begin.

    build: a scene from settings. cameras: how many to try, each under the scene's light, the probes and uniform light
    at several exposures, and before light gray. Returns the settings of the most confident scene; the settings as they
    are, where the classifier is right in them, or in no candidate.
    """
    if _confidence(build(settings), attack, classifier).item() > 0:
        return settings
    highest, chosen = 0.0, settings
    for candidate in progress(_candidates(settings, cameras, draws), "search for a scene"):
        confidence, lit = _best_light(build(candidate), candidate, attack, classifier)
        if confidence > highest:
            highest, chosen = confidence, lit
        if highest >= SURE:
            break
    return chosen


def _candidates(settings: Settings, cameras: int, draws: torch.Generator) -> Iterator[Settings]:
    """The scene from several cameras, its own first, before its backgrounds and, instead of a gray, light gray."""
    for index in range(cameras):
        fov = FOV if settings.fov is None and index % 2 else settings.fov
        candidate = _with_random_camera(replace(settings, fov=fov), draws) if index else settings
        yield candidate
        if len(settings.backgrounds) == 1 and not isinstance(settings.backgrounds[0], str):
            yield replace(candidate, backgrounds=[LIGHT_GRAY])


def _best_light(
    scene: Scene, settings: Settings, attack: AttackSettings, classifier: Classifier
) -> tuple[float, Settings]:
    """The highest confidence, and the settings with the light and exposure that reach it."""
    names, degree = dict.fromkeys([settings.light, *PROBES, UNIFORM]), harmonics_of(scene.basis).degree
    loaded, lights = {name: load_light(name, degree) for name in names}, list(product(names, EXPOSURES))
    exposures = [settings.exposure * factor for _, factor in lights]
    coefficients = [loaded[name] * exposure for (name, _), exposure in zip(lights, exposures, strict=True)]
    sky = torch.stack(coefficients).repeat_interleave(len(scene), dim=0).to(scene.lights.device)
    lit = torch.cat([sky, scene.lights.repeat(len(lights), 1, 1)[:, sky.shape[1] :]], dim=1)  # projector and lamps stay
    rows = replace(scene, examples=[*scene.examples] * len(lights), lights=lit)
    confidence, index = _confidence(rows, attack, classifier, len(lights)).max(0)
    return float(confidence), replace(settings, light=lights[index][0], exposure=exposures[index])


@torch.no_grad()
def _confidence(scene: Scene, attack: AttackSettings, classifier: Classifier, groups: int = 1) -> Tensor:
    """(groups,) the least confidence in the label where an attack would begin, by group of rows; 0 for any error."""
    problem = attack.problem(scene)
    images = problem.images(problem.start)
    probabilities = logits_of(attack.preprocessed_model(classifier), images, attack.batch_size).softmax(2)
    labels = torch.tensor([classifier.label(label) for label in scene.labels], device=probabilities.device)[:, None]
    confidence = probabilities.gather(2, labels[..., None].expand(-1, scene.views, 1))[..., 0]
    return (confidence * (probabilities.argmax(2) == labels)).view(groups, -1).amin(1)


def _with_random_camera(settings: Settings, draws: torch.Generator) -> Settings:
    """The scene from another side and another distance, with the same field of view."""
    polar, azimuth, width = torch.rand(3, generator=draws).tolist()
    least, most = WIDTH
    if settings.fov is not None:
        narrowest = 2 * CLOSEST * math.tan(math.radians(settings.fov) / 2)
        least, most = max(least, narrowest), max(most, 2 * narrowest)
    return replace(
        settings,
        polar=round(POLAR[0] + (POLAR[1] - POLAR[0]) * polar, 1),
        azimuth=round(360 * azimuth, 1),
        width=round(least + (most - least) * width, 2),
    )
