"""Projected gradient descent on the adversarial cost, over anything that renders differentiably.

An example's values x (light, shape, ...) render to V views I_v(x). With a source class s (what the views show) and,
in a targeted attack, a target class t for each view, descent lowers the paper's equation 1,

    cost(x) = Σ_v  −CE(f(I_v(x)), s_v) + CE(f(I_v(x)), t_v),        x ← project(x − length · step(∂cost/∂x)),

where step() scales the gradient (`augment.attacks.norm_ball.StepSettings`) and project() returns into the norm-ball and
the physically possible. The length is 1; with `shorten`, a step that did not lower the cost is undone and tried at half
its length. One forward pass gives the cost, the gradient and the predictions. An example is a success once the
criterion is met in every view by the image as the preprocessed classifier gets it; it leaves the batch once its
logits also lead by `margin` there and, where the settings ask for it, by more than a sensor's noise changes. Until
then, the success of lowest cost is kept. Whether it counts is decided after the descent, by `fooled_in_views`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from augment.attacks.eot import ExpectationOverTransformations, stored
from augment.batches import BatchSize, as_found
from augment.losses import NO_CLASS, adversarial_cost, logit_gap
from augment.progress import Phases, progress
from augment.random_streams import generator

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from augment.attacks.attack import AttackSettings
    from augment.attacks.parameters import AttackProblem


@dataclass(frozen=True)
class Goal:
    """Source and target class of each view: an attack lowers the confidence in one and raises it in the other.

    source: NO_CLASS where only the target counts. target: NO_CLASS, or None for all views, where any error will do. A
    goal is reached where every view is classified as its target or, without a target, as anything but its source.
    """

    source: Int[Tensor, "E V"]
    target: Int[Tensor, "E V"] | None = None

    def of(self, examples: Tensor) -> Goal:
        """The goal of some of the examples."""
        return Goal(self.source[examples], None if self.target is None else self.target[examples])

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Whether the predicted classes reach the goal in all views of an example."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, "E V"]:
        """Whether the predicted classes reach the goal, view by view."""
        erred = predicted != self.source
        return erred if self.target is None else torch.where(self.target == NO_CLASS, erred, predicted == self.target)


@dataclass(frozen=True)
class DescentResult:
    """The end of a descent, per example; all tensors lie on the values' device.

    values, images: of the step that reached the margin, else of the success of lowest cost, else of the last step that
    was accepted. success: without noise. cost_before, cost: equation 1. predicted: classes. zero_gradient: the first
    one was exactly zero.
    """

    values: Float[Tensor, "E D"]
    images: Float[Tensor, "E V 3 H W"]
    steps: Int[Tensor, " E"]
    success_before: Bool[Tensor, " E"]
    success: Bool[Tensor, " E"]
    cost_before: Float[Tensor, " E"]
    cost: Float[Tensor, " E"]
    predicted: Int[Tensor, "E V"]
    zero_gradient: Bool[Tensor, " E"]


def descend(
    model: nn.Module,
    problem: AttackProblem,
    goal: Goal,
    settings: AttackSettings,
    phases: Phases | None = None,
    *,
    examples: Tensor | None = None,
    start: Tensor | None = None,
    restarts: Iterable[Tensor] = (),
    seed: int = 0,
) -> DescentResult:
    """Descend from the problem's start and, for examples without success, from further starts. As many examples as the
    problem renders at once are attacked in a round, so that memory holds no more than theirs.

    model: (N, 3, H, W) in [0, 1] → logits, with its preprocessing; used in eval mode and left as it was found. goal: of
    the examples. examples: (A,), some of the problem's. start: (A, D) instead of the problem's. restarts: further
    starts (A, D); one replaces an example's result only if it succeeds; steps add up. seed: of `settings.eot` and of
    the noise that a lead is compared with.
    """
    phases = phases or Phases()
    examples = torch.arange(len(problem.start), device=problem.start.device) if examples is None else examples
    start = problem.start[examples] if start is None else start
    expectation = ExpectationOverTransformations(settings.eot, generator(seed, "expectation"))
    rounds = torch.arange(len(start), device=start.device).split(problem.at_once)
    restarts = restarts if len(rounds) <= 1 else list(restarts)
    whole: dict[str, Tensor] = {}

    def run(rows: Tensor, begin: Tensor) -> DescentResult:
        chosen = examples[rows], begin[rows], goal.of(rows)
        return _descend_once(model, problem, *chosen, settings, expectation, phases, seed)

    for rows in progress(rounds, "groups of examples") if len(rounds) > 1 else rounds:
        best = run(rows, start)
        for restart in restarts:
            left = torch.nonzero(~best.success).squeeze(1)
            if not len(left):
                break
            again = run(rows[left], restart)
            better = left[again.success]
            best.steps[left] += again.steps
            for name in ("values", "images", "success", "cost", "predicted"):
                getattr(best, name)[better] = getattr(again, name)[again.success]
        if len(rounds) == 1:
            return best
        for item in fields(best):
            result = getattr(best, item.name)
            whole.setdefault(item.name, result.new_empty(len(start), *result.shape[1:]))[rows] = result
    return DescentResult(**whole)


@torch.enable_grad()
def _descend_once(
    model: nn.Module,
    problem: AttackProblem,
    examples: Tensor,
    start: Tensor,
    goal: Goal,
    settings: AttackSettings,
    expectation: ExpectationOverTransformations,
    phases: Phases,
    seed: int,
) -> DescentResult:
    """Of examples (A,) from a start (A, D). Only examples that go on are rendered."""
    values = start.detach().clone()
    active = torch.arange(len(values), device=values.device)
    steps, success = torch.zeros_like(active), torch.zeros_like(active).bool()
    kept_cost, position_cost = values.new_full((2, len(values)), torch.inf)
    candidate, position, position_gradient = values.clone(), values.clone(), torch.zeros_like(values)
    length = values.new_ones(len(values), 1)
    predicted, batch_size = torch.zeros_like(goal.source), BatchSize(settings.batch_size)
    with as_found(model):
        for step in progress(range(settings.max_steps + 1), "attack, until all succeed"):
            chosen, active_goal = candidate[active].requires_grad_(True), goal.of(active)
            rendered = problem.render(chosen, examples[active])
            shown = rendered.detach()
            with phases("attack_classifier"):
                cost, gap, classes, by_image = _classifier_pass(model, shown, active_goal, batch_size, expectation)
            (gradient,) = torch.autograd.grad(rendered, chosen, by_image)
            reached = active_goal.reached(classes)
            if step == 0:
                images, cost_before, success_before = shown.clone(), cost, reached
                zero_gradient = gradient.abs().amax(1) == 0
            done = reached & (gap >= settings.margin)
            if settings.lead_over_noise:
                with phases("attack_classifier"):
                    leading = done.nonzero()[:, 0]
                    of_leading = shown[leading], examples[active[leading]], active_goal.of(leading)
                    done[leading] = _leads_over_noise(model, *of_leading, settings, seed)
            # The next step starts from an accepted one; with `shorten`, from none that raised the cost.
            accepted = done | (cost < position_cost[active]) if settings.shorten else torch.ones_like(done)
            # Kept is what would be returned if this step were the last one.
            better = done | torch.where(success[active], reached & (cost < kept_cost[active]), reached | accepted)
            masks = torch.stack([accepted, better, ~done]).cpu()  # at once, since the host waits here for a GPU
            on, rows, left = (mask.nonzero()[:, 0].to(values.device, non_blocking=True) for mask in masks)
            length[active] /= 2 - accepted[:, None].to(length)
            moved, kept = active[on], active[rows]
            position[moved], position_gradient[moved] = candidate[moved], gradient[on]
            position_cost[moved] = cost[on]
            values[kept], images[kept], kept_cost[kept] = candidate[kept], shown[rows], cost[rows]
            predicted[kept], success[kept] = classes[rows], reached[rows]
            active = active[left]
            if step == settings.max_steps or not len(active):
                break
            stepped = position[active] - length[active] * problem.step(position_gradient[active])
            candidate[active] = problem.project(stepped, examples[active])
            steps[active] += 1
    return DescentResult(
        values, images, steps, success_before, success, cost_before, kept_cost, predicted, zero_gradient
    )


@torch.no_grad()
def _leads_over_noise(
    model: nn.Module, images: Tensor, examples: Tensor, goal: Goal, settings: AttackSettings, seed: int
) -> Tensor:
    """Whether images (A, V, 3, H, W) lead by more than noise changes, in every view, (A,) bool: whether the smallest
    lead of their logits, with noise and without, is `settings.lead_over_noise` times the range of these leads. The
    draws of noise are not those by which a success is counted."""
    if not len(images):
        return examples.new_zeros(0, dtype=torch.bool)
    noisy_images = stored(images, settings.sensor_noise, examples, seed, "noise margin")
    leads = []
    for shown in (images, *noisy_images):
        flat = shown.flatten(0, 1)
        logits = torch.cat([model(part) for part in flat.split(settings.batch_size)])
        leads.append(logit_gap(logits.unflatten(0, shown.shape[:2]), goal.source, goal.target))
    smallest, largest = torch.stack(leads).aminmax(dim=0)
    return (smallest >= settings.lead_over_noise * (largest - smallest)).all(1)


def _classifier_pass(
    model: nn.Module, images: Tensor, goal: Goal, batch_size: BatchSize, expectation: ExpectationOverTransformations
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of images (A, V, 3, H, W): the sum of the cost (A,) and the least logit gap (A,) over views, the predicted
    classes (A, V) of the images as they are, and the gradient of the cost by the images."""
    views, flat = images.shape[1], images.flatten(0, 1)
    source, target = goal.source.flatten(), None if goal.target is None else goal.target.flatten()
    gradient = torch.empty_like(flat)

    def compute(part: slice) -> tuple[Tensor, Tensor, Tensor]:
        batch = flat[part].detach().requires_grad_(True)
        logits = model(batch)
        expected = expectation(model, batch, logits)
        classes = source[part], None if target is None else target[part]
        cost = adversarial_cost(expected, *classes)
        (by_image,) = torch.autograd.grad(cost.sum(), batch)
        gradient[part] = by_image  # laid out as the images are, not as the network's channels
        return cost.detach(), logit_gap(expected.detach(), *classes), logits.detach().argmax(1)

    parts = zip(*batch_size.map(compute, len(flat)), strict=True)
    cost, gap, predicted = (torch.cat(part).unflatten(0, (-1, views)) for part in parts)
    return cost.sum(1), gap.amin(1), predicted, gradient.unflatten(0, (-1, views))
