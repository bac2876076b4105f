"""An attack from its configuration: scene, criterion, and what is changed."""

import torch

from augment.attacks.criteria import Criterion, LeastLikely, Misclassification, Targeted
from augment.attacks.run import Attacked, attack
from augment.build import build_scene
from augment.classifiers import Classifier
from augment.objects import ObjectSettings
from train.attacks.settings import AttackExperimentSettings

LEAST_LIKELY = "least_likely"


def attack_mesh(
    item: ObjectSettings, settings: AttackExperimentSettings, classifier: Classifier, device: torch.device
) -> Attacked:
    """Attack one mesh under the settings, on the classifier's device.

    InputError also where the classifier does not recognise it to begin with.
    """
    scene = build_scene(
        [item],
        classifier.size,
        settings.scene.views,
        shared=settings.attack.shared,
        **settings.scene.choices,
        **settings.renderer.choices,
        device=device,
    )
    wanted, force = criterion(settings.target), settings.attack.force
    return attack(classifier, scene, wanted, settings.attack, seed=settings.seed, force=force)


def criterion(target: object) -> Criterion:
    """Of target=null, least_likely, a class or a list of classes, one per view."""
    if target is None:
        return Misclassification()
    if target == LEAST_LIKELY:
        return LeastLikely()
    return Targeted([str(name) for name in target] if isinstance(target, list) else str(target))
