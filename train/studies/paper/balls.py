"""Attacks and uniform draws in norm-balls of light, shape and pixels."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from augment.attacks.attack import logits_of
from augment.attacks.criteria import Goal
from augment.attacks.descent import DescentSettings, descend
from augment.attacks.parameters import PARAMETERS, AttackProblem, StepSettings
from augment.classifiers import Classifier
from augment.scene import Scene
from augment.utils import Phases
from train.studies.paper.subjects import PART, part_of


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
    descent may take steps. before, images: (E, 3, H, W) at the start and where the descent ended; predicted: (E,) its
    class; reach: (E,) L∞ between the images.
    """

    adversarial: Tensor
    random: Tensor
    search: Tensor
    before: Tensor
    images: Tensor
    predicted: Tensor

    @property
    def reach(self) -> Tensor:
        return (self.images - self.before).abs().flatten(1).amax(1)


@torch.no_grad()
def attack_ball(
    scene: Scene, classifier: Classifier, label: str, name: str, radius: float, steps: int, draws: torch.Generator
) -> Outcome:
    """Descend and draw in one ball of a space."""
    space = SPACES[name]
    problem = AttackProblem(scene, [PARAMETERS[name](scene, StepSettings("linf", radius, "sign", radius * space.step))])
    goal = Goal(torch.full((len(scene), 1), classifier.label(label)))
    everything = torch.arange(len(scene))

    def success(values: Tensor, examples: Tensor) -> Tensor:
        images = problem.render(values, examples)
        return goal.of(examples).reached(logits_of(classifier, images, PART).argmax(2))

    before = problem.render(problem.start, everything)
    # The gradient of geometry holds visibility fixed, so that whole steps may raise the cost.
    descent = DescentSettings(steps, shorten=name == "geometry", batch_size=PART)
    result = descend(classifier, problem, goal, descent, Phases(problem.start.device))
    random = success(problem.sample(draws), everything)
    search = random.clone()
    for _ in range(steps - 1):
        left = torch.nonzero(~search).squeeze(1)
        if len(left):
            search[left] = success(problem.sample(draws)[left], left)
    return Outcome(result.success, random, search, before[:, 0], result.images[:, 0], result.predicted[:, 0])


def parts(scene: Scene) -> Iterator[Scene]:
    """A scene's examples a few at a time: the gradient of a shape keeps all its images' samples."""
    for rows in torch.arange(len(scene)).split(PART):
        yield part_of(scene, rows)


def joined(found: Sequence[Outcome]) -> Outcome:
    """One outcome of several, example after example."""
    return Outcome(*(torch.cat([getattr(each, field.name) for each in found]) for field in fields(Outcome)))
