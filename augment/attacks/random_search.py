"""Random search: an attack that needs no gradients.

A candidate is a random change of the accepted values, projected onto the
feasible values in the norm-ball. It is accepted if its cost is lower. At first,
changes reach across the norm-ball (`Parameter.search_scale`). They become
longer after an accepted candidate and shorter after another, so that about one
candidate in five is accepted: the (1+1) evolution strategy of Rechenberg
(1973).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from augment.attacks.gradient_free import GradientFree
from augment.attacks.loop import Decision, Evaluation, State

# Random search multiplies the length of its random changes by GROWTH after an
# accepted candidate and by SHRINKAGE after a rejected one. Four rejections undo
# one acceptance (the 1/5 success rule of evolution strategies).
GROWTH = 1.5
SHRINKAGE = GROWTH**-0.25


@dataclass(frozen=True)
class RandomSearch(GradientFree):
    """Random search against one classifier: the (1+1) evolution strategy.

    In a step, each example has one candidate: a random change of its accepted
    values, which is accepted if it lowers the cost.
    """

    def _step(self, state: State) -> None:
        """Compute the next candidate of each active example by a random change of its values."""
        rows = state.active_rows
        examples = state.examples[rows]
        # Standard deviation of each change, shape (N, D) for N active examples.
        deviation = state.length[rows] * self.problem.search_scale(examples)
        normal_numbers = self._draw_normal(state, count=1)[:, 0]
        moved = state.values[rows] + deviation * normal_numbers
        state.candidate[rows] = self.problem.project(moved, examples)
        state.result.steps[rows] += 1

    def _decide(self, state: State, evaluation: Evaluation) -> Decision:
        """Decide which candidates are accepted, and adapt the length of the next changes."""
        decision = super()._decide(state, evaluation)
        factor = torch.where(decision.is_accepted, GROWTH, SHRINKAGE)
        return replace(decision, length_factor=factor)
