"""One call that attacks a classifier through a scene, and its result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from augment.attacks.adversary import Adversary
from augment.attacks.criteria import Criterion, Misclassification, Targeted
from augment.attacks.settings import AttackSettings
from augment.classifiers.adapter import Classifier
from augment.descent import AttackResult, descend_in_parts
from augment.goal import Goal
from augment.kind import StepSettings
from augment.memory import BatchSize
from augment.objects import SceneObject
from augment.perturbation import Perturbation
from augment.phases import Phases
from augment.scene import Conditions, Scene
from augment.seeding import generator
from renderer.arguments import checked
from renderer.errors import InputError

if TYPE_CHECKING:
    from augment.attacks.checks import Checks
    from augment.attacks.sweep import Sweep
    from augment.attacks.transfer import Transfer
    from augment.attacks.verification import Verdict


class NotRecognisedError(InputError):
    """The classifier is wrong before any attack."""


@dataclass(frozen=True)
class Attacked:
    """What was attacked and what came of it, for E examples of V views.

    images_before, images: (E, V, 3, size, size), neither of them rounded, with the shadows and bounces of each shape in
    its own colours; logits_before, logits: (E, V, C) of them, rounded where the settings say so. result: where the
    descent ended, which holds shadows and bounces while shape and colours change. seconds: of the descent.
    """

    problem: Perturbation
    classifier: Classifier
    goal: Goal
    settings: AttackSettings
    seed: int
    images_before: Tensor
    images: Tensor
    logits_before: Tensor
    logits: Tensor
    result: AttackResult
    seconds: dict[str, float]

    @property
    def judge(self) -> nn.Module:
        """The classifier, which is given what the settings say of an image."""
        return self.settings.judge(self.classifier)

    @property
    def success(self) -> Tensor:
        """(E,) bool: whether the criterion is met in every view."""
        return self.success_in_views.all(1)

    @property
    def success_in_views(self) -> Tensor:
        """(E, V) bool: whether the criterion is met in each view."""
        return self.goal.reached_in_views(self.logits.argmax(2))

    @property
    def recognised(self) -> Tensor:
        """(E,) bool: whether every view was given its label before, so that the attack can be credited with more."""
        return (self.logits_before.argmax(2) == self.goal.decrease).all(1)

    @property
    def steps(self) -> Tensor:
        """(E,) int64: taken."""
        return self.result.steps

    @property
    def conditions(self) -> Conditions:
        """The lights (E, 49, 3), vertices (E, N, 3), albedos and pixels that the attack ended with; `Conditions`."""
        return self.problem.conditions(self.result.values, self.problem.everything)

    def check(self) -> Checks:
        """Random search with as many tries, and success as steps grow: see `augment.attacks.checks.Checks`."""
        from augment.attacks.checks import check

        return check(self)

    @checked
    def sweep(self, scales: Sequence[float]) -> Sweep:
        """Success against the radius of the norm-balls: see `augment.attacks.sweep.sweep`."""
        from augment.attacks.sweep import sweep

        return sweep(self, scales)

    @checked
    def transfer(
        self,
        classifiers: Sequence[Classifier] = (),
        azimuths: Sequence[float] = (),
        objects: Sequence[SceneObject] = (),
    ) -> Iterator[Transfer]:
        """What the adversaries do elsewhere: see `augment.attacks.transfer.transfer`."""
        from augment.attacks.transfer import transfer

        return transfer(self, classifiers, azimuths, objects)

    @checked
    def save(
        self, folder: str | Path, checks: Checks | None = None, verify: Sequence[str] = ("reload",)
    ) -> list[Verdict]:
        """Write a folder: attack.jsonl and, for each example, an image of before and after and a folder with all of it.

        verify: "reload", "mitsuba" or both render these anew; what became of the adversaries is returned.
        """
        from augment.attacks.files import write_files

        return write_files(self, checks, Path(folder), verify)


@checked
def attack(
    classifier: Classifier,
    scene: Scene,
    criterion: Criterion | None = None,
    settings: AttackSettings | None = None,
    *,
    seed: int = 0,
    force: bool = False,
) -> Attacked:
    """Change a scene until a classifier errs, example by example; the classifier is left as it was found.

    criterion: `Misclassification` (the default), `Targeted`, `LeastLikely`. settings: what is changed, within which
    norm-balls; by default the light, without a limit. seed: of the restarts. force: also where the classifier is wrong
    to begin with. The scene lies on the classifier's device.
    NotRecognisedError where an example is not recognised before; InputError where the classifier lacks a class, or a
    target is the right one.
    """
    settings = settings or AttackSettings(lighting=StepSettings())
    settings.require_kinds()
    problem = settings.problem(scene)
    images_before = problem.images(problem.start)
    before = logits_of(settings.judge(classifier), images_before, settings.batch_size)
    labels = torch.tensor([classifier.label(label) for label in scene.labels], device=before.device)
    if not force:
        require_recognised(scene, before, labels, classifier)
    criterion = criterion or Misclassification()
    targets = criterion.targets(before, classifier)
    if isinstance(criterion, Targeted) and targets is not None and torch.eq(targets, labels[:, None]).any():
        raise InputError(f"target={criterion.classes} is the right class of an example: name one to mistake it for")
    goal = Goal(labels[:, None].expand(-1, scene.views), targets)
    phases = Phases(problem.start.device)
    starts = (problem.sample(generator(seed, restart + 1, "restart")) for restart in range(settings.restarts))
    with phases("attack"):
        seen = settings.observed(classifier, seed)
        result = descend_in_parts(seen, problem, goal, settings, phases, starts, scene.at_once)
        images = _with_own_transport(problem, result)
    after = logits_of(settings.judge(classifier), images, settings.batch_size)
    seconds = phases.take()
    return Attacked(problem, classifier, goal, settings, seed, images_before, images, before, after, result, seconds)


def _with_own_transport(problem: Perturbation, result: AttackResult) -> Tensor:
    """`Attacked.images` of a result."""
    scene, after = problem.scene, problem.conditions(result.values, problem.everything)
    if scene.settings.transport == "direct" or (after.vertices is None and after.albedo is None):
        return result.images
    left = (Adversary.of(scene, example, after, each, each) for example, each in enumerate(result.images))
    return torch.stack([each.render(scene.backend) for each in left]).to(result.images)


@torch.no_grad()
def logits_of(classifier: nn.Module, images: Tensor, batch_size: int) -> Tensor:
    """(E, V, C) of images (E, V, 3, H, W)."""
    flat = images.flatten(0, 1)
    logits = BatchSize(batch_size).map(lambda part: classifier(flat[part]), len(flat))
    return torch.cat(list(logits)).unflatten(0, images.shape[:2])


def answers(logits: Tensor, classes: Sequence[str]) -> dict[str, Any]:
    """The classes of the highest logits (V, C) by name, and their probabilities, for JSON."""
    best = logits.softmax(1).max(1)
    return {"answer": [classes[index] for index in best.indices.tolist()], "confidence": best.values.tolist()}


def require_recognised(scene: Scene, logits: Tensor, labels: Tensor, classifier: Classifier) -> None:
    """NotRecognisedError, with the classifier's five best answers, unless every image (E, V) has its label (E,)."""
    wrong = (logits.argmax(2) != labels[:, None]).nonzero().tolist()
    if wrong:
        example, view = wrong[0]
        shown = scene.objects[scene.examples[example].object]
        best = logits[example, view].softmax(0).topk(min(5, len(classifier.classes)))
        answers = ", ".join(
            f"{classifier.classes[index]} {share:.1%}"
            for share, index in zip(best.values.tolist(), best.indices.tolist(), strict=True)
        )
        raise NotRecognisedError(
            f"{len(wrong)} of {logits.shape[0] * logits.shape[1]} images of {shown.name} are not recognised as "
            f"{shown.label!r} before any attack (the first: {answers}): change the scene, or set attack.force=true"
        )
