"""The loop of all attacks: ask an optimizer for candidates, score them, and tell it the costs.

An example is attacked through its values x, such as the coefficients of its lighting. A problem
(`Problem`, such as `SceneProblem`) says which values are possible and renders them, an objective
(`augment.attacks.objective`) says what they cost and when they succeed, and an optimizer
(`augment.attacks.optimizers`) says which to try next.

Examples that are finished are dropped. Until then, the successful values of lowest cost are kept.
The loop tests with sensor noise of its own. Whether a success counts is finally decided after it
(`Objective.fooled_in_views`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.attack_settings import GRADIENT
from augment.attacks.objective import NOISE_DRAWS, Examples, Images, Objective, Score, Values
from augment.attacks.optimizers import FOUND, KINDS, Evaluation, Optimizer, Problem, chosen
from augment.network import frozen_eval_mode, say_once
from augment.progress import progress
from augment.scene.truth import Rows
from renderer.errors import Check, ShortRepr, late_checks, raise_first
from renderer.modes import without_autocast

# Fields that also count what restarts take.
COUNTS = ("steps", "queries", "backward_passes")


def drop_period(device: torch.device) -> int:
    """Return after how many steps finished examples are dropped, for which a CPU waits."""
    return 1 if device.type == "cpu" else 4


@dataclass(frozen=True, repr=False)
class Minimum(Rows, ShortRepr):
    """Values that `minimize` found for E examples, with their images and costs.

    A candidate is a vector of D values that was evaluated. For each example, one candidate is
    returned. It is

    - the candidate that reached the criterion with the required margin,
    - if there is none, the candidate of lowest cost that reached the criterion,
    - if there is none, the last candidate that the optimizer accepted (`Optimizer.tell`).

    The candidate of a restart that succeeds replaces it. Each tensor has one row for each example,
    and lies on the device of the attacked values.

    Attributes:
        values: Values of the returned candidate.
        images: Images of the V views of the returned candidate, in [0, 1].
        steps: Number of steps taken, including those of restarts.
        queries: Number of images of the example that the network was shown, including those of
            restarts.
        backward_passes: Number of these images for which a gradient was computed.
        success_before: Whether the initial values reach the criterion.
        success: Whether the returned candidate reaches the criterion, without noise.
        cost_before: Cost of the initial values, see `Criterion.cost`.
        cost: Cost of the returned candidate.
        predicted: Class predicted for each view of the returned candidate.
        zero_gradient: Whether the gradient at the initial values is exactly zero. False if no
            gradient was computed.
    """

    values: Values
    images: Images
    steps: Int[Tensor, " E"]
    queries: Int[Tensor, " E"]
    backward_passes: Int[Tensor, " E"]
    success_before: Bool[Tensor, " E"]
    success: Bool[Tensor, " E"]
    cost_before: Float[Tensor, " E"]
    cost: Float[Tensor, " E"]
    predicted: Int[Tensor, "E V"]
    zero_gradient: Bool[Tensor, " E"]

    @classmethod
    def at_start(cls, evaluation: Evaluation) -> Minimum:
        """Return the result before the evaluated initial values are recorded: no success."""
        score = evaluation.score
        # One integer zero for each example.
        zeros = torch.zeros_like(score.predicted[:, 0])
        is_zero = torch.zeros_like(score.is_success)
        if evaluation.gradient is not None:
            is_zero = evaluation.gradient.abs().amax(1) == 0
        # The cost is infinite, so that the first candidate of each example is recorded.
        nothing = {"success": zeros.bool(), "cost": torch.full_like(score.cost, torch.inf)}
        minimum = cls(
            **evaluation.found | nothing | dict.fromkeys(COUNTS, zeros),
            success_before=score.is_success,
            cost_before=score.cost,
            zero_gradient=is_zero,
        )
        # Each tensor is changed in place.
        return minimum.map(torch.clone)

    def record(self, rows: Examples, found: dict[str, Tensor], mask: Bool[Tensor, " E"]) -> None:
        """Make candidates the present results of some examples, where the mask is true."""
        for name, candidates in found.items():
            column = getattr(self, name)
            column[rows] = chosen(mask, candidates, column[rows])


@torch.no_grad()
def minimize(
    problem: Problem,
    objective: Objective,
    *,
    examples: Examples | None = None,
    start: Values | None = None,
    restarts: Iterable[Tensor] = (),
    optimizer: type[Optimizer] | None = None,
) -> Minimum:
    """Attack examples with an optimizer, by default the one that the settings choose.

    The examples are attacked in groups of at most `problem.group_size`, so that the gradients fit
    in memory. The network runs in evaluation mode, and its state is restored afterwards. By
    default, all examples are attacked, starting at `problem.start`. Restarts are further initial
    values, tried in turn for the examples that have not succeeded.
    """
    if examples is None:
        examples = torch.arange(len(problem.start), device=problem.start.device)
    if start is None:
        start = problem.start[examples]
    all_rows = torch.arange(len(start), device=start.device)
    groups: Iterable[Tensor] = all_rows.split(problem.group_size)
    if len(start) > problem.group_size:
        # Each group uses all restarts, and an iterator would be empty after the first.
        restarts = list(restarts)
        groups = progress(groups, "groups of examples")
    kind = optimizer or KINDS[objective.settings.optimizer or GRADIENT]
    search = kind(problem, objective.settings, objective.seed)
    minima = []
    for rows in groups:
        # Further initial values of the group, which are read only while examples fail.
        starts = (restart[rows] for restart in restarts)
        part = objective.select(rows)
        minima.append(_minimize_group(search, part, examples[rows], start[rows], starts))
    return Minimum.join(minima)


def _minimize_group(
    optimizer: Optimizer,
    objective: Objective,
    examples: Examples,
    start: Values,
    restarts: Iterable[Tensor],
) -> Minimum:
    """Attack E examples from one or more initial values, until they succeed.

    Further values are for examples that fail, or fail with sensor noise, while queries remain.
    """
    settings = objective.settings
    limit = settings.query_limit_of_start
    result = minimize_from(start, optimizer, objective, examples)
    # The network sees the initial values of a start, and then the candidates of its first step.
    needed = (1 + optimizer.candidate_count) * objective.passes_per_candidate
    if optimizer.candidate_count > 1 and limit is not None and limit < needed:
        given = f"max_queries={settings.query_limit} with restarts={settings.restarts}"
        advice = f"set max_queries to at least {needed * (1 + settings.restarts)}"
        say_once(f"{given} is too little for a step of {settings.optimizer}: {advice}")
    # Stop if the queries of a start do not even pay for one candidate.
    if limit is not None and limit < objective.passes_per_candidate:
        return result
    # Result of the latest start alone, and the rows of its examples in the whole result.
    latest = result
    rows = torch.arange(len(examples), device=examples.device)
    for restart in restarts:
        # The successes that must survive sensor noise. A success whose start has too few queries
        # left for the noisy images counts without them.
        noisy_count = NOISE_DRAWS * objective.criterion.view_count
        is_checked = latest.success & bool(settings.sensor_noise)
        if limit is not None:
            is_checked &= latest.queries + noisy_count <= limit
        checked = is_checked.nonzero()[:, 0]
        result.queries[rows[checked]] += noisy_count
        is_success = latest.success.clone()
        with frozen_eval_mode(objective.model):
            if len(checked):
                part, shown = objective.select(rows[checked]), examples[rows[checked]]
                moved = part.moved(optimizer.problem, latest.values[checked], shown)
                is_success[checked] = moved.is_robust(latest.images[checked], shown)
        rows = rows[~is_success]
        if not len(rows):
            break
        latest = minimize_from(restart[rows], optimizer, objective.select(rows), examples[rows])
        for name in COUNTS:
            getattr(result, name)[rows] += getattr(latest, name)
        # Where the restart succeeds, its candidate replaces that of the example.
        result.record(rows, {name: getattr(latest, name) for name in FOUND}, latest.success)
    return result


@torch.no_grad()
def minimize_from(
    start: Values,
    optimizer: Optimizer,
    objective: Objective,
    examples: Examples,
    scores_last: bool = True,
) -> Minimum:
    """Attack E examples from one set of initial values.

    Each example takes steps until it reaches its criterion with the required margin, or has used up
    its steps or queries. On a GPU, finished examples stay in the batch for up to `drop_period`
    steps, which do not change their results, and candidates are tested with noise only in the last
    of these. Without `scores_last`, the values after the last step are the result of the examples
    that are not finished, whatever they cost. Their images and costs are older then.
    """
    settings = objective.settings
    evaluation_count = settings.step_limit + scores_last
    period = drop_period(start.device) if settings.query_limit_of_start is None else 1
    checks: list[Check] = []
    # Rows of the examples that are attacked, their numbers, and a mask of those that are finished.
    active = torch.arange(len(start), device=start.device)
    shown, part, is_over = examples, objective, torch.zeros_like(active, dtype=torch.bool)
    optimizer.begin(examples, start)
    with frozen_eval_mode(objective.model):
        for step in progress(range(evaluation_count), "attack, until all succeed"):
            # Only steps that drop examples wait for a GPU.
            drops = step % period == 0 or step == evaluation_count - 1
            # Step 0 evaluates the initial values.
            candidates = optimizer.ask(active) if step else start[:, None]
            # The last evaluation needs no gradient, because no step follows.
            needs_gradient = settings.uses_gradients and step < settings.step_limit
            with late_checks(checks if step and period > 1 else None):
                evaluation = evaluate(optimizer.problem, part, candidates, shown, needs_gradient)
            if not step:
                result = Minimum.at_start(evaluation)
            is_accepted = optimizer.tell(active, evaluation)
            score = evaluation.score
            moved = part
            # A GPU would wait to find that no success needs a test with noise.
            if period > 1 or score.is_success.any():
                moved = part.moved(optimizer.problem, evaluation.values, shown)
            is_finished, noisy_count = moved.finished(score, evaluation.images, shown, drops)
            # An example without a success takes each candidate that the optimizer accepts as its
            # result. An example with a success takes only successes of lower cost.
            is_cheaper = score.is_success & (score.cost < result.cost[active])
            is_first = ~result.success[active] & (score.is_success | is_accepted)
            is_better = is_finished | is_cheaper | is_first
            result.record(active, evaluation.found, is_better & ~is_over)
            passes = candidates.shape[1] * objective.passes_per_candidate
            result.steps[active] = torch.where(is_over, result.steps[active], step)
            result.queries[active] += torch.where(is_over, 0, passes + noisy_count)
            result.backward_passes[active] += torch.where(is_over, 0, passes * needs_gradient)
            is_over = is_over | is_finished
            if not drops:
                continue
            raise_first(checks)
            is_kept = ~is_over
            # Drop also the examples that cannot pay for another step.
            if settings.query_limit_of_start is not None:
                needed = optimizer.candidate_count * objective.passes_per_candidate
                is_kept &= result.queries[active] <= settings.query_limit_of_start - needed
            kept = active[is_kept]
            if len(kept) < len(active):
                active, shown, part = kept, examples[kept], objective.select(kept)
                is_over = torch.zeros_like(kept, dtype=torch.bool)
            if not len(active):
                break
    if not scores_last:
        result.values[active] = optimizer.ask(active)[:, 0]
    return result


def evaluate(
    problem: Problem,
    objective: Objective,
    candidates: Float[Tensor, "E P D"],
    examples: Examples,
    needs_gradient: bool,
) -> Evaluation:
    """Render and score P candidates of each example, in groups that fit in memory."""
    count = candidates.shape[1]
    # The candidates of all examples as one list, and the row of the example of each.
    values = candidates.detach().flatten(0, 1)
    rows = torch.arange(len(examples), device=examples.device).repeat_interleave(count)
    images = []
    scores = []
    gradients: list[Tensor] = []
    for group in torch.arange(len(rows), device=rows.device).split(problem.group_size):
        part = values[group].requires_grad_(needs_gradient)
        # A renderer keeps what it made for the same tensor of examples.
        is_all = len(group) == len(rows) == len(examples)
        shown = examples if is_all else examples[rows[group]]
        with torch.set_grad_enabled(needs_gradient):
            rendered = problem.render(part, shown)
        images.append(rendered.detach())
        # The values may move the objects, and with them the truth that the criterion needs.
        moved = objective.select(rows[group]).moved(problem, part.detach(), shown)
        score, image_gradient = moved.score(images[-1], needs_gradient)
        scores.append(score)
        if needs_gradient:
            # Chain rule: the gradient with respect to the images gives the gradient with respect
            # to the values.
            gradients += without_autocast(torch.autograd.grad)(rendered, part, image_gradient)
    score = Score.join(scores)
    # One row for each example, one column for each of its candidates.
    costs = score.cost.unflatten(0, (-1, count))
    is_success = score.is_success.unflatten(0, (-1, count))
    is_excluded = is_success.any(1, keepdim=True) & ~is_success
    # Indices among all candidates: the one of lowest cost, among those that succeed if any does.
    column = costs.masked_fill(is_excluded, torch.inf).argmin(1)
    best = column + count * torch.arange(len(costs), device=costs.device)
    return Evaluation(
        candidates=candidates,
        costs=costs,
        values=values[best],
        images=torch.cat(images)[best],
        score=score.select(best),
        gradient=torch.cat(gradients)[best] if needs_gradient else None,
    )
