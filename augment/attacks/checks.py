"""Guards against fooling oneself: does the cost fall, does random search do as well, do more steps fool more?"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from augment.attacks.run import Attacked, logits_of
from augment.descent import descend
from augment.phases import Phases
from augment.seeding import generator

GROWTH = (1, 3, 10)


@dataclass(frozen=True)
class Checks:
    """Shares of the examples, in [0, 1], and mean costs.

    cost_fell: of those that were not fooled to begin with. success, random_search and success_by_steps: of those that
    were recognised before. random_search: fooled by any of as many draws as the attack had passes, each as far from the
    start as the attack may go or went. success_by_steps: fooled within the steps, ×3 and ×10.
    """

    cost_before: float
    cost: float
    cost_fell: float
    zero_gradient: float
    success: float
    random_search: float
    success_by_steps: dict[int, float]

    @property
    def warnings(self) -> list[str]:
        """What a reader must know before believing the attack."""
        found = {
            "random search does as well or better": self.success > 0 and self.random_search >= self.success,
            "the cost rose in some examples": self.cost_fell < 1,
            "some first gradients are exactly zero": self.zero_gradient > 0,
        }
        return [warning for warning, holds in found.items() if holds]


def check(attacked: Attacked) -> Checks:
    """Search at random and descend for ten times as long, beside an attack that is done."""
    result, draws = attacked.result, generator(attacked.seed, "random search")
    open_cases = ~result.fooled_before
    fell = (result.cost < result.cost_before) | result.fooled
    draw = partial(attacked.problem.sample_as_far, result.values, draws)
    random = fooled_by_draws(attacked, result.fooled_before, draw)
    return Checks(
        cost_before=float(result.cost_before.mean()),
        cost=float(result.cost.mean()),
        cost_fell=_share(fell[open_cases]) if open_cases.any() else 1.0,
        zero_gradient=_share(result.zero_gradient),
        success=_share(attacked.success[attacked.recognised]),
        random_search=_share(random[attacked.recognised]),
        success_by_steps=_success_by_steps(attacked),
    )


def fooled_by_draws(attacked: Attacked, fooled: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """(E,) bool: whether `fooled` (E,) says so, or any of as many draws (E, D) as the attack had steps fools."""
    fooled = fooled.clone()
    for _ in range(attacked.settings.max_steps):
        left = torch.nonzero(~fooled).squeeze(1)
        if not len(left):
            break
        drawn = draw()[left]
        with torch.no_grad():
            images = attacked.problem.render(drawn, left)
        predicted = logits_of(attacked.judge, images, attacked.settings.batch_size).argmax(2)
        fooled[left] = attacked.goal.of(left).reached(predicted)
    return fooled


def _success_by_steps(attacked: Attacked) -> dict[int, float]:
    settings, phases = attacked.settings, Phases(attacked.problem.start.device)
    longest = replace(settings, max_steps=settings.max_steps * max(GROWTH))
    seen = settings.observed(attacked.classifier, attacked.seed)
    result = descend(seen, attacked.problem, attacked.goal, longest, phases)
    limits = [settings.max_steps * factor for factor in GROWTH]
    return {limit: _share((result.fooled & (result.fooled_at <= limit))[attacked.recognised]) for limit in limits}


def _share(values: Tensor) -> float:
    return float(values.double().mean()) if len(values) else 0.0
