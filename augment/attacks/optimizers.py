"""Problems, and optimizers that are asked for candidates and told their costs.

A candidate is a vector of attack values that is evaluated next.

- `Gradient`: projected gradient descent, x ← project(x − length · step(∂cost/∂x)).
- `RandomSearch`: the (1+1) evolution strategy of Rechenberg (1973).
- `CMAES`: covariance matrix adaptation (Hansen 2016).
"""

from __future__ import annotations

import importlib
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.attacks.objective import Score
from augment.random_streams import generator, stream_seed
from renderer.errors import InputError

if TYPE_CHECKING:
    from augment.attack_settings import AttackSettings

# Random search multiplies the length of its random changes by GROWTH after an accepted candidate
# and by SHRINKAGE after a rejected one. Four rejections undo one acceptance (the 1/5 success rule
# of evolution strategies), so that about one candidate in five is accepted.
GROWTH = 1.5
SHRINKAGE = GROWTH**-0.25
# CMA-ES with more values than this uses a diagonal covariance (Ros and Hansen
# 2008), because the size of a full covariance is the square of their number.
MAX_FULL_COVARIANCE = 1000


class Problem(Protocol):
    """Values of E examples that an attack changes, and the images that they give.

    Attributes:
        start: Values at which attacks start, one row for each example.
        group_size: Largest number of examples that are rendered at the same time,
            so that they fit in memory.
    """

    start: Float[Tensor, "E D"]
    group_size: int

    def render(
        self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A V 3 size size"]:
        """Render the V views of examples, differentiable in the values."""

    def project(
        self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A D"]:
        """Find the nearest values that are feasible and lie in the norm-balls."""

    def scale_gradient(self, gradient: Float[Tensor, "A D"]) -> Float[Tensor, "A D"]:
        """Compute the step that gradient descent subtracts from the values."""

    def search_scale(self, examples: Int[Tensor, " A"]) -> Float[Tensor, "A D"]:
        """Return how much a search without gradients should change each value at first."""


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
    images: Float[Tensor, "N V _ H W"]
    score: Score
    gradient: Float[Tensor, "N D"] | None

    @property
    def found(self) -> dict[str, Tensor]:
        """Return what is recorded of the best candidates, by the names in `Minimum`."""
        return {
            "values": self.values,
            "images": self.images,
            "success": self.score.is_success,
            "cost": self.score.cost,
            "predicted": self.score.predicted,
        }


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


@dataclass
class Population:
    """CMA-ES of one example, with P candidates in each step.

    The strategy draws points. A point p stands for the candidate with the
    attack values start + scale · p.

    Attributes:
        strategy: A `cma.CMAEvolutionStrategy`.
        start: The D attack values at which the strategy began, shape (D,).
        scale: Unit of each value, shape (D,). It is 0 for values without effect.
        drawn: The P points that were drawn last, shape (P, D).
    """

    strategy: Any
    start: Float[Tensor, " D"]
    scale: Float[Tensor, " D"]
    drawn: Float[np.ndarray, "P D"] = field(init=False)

    def ask(self) -> Float[Tensor, "P D"]:
        """Draw the P candidates of a step."""
        self.drawn = np.stack(self.strategy.ask())
        return self._unprojected()

    def _unprojected(self) -> Tensor:
        """Return the attack values of the points that were drawn last, shape (P, D)."""
        return self.start + self.scale * torch.from_numpy(self.drawn).to(self.scale)

    def tell(self, values: Float[Tensor, "P D"], costs: Float[Tensor, " P"]) -> None:
        """Adapt the strategy to the costs of the P candidates that were drawn last.

        A candidate outside of the norm-ball was evaluated at the nearest values inside. A penalty
        is added to its cost: the interquartile range of the costs times the mean squared distance
        to these values, in units of `scale`.
        """
        offsets = self._unprojected() - values
        # Distance of each value from the norm-ball in units of `scale`, shape (P, D).
        relative_offsets = torch.where(self.scale > 0, offsets / self.scale, 0.0)
        lower, upper = costs.double().quantile(costs.new_tensor([0.25, 0.75]).double())
        interquartile_range = upper - lower
        penalties = interquartile_range * relative_offsets.double().square().mean(1)
        self.strategy.tell(list(self.drawn), (costs.double() + penalties).tolist())


class CMAES(Optimizer):
    """CMA-ES (covariance matrix adaptation evolution strategy, Hansen 2016), by the library `cma`.

    Each example has an evolution strategy of its own. In a step, it draws a generation of
    candidates from a normal distribution, and adapts the mean and the covariance to the best of
    them. At first, the mean is at the initial values, and the standard deviations reach across the
    norm-ball (`Problem.search_scale`). Candidates are projected onto the feasible values in the
    norm-ball before they are evaluated. A penalty keeps the distribution near these values: the
    interquartile range of the costs times the mean squared distance from the projection, in units
    of the first standard deviations (as Hansen et al. 2009 scale it).
    """

    def begin(self, examples: Int[Tensor, " A"], start: Float[Tensor, "A D"]) -> None:
        """Begin new evolution strategies, by the rows of their examples."""
        super().begin(examples, start)
        self._populations: dict[int, Population] = {}

    @property
    def candidate_count(self) -> int:
        """Number of candidates: 4 + ⌊3 ln D⌋ for D values, the default of `cma`."""
        return 4 + int(3 * math.log(self.values.shape[1]))

    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N P D"]:
        """Draw candidates of each example, and project them to the norm-balls."""
        candidates = []
        for row in rows.tolist():
            if row not in self._populations:
                self._populations[row] = self._population(row)
            values = self._populations[row].ask()
            # `project` needs the example of each of the P candidates, which is the same for all.
            examples = self.examples[row].expand(len(values))
            candidates.append(self.problem.project(values, examples))
        return torch.stack(candidates)

    def _population(self, row: int) -> Population:
        """Start the evolution strategy of an example at its accepted values."""
        example = self.examples[[row]]
        strategy = start_strategy(
            self.values.shape[1],
            population_size=self.candidate_count,
            seed=stream_seed(self.seed, int(example), "cma"),
        )
        [scale] = self.problem.search_scale(example)
        return Population(strategy, self.values[row].clone(), scale)

    def tell(self, rows: Int[Tensor, " N"], evaluation: Evaluation) -> Bool[Tensor, " N"]:
        """Adapt the strategies to the costs of their candidates."""
        # No strategy drew the initial values.
        for index, row in enumerate(rows.tolist() if self._populations else []):
            self._populations[row].tell(evaluation.candidates[index], evaluation.costs[index])
        return super().tell(rows, evaluation)


def start_strategy(value_count: int, population_size: int, seed: int) -> Any:
    """Start an evolution strategy at 0 with standard deviation 1."""
    try:
        cma: Any = importlib.import_module("cma")
    except ImportError as error:
        raise InputError(
            'optimizer=cma_es needs cma: pip install "parametric-norm-balls[search]"',
            "optimizer",
        ) from error
    numbers = np.random.default_rng(seed)
    options = {
        "verbose": -9,
        "popsize": population_size,
        "CMA_diagonal": value_count > MAX_FULL_COVARIANCE,
        # If cma got a seed, it would seed NumPy for the whole process.
        "seed": np.nan,
        "randn": lambda *shape: numbers.standard_normal(shape),
    }
    return cma.CMAEvolutionStrategy(np.zeros(value_count), 1.0, options)
