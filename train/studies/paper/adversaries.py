"""What Tables 3 and 4 share: attacks by light and by shape, random changes as large."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from augment.attacks.criteria import Goal
from augment.attacks.descent import DescentSettings, Part, Problem, descend
from augment.attacks.parameters import AttackProblem, Geometry, Lighting, Parameter, StepSettings
from augment.classifiers import Classifier
from augment.scene import Scene
from augment.utils import Phases

STEPS = 30  # the paper's appendix C
FURTHER = 10  # steps that an adversary goes on for


class Unreachable(Goal):
    """An error is wanted, and is never enough: the descent takes all of its steps."""

    def of(self, examples: Tensor) -> "Unreachable":
        return Unreachable(self.source[examples])

    def reached(self, predicted: Tensor) -> Tensor:
        return torch.zeros(len(predicted), dtype=torch.bool)


@dataclass(frozen=True)
class Attack:
    """What changes, by which steps, and for how long."""

    kind: Callable[[Scene, StepSettings], Parameter]
    step: StepSettings
    descent: DescentSettings

    def problem(self, scene: Scene) -> AttackProblem:
        return AttackProblem(scene, [self.kind(scene, self.step)])

    def adversaries(self, problem: Problem, classifier: Classifier, label: str, views: int) -> tuple[Tensor, Tensor]:
        """(E, D) values where the descent first fools or ends, and (E, D) those `FURTHER` steps later.

        views: of each example.
        """
        goal = Goal(torch.full((len(problem.start), views), classifier.label(label)))
        first = descend(classifier, problem, goal, self.descent, Phases())
        onwards = Part(problem, torch.arange(len(first.values)), first.values)
        longer = replace(self.descent, max_steps=FURTHER)
        last = descend(classifier, onwards, Unreachable(goal.source), longer, Phases())
        return first.values, last.values


ATTACKS = {
    "lighting": Attack(Lighting, StepSettings("linf", None, "unit", 0.05), DescentSettings(STEPS)),
    "geometry": Attack(Geometry, StepSettings("linf", 0.002, "sign", 0.0005), DescentSettings(STEPS, shorten=True)),
}


def with_random_signs(values: Tensor, start: Tensor, draws: torch.Generator) -> Tensor:
    """The start (E, D) with each entry changed by as much as in values (E, D), but up or down at random.

    It is as far in any norm, and changes nothing that could not reach a pixel.
    """
    signs = 2 * torch.randint(2, values.shape, generator=draws) - 1
    return start + (values - start) * signs.to(values)
