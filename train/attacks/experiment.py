"""An attack from its configuration: scene, criterion, and what is changed."""

import math

import torch

from augment.attacks.criteria import Criterion, LeastLikely, Misclassification, Targeted
from augment.attacks.run import Attacked, attack
from augment.backgrounds import load_backgrounds
from augment.classifiers import Classifier
from augment.objects import ObjectSettings, load_object
from augment.scene import Scene
from renderer.cache import OperatorCache, cache_folder
from renderer.camera import ring
from renderer.lights import load_light
from renderer.visibility import choose
from train.attacks.settings import AttackExperimentSettings

LEAST_LIKELY = "least_likely"


def attack_mesh(
    item: ObjectSettings, settings: AttackExperimentSettings, classifier: Classifier, device: torch.device
) -> Attacked:
    """Attack one mesh under the settings, on the classifier's device.

    InputError also where the classifier does not recognise it to begin with.
    """
    scene = build_scene(item, settings, classifier.size, device)
    wanted, force = criterion(settings.target), settings.attack.force
    return attack(classifier, scene, wanted, settings.attack, seed=settings.seed, force=force)


def build_scene(item: ObjectSettings, settings: AttackExperimentSettings, size: int, device: torch.device) -> Scene:
    """Views × backgrounds, as an example each or, where the views share what is attacked, an example per background."""
    scene, renderer = settings.scene, settings.renderer
    return Scene.grid(
        [load_object(item, scene.vertices)],
        ring(scene.views, scene.field_of_view, math.radians(scene.polar), math.radians(scene.azimuth)),
        load_backgrounds(scene.backgrounds, size),
        (load_light(scene.light) * scene.exposure).to(device),
        renderer.images(size),
        choose(renderer.visibility),
        OperatorCache(cache_folder(renderer.cache)),
        shared=settings.attack.shared,
    )


def criterion(target: object) -> Criterion:
    """Of target=null, least_likely, a class or a list of classes, one per view."""
    if target is None:
        return Misclassification()
    if target == LEAST_LIKELY:
        return LeastLikely()
    return Targeted([str(name) for name in target] if isinstance(target, list) else str(target))
