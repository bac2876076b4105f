"""Optimizers, which are asked for candidates and told their costs.

A candidate is a vector of attack values that is evaluated next.

- `Gradient`: projected gradient descent, x ← project(x − length · step(∂cost/∂x)).
- `RandomSearch`: the (1+1) evolution strategy of Rechenberg (1973).
- `UniformDraws`: independent draws from the norm-ball, for comparison.
- `CMAES` (`augment.attacks.cma_es`): covariance matrix adaptation.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.attacks.objective import Score
from augment.random_streams import generator

if TYPE_CHECKING:
    from augment.attack_settings import AttackSettings
    from augment.attacks.problem import Problem

# Random search multiplies the length of its random changes by GROWTH after an accepted candidate
# and by SHRINKAGE after a rejected one. Four rejections undo one acceptance (the 1/5 success rule
# of evolution strategies), so that about one candidate in five is accepted.
GROWTH = 1.5
SHRINKAGE = GROWTH**-0.25


@dataclass(frozen=True)
class Evaluation:
    """Costs of P candidates of each of N examples, and the best candidate of each example.

    The best candidate has the lowest cost of those that succeed or, if none does, of all.

    Attributes:
        candidates: All candidates.
        costs: Costs of all candidates.
        values: The best candidates.
        images: Their images, of V views.
        score: Their scores.
        gradient: Gradient of the cost at the best candidates. None if it was not computed.
    """

    candidates: Float[Tensor, "N P D"]
    costs: Float[Tensor, "N P"]
    values: Float[Tensor, "N D"]
    images: Float[Tensor, "N V 3 H W"]
    score: Score
    gradient: Float[Tensor, "N D"] | None


class Optimizer(ABC):
    """Search for attack values of low cost, for each of A examples by itself.

    `begin`, then `tell` with the initial values, then `ask` and `tell` by turns. Rows are those of
    the examples that are still attacked.

    Attributes:
        uses_gradients: Whether `tell` needs the gradient of the cost.
        values: Values of the accepted candidate of each example, shape (A, D).
        cost: Its cost, shape (A,).
    """

    uses_gradients: ClassVar[bool] = False

    def __init__(self, problem: Problem, settings: AttackSettings, seed: int):
        self.problem = problem
        self.settings = settings
        self.seed = seed
        # Generator of the random numbers of each example, so that its numbers do not depend on the
        # other examples. Further starts continue with the same generators.
        self._draws: dict[int, torch.Generator] = {}

    def begin(self, examples: Int[Tensor, " A"], start: Float[Tensor, "A D"]) -> None:
        """Begin a search at initial values. `examples` are indices in the problem."""
        self.examples = examples
        self.values = start.clone()
        self.cost = start.new_full((len(start),), torch.inf)

    @property
    def candidate_count(self) -> int:
        """Number P of candidates of each example that `ask` returns."""
        return 1

    @abstractmethod
    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N P D"]:
        """Return the candidates to evaluate next."""

    def tell(self, rows: Int[Tensor, " N"], evaluation: Evaluation) -> Bool[Tensor, " N"]:
        """Learn from the evaluated candidates, and return a mask of those that are accepted.

        By default, the best candidate of an example is accepted if it lowers the cost.
        """
        is_accepted = self._is_accepted(rows, evaluation.score.cost)
        self.values[rows] = _chosen(is_accepted, evaluation.values, self.values[rows])
        self.cost[rows] = _chosen(is_accepted, evaluation.score.cost, self.cost[rows])
        return is_accepted

    def _is_accepted(self, rows: Int[Tensor, " N"], cost: Float[Tensor, " N"]) -> Tensor:
        return cost < self.cost[rows]

    def _generator(self, example: int) -> torch.Generator:
        """Return the generator of the random numbers of an example."""
        if example not in self._draws:
            self._draws[example] = generator(self.seed, example, "directions")
        return self._draws[example]


def _chosen(mask: Bool[Tensor, " N"], new: Tensor, old: Tensor) -> Tensor:
    """Return the new rows where the mask is true, and the old rows elsewhere."""
    return torch.where(mask.view(-1, *[1] * (new.ndim - 1)), new, old)


class Gradient(Optimizer):
    """Projected gradient descent. The length of a step is 1.

    With backtracking, a step that does not lower the cost is undone, and tried again at half its
    length. Without it, every candidate is accepted.
    """

    uses_gradients = True

    def begin(self, examples: Int[Tensor, " A"], start: Float[Tensor, "A D"]) -> None:
        """Begin with steps of length 1."""
        super().begin(examples, start)
        self.gradient = torch.zeros_like(start)
        self.length = start.new_ones(len(start), 1)

    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N 1 D"]:
        """Return the values after a step from the accepted values."""
        step = self.problem.scale_gradient(self.gradient[rows])
        moved = self.values[rows] - self.length[rows] * step
        return self.problem.project(moved, self.examples[rows])[:, None]

    def tell(self, rows: Int[Tensor, " N"], evaluation: Evaluation) -> Bool[Tensor, " N"]:
        """Keep the gradient of accepted candidates, and halve the next step after others."""
        is_accepted = super().tell(rows, evaluation)
        if evaluation.gradient is not None:
            gradient = evaluation.gradient
            self.gradient[rows] = _chosen(is_accepted, gradient, self.gradient[rows])
        self.length[rows] *= torch.where(is_accepted, 1.0, 0.5)[:, None]
        return is_accepted

    def _is_accepted(self, rows: Int[Tensor, " N"], cost: Float[Tensor, " N"]) -> Tensor:
        is_cheaper = super()._is_accepted(rows, cost)
        return is_cheaper if self.settings.backtracking else torch.ones_like(is_cheaper)


class RandomSearch(Optimizer):
    """Random changes of the accepted values, which are accepted if they lower the cost.

    At first, changes reach across the norm-ball (`Problem.search_scale`). They become longer after
    an accepted candidate and shorter after another.
    """

    def begin(self, examples: Int[Tensor, " A"], start: Float[Tensor, "A D"]) -> None:
        """Begin with changes of length 1, in units of the search scale."""
        super().begin(examples, start)
        self.length = start.new_ones(len(start), 1)

    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N 1 D"]:
        """Return a random change of the accepted values."""
        examples = self.examples[rows]
        # Standard deviation of each change, shape (N, D).
        deviation = self.length[rows] * self.problem.search_scale(examples)
        shape = self.values.shape[1:]
        normal = [
            torch.randn(shape, generator=self._generator(example)) for example in examples.tolist()
        ]
        moved = self.values[rows] + deviation * torch.stack(normal).to(self.values)
        return self.problem.project(moved, examples)[:, None]

    def tell(self, rows: Int[Tensor, " N"], evaluation: Evaluation) -> Bool[Tensor, " N"]:
        """Adapt the length of the next change."""
        is_accepted = super().tell(rows, evaluation)
        self.length[rows] *= torch.where(is_accepted, GROWTH, SHRINKAGE)[:, None]
        return is_accepted
