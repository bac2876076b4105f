"""An attack from its configuration: classifier, scene, what the classifier sees at first, descent, checks, files."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from augment.attack import AttackResult, Goal, descend_repeatedly
from augment.backgrounds import load_backgrounds
from augment.classifiers import Classifier
from augment.objects import ObjectSettings, load_object
from augment.perturbation import Perturbation
from augment.phases import Phases
from augment.scene import Scene
from augment.seeding import generator
from renderer.cache import OperatorCache, cache_folder
from renderer.camera import ring
from renderer.errors import InputError
from renderer.lights import load_light
from renderer.visibility import choose
from train.attacks.settings import AttackExperimentSettings

LEAST_LIKELY = "least_likely"


@dataclass(frozen=True)
class Attacked:
    """What was attacked and what came of it.

    logits_before, logits: (E, V, C) of the pictures at the start and at the end. seconds: of the descent.
    """

    problem: Perturbation
    classifier: Classifier
    goal: Goal
    images_before: Tensor
    logits_before: Tensor
    logits: Tensor
    result: AttackResult
    seconds: dict[str, float]


def attack_mesh(
    item: ObjectSettings, settings: AttackExperimentSettings, classifier: Classifier, device: torch.device
) -> Attacked:
    """Attack one mesh under the settings, on the classifier's device.

    InputError also where the classifier does not recognise it to begin with.
    """
    scene = build_scene(item, settings, classifier.size, device)
    problem = settings.attack.problem(scene)
    images = problem.render(problem.start, problem.everything).detach()
    before = logits_of(classifier, images, settings.attack.batch_size)
    label = classifier.label(item.label)
    if not settings.attack.force:
        require_recognised(item, before, label, classifier)
    goal = Goal(torch.full_like(before[..., 0], label, dtype=torch.int64), targets(settings, before, classifier))
    phases = Phases(problem.start.device)
    starts = (
        problem.sample(generator(settings.seed, restart + 1, "restart")) for restart in range(settings.attack.restarts)
    )
    with phases("attack"):
        result = descend_repeatedly(classifier, problem, goal, settings.attack.descent(), phases, starts)
    after = logits_of(classifier, result.images, settings.attack.batch_size)
    return Attacked(problem, classifier, goal, images, before, after, result, phases.take())


def build_scene(item: ObjectSettings, settings: AttackExperimentSettings, size: int, device: torch.device) -> Scene:
    """Views × backgrounds, as an example each or, where the views share what is attacked, an example per background."""
    scene, renderer = settings.scene, settings.renderer
    return Scene.grid(
        [load_object(item, scene.vertices)],
        ring(scene.views, scene.field_of_view, math.radians(scene.polar)),
        load_backgrounds(scene.backgrounds, size),
        (load_light(scene.light) * scene.exposure).to(device),
        renderer.pictures(size),
        choose(renderer.visibility),
        OperatorCache(cache_folder(renderer.cache)),
        shared=settings.attack.shared,
    )


@torch.no_grad()
def logits_of(classifier: Classifier, images: Tensor, batch_size: int) -> Tensor:
    """(E, V, C) of pictures (E, V, 3, H, W)."""
    flat = images.flatten(0, 1)
    return torch.cat([classifier(batch) for batch in flat.split(batch_size)]).unflatten(0, images.shape[:2])


def require_recognised(item: ObjectSettings, logits: Tensor, label: int, classifier: Classifier) -> None:
    """InputError, with the classifier's five best answers, unless it gives every picture (E, V) its label."""
    wrong = (logits.argmax(2) != label).nonzero().tolist()
    if wrong:
        example, view = wrong[0]
        best = logits[example, view].softmax(0).topk(min(5, len(classifier.classes)))
        answers = ", ".join(
            f"{classifier.classes[index]} {share:.1%}"
            for share, index in zip(best.values.tolist(), best.indices.tolist(), strict=True)
        )
        raise InputError(
            f"{len(wrong)} of {logits.shape[0] * logits.shape[1]} pictures of {item.mesh} are not recognised as "
            f"{item.label!r} before any attack (the first: {answers}): change the scene, or set attack.force=true"
        )


def targets(settings: AttackExperimentSettings, logits: Tensor, classifier: Classifier) -> Tensor | None:
    """(E, V) the classes to increase; None for an attack that takes any error."""
    target, views = settings.target, logits.shape[1]
    if target is None:
        return None
    if target == LEAST_LIKELY:
        return logits.argmin(2)
    names = [str(name) for name in target] if isinstance(target, list) else [str(target)] * views
    if len(names) != views:
        raise InputError(
            f"target={names} names {len(names)} classes for {views} views that share what is attacked: give as many, "
            "and attack.shared=true"
        )
    wanted = torch.tensor([classifier.label(name) for name in names], device=logits.device)
    return wanted.expand(len(logits), views)
