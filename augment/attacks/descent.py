"""Descent on the adversarial cost over anything that renders differentiably, until the classifier is fooled."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor, nn

from augment.attacks.criteria import Goal, adversarial_cost, logit_gap
from augment.utils import BatchSize, Phases, as_found, progress
from renderer.errors import FACTOR, require_range

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


@dataclass
class DescentSettings:
    """How long a descent lasts.

    max_steps: renders after the first; the paper's appendix C has 30. shorten: a step after which the cost has not
    fallen is taken back and tried at half its length, since the gradient of geometry holds visibility fixed.
    batch_size: images per pass through the classifier, fewer where memory runs out. margin: by how much the logits of
    what fools are to exceed all others, in every view, before an example leaves.
    """

    max_steps: int = 30
    shorten: bool = False
    batch_size: int = 128
    margin: float = 0.0

    def __post_init__(self) -> None:
        require_range("attack: max_steps", self.max_steps, 0, 10**6)
        require_range("attack: batch_size", self.batch_size, 1, 10**6)
        require_range("attack: margin", self.margin, 0, FACTOR)


class Problem(Protocol):
    """What is attacked: E examples of V views each, whose images follow from values (E, D)."""

    @property
    def start(self) -> Float[Tensor, "E D"]:
        """The values where they begin."""

    def render(self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]) -> Float[Tensor, "A V 3 H W"]:
        """Images in [0, 1] of some examples under values of theirs."""

    def step(self, gradient: Float[Tensor, "A D"]) -> Float[Tensor, "A D"]:
        """How far to go down a gradient."""

    def project(self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]) -> Float[Tensor, "A D"]:
        """Values moved to where they may be."""


@dataclass(frozen=True)
class DescentResult:
    """What an attack did, per example; all tensors lie on the values' device.

    values, images: where the descent ended, or of those that fool the one of the lowest cost. steps: taken. fooled_at:
    the step that first fooled, of no meaning where none did; with a margin, a descent goes on from there.
    cost_before, cost: the paper's cost, summed over views. predicted: the classes there. zero_gradient: the first
    gradient was exactly zero.
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


@dataclass(frozen=True)
class _Pass:
    """What a classifier makes of A examples: the cost's gradient is by their images (A, V, 3, H, W). gap: (A,), the
    least over views of `logit_gap`."""

    cost: Tensor
    predicted: Tensor
    gap: Tensor
    gradient: Tensor


@dataclass(frozen=True)
class Part:
    """Some examples (A,) of a problem, from starts (A, D) of their own."""

    problem: Problem
    examples: Tensor
    start: Tensor

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        return self.problem.render(values, self.examples[examples])

    def step(self, gradient: Tensor) -> Tensor:
        return self.problem.step(gradient)

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        return self.problem.project(values, self.examples[examples])


def descend_in_parts(
    model: nn.Module,
    problem: Problem,
    goal: Goal,
    settings: DescentSettings,
    phases: Phases,
    starts: Iterable[Tensor],
    at_once: int,
) -> DescentResult:
    """`descend_repeatedly`, of so many examples at a time, so that memory holds no more than these and the result."""
    parts = torch.arange(len(problem.start), device=problem.start.device).split(at_once)
    if len(parts) <= 1:
        return descend_repeatedly(model, problem, goal, settings, phases, starts)
    starts = list(starts)
    whole: dict[str, Tensor] = {}
    for rows in progress(parts, "attack"):
        part, begin = Part(problem, rows, problem.start[rows]), (start[rows] for start in starts)
        result = descend_repeatedly(model, part, goal.of(rows), settings, phases, begin)
        for item in fields(result):
            found = getattr(result, item.name)
            whole.setdefault(item.name, found.new_empty(len(problem.start), *found.shape[1:]))[rows] = found
    return DescentResult(**whole)


def descend_repeatedly(
    model: nn.Module, problem: Problem, goal: Goal, settings: DescentSettings, phases: Phases, starts: Iterable[Tensor]
) -> DescentResult:
    """`descend`, and again from other starts (E, D) for the examples that no descent has fooled yet.

    What a later descent reaches counts where it fools; steps add up.
    """
    best = descend(model, problem, goal, settings, phases)
    for start in starts:
        left = torch.nonzero(~best.success).squeeze(1)
        if not len(left):
            break
        again = descend(model, Part(problem, left, start[left]), goal.of(left), settings, phases)
        better = left[again.success]
        best.success_at[better] = (best.steps[left] + again.success_at)[again.success]
        best.steps[left] += again.steps
        for name in ("values", "images", "success", "cost", "predicted"):
            getattr(best, name)[better] = getattr(again, name)[again.success]
    return best


@torch.enable_grad()
def descend(model: nn.Module, problem: Problem, goal: Goal, settings: DescentSettings, phases: Phases) -> DescentResult:
    """Step each example's values down the cost, summed over its views, until the goal is reached.

    model: (N, 3, H, W) in [0, 1] → logits; used in eval mode and left as it was found. The forward pass that yields the
    gradient also tells who is fooled, and only examples that go on are rendered.
    """
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
                seen = _classifier_pass(model, rendered.detach(), aim, batch_size)
            (gradient,) = torch.autograd.grad(rendered, chosen, seen.gradient)
            reached = aim.reached(seen.predicted)
            if step == 0:
                images, cost_before, success_before = rendered.detach().clone(), seen.cost, reached
                zero_gradient = gradient.abs().amax(1) == 0
            done = reached & (seen.gap >= settings.margin)
            success_at[active[reached & ~success[active]]] = step
            fell = seen.cost < cost[active]
            taken = done | fell if settings.shorten else torch.ones_like(done)
            best = done | torch.where(success[active], reached & fell, reached | taken)
            rows = torch.nonzero(best).squeeze(1)
            kept = active[rows]
            values[kept], images[kept] = candidate[kept], rendered.detach()[rows]
            cost[kept], predicted[kept], success[kept] = seen.cost[rows], seen.predicted[rows], reached[rows]
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


def _classifier_pass(model: nn.Module, images: Tensor, goal: Goal, batch_size: BatchSize) -> _Pass:
    views, flat = images.shape[1], images.flatten(0, 1)
    source, target = goal.source.flatten(), None if goal.target is None else goal.target.flatten()
    gradient = torch.empty_like(flat)

    def preprocessed_model(part: slice) -> tuple[Tensor, Tensor, Tensor]:
        batch = flat[part].detach().requires_grad_(True)
        logits = model(batch)
        aim = source[part], None if target is None else target[part]
        cost = adversarial_cost(logits, *aim)
        (by_image,) = torch.autograd.grad(cost.sum(), batch)
        gradient[part] = by_image  # laid out as the images are, not as the network's channels
        return cost.detach(), logits.detach().argmax(1), logit_gap(logits.detach(), *aim)

    costs, predicted, gaps = zip(*batch_size.map(preprocessed_model, len(flat)), strict=True)
    return _Pass(
        torch.cat(costs).unflatten(0, (-1, views)).sum(1),
        torch.cat(predicted).unflatten(0, (-1, views)),
        torch.cat(gaps).unflatten(0, (-1, views)).amin(1),
        gradient.unflatten(0, (-1, views)),
    )
