"""Attacks and uniform draws in norm-balls of light, shape and pixels."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from augment.attacks.run import logits_of
from augment.classifiers import Classifier
from augment.descent import DescentSettings, descend
from augment.goal import Goal
from augment.parameters import KINDS, StepSettings
from augment.perturbation import Perturbation
from augment.phases import Phases
from augment.scene import Scene
from train.studies.paper.subjects import Subject, scene_of

PART = 10  # examples attacked at once


@dataclass(frozen=True)
class Space:
    """What is perturbed: L∞ radii, the paper's among them; the length of a step along the gradient's sign, in radii.

    A whole radius is the fast gradient sign method, so that images of pixel attacks reach their radius.
    """

    title: str
    axis: str
    radii: tuple[float, ...]
    paper: tuple[float, ...]
    step: float


LEVELS = {"small": 0.12, "medium": 0.53, "large": 0.82}  # the paper's L∞ on the image
SPACES = {
    "lighting": Space("light", "per coefficient", (0.02, 0.05, 0.1, 0.3, 1.0), (0.1,), 0.25),
    "geometry": Space("shape", "per vertex and axis", (0.0001, 0.0005, 0.002, 0.01, 0.03), (0.002,), 0.25),
    "pixels": Space("pixels", "per value", (0.01, *LEVELS.values()), tuple(LEVELS.values()), 1.0),
}


@dataclass(frozen=True)
class Outcome:
    """What a ball holds for E examples.

    adversarial, random, search: (E,) bool, fooled by the descent, by one uniform draw, by any of as many draws as the
    descent may take steps. reach, random_reach: (E,) L∞ between the starting image and those of the first two.
    before, images: (E, 3, H, W) at the start and where the descent ended; predicted: (E,) its class.
    """

    adversarial: Tensor
    random: Tensor
    search: Tensor
    reach: Tensor
    random_reach: Tensor
    before: Tensor
    images: Tensor
    predicted: Tensor


@torch.no_grad()
def attack_ball(
    scene: Scene, classifier: Classifier, label: str, name: str, radius: float, steps: int, draws: torch.Generator
) -> Outcome:
    """Descend and draw in one ball of a space."""
    space = SPACES[name]
    problem = Perturbation(scene, [KINDS[name](scene, StepSettings("linf", radius, "sign", radius * space.step))])
    goal = Goal(torch.full((len(scene), 1), classifier.label(label)))
    everything = torch.arange(len(scene))

    def fooled(images: Tensor, examples: Tensor) -> Tensor:
        return goal.of(examples).reached(logits_of(classifier, images, PART).argmax(2))

    before = problem.render(problem.start, everything)
    # The gradient of geometry holds visibility fixed, so that whole steps may raise the cost.
    descent = DescentSettings(steps, shorten=name == "geometry", batch_size=PART)
    result = descend(classifier, problem, goal, descent, Phases(problem.start.device))
    drawn = problem.render(problem.sample(draws), everything)
    random = fooled(drawn, everything)
    search = random.clone()
    for _ in range(steps - 1):
        left = torch.nonzero(~search).squeeze(1)
        if len(left):
            search[left] = fooled(problem.render(problem.sample(draws)[left], left), left)
    return Outcome(
        result.fooled,
        random,
        search,
        distance(result.images, before),
        distance(drawn, before),
        before[:, 0],
        result.images[:, 0],
        result.predicted[:, 0],
    )


def distance(images: Tensor, before: Tensor) -> Tensor:
    """(E,) L∞ between images (E, 1, 3, H, W)."""
    return (images - before).abs().flatten(1).amax(1)


def parts(subject: Subject, scene: Scene, classifier: Classifier, light: str) -> Iterator[Scene]:
    """A scene's examples a few at a time: the gradient of a shape keeps all its images' samples."""
    for examples in torch.arange(len(scene)).split(PART):
        cameras = [scene.cameras[index] for index in examples]
        yield scene_of(subject, classifier, light, cameras, scene.backgrounds[examples, 0, 0, 0])


def joined(found: Sequence[Outcome]) -> Outcome:
    """One outcome of several, example after example."""
    return Outcome(*(torch.cat([getattr(each, field.name) for each in found]) for field in fields(Outcome)))
