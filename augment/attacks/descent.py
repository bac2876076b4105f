"""Projected gradient descent on the adversarial cost, over anything that renders differentiably.

An example's values x (light, shape, ...) render to V views I_v(x). With a source class s (what the views show) and,
in a targeted attack, a target class t for each view, descent lowers the paper's equation 1,

    cost(x) = Σ_v  −CE(f(I_v(x)), s_v) + CE(f(I_v(x)), t_v),        x ← project(x − length · step(∂cost/∂x)),

where step() scales the gradient (`augment.attacks.norm_ball.StepSettings`) and project() returns into the norm-ball and
the physically possible. The length is 1; with `shorten`, a step that did not lower the cost is undone and tried at half
its length. One forward pass gives the cost, the gradient and the predictions. An example is a success once the
criterion is met in every view by the image as the preprocessed classifier gets it; it leaves the batch once its
logits also lead by `margin` there. Until then, the success of lowest cost is kept.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from augment.attacks.criteria import Goal
from augment.attacks.eot import ExpectationOverTransformations
from augment.losses import adversarial_cost, logit_gap
from augment.utils import BatchSize, Phases, as_found, generator, progress

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from augment.attacks.attack import AttackSettings


class Problem(Protocol):
    """What is attacked: E examples of V views each, rendered from values (E, D)."""

    @property
    def start(self) -> Float[Tensor, "E D"]:
        """The values where descent begins."""

    def render(self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]) -> Float[Tensor, "A V 3 H W"]:
        """Images in [0, 1] of some examples under these values."""

    def step(self, gradient: Float[Tensor, "A D"]) -> Float[Tensor, "A D"]:
        """The step for a gradient, to be subtracted."""

    def project(self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]) -> Float[Tensor, "A D"]:
        """The nearest permitted values."""


@dataclass(frozen=True)
class Part:
    """Some examples (A,) of a problem, with other starts (A, D)."""

    problem: Problem
    examples: Tensor
    start: Tensor

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        return self.problem.render(values, self.examples[examples])

    def step(self, gradient: Tensor) -> Tensor:
        return self.problem.step(gradient)

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        return self.problem.project(values, self.examples[examples])


@dataclass(frozen=True)
class DescentResult:
    """The end of a descent, per example; all tensors lie on the values' device.

    values, images: of the success of lowest cost or, without a success, of the last step that was kept. steps: number
    of steps. success_at: the first step that was a success (meaningless without one); with a margin, descent goes on
    from there. cost_before, cost: equation 1. predicted: classes. zero_gradient: the first gradient was exactly zero.
    """

    values: Float[Tensor, "E D"]
    images: Float[Tensor, "E V 3 H W"]
    steps: Int[Tensor, " E"]
    success_before: Bool[Tensor, " E"]
    success: Bool[Tensor, " E"]
    success_at: Int[Tensor, " E"]
    cost_before: Float[Tensor, " E"]
    cost: Float[Tensor, " E"]
    predicted: Int[Tensor, "E V"]
    zero_gradient: Bool[Tensor, " E"]


def descend(
    model: nn.Module,
    problem: Problem,
    goal: Goal,
    settings: AttackSettings,
    phases: Phases | None = None,
    *,
    starts: Iterable[Tensor] = (),
    at_once: int | None = None,
    seed: int = 0,
) -> DescentResult:
    """Descend from the problem's start and, for examples without success, from further starts (E, D).

    model: (N, 3, H, W) in [0, 1] → logits, with its preprocessing; used in eval mode and left as it was found. A later
    start replaces an example's result only if it succeeds; steps add up. at_once: examples per round, so that memory
    holds no more than theirs; None: all. seed: of the transformations that `settings.eot` asks for.
    """
    phases, begin = phases or Phases(), problem.start
    expectation = ExpectationOverTransformations(settings.eot, generator(seed, "expectation"))
    rounds = torch.arange(len(begin), device=begin.device).split(at_once or max(len(begin), 1))
    starts = starts if len(rounds) <= 1 else list(starts)
    whole: dict[str, Tensor] = {}
    for rows in progress(rounds, "attack") if len(rounds) > 1 else rounds:
        part = problem if len(rounds) == 1 else Part(problem, rows, begin[rows])
        best = _descend_once(model, part, goal.of(rows), settings, expectation, phases)
        for start in starts:
            left = torch.nonzero(~best.success).squeeze(1)
            if not len(left):
                break
            rest = Part(problem, rows[left], start[rows[left]])
            again = _descend_once(model, rest, goal.of(rows[left]), settings, expectation, phases)
            better = left[again.success]
            best.success_at[better] = (best.steps[left] + again.success_at)[again.success]
            best.steps[left] += again.steps
            for name in ("values", "images", "success", "cost", "predicted"):
                getattr(best, name)[better] = getattr(again, name)[again.success]
        if len(rounds) == 1:
            return best
        for item in fields(best):
            result = getattr(best, item.name)
            whole.setdefault(item.name, result.new_empty(len(begin), *result.shape[1:]))[rows] = result
    return DescentResult(**whole)


@torch.enable_grad()
def _descend_once(
    model: nn.Module,
    problem: Problem,
    goal: Goal,
    settings: AttackSettings,
    expectation: ExpectationOverTransformations,
    phases: Phases,
) -> DescentResult:
    """Only examples that go on are rendered."""
    values = problem.start.detach().clone()
    active = torch.arange(len(values), device=values.device)
    steps, success_at, success = torch.zeros_like(active), torch.zeros_like(active), torch.zeros_like(active).bool()
    cost, length = values.new_full((len(values),), torch.inf), values.new_ones(len(values), 1)
    candidate, place, slope = values.clone(), values.clone(), torch.zeros_like(values)
    predicted, batch_size = torch.zeros_like(goal.source), BatchSize(settings.batch_size)
    with as_found(model):
        for step in range(settings.max_steps + 1):
            chosen = candidate[active].requires_grad_(True)
            rendered = problem.render(chosen, active)
            aim = goal.of(active)
            with phases("attack_classifier"):
                now = _classifier_pass(model, rendered.detach(), aim, batch_size, expectation)
            (gradient,) = torch.autograd.grad(rendered, chosen, now.gradient)
            reached = aim.reached(now.predicted)
            if step == 0:
                images, cost_before, success_before = rendered.detach().clone(), now.cost, reached
                zero_gradient = gradient.abs().amax(1) == 0
            done = reached & (now.gap >= settings.margin)
            success_at[active[reached & ~success[active]]] = step
            fell = now.cost < cost[active]
            taken = done | fell if settings.shorten else torch.ones_like(done)
            best = done | torch.where(success[active], reached & fell, reached | taken)
            rows = torch.nonzero(best).squeeze(1)
            kept = active[rows]
            values[kept], images[kept] = candidate[kept], rendered.detach()[rows]
            cost[kept], predicted[kept], success[kept] = now.cost[rows], now.predicted[rows], reached[rows]
            place[active[taken]], slope[active[taken]] = candidate[active[taken]], gradient[taken]
            length[active[~taken]] /= 2
            active = active[~done]
            if step == settings.max_steps or not len(active):
                break
            moved = place[active] - length[active] * problem.step(slope[active])
            candidate[active] = problem.project(moved, active)
            steps[active] += 1
    return DescentResult(
        values, images, steps, success_before, success, success_at, cost_before, cost, predicted, zero_gradient
    )


class _Pass(NamedTuple):
    """A classifier's pass over A examples. cost, gap: (A,), the sum and the least over views. predicted: (A, V), of the
    images as they are. gradient: of the cost by the images (A, V, 3, H, W)."""

    cost: Tensor
    gap: Tensor
    predicted: Tensor
    gradient: Tensor


def _classifier_pass(
    model: nn.Module, images: Tensor, goal: Goal, batch_size: BatchSize, expectation: ExpectationOverTransformations
) -> _Pass:
    views, flat = images.shape[1], images.flatten(0, 1)
    source, target = goal.source.flatten(), None if goal.target is None else goal.target.flatten()
    gradient = torch.empty_like(flat)

    def compute(part: slice) -> tuple[Tensor, Tensor, Tensor]:
        batch = flat[part].detach().requires_grad_(True)
        logits = model(batch)
        expected = expectation(model, batch, logits)
        aim = source[part], None if target is None else target[part]
        cost = adversarial_cost(expected, *aim)
        (by_image,) = torch.autograd.grad(cost.sum(), batch)
        gradient[part] = by_image  # laid out as the images are, not as the network's channels
        return cost.detach(), logit_gap(expected.detach(), *aim), logits.detach().argmax(1)

    parts = zip(*batch_size.map(compute, len(flat)), strict=True)
    costs, gaps, predicted = (torch.cat(part).unflatten(0, (-1, views)) for part in parts)
    return _Pass(costs.sum(1), gaps.amin(1), predicted, gradient.unflatten(0, (-1, views)))
