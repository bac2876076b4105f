"""Problems, norm-balls, and optimizers that are asked for candidates and told their costs.

A candidate is a vector of attack values that is evaluated next.

- `Gradient`: projected gradient descent, x ← project(x − length · step(∂cost/∂x)).
- `RandomSearch`: the (1+1) evolution strategy of Rechenberg (1973).
- `CMAES`: covariance matrix adaptation (Hansen 2016).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from augment.attack_settings import CMA_ES, GRADIENT, RANDOM_SEARCH, AttackSettings, StepSettings
from augment.attacks.objective import Examples, Images, Score, Values
from augment.random_streams import generator, stream_seed
from augment.scene.truth import Truth
from renderer.errors import import_package
from renderer.vectors import Ball, nearest_in_box

# Random search multiplies the length of its random changes by GROWTH after an accepted candidate
# and by GROWTH^(-1/4) after a rejected one. Four rejections undo one acceptance (the 1/5 success
# rule of evolution strategies), so that about one candidate in five is accepted.
GROWTH = 1.5
# CMA-ES with more values than this uses a diagonal covariance (Ros and Hansen
# 2008), because the size of a full covariance is the square of their number.
MAX_FULL_COVARIANCE = 1000
# If a parameter has no radius, a search without gradients begins with random changes that are as
# long as this many steps.
STEPS_OF_SEARCH = 4


class Problem(Protocol):
    """Values of E examples that an attack changes, and the images that they give.

    Attributes:
        start: Values at which attacks start, one row for each example.
        group_size: Largest number of examples that are rendered at the same time,
            so that they fit in memory.
    """

    start: Values
    group_size: int

    def render(self, values: Values, examples: Examples) -> Images:
        """Render the V views of examples, differentiable in the values."""

    def truth(self, values: Values, examples: Examples) -> Truth | None:
        """Find where the objects are, for criteria with `needs_truth`. None if they never move."""

    def project(self, values: Values, examples: Examples) -> Values:
        """Find the nearest values that are feasible and lie in the norm-balls."""

    def scale_gradient(self, gradient: Values) -> Values:
        """Compute the step that gradient descent subtracts from the values."""

    def search_scale(self, examples: Examples) -> Values:
        """Return how much a search without gradients should change each value at first."""


class NormBalls:
    """Values of E examples, in norm-balls around those at which attacks start.

    A subclass whose values are not all feasible sets `box`, or overrides `project_feasible`.

    Attributes:
        settings: Norm-ball and steps of the attack.
        start: Values at which attacks start and on which the norm-balls are
            centered, shape (E, D).
        used_mask: Mask of the values that an attack may change, shape (E, D).
            The other values have no effect on the image. By default, all may change.
        box: Smallest and largest feasible values.
    """

    box: Any = (-math.inf, math.inf)

    def __init__(self, settings: StepSettings, start: Tensor, used_mask: Tensor | None = None):
        self.settings = settings
        self.start = start
        # The default takes the memory of one value.
        every = torch.ones((), dtype=torch.bool, device=start.device).expand(start.shape)
        self.used_mask = every if used_mask is None else used_mask

    def truth(self, values: Values, examples: Examples) -> Truth | None:
        """Return None: objects in images that are not rendered stay where they are."""
        return None

    def project_feasible(
        self, values: Values, within: Ball | None = None, examples: Examples | slice = slice(None)
    ) -> Values:
        """Find the nearest feasible values of examples. By default, those in the box are feasible.

        The nearest values are meant in the Euclidean sense, and the centers of `within` are
        feasible.
        """
        low, high = self.box
        return nearest_in_box(values, low, high, within)

    def scale_gradient(self, gradient: Values) -> Values:
        """Compute the step that gradient descent subtracts from the values.

        The step is the gradient ("raw"), its sign ("sign") or its direction ("unit"), times the
        step size. A step is zero if its gradient is zero.
        """
        if self.settings.step == "raw":
            return self.settings.step_size * gradient
        if self.settings.step == "sign":
            return self.settings.step_size * gradient.sign()
        # The gradient is first divided by its largest entry, because the squares of tiny entries
        # would be rounded to zero.
        tiny = torch.finfo(gradient.dtype).tiny
        scaled = gradient / gradient.abs().amax(1, keepdim=True).clamp(min=tiny)
        return self.settings.step_size * torch.nn.functional.normalize(scaled, eps=tiny)

    def search_scale(self, examples: Examples) -> Values:
        """Return how much a search without gradients should change each value at first.

        With the norm "l2", a random change is about as long as the radius. With the norm "linf", it
        changes each value by about half the radius. Without a radius, `STEPS_OF_SEARCH` times the
        step size takes its place. The result is 0 for values that have no effect.
        """
        settings = self.settings
        length = settings.radius
        limits_each_value = settings.norm == "linf"
        if length is None:
            length = STEPS_OF_SEARCH * settings.step_size
            limits_each_value = settings.step == "sign"
        # 1 for values that have an effect, and 0 for the others, shape (E, D).
        used = self.used_mask[examples].to(self.start)
        if limits_each_value:
            return length / 2 * used
        # n independent numbers with the standard deviation length / √n form a vector that is
        # about `length` long.
        return length * used / used.sum(1, keepdim=True).clamp(min=1).sqrt()

    def project(self, values: Values, examples: Examples | slice) -> Values:
        """Find the nearest values that are feasible and lie in the norm-balls around the start."""
        radius = self.settings.radius
        ball = None if radius is None else Ball(self.start[examples], radius, self.settings.norm)
        return self.project_feasible(values, ball, examples)

    def sample(self, draws: Generator, reached: Values | None = None) -> Values:
        """Draw random feasible values for all E examples.

        With a radius, values are drawn uniformly from the norm-balls and then
        projected onto the feasible values. Without a radius, they are drawn in
        random directions, as far from the start as the values of an attack.
        """
        if self.settings.radius is None and reached is not None:
            # Each example gets a random direction, at the distance that its attack has reached.
            direction = torch.randn(reached.shape, generator=draws).to(reached) * self.used_mask
            distance = (reached - self.start).norm(dim=1, keepdim=True)
            offset = direction * distance / direction.norm(dim=1, keepdim=True).clamp(min=1e-12)
            return self.project_feasible(self.start + offset)
        return self.project(self.draw(draws), slice(None))

    def draw(self, draws: Generator, examples: Sequence[int] | slice = slice(None)) -> Values:
        """Draw values uniformly from the norm-balls of examples, which need a radius."""
        assert self.settings.radius is not None
        center, is_used = self.start[examples], self.used_mask[examples].cpu()
        if self.settings.norm == "linf":
            offset = 2 * torch.rand(center.shape, generator=draws) - 1
        else:
            direction = torch.randn(center.shape, generator=draws) * is_used
            # A uniform point of the unit ball in n dimensions has a distance below r with
            # probability r^n. Its distance is distributed like the n-th root of a uniform number.
            root = 1 / is_used.sum(1, keepdim=True)
            distance = torch.rand(len(center), 1, generator=draws) ** root
            # Rows without a used value stay at the center.
            offset = torch.nn.functional.normalize(direction) * distance
        return center + self.settings.radius * (offset * is_used).to(center)


# What is recorded of the best candidates: the fields of `Minimum` that belong to one candidate.
FOUND = ("values", "images", "success", "cost", "predicted")


@dataclass(frozen=True)
class Evaluation:
    """Costs of P candidates of each of E examples, and the best candidate of each example.

    The best candidate has the lowest cost of those that succeed or, if none does, of all.

    Attributes:
        candidates: All candidates.
        costs: Costs of all candidates.
        values: The best candidates.
        images: Their images, of V views.
        score: Their scores.
        gradient: Gradient of the cost at the best candidates. None if it was not computed.
    """

    candidates: Float[Tensor, "E P D"]
    costs: Float[Tensor, "E P"]
    values: Values
    images: Images
    score: Score
    gradient: Values | None

    @property
    def found(self) -> dict[str, Tensor]:
        """Return what is recorded of the best candidates, by the names in `Minimum`."""
        score = self.score
        parts = self.values, self.images, score.is_success, score.cost, score.predicted
        return dict(zip(FOUND, parts, strict=True))


class Optimizer(ABC):
    """Search for attack values of low cost, for each of E examples by itself.

    `begin`, then `tell` with the initial values, then `ask` and `tell` by turns. Rows are those of
    the examples that are still attacked.

    Attributes:
        candidate_count: Number P of candidates of each example that `ask` returns.
        accepts_all: Whether candidates are accepted that do not lower the cost.
        values: Values of the accepted candidate of each example, shape (E, D).
        cost: Its cost, shape (E,).
        length: Length of the next change of each example, from 1 on, shape (E, 1).
        length_factors: Factors of the length after an accepted candidate, and after another.
    """

    candidate_count: int = 1
    accepts_all: bool = False
    length_factors: ClassVar[tuple[float, float]] = (1.0, 1.0)

    def __init__(self, problem: Problem, settings: AttackSettings, seed: int):
        self.problem = problem
        self.settings = settings
        # Generator of the random numbers of each example, so that its numbers do not depend on the
        # other examples. Further starts continue with the same generators.
        self._generator = cache(lambda example: generator(seed, example, "directions"))

    def begin(self, examples: Examples, start: Values) -> None:
        """Begin a search at initial values. `examples` are indices in the problem."""
        self.examples = examples
        self.values = start.clone()
        self.cost = start.new_full((len(start),), torch.inf)
        self.length = start.new_ones(len(start), 1)

    @abstractmethod
    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N P D"]:
        """Return the candidates to evaluate next."""

    def tell(self, rows: Int[Tensor, " N"], evaluation: Evaluation) -> Bool[Tensor, " N"]:
        """Learn from the evaluated candidates, and return a mask of those that are accepted.

        By default, the best candidate of an example is accepted if it lowers the cost.
        """
        cost = evaluation.score.cost
        is_accepted = (cost < self.cost[rows]) | self.accepts_all
        self.values[rows] = chosen(is_accepted, evaluation.values, self.values[rows])
        self.cost[rows] = chosen(is_accepted, cost, self.cost[rows])
        self.length[rows] *= torch.where(is_accepted, *self.length_factors)[:, None]
        return is_accepted


def chosen(mask: Bool[Tensor, " N"], new: Tensor, old: Tensor) -> Tensor:
    """Return the new rows where the mask is true, and the old rows elsewhere."""
    return torch.where(mask.view(-1, *[1] * (new.ndim - 1)), new, old)


class Gradient(Optimizer):
    """Projected gradient descent. The length of a step is 1.

    With backtracking, a step that does not lower the cost is undone, and tried again at half its
    length. Without it, every candidate is accepted.
    """

    length_factors = (1.0, 0.5)

    def begin(self, examples: Examples, start: Values) -> None:
        """Begin with a gradient of zero."""
        super().begin(examples, start)
        self.accepts_all = not self.settings.backtracking
        self.gradient = torch.zeros_like(start)

    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N 1 D"]:
        """Return the values after a step from the accepted values."""
        step = self.problem.scale_gradient(self.gradient[rows])
        moved = self.values[rows] - self.length[rows] * step
        return self.problem.project(moved, self.examples[rows])[:, None]

    def tell(self, rows: Int[Tensor, " N"], evaluation: Evaluation) -> Bool[Tensor, " N"]:
        """Keep the gradient of accepted candidates."""
        is_accepted = super().tell(rows, evaluation)
        if evaluation.gradient is not None:
            self.gradient[rows] = chosen(is_accepted, evaluation.gradient, self.gradient[rows])
        return is_accepted


class RandomSearch(Optimizer):
    """Random changes of the accepted values, which are accepted if they lower the cost.

    At first, changes reach across the norm-ball (`Problem.search_scale`). They become longer after
    an accepted candidate and shorter after another.
    """

    length_factors = (GROWTH, GROWTH**-0.25)

    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N 1 D"]:
        """Return a random change of the accepted values."""
        examples = self.examples[rows]
        generators = map(self._generator, examples.tolist())
        normal = [torch.randn(self.values.shape[1:], generator=draws) for draws in generators]
        # Standard deviation of each change, shape (N, D).
        deviation = self.length[rows] * self.problem.search_scale(examples)
        moved = self.values[rows] + deviation * torch.stack(normal).to(self.values)
        return self.problem.project(moved, examples)[:, None]


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

    def __init__(self, problem: Problem, settings: AttackSettings, seed: int):
        super().__init__(problem, settings, seed)
        # The same as `_generator`, for the arrays of `cma`.
        self._draws = cache(lambda of: np.random.default_rng(stream_seed(seed, of, "cma")))

    def begin(self, examples: Examples, start: Values) -> None:
        """Begin new evolution strategies. A point p of one stands for the values start + scale · p.

        The scale is 0 for values that have no effect.
        """
        super().begin(examples, start)
        # The default of `cma` for D values.
        self.candidate_count = 4 + int(3 * math.log(start.shape[1]))
        self._start = start
        self._scale = self.problem.search_scale(examples)
        self._strategies: dict[int, Any] = {}
        # The P points that each strategy drew last, shape (P, D), by the row of the example.
        self._drawn: dict[int, np.ndarray] = {}

    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N P D"]:
        """Draw candidates of each example, and project them to the norm-balls."""
        candidates = []
        for row in rows.tolist():
            if row not in self._strategies:
                self._strategies[row] = self._strategy(self._draws(int(self.examples[row])))
            self._drawn[row] = np.stack(self._strategies[row].ask())
            values = self._unprojected(row)
            # `project` needs the example of each of the P candidates, which is the same for all.
            examples = self.examples[row].expand(len(values))
            candidates.append(self.problem.project(values, examples))
        return torch.stack(candidates)

    def _unprojected(self, row: int) -> Float[Tensor, "P D"]:
        """Return the attack values of the points that were drawn last for an example."""
        points = torch.from_numpy(self._drawn[row]).to(self._scale)
        return self._start[row] + self._scale[row] * points

    def tell(self, rows: Int[Tensor, " N"], evaluation: Evaluation) -> Bool[Tensor, " N"]:
        """Adapt the strategies to the costs of their candidates, and to the penalties."""
        # No strategy drew the initial values.
        for index, row in enumerate(rows.tolist() if self._strategies else []):
            offsets = self._unprojected(row) - evaluation.candidates[index]
            scale = self._scale[row]
            # Distance of each value from the norm-ball in units of `scale`, shape (P, D).
            relative_offsets = torch.where(scale > 0, offsets / scale, 0.0).double()
            costs = evaluation.costs[index].double()
            # Points that left the norm-ball are penalized, in units of the spread of the costs.
            lower, upper = costs.quantile(costs.new_tensor([0.25, 0.75]))
            penalties = (upper - lower) * relative_offsets.square().mean(1)
            self._strategies[row].tell(list(self._drawn[row]), (costs + penalties).tolist())
        return super().tell(rows, evaluation)

    def _strategy(self, draws: np.random.Generator) -> Any:
        """Start an evolution strategy at 0 with standard deviation 1."""
        cma = import_package("cma", '"parametric-norm-balls[search]"')
        value_count = self.values.shape[1]
        options = {
            # Print nothing, and adapt the variances alone if there are many values.
            "verbose": -9,
            "popsize": self.candidate_count,
            "CMA_diagonal": value_count > MAX_FULL_COVARIANCE,
            # If cma got a seed, it would seed NumPy for the whole process.
            "seed": np.nan,
            "randn": lambda *shape: draws.standard_normal(shape),
        }
        return cma.CMAEvolutionStrategy(np.zeros(value_count), 1.0, options)


# Optimizers by their names in the settings.
KINDS = {GRADIENT: Gradient, RANDOM_SEARCH: RandomSearch, CMA_ES: CMAES}
