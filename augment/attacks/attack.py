"""One call that attacks a classifier through a scene: its settings and its result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from augment.attacks.adversary import Adversary
from augment.attacks.criteria import Criterion, Goal, Misclassification, Targeted
from augment.attacks.descent import DescentResult, DescentSettings, descend_in_parts
from augment.attacks.eot import EOTSettings, ExpectationOverTransformations, Rounded
from augment.attacks.parameters import PARAMETERS, AttackProblem, Lighting, SkylightSettings, StepSettings
from augment.classifiers.adapter import Classifier
from augment.objects import SceneObject
from augment.scene import Conditions, Scene
from augment.utils import BatchSize, Phases, generator
from renderer.errors import InputError, require_range

if TYPE_CHECKING:
    from augment.attacks.evaluate import Checks, RerenderCheck, Sweep, Transfer


@dataclass
class AttackSettings(DescentSettings):
    """None for what stays as it is. restarts: further starts, drawn from the norm-balls, where nothing is fooled yet.

    allow_negative: any coefficients of light; otherwise only light that something can emit (of harmonics: radiance
    nowhere negative), whatever is attacked, beginning with the nearest such light to the scene's.
    rounded: the classifier is given images of 8 bits. eot: over random changes of them.
    """

    lighting: StepSettings | None = None
    skylight: SkylightSettings | None = None
    projector: StepSettings | None = None
    lamps: StepSettings | None = None
    positions: StepSettings | None = None
    geometry: StepSettings | None = None
    albedo: StepSettings | None = None
    pixels: StepSettings | None = None
    allow_negative: bool = False
    restarts: int = 0
    batch_size: int = 32
    rounded: bool = False
    eot: EOTSettings = field(default_factory=EOTSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lighting and self.skylight:
            raise InputError("attack: lighting and skylight both set the light: choose one of them")
        require_range("attack.restarts", self.restarts, 0, 10**6)
        if self.restarts and any(settings.radius is None for settings in self.parameters.values()):
            raise InputError("attack.restarts draws from the norm-balls: set the radius of every kind, or restarts=0")

    @property
    def parameters(self) -> dict[str, StepSettings]:
        """The settings of what is changed, by name."""
        return {name: settings for name in PARAMETERS if (settings := getattr(self, name)) is not None}

    def require_parameters(self) -> None:
        """InputError where nothing is to be changed."""
        if not self.parameters:
            raise InputError(f"attack: name what to change, such as attack=lighting; there are {', '.join(PARAMETERS)}")

    def preprocessed_model(self, classifier: nn.Module) -> nn.Module:
        """A classifier that is given 8 bits, where they are rounded."""
        return Rounded(classifier) if self.rounded else classifier

    def eot_model(self, classifier: nn.Module, seed: int) -> nn.Module:
        """The judge's mean over the random changes of its images, if there are any: what a descent goes by."""
        preprocessed_model, draws = self.preprocessed_model(classifier), generator(seed, "expectation")
        return (
            ExpectationOverTransformations(preprocessed_model, self.eot, draws)
            if self.eot.draws
            else preprocessed_model
        )

    def problem(self, scene: Scene) -> AttackProblem:
        """What is changed of a scene, in light that is possible."""
        if not self.allow_negative:
            scene = replace(scene, lights=scene.basis.project_nonnegative(scene.lights))
        parameters = PARAMETERS | {Lighting.name: partial(Lighting, physical=not self.allow_negative)}
        return AttackProblem(scene, [parameters[name](scene, settings) for name, settings in self.parameters.items()])


class NotCleanCorrectError(InputError):
    """The classifier is wrong before any attack."""


@dataclass(frozen=True)
class AttackResult:
    """What was attacked and what came of it, for E examples of V views.

    images_before, images: (E, V, 3, size, size), neither of them rounded, with the shadows and bounces of each shape in
    its own colors; logits_before, logits: (E, V, C) of them, rounded where the settings say so. descent: where the
    descent ended, which holds shadows and bounces while shape and colors change. seconds: of the descent.
    """

    problem: AttackProblem
    classifier: Classifier
    goal: Goal
    settings: AttackSettings
    seed: int
    images_before: Tensor
    images: Tensor
    logits_before: Tensor
    logits: Tensor
    descent: DescentResult
    seconds: dict[str, float]

    @property
    def preprocessed_model(self) -> nn.Module:
        """The classifier, which is given what the settings say of an image."""
        return self.settings.preprocessed_model(self.classifier)

    @property
    def success(self) -> Tensor:
        """(E,) bool: whether the criterion is met in every view."""
        return self.success_in_views.all(1)

    @property
    def success_in_views(self) -> Tensor:
        """(E, V) bool: whether the criterion is met in each view."""
        return self.goal.reached_in_views(self.logits.argmax(2))

    @property
    def clean_correct(self) -> Tensor:
        """(E,) bool: whether every view was given its label before, so that the attack can be credited with more."""
        return (self.logits_before.argmax(2) == self.goal.source).all(1)

    @property
    def steps(self) -> Tensor:
        """(E,) int64: taken."""
        return self.descent.steps

    @property
    def conditions(self) -> Conditions:
        """The lights (E, 49, 3), vertices (E, N, 3), albedos and pixels that the attack ended with; `Conditions`."""
        return self.problem.conditions(self.descent.values, self.problem.everything)

    def check(self) -> Checks:
        """Random search with as many tries, and success as steps grow: see `augment.attacks.evaluate.Checks`."""
        from augment.attacks.evaluate import check

        return check(self)

    def sweep(self, scales: Sequence[float]) -> Sweep:
        """Success against the radius of the norm-balls: see `augment.attacks.evaluate.sweep`."""
        from augment.attacks.evaluate import sweep

        return sweep(self, scales)

    def transfer(
        self,
        classifiers: Sequence[Classifier] = (),
        azimuths: Sequence[float] = (),
        objects: Sequence[SceneObject] = (),
    ) -> Iterator[Transfer]:
        """What the adversaries do elsewhere: see `augment.attacks.evaluate.transfer`."""
        from augment.attacks.evaluate import transfer

        return transfer(self, classifiers, azimuths, objects)

    def save(
        self, folder: str | Path, checks: Checks | None = None, verify: Sequence[str] = ("reload",)
    ) -> list[RerenderCheck]:
        """Write a folder: attack.jsonl and, for each example, an image of before and after and a folder with all of it.

        verify: "reload", "mitsuba" or both render these anew; what became of the adversaries is returned.
        """
        from augment.attacks.files import write_files

        return write_files(self, checks, Path(folder), verify)


