"""Attack examples with the optimizer that the settings choose."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from augment.attack_settings import CMA_ES, GRADIENT, RANDOM_SEARCH
from augment.attacks.cma_es import CMAES
from augment.attacks.eot import ExpectationOverTransformations
from augment.attacks.loop import Criterion, Descent, DescentResult
from augment.attacks.random_search import RandomSearch
from augment.progress import Phases, progress
from augment.random_streams import generator

if TYPE_CHECKING:
    from augment.attack_settings import AttackSettings
    from augment.attacks.problem import AttackProblem

# Optimizers by their names in the settings.
OPTIMIZERS: dict[str, type[Descent]] = {
    GRADIENT: Descent,
    RANDOM_SEARCH: RandomSearch,
    CMA_ES: CMAES,
}


def descend(
    model: nn.Module,
    problem: AttackProblem,
    criterion: Criterion,
    settings: AttackSettings,
    phases: Phases | None = None,
    *,
    examples: Int[Tensor, " A"] | None = None,
    start: Float[Tensor, "A D"] | None = None,
    restarts: Iterable[Tensor] = (),
    seed: int = 0,
) -> DescentResult:
    """Attack examples with the optimizer that the settings choose.

    The examples are attacked in groups of at most `problem.group_size`, so that the gradients fit
    in memory. The model runs in evaluation mode, and its state is restored afterwards. By default,
    all examples are attacked, starting at `problem.start`. Restarts are further initial values,
    tried in turn for the examples that have not succeeded.
    """
    if examples is None:
        examples = torch.arange(len(problem.start), device=problem.start.device)
    if start is None:
        start = problem.start[examples]
    expectation = ExpectationOverTransformations(settings.eot, generator(seed, "expectation"))
    optimizer = OPTIMIZERS[settings.optimizer or GRADIENT]
    descent = optimizer(
        model=model,
        problem=problem,
        settings=settings,
        expectation=expectation,
        phases=phases or Phases(),
        seed=seed,
    )
    rows_by_group = torch.arange(len(start), device=start.device).split(problem.group_size)
    if len(rows_by_group) == 1:
        return descent.run_with_restarts(criterion, examples, start, restarts)

    # Each group of examples uses all restarts, and an iterator would be empty after the first.
    restarts = list(restarts)
    result = None
    for rows in progress(rows_by_group, "groups of examples"):
        group_result = descent.run_with_restarts(
            criterion.select(rows),
            examples[rows],
            start[rows],
            (restart[rows] for restart in restarts),
        )
        if result is None:
            result = group_result.allocate(len(start))
        result.write(rows, group_result)
    assert result is not None, "there are at least two groups"
    return result
