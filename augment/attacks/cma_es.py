"""CMA-ES: an attack that needs no gradients, by the library `cma` (Hansen 2016).

Each example has an evolution strategy of its own. It draws a generation of
candidates from a normal distribution, and adapts the mean and the covariance to
the best of them. At first, the mean is at the initial values, and the standard
deviations reach across the norm-ball (`Parameter.search_scale`). Candidates are
projected onto the feasible values in the norm-ball before they are evaluated.
A penalty keeps the distribution near these values: the interquartile range of
the costs times the mean squared distance from the projection, in units of the
first standard deviations (as Hansen et al. 2009 scale it).
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.attacks.descent import Criterion, DescentResult, State
from augment.attacks.gradient_free import GradientFree
from augment.random_streams import stream_seed
from renderer.errors import InputError

# With more values, the covariance is diagonal (Ros and Hansen 2008), because its
# memory and time grow with the square of their number.
MAX_FULL_COVARIANCE = 1000


@dataclass
class Population:
    """Evolution strategy of one example.

    Its points are offsets from the start in units of `Parameter.search_scale`.

    Attributes:
        strategy: Evolution strategy, a `cma.CMAEvolutionStrategy`.
        start: The D attack values at which the strategy began, shape (D,).
        scale: Unit of each value, shape (D,). It is 0 for values without effect.
        drawn: The P points of the present generation, shape (P, D).
    """

    strategy: Any
    start: Tensor
    scale: Tensor
    drawn: np.ndarray = field(init=False)

    def ask(self) -> Tensor:
        """Draw a new generation of P points.

        Returns:
            Attack values of the points, which may be outside of the norm-ball, shape (P, D).
        """
        self.drawn = np.stack(self.strategy.ask())
        return self._unprojected()

    def _unprojected(self) -> Tensor:
        """Convert the points of the generation to attack values, shape (P, D)."""
        return self.start + self.scale * torch.from_numpy(self.drawn).to(self.scale)

    def tell(self, values: Tensor, costs: Tensor) -> None:
        """Adapt the strategy to the costs of its generation.

        The penalty that the module describes is added to each cost.

        Args:
            values: Feasible attack values in the norm-ball that are nearest to the P points of
                the generation, shape (P, D).
            costs: Cost of each of these values, shape (P,).
        """
        offsets = self._unprojected() - values
        # Offsets in units of the first standard deviations, shape (P, D).
        relative_offsets = torch.where(self.scale > 0, offsets / self.scale, 0.0)
        lower, upper = costs.double().quantile(costs.new_tensor([0.25, 0.75]).double())
        interquartile_range = upper - lower
        penalties = interquartile_range * relative_offsets.double().square().mean(1)
        self.strategy.tell(list(self.drawn), (costs.double() + penalties).tolist())


@dataclass(frozen=True)
class CMAES(GradientFree):
    """CMA-ES against one classifier, see the module.

    Attributes:
        populations: Evolution strategy of each example. The key is the row of the
            example in the state of the search.
        generations: Projected values of the present generation of each example, P points of
            D values, shape (P, D). The key is the same.
    """

    populations: dict[int, Population] = field(default_factory=dict, init=False)
    generations: dict[int, Tensor] = field(default_factory=dict, init=False)

    def run(self, criterion: Criterion, examples: Tensor, start: Tensor) -> DescentResult:
        """Search until all examples are finished or have used up their queries."""
        self.populations.clear()
        self.generations.clear()
        return super().run(criterion, examples, start)

    def _candidates_per_step(self, state: State) -> int:
        """Return the number P of candidates in a generation, which is the default of `cma`."""
        return 4 + int(3 * math.log(state.values.shape[1]))

    def _step(self, state: State) -> None:
        """Draw the next generation of each active example, and project it."""
        for row in state.active_rows.tolist():
            if row not in self.populations:
                self.populations[row] = self._begin(state, row)
            values = self.populations[row].ask()
            # All P candidates belong to the same example, shape (P,).
            examples = state.examples[row].expand(len(values))
            self.generations[row] = self.problem.project(values, examples)
        state.result.steps[state.active_rows] += 1

    def _begin(self, state: State, row: int) -> Population:
        """Start the evolution strategy of an example at its accepted values."""
        example = state.examples[[row]]
        value_count = state.values.shape[1]
        strategy = start_strategy(
            value_count,
            population_size=self._candidates_per_step(state),
            seed=stream_seed(self.seed, int(example), "cma"),
        )
        [scale] = self.problem.search_scale(example)
        return Population(strategy, state.values[row].clone(), scale)

    def _candidates(self, state: State) -> Tensor:
        """Return the candidates that are evaluated next for each of the N active examples.

        Returns:
            Projected values of the present generation, shape (N, P, D). Before the first
            generation, they are the initial values, and P is 1.
        """
        if not self.generations:
            return super()._candidates(state)
        return torch.stack([self.generations[row] for row in state.active_rows.tolist()])

    def _learn(self, state: State, candidates: Tensor, costs: Tensor) -> None:
        """Adapt the evolution strategies of the N active examples to their generations.

        Args:
            state: State of the search.
            candidates: Projected values of each generation, shape (N, P, D).
            costs: Cost of each candidate, shape (N, P).
        """
        # The initial values do not belong to a generation.
        if not self.generations:
            return
        for index, row in enumerate(state.active_rows.tolist()):
            self.populations[row].tell(candidates[index], costs[index])


def start_strategy(value_count: int, population_size: int, seed: int) -> Any:
    """Start an evolution strategy at 0 with standard deviation 1.

    Args:
        value_count: Number of values D.
        population_size: Number of points of a generation.
        seed: Seed of its random numbers, which leave those of NumPy alone.

    Returns:
        `cma.CMAEvolutionStrategy`.

    Raises:
        InputError: If `cma` is not installed.
    """
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