def attack(
    classifier: Classifier,
    scene: Scene,
    criterion: Criterion | None = None,
    settings: AttackSettings | None = None,
    *,
    seed: int = 0,
    force: bool = False,
) -> AttackResult:
    """Change a scene until a classifier errs, example by example; the classifier is left as it was found.

    criterion: `Misclassification` (the default), `Targeted`, `LeastLikely`. settings: what is changed, within which
    norm-balls; by default the light, without a limit. seed: of the restarts. force: also where the classifier is wrong
    to begin with. The scene lies on the classifier's device.
    NotCleanCorrectError where an example is not recognized before; InputError where the classifier lacks a class, or a
    target is the right one.
    """
    settings = settings or AttackSettings(lighting=StepSettings())
    settings.require_parameters()
    problem = settings.problem(scene)
    images_before = problem.images(problem.start)
    before = logits_of(settings.preprocessed_model(classifier), images_before, settings.batch_size)
    labels = torch.tensor([classifier.label(label) for label in scene.labels], device=before.device)
    if not force:
        require_clean_correct(scene, before, labels, classifier)
    criterion = criterion or Misclassification()
    targets = criterion.targets(before, classifier)
    if isinstance(criterion, Targeted) and targets is not None and torch.eq(targets, labels[:, None]).any():
        raise InputError(f"target={criterion.classes} is the right class of an example: name one to mistake it for")
    goal = Goal(labels[:, None].expand(-1, scene.views), targets)
    phases = Phases(problem.start.device)
    starts = (problem.sample(generator(seed, restart + 1, "restart")) for restart in range(settings.restarts))
    with phases("attack"):
        seen = settings.eot_model(classifier, seed)
        result = descend_in_parts(seen, problem, goal, settings, phases, starts, scene.at_once)
        images = _with_own_transport(problem, result)
    after = logits_of(settings.preprocessed_model(classifier), images, settings.batch_size)
    seconds = phases.take()
    return AttackResult(
        problem, classifier, goal, settings, seed, images_before, images, before, after, result, seconds
    )


def _with_own_transport(problem: AttackProblem, result: DescentResult) -> Tensor:
    """`AttackResult.images` of a result."""
    scene, after = problem.scene, problem.conditions(result.values, problem.everything)
    if not scene.settings.global_illumination or (after.vertices is None and after.albedo is None):
        return result.images
    left = (Adversary.of(scene, example, after, each, each) for example, each in enumerate(result.images))
    return torch.stack([each.render(scene.rasterizer) for each in left]).to(result.images)


@torch.no_grad()
def logits_of(classifier: nn.Module, images: Tensor, batch_size: int) -> Tensor:
    """(E, V, C) of images (E, V, 3, H, W)."""
    flat = images.flatten(0, 1)
    logits = BatchSize(batch_size).map(lambda part: classifier(flat[part]), len(flat))
    return torch.cat(list(logits)).unflatten(0, images.shape[:2])


def predictions(logits: Tensor, classes: Sequence[str]) -> dict[str, Any]:
    """The classes of the highest logits (V, C) by name, and their probabilities, for JSON."""
    best = logits.softmax(1).max(1)
    return {"predicted": [classes[index] for index in best.indices.tolist()], "confidence": best.values.tolist()}


def require_clean_correct(scene: Scene, logits: Tensor, labels: Tensor, classifier: Classifier) -> None:
    """NotCleanCorrectError, with the classifier's five best answers, unless every image (E, V) has its label (E,)."""
    wrong = (logits.argmax(2) != labels[:, None]).nonzero().tolist()
    if wrong:
        example, view = wrong[0]
        shown = scene.objects[scene.examples[example].object]
        best = logits[example, view].softmax(0).topk(min(5, len(classifier.classes)))
        predictions = ", ".join(
            f"{classifier.classes[index]} {share:.1%}"
            for share, index in zip(best.values.tolist(), best.indices.tolist(), strict=True)
        )
        raise NotCleanCorrectError(
            f"{len(wrong)} of {logits.shape[0] * logits.shape[1]} images of {shown.name} are not recognized as "
            f"{shown.label!r} before any attack (the first: {predictions}): change the scene, or set attack.force=true"
        )
