"""An attack from its configuration: scene, criterion, and what is changed."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from augment.attacks.adversary import Adversary
from augment.attacks.attack import AttackResult, attack
from augment.attacks.criteria import Criterion, LeastLikely, Misclassification, Targeted
from augment.classifiers import Classifier
from augment.objects import ObjectSettings
from renderer.errors import InputError
from renderer.rasterizer import choose
from train.attacks.search import scene_of, search
from train.attacks.settings import AttackExperimentSettings, AttackSceneSettings
from train.settings import read_object

LEAST_LIKELY = "least_likely"


def attacks(
    settings: AttackExperimentSettings, classifier: Classifier, device: torch.device, adversary: Adversary | None = None
) -> Iterator[tuple[str, AttackSceneSettings, AttackResult]]:
    """(name, the scene that was attacked, what came of it) for an adversary to go on from or, without one, for each
    mesh, in a scene that was searched for where `scene.search` says so."""
    if adversary is not None:
        yield adversary.shown.name, settings.scene, attack_adversary(adversary, settings, classifier, device)
        return
    for index, item in enumerate(settings.scene.meshes):
        named = read_object(item, settings.label, index)
        sought = settings.scene.search and not settings.attack.force
        scene = search(named, settings, classifier, device) if sought else settings.scene
        yield named.mesh, scene, attack_mesh(named, replace(settings, scene=scene), classifier, device)


def attack_mesh(
    item: ObjectSettings, settings: AttackExperimentSettings, classifier: Classifier, device: torch.device
) -> AttackResult:
    """Attack one mesh under the settings, on the classifier's device.

    InputError also where the classifier does not recognize it to begin with.
    """
    scene = scene_of(item, settings, classifier.size, device)
    wanted, force = criterion(settings.target), settings.attack.force
    return attack(classifier, scene, wanted, settings.attack, seed=settings.seed, force=force)


def attack_adversary(
    adversary: Adversary, settings: AttackExperimentSettings, classifier: Classifier, device: torch.device
) -> AttackResult:
    """Go on from an adversary that was read back; norm-balls are around where it is."""
    if adversary.pixels is not None:
        raise InputError(
            "reload: this adversary's pixels were changed, from which no attack goes on: leave attack= out"
        )
    scene = adversary.scene(choose(settings.renderer.rasterizer), device)
    return attack(classifier, scene, criterion(settings.target), settings.attack, seed=settings.seed, force=True)


def criterion(target: object) -> Criterion:
    """Of target=null, least_likely, a class or a list of classes, one per view."""
    if target is None:
        return Misclassification()
    if target == LEAST_LIKELY:
        return LeastLikely()
    return Targeted([str(name) for name in target] if isinstance(target, list) else str(target))
