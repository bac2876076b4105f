"""Whether what fools one network fools elsewhere: others, the same from other sides, the same on other meshes."""

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.attacks.adversary import Adversary
from augment.attacks.run import Attacked, logits_of
from augment.classifiers import Classifier
from augment.goal import Goal
from augment.objects import SceneObject
from renderer.errors import InputError

Pair = tuple[Adversary, Adversary]  # an example before the attack, and after
OF_MESH, OF_VIEW = ("geometry", "albedo", "pixels"), ("pixels",)  # kinds of which no other has what was changed


@dataclass(frozen=True)
class Transfer:
    """What the A adversaries, examples that were recognised and then fooled, do elsewhere.

    kind: "network", "azimuth" or "mesh"; name: which. classes: the network's. before, after: (A, V, C) logits.
    recognised: (A,) bool, in every view before the attack. fooled: (A,) bool, whether the attack's criterion is met in
    every view after it; it counts only of what was recognised.
    """

    kind: str
    name: str
    classes: Sequence[str]
    before: Tensor
    after: Tensor
    recognised: Tensor
    fooled: Tensor


def transfer(
    attacked: Attacked,
    classifiers: Sequence[Classifier] = (),
    azimuths: Sequence[float] = (),
    objects: Sequence[SceneObject] = (),
) -> Iterator[Transfer]:
    """Render an attack's adversaries anew for each classifier, at its size; for the one that was attacked, from cameras
    turned by degrees around the vertical; and, in place of its object, for each of others.

    What is added to pixels or is behind the object is resized for another network. InputError: as
    `require_transferable`, and where a classifier lacks a class.
    """
    require_transferable([kind.name for kind in attacked.problem.kinds], azimuths, objects)
    pairs, own = _pairs(attacked), attacked.classifier

    def judged(change: Callable[[Adversary], Adversary], kind: str, name: str, by: Classifier) -> Transfer:
        return _judged(attacked, [(change(old), change(new)) for old, new in pairs], kind, name, by)

    for classifier in classifiers:
        yield judged(partial(_resized, size=classifier.size), "network", classifier.name, classifier)
    for angle in azimuths:
        yield judged(partial(_turned, angle=math.radians(angle)), "azimuth", f"{angle:+g}°", own)
    for shown in objects:
        yield judged(partial(replace, shown=shown), "mesh", Path(shown.name).name, own)


def require_transferable(kinds: Collection[str], azimuths: Collection[float], objects: Collection[Any]) -> None:
    """InputError where kinds of parameters belong to a view or a mesh that is to be another."""
    for name, wanted, bound in (("azimuths", azimuths, OF_VIEW), ("meshes", objects, OF_MESH)):
        if wanted and (mine := [kind for kind in kinds if kind in bound]):
            raise InputError(f"transfer.{name}: attack={mine[0]} belongs to what was attacked: leave one of them out")


def _pairs(attacked: Attacked) -> list[Pair]:
    scene, problem = attacked.problem.scene, attacked.problem
    ends = problem.conditions(problem.start, problem.everything), attacked.conditions
    found = []
    for example in torch.nonzero(attacked.recognised & attacked.success).flatten().tolist():
        images = attacked.images_before[example], attacked.images[example]
        old, new = (Adversary.of(scene, example, each, *images) for each in ends)
        found.append((old, new))
    return found


def _resized(adversary: Adversary, size: int) -> Adversary:
    """For a network of another size."""
    if adversary.settings.size == size:
        return adversary

    def fit(images: Tensor) -> Tensor:
        return F.interpolate(images, (size, size), mode="bilinear", antialias=True, align_corners=False)

    return replace(
        adversary,
        settings=replace(adversary.settings, size=size),
        background=fit(adversary.background[None])[0].clamp(0, 1),
        pixels=None if adversary.pixels is None else fit(adversary.pixels),
    )


def _turned(adversary: Adversary, angle: float) -> Adversary:
    cameras = tuple(replace(camera, azimuth=camera.azimuth + angle) for camera in adversary.cameras)
    return replace(adversary, cameras=cameras)


def _judged(attacked: Attacked, pairs: Sequence[Pair], kind: str, name: str, classifier: Classifier) -> Transfer:
    goal, settings = _goal(attacked, [new.shown.label for _, new in pairs], classifier), attacked.settings
    backend, views, judge = attacked.problem.scene.backend, attacked.problem.scene.views, settings.judge(classifier)

    def logits(adversaries: Sequence[Adversary]) -> Tensor:
        if not adversaries:
            return torch.empty(0, views, len(classifier.classes))
        images = torch.stack([each.render(backend) for each in adversaries]).to(attacked.images)
        return logits_of(judge, images, settings.batch_size).cpu()

    before, after = (logits([pair[side] for pair in pairs]) for side in (0, 1))
    recognised = (before.argmax(2) == goal.decrease).all(1)
    return Transfer(kind, name, classifier.classes, before, after, recognised, goal.reached(after.argmax(2)))


def _goal(attacked: Attacked, labels: Sequence[str], classifier: Classifier) -> Goal:
    """The attack's own, by the names of its classes, for adversaries that show things with labels (A,)."""
    own, views = attacked.goal, attacked.problem.scene.views
    decrease = torch.tensor([[classifier.label(label)] * views for label in labels], dtype=torch.int64).view(-1, views)
    if own.increase is None:
        return Goal(decrease)
    wanted = own.increase[attacked.recognised & attacked.success].tolist()
    names = attacked.classifier.classes
    increase = [[classifier.label(names[index]) for index in row] for row in wanted]
    return Goal(decrease, torch.tensor(increase, dtype=torch.int64).view(-1, views))
