"""CMA-ES: an attack that needs no gradients, by the library `cma` (Hansen 2016).

Each example has an evolution strategy of its own. In a step, it draws a
generation of candidates from a normal distribution, and adapts the mean and the
covariance to the best of them. At first, the mean is at the initial values, and
the standard deviations reach across the norm-ball (`Parameter.search_scale`).
Candidates are projected onto the feasible values in the norm-ball before they
are evaluated. A penalty keeps the distribution near these values: the
interquartile range of the costs times the mean squared distance from the
projection, in units of the first standard deviations (as Hansen et al. 2009
scale it).
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.attacks.optimizers import Evaluation, Optimizer
from augment.random_streams import stream_seed
from renderer.errors import InputError

# CMA-ES with more values than this uses a diagonal covariance (Ros and Hansen
# 2008), because the size of a full covariance is the square of their number.
MAX_FULL_COVARIANCE = 1000


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
    """CMA-ES (covariance matrix adaptation evolution strategy, Hansen 2016) of each example."""

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
