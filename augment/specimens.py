"""A few of the examples that fooled, before and after: what one looks at of a regeneration."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from augment.model_state import as_found
from augment.perturbation import Perturbation
from renderer.basis import HARMONICS, Basis

MOST = 4


@dataclass(frozen=True)
class Specimens:
    """S of the examples that a model errs on, as the scene had them before and under the conditions that fool.

    images_before, images: (S, 3, H, W) in [0, 1]. lights_before, lights: (S, basis.size, 3). answers_before, answers:
    (S, C) probabilities. labels: (S,) int64.
    """

    images_before: Tensor
    images: Tensor
    lights_before: Tensor
    lights: Tensor
    answers_before: Tensor
    answers: Tensor
    labels: Tensor
    basis: Basis = HARMONICS

    def __len__(self) -> int:
        return len(self.labels)


def choose_specimens(
    model: nn.Module, problem: Perturbation, values: Tensor, fooled: Tensor, labels: Tensor
) -> Specimens:
    """Up to MOST of the examples that are `fooled` (E,), evenly drawn, under values (E, D); the model stays as it was.

    The problem's examples are of one view each.
    """
    candidates = torch.nonzero(fooled).squeeze(1)
    drawn = torch.linspace(0, max(len(candidates) - 1, 0), min(MOST, len(candidates))).round().long()
    rows = candidates[drawn.to(candidates.device)]
    before, after = (problem.conditions(each[rows], rows) for each in (problem.start, values))
    with as_found(model), torch.no_grad():
        images = [problem.scene.render(conditions, rows)[:, 0] for conditions in (before, after)]
        answers = [model(side).float().softmax(1) if len(rows) else side.new_zeros(0, 0) for side in images]
    return Specimens(
        images[0], images[1], before.light, after.light, answers[0], answers[1], labels[rows], problem.scene.basis
    )
