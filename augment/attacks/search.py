"""Search for a scene whose images a classifier recognizes before an attack."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from augment.attack_settings import AttackSettings
from augment.attacks.attack import logits_of, source_labels
from augment.attacks.eot import preprocessed_model
from augment.attacks.problem import build_problem
from augment.classifiers import Classifier
from augment.progress import progress
from augment.scene.scene import Scene
from augment.settings import SceneSettings
from renderer.light.basis import harmonics_of
from renderer.light.presets import PROBES, UNIFORM, load_light

# Range of the polar angle of random cameras, in degrees, and of the width of their
# view, in world units.
POLAR = (20.0, 100.0)
WIDTH = (1.8, 3.5)

# A normalized mesh lies within this distance of the origin, in world units.
CLOSEST = 2.0

# Field of view in degrees. If the camera of the scene is orthographic, every
# second candidate has a perspective camera with this field of view.
FOV = 45.0

# Gray value of a background like in product photographs.
LIGHT_GRAY = 0.9

# Exposures that are tried, as factors of the exposure of the scene.
EXPOSURES = (1.0, 0.5, 0.7, 1.5, 2.5, 4.0)

# The search ends when the confidence is at least this high in all images.
CONFIDENCE_TO_STOP = 0.5

Settings = TypeVar("Settings", bound=SceneSettings)


def find_scene(
    classifier: Classifier,
    settings: Settings,
    attack: AttackSettings,
    build: Callable[[Settings], Scene],
    cameras: int,
    draws: torch.Generator,
) -> Settings:
    """Search for a scene whose images a classifier recognizes before the attack.

    The search tries several cameras. Each is tried in the light of the scene, in
    the built-in environments and in uniform light, with several exposures, and
    also in front of a light gray background.

    Args:
        classifier: The classifier to attack.
        settings: Settings of a scene.
        attack: Settings of the attack.
        build: A function from settings of a scene to the scene.
        cameras: Number of cameras to try.
        draws: CPU generator of the random cameras.

    Returns:
        Settings of the scene with the highest confidence. The given settings,
        if all images are correct with them, or if no candidate is better.
    """
    [confidence] = _confidences(build(settings), attack, classifier)
    if confidence > 0:
        return settings
    highest = 0.0
    chosen = settings
    for candidate in progress(_candidates(settings, cameras, draws), "search for a scene"):
        confidence, lit = _best_light(build(candidate), candidate, attack, classifier)
        if confidence > highest:
            highest = confidence
            chosen = lit
        if highest >= CONFIDENCE_TO_STOP:
            break
    return chosen


def _candidates(settings: Settings, cameras: int, draws: torch.Generator) -> Iterator[Settings]:
    """Yield settings of the scene with several cameras. The first has the camera of the scene.

    If the only background is a gray value, each candidate is followed by the
    same candidate in front of light gray.
    """
    has_one_gray = len(settings.backgrounds) == 1 and not isinstance(settings.backgrounds[0], str)
    for index in range(cameras):
        candidate = settings
        if index > 0:
            is_orthographic_turn = settings.fov is None and index % 2 == 1
            fov = FOV if is_orthographic_turn else settings.fov
            candidate = _with_random_camera(replace(settings, fov=fov), draws)
        yield candidate
        if has_one_gray:
            yield replace(candidate, backgrounds=[LIGHT_GRAY])


def _with_random_camera(settings: Settings, draws: torch.Generator) -> Settings:
    """Return a copy of the settings with a camera at a random place and the same field of view."""
    polar, azimuth, width = torch.rand(3, generator=draws).tolist()
    lowest_polar, highest_polar = POLAR
    narrowest, widest = WIDTH
    if settings.fov is not None:
        closest_width = 2 * CLOSEST * math.tan(math.radians(settings.fov) / 2)
        narrowest = max(narrowest, closest_width)
        widest = max(widest, 2 * closest_width)
    return replace(
        settings,
        polar=round(lowest_polar + (highest_polar - lowest_polar) * polar, 1),
        azimuth=round(360 * azimuth, 1),
        width=round(narrowest + (widest - narrowest) * width, 2),
    )


def _best_light(
    scene: Scene, settings: Settings, attack: AttackSettings, classifier: Classifier
) -> tuple[float, Settings]:
    """Try lights and exposures, and return the highest confidence and its settings."""
    names = dict.fromkeys([settings.light, *PROBES, UNIFORM])
    degree = harmonics_of(scene.basis).degree
    candidates = []
    coefficients = []
    for name in names:
        light = load_light(name, degree)
        for factor in EXPOSURES:
            exposure = settings.exposure * factor
            candidates.append(replace(settings, light=name, exposure=exposure))
            coefficients.append(light * exposure)
    lit = _under_lights(scene, torch.stack(coefficients))
    confidences = _confidences(lit, attack, classifier, groups=len(candidates))
    highest, index = confidences.max(0)
    return float(highest), candidates[index]


def _under_lights(scene: Scene, skies: Tensor) -> Scene:
    """Return a scene with N copies of the examples, one for each environment light.

    The lights have shape (N, K, 3). Projector and lamps do not change.
    """
    count = len(skies)
    sky = skies.repeat_interleave(len(scene), dim=0).to(scene.lights.device)
    local_lights = scene.lights.repeat(count, 1, 1)[:, sky.shape[1] :]
    lights = torch.cat([sky, local_lights], dim=1)
    return scene.changed(examples=[*scene.examples] * count, lights=lights)


@torch.no_grad()
def _confidences(
    scene: Scene,
    attack: AttackSettings,
    classifier: Classifier,
    groups: int = 1,
) -> Tensor:
    """Return the lowest confidence in the true class among the images of each group.

    The images are rendered with the initial attack values. The examples are
    divided into groups of equal size. A misclassified image counts as a
    confidence of 0. The result has shape (groups,).
    """
    problem = build_problem(attack, scene)
    images = problem.images(problem.start)
    logits = logits_of(preprocessed_model(attack, classifier), images, attack.batch_size)
    probabilities = logits.softmax(2)
    labels = source_labels(scene, logits, classifier)
    confidence = probabilities.gather(2, labels[..., None])[..., 0]
    is_correct = probabilities.argmax(2) == labels
    return (confidence * is_correct).view(groups, -1).amin(1)
