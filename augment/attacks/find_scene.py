"""Search for a scene whose images a classifier recognizes before an attack."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from augment.attack_settings import AttackSettings
from augment.attacks.objective import preprocessed_model
from augment.attacks.problem import build_problem, source_labels
from augment.classifier import Classifier
from augment.network import compute_outputs
from augment.progress import progress
from augment.scene.scene import Scene
from augment.settings import SceneSettings
from renderer.light.basis import harmonics_of
from renderer.light.files import PROBES, UNIFORM, load_light

# `_with_random_camera` draws the polar angle of a camera from the range `POLAR`, in degrees, and
# the width of the visible region from the range `WIDTH`, in world units.
POLAR = (20.0, 100.0)
WIDTH = (1.8, 3.5)

# Smallest distance of a random perspective camera from the origin, in world units. A
# normalized mesh lies within this distance, so the camera is outside of the mesh.
CLOSEST = 2.0

# If the camera of the scene is orthographic, every second camera that the search tries is a
# perspective camera with this field of view in degrees.
FOV = 45.0

# Gray value of the background that the search tries, like that of product photographs.
LIGHT_GRAY = 0.9

# Exposures that are tried, as factors of the exposure of the scene.
EXPOSURES = (1.0, 0.5, 0.7, 1.5, 2.5, 4.0)

# The search for a scene ends when the classifier gives the true class at least this probability
# in all images.
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

    The search tries several cameras. Each is tried in the light of the scene, in the built-in
    environments and in uniform light, with several exposures, and also in front of a light gray
    background. It ends when the classifier gives the true class a probability of at least
    `CONFIDENCE_TO_STOP` in all images. The given settings are returned if the classifier is right
    in all their images, or if no other scene is recognized.
    """
    [confidence] = _confidences(build(settings), attack, classifier)
    # `_confidences` returns 0 if an image is misclassified.
    if confidence > 0:
        return settings
    highest = 0.0
    best_settings = settings
    for candidate in progress(_candidates(settings, cameras, draws), "search for a scene"):
        confidence, lit_candidate = _best_light(build(candidate), candidate, attack, classifier)
        if confidence > highest:
            highest = confidence
            best_settings = lit_candidate
        if highest >= CONFIDENCE_TO_STOP:
            break
    return best_settings


def _candidates(settings: Settings, cameras: int, draws: torch.Generator) -> Iterator[Settings]:
    """Yield copies of the settings of a scene with different cameras and backgrounds.

    If the only background is a gray value, each camera is used twice: with this
    background and with a light gray one.
    """
    has_one_gray = len(settings.backgrounds) == 1 and not isinstance(settings.backgrounds[0], str)
    for index in range(cameras):
        candidate = settings
        if index > 0:
            is_orthographic = settings.fov is None
            becomes_perspective = is_orthographic and index % 2 == 1
            fov = FOV if becomes_perspective else settings.fov
            candidate = _with_random_camera(replace(settings, fov=fov), draws)
        yield candidate
        if has_one_gray:
            yield replace(candidate, backgrounds=[LIGHT_GRAY])


def _with_random_camera(settings: Settings, draws: torch.Generator) -> Settings:
    """Return a copy of a scene's settings with a camera at a random place.

    The field of view stays the same, or the camera stays orthographic.
    """
    polar, azimuth, width = torch.rand(3, generator=draws).tolist()
    lowest_polar, highest_polar = POLAR
    narrowest, widest = WIDTH
    if settings.fov is not None:
        # Width of what a perspective camera sees at the origin if it is `CLOSEST` away. A
        # smaller width would bring the camera closer.
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
    """Find the light and the exposure in which a classifier recognizes a scene best.

    Return the confidence (the lowest probability of the true class in all images, or 0 if one is
    misclassified), and the settings that give it.
    """
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
    # Put all candidates into one scene, so that they are rendered and classified in large batches.
    scene_of_candidates = _under_lights(scene, torch.stack(coefficients))
    confidences = _confidences(scene_of_candidates, attack, classifier, groups=len(candidates))
    highest, index = confidences.max(0)
    return float(highest), candidates[index]


def _under_lights(scene: Scene, skies: Float[Tensor, "N K 3"]) -> Scene:
    """Return a scene that repeats all examples in each of several environment lights.

    Example n · E + e is example e in light n. Projector and lamps are those of the given scene.
    """
    count = len(skies)
    # Environment light of each new example, shape (N · E, K, 3).
    environment = skies.repeat_interleave(len(scene), dim=0).to(scene.lights.device)
    # The first K coefficients of an example are its environment light, and the others its
    # projector and lamps.
    local_lights = scene.lights.repeat(count, 1, 1)[:, environment.shape[1] :]
    lights = torch.cat([environment, local_lights], dim=1)
    return scene.changed(examples=[*scene.examples] * count, lights=lights)


@torch.no_grad()
def _confidences(
    scene: Scene,
    attack: AttackSettings,
    classifier: Classifier,
    groups: int = 1,
) -> Float[Tensor, " groups"]:
    """Compute how surely a classifier recognizes each group of examples before an attack.

    The confidence of an image is the probability of its true class, or 0 if the image is
    misclassified. The confidence of a group is the lowest one of its images. Each group has
    E / groups successive examples.
    """
    problem = build_problem(attack, scene)
    images = problem.images(problem.start)
    logits = compute_outputs(preprocessed_model(attack, classifier), images, attack.batch_size)
    # Probability of each of the C classes in each view of each example, shape (E, V, C).
    probabilities = logits.softmax(2)
    labels = source_labels(scene, logits, classifier)
    confidence = probabilities.gather(2, labels[..., None])[..., 0]
    is_correct = probabilities.argmax(2) == labels
    return (confidence * is_correct).view(groups, -1).amin(1)
