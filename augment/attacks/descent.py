"""Projected gradient descent on the adversarial cost.

An example is attacked through its values x, such as the coefficients of its
lighting. They render to V images I_v(x), one for each view v. A classifier f
maps an image to logits, and CE(f(I), c) is the cross entropy of its prediction
with class c. Each view has a source class s_v, the class that it shows. In a
targeted attack it also has a target class t_v. The attack lowers the cost of
the paper's equation 1,

    cost(x) = Σ_v −CE(f(I_v(x)), s_v) + CE(f(I_v(x)), t_v),

by repeating the step

    x ← project(x − length · step(∂cost/∂x)).

`norm_ball.take_step` takes this step: it scales the gradient, and returns the
nearest values that are feasible and lie in the norm-ball. The length is 1. With
backtracking (`AttackSettings.backtracking`), a step that does not lower the cost is
undone and tried again at half its length.

One forward and backward pass of the classifier gives the cost, its gradient and
the predictions. An example succeeds when the predictions reach its criterion in
every view. It is finished when the logits also lead by `AttackSettings.margin`
in every view and, if the settings ask for it, by more than the noise of a
sensor changes them. Until then it stays active: it takes further steps, and its
successful values of lowest cost are kept. Whether a success counts is decided
after the descent (`augment.attacks.attack.fooled_in_views`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from augment.attacks.eot import NOISE_DRAWS, ExpectationOverTransformations, stored
from augment.losses import NO_CLASS, adversarial_cost, logit_gap
from augment.model_passes import BatchSize, frozen_eval_mode
from augment.progress import Phases, progress

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from augment.attack_settings import AttackSettings
    from augment.attacks.problem import AttackProblem


@dataclass(frozen=True)
class Criterion:
    """Source and target class of each view of an attack.

    An attack lowers the confidence in the source class of each view and raises
    the confidence in its target class. A view reaches the criterion when it is
    classified as its target or, without a target, as any class except its
    source. An example reaches the criterion when all its views do.

    Attributes:
        source: Source class of each view. NO_CLASS removes the source from the
            cost of a view, so that only its target counts.
        target: Target class of each view. NO_CLASS makes the attack on a view
            untargeted. None makes the attack on all views untargeted.

    Example:
        >>> criterion = Criterion(source=torch.tensor([[0, 0]]))
        >>> criterion.reached(torch.tensor([[2, 1]])), criterion.reached(torch.tensor([[2, 0]]))
        (tensor([True]), tensor([False]))
    """

    source: Int[Tensor, "E V"]
    target: Int[Tensor, "E V"] | None = None

    def select(self, examples: Tensor | slice) -> Criterion:
        """Return the criterion of some of the examples.

        Args:
            examples: Indices of the A examples, shape (A,), or a slice.

        Returns:
            Source and target classes of the A examples.
        """
        if self.target is None:
            return Criterion(self.source[examples])
        return Criterion(self.source[examples], self.target[examples])

    def flatten(self) -> Criterion:
        """Return a criterion with an entry for each view of each example, in shape (E · V,)."""
        if self.target is None:
            return Criterion(self.source.flatten())
        return Criterion(self.source.flatten(), self.target.flatten())

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Return whether all views of each example are predicted as its criterion demands."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, "E V"]:
        """Return whether each view is predicted as its criterion demands."""
        is_misclassified = predicted != self.source
        if self.target is None:
            return is_misclassified
        is_untargeted = self.target == NO_CLASS
        return torch.where(is_untargeted, is_misclassified, predicted == self.target)


@dataclass(frozen=True)
class DescentResult:
    """Values that a descent found for E examples, with their images and costs.

    A candidate is a vector of values that the descent evaluated. For each
    example, one candidate is returned: the one that reached the margin, else
    the successful one of lowest cost, else the last one from which a step was
    taken. All tensors lie on the device of the attacked values.

    Attributes:
        values: Values of the returned candidate.
        images: Images of the returned candidate, in [0, 1].
        steps: Number of steps taken, including those of restarts.
        queries: Number of forward passes: images of the example that the
            classifier was shown, including those of restarts.
        backward_passes: Number of these images for which a gradient was
            computed.
        success_before: Whether the initial values reach the criterion.
        success: Whether the returned candidate reaches the criterion, without noise.
        cost_before: Cost of the initial values (equation 1).
        cost: Cost of the returned candidate (equation 1).
        predicted: Class predicted for each view of the returned candidate.
        zero_gradient: Whether the gradient at the initial values is exactly
            zero. False if no gradient was computed.
    """

    values: Float[Tensor, "E D"]
    images: Float[Tensor, "E V 3 H W"]
    steps: Int[Tensor, " E"]
    queries: Int[Tensor, " E"]
    backward_passes: Int[Tensor, " E"]
    success_before: Bool[Tensor, " E"]
    success: Bool[Tensor, " E"]
    cost_before: Float[Tensor, " E"]
    cost: Float[Tensor, " E"]
    predicted: Int[Tensor, "E V"]
    zero_gradient: Bool[Tensor, " E"]

    def allocate(self, example_count: int) -> DescentResult:
        """Return an uninitialized result with rows for `example_count` examples.

        The tensors have the dtypes, devices and remaining dimensions of the
        tensors of this result.

        Args:
            example_count: Number of examples. Each tensor has one row for each example.
        """
        tensors = {}
        for item in fields(self):
            tensor = getattr(self, item.name)
            tensors[item.name] = tensor.new_empty(example_count, *tensor.shape[1:])
        return DescentResult(**tensors)

    def write(self, rows: Tensor, group: DescentResult) -> None:
        """Copy the result of a group of examples into the given rows of this result.

        Args:
            rows: Row of each example of the group, shape (A,).
            group: Result of the A examples of the group.
        """
        for item in fields(self):
            getattr(self, item.name)[rows] = getattr(group, item.name)

    def add_restart(self, rows: Tensor, restart: DescentResult) -> None:
        """Add the steps and passes of a restart, and take over its result wherever it succeeds.

        Args:
            rows: Row of each restarted example, shape (A,). None of these
                examples has succeeded before.
            restart: Result of the restart of these A examples.
        """
        is_success = restart.success
        successful_rows = rows[is_success]
        self.steps[rows] += restart.steps
        self.queries[rows] += restart.queries
        self.backward_passes[rows] += restart.backward_passes
        self.values[successful_rows] = restart.values[is_success]
        self.images[successful_rows] = restart.images[is_success]
        self.success[successful_rows] = restart.success[is_success]
        self.cost[successful_rows] = restart.cost[is_success]
        self.predicted[successful_rows] = restart.predicted[is_success]


@dataclass(frozen=True)
class Descent:
    """Projected gradient descent against one classifier.

    Attributes:
        model: Classifier with its preprocessing.
        problem: Attacked parameters and the scene that renders them.
        settings: Number of steps, margin, backtracking and batch size.
        expectation: Average of the model output over random transformations of
            an image.
        phases: Timer of the classifier passes.
        seed: Seed of the noise with which leads are compared.
    """

    model: nn.Module
    problem: AttackProblem
    settings: AttackSettings
    expectation: ExpectationOverTransformations
    phases: Phases
    seed: int

    def run_with_restarts(
        self, criterion: Criterion, examples: Tensor, start: Tensor, restarts: Iterable[Tensor]
    ) -> DescentResult:
        """Attack examples from their start, and from each restart until they succeed.

        Args:
            criterion: Source and target classes of the A examples.
            examples: Indices of the attacked examples in the problem,
                shape (A,).
            start: Initial values, shape (A, D).
            restarts: Further initial values, each of shape (A, D).

        Returns:
            Result of the A examples.
        """
        result = self.run(criterion, examples, start)
        for restart in restarts:
            failed_rows = torch.nonzero(~result.success).squeeze(1)
            if not len(failed_rows):
                break
            failed_criterion = criterion.select(failed_rows)
            restarted = self.run(failed_criterion, examples[failed_rows], restart[failed_rows])
            result.add_restart(failed_rows, restarted)
        return result

    @torch.enable_grad()
    def run(self, criterion: Criterion, examples: Tensor, start: Tensor) -> DescentResult:
        """Take steps until all examples are finished or have used up their budget.

        Only these examples are rendered and classified.

        Args:
            criterion: Source and target classes of the A examples.
            examples: Indices of the attacked examples in the problem,
                shape (A,).
            start: Initial values, shape (A, D).

        Returns:
            Result of the A examples.
        """
        state = State.at_start(criterion, examples, start, self.settings.batch_size)
        with frozen_eval_mode(self.model):
            # The initial values are evaluated before the first step, so there
            # is one more evaluation than steps.
            step_limit = self.settings.step_limit
            for step in progress(range(step_limit + 1), "attack, until all succeed"):
                evaluation = self._evaluate(state)
                if step == 0:
                    state.begin_result(evaluation)
                self._count_passes(state, evaluation)
                decision = self._decide(state, evaluation)
                state.record(evaluation, decision)
                self._drop_examples_without_budget(state)
                if step == step_limit or not len(state.active_rows):
                    break
                self._step(state)
        return state.result

    def _count_passes(self, state: State, evaluation: Evaluation) -> None:
        """Add the passes of an evaluation to those of the N active examples."""
        pass_count = evaluation.candidate_count * self._passes_of_candidate(state)
        state.result.queries[state.active_rows] += pass_count
        if evaluation.gradient is not None:
            state.result.backward_passes[state.active_rows] += pass_count

    def _passes_of_candidate(self, state: State) -> int:
        """Return the number of images by which a candidate is evaluated."""
        view_count = state.criterion.source.shape[1]
        return view_count * (1 + self.settings.eot.draws)

    def _drop_examples_without_budget(self, state: State) -> None:
        """Remove the examples for which the next step would need too many queries."""
        limit = self.settings.query_limit
        if limit is None or not len(state.active_rows):
            return
        needed = self._candidates_per_step(state) * self._passes_of_candidate(state)
        is_affordable = state.result.queries[state.active_rows] + needed <= limit
        state.active_rows = state.active_rows[is_affordable]

    def _candidates_per_step(self, state: State) -> int:
        """Return the number of candidates of an example that a step evaluates."""
        return 1

    def _evaluate(self, state: State) -> Evaluation:
        """Render and classify the candidates of the N active examples."""
        candidate = state.candidate[state.active_rows].requires_grad_(True)
        criterion = state.criterion.select(state.active_rows)
        rendered = self.problem.render(candidate, state.examples[state.active_rows])
        images = rendered.detach()
        with self.phases("attack_classifier"):
            score, image_gradient = self._score(images, criterion, state.batch_size)
        # The chain rule continues the gradient from the images to the values.
        (gradient,) = torch.autograd.grad(rendered, candidate, image_gradient)
        return Evaluation(
            values=candidate.detach(),
            images=images,
            score=score,
            is_criterion_met=criterion.reached(score.predicted),
            gradient=gradient,
        )

    def _score(
        self, images: Tensor, criterion: Criterion, batch_size: BatchSize
    ) -> tuple[Score, Tensor]:
        """Compute the costs, logit gaps and predictions of N examples, batch by batch.

        Args:
            images: Rendered images, shape (N, V, 3, H, W).
            criterion: Source and target classes of the N examples.
            batch_size: Images per classifier pass.

        Returns:
            The score of each example, and the gradient of its cost with respect
            to its images, shape (N, V, 3, H, W).
        """
        view_count = images.shape[1]
        all_images = images.flatten(0, 1)
        all_gradients = torch.empty_like(all_images)
        score_batch = partial(self._score_batch, all_images, criterion.flatten(), all_gradients)
        scores = list(batch_size.map(score_batch, len(all_images)))
        image_gradient = all_gradients.unflatten(0, (-1, view_count))
        return Score.of_examples(scores, view_count), image_gradient

    def _score_batch(
        self,
        all_images: Tensor,
        criterion: Criterion,
        all_gradients: Tensor,
        batch_rows: slice,
    ) -> Score:
        """Compute the cost, logit gap and prediction of each image of a batch.

        The gradient of the cost with respect to the batch is written to its
        rows of `all_gradients`.

        Args:
            all_images: The images of all examples and views, shape
                (N · V, 3, H, W).
            criterion: Source and target class of each image, shape (N · V,).
            all_gradients: Gradients of the costs with respect to all images,
                shape (N · V, 3, H, W).
            batch_rows: Rows of the batch among the N · V images.

        Returns:
            Score of each image of the batch.
        """
        batch = all_images[batch_rows].detach().requires_grad_(True)
        classes = criterion.select(batch_rows)
        logits = self.model(batch)
        expected_logits = self.expectation(self.model, batch, logits)
        cost = adversarial_cost(expected_logits, classes.source, classes.target)
        (batch_gradient,) = torch.autograd.grad(cost.sum(), batch)
        # Copying keeps the memory layout of the images, whichever layout the
        # network prefers.
        all_gradients[batch_rows] = batch_gradient
        return Score(
            cost=cost.detach(),
            gap=logit_gap(expected_logits.detach(), classes.source, classes.target),
            predicted=logits.detach().argmax(1),
        )

    def _decide(self, state: State, evaluation: Evaluation) -> Decision:
        """Decide which candidates are finished, accepted and kept (see `Decision`)."""
        active_rows = state.active_rows
        is_success = evaluation.is_criterion_met
        cost = evaluation.score.cost
        is_finished = is_success & (evaluation.score.gap >= self.settings.margin)
        if self.settings.lead_over_noise:
            is_finished = self._with_lead_over_noise(is_finished, state, evaluation)
        is_accepted = is_finished | self._is_accepted(state, evaluation)
        # Until an example succeeds, its result is its last accepted candidate. A
        # success replaces it. After that, only a success of lower cost does.
        is_cheaper_success = is_success & (cost < state.result.cost[active_rows])
        has_succeeded = state.result.success[active_rows]
        is_better = torch.where(has_succeeded, is_cheaper_success, is_success | is_accepted)
        return Decision(
            is_finished=is_finished,
            is_accepted=is_accepted,
            is_kept=is_finished | is_better,
            length_factor=torch.where(is_accepted, 1.0, 0.5),
        )

    def _is_accepted(self, state: State, evaluation: Evaluation) -> Tensor:
        """Return a mask of the candidates from which the next step may start, shape (N,).

        Without backtracking, a step may start from every candidate. With backtracking, it may
        start only from candidates with a lower cost than the accepted values.

        Args:
            state: State of the descent, with N active examples.
            evaluation: Scores of their candidates.
        """
        is_cheaper = evaluation.score.cost < state.cost[state.active_rows]
        if self.settings.backtracking:
            return is_cheaper
        return torch.ones_like(is_cheaper)

    def _with_lead_over_noise(
        self,
        is_finished: Tensor,
        state: State,
        evaluation: Evaluation,
    ) -> Tensor:
        """Return a mask of the finished examples whose lead survives the noise of a camera.

        The lead of a view is its logit gap, see `augment.losses.logit_gap`.

        Args:
            is_finished: Mask of the examples that lead by the margin,
                shape (N,).
            state: State of the descent.
            evaluation: Images of the N active examples.

        Returns:
            Mask, shape (N,).
        """
        # Indices of the finished examples among the N active examples.
        chosen = is_finished.nonzero()[:, 0]
        rows = state.active_rows[chosen]
        state.result.queries[rows] += NOISE_DRAWS * evaluation.images.shape[1]
        with self.phases("attack_classifier"):
            is_leading = self._leads_over_noise(
                evaluation.images[chosen],
                state.examples[rows],
                state.criterion.select(rows),
            )
        return is_finished.index_copy(0, chosen, is_leading)

    @torch.no_grad()
    def _leads_over_noise(self, images: Tensor, examples: Tensor, criterion: Criterion) -> Tensor:
        """Return a mask of the examples whose views all lead by more than noise changes.

        The lead of a view is its logit gap. It is computed without noise and
        with several draws of noise. The smallest of these leads must be at
        least `AttackSettings.lead_over_noise` times the difference between the
        largest and the smallest. Other noise decides later whether a success
        counts.

        Args:
            images: Images of the A examples, shape (A, V, 3, H, W).
            examples: Indices of the examples in the problem, shape (A,).
            criterion: Source and target classes of the A examples.

        Returns:
            Mask, shape (A,).
        """
        if not len(images):
            return examples.new_zeros(0, dtype=torch.bool)
        noisy_versions = stored(
            images,
            self.settings.sensor_noise,
            examples,
            self.seed,
            "noise margin",
        )
        leads = []
        for version in (images, *noisy_versions):
            batches = version.flatten(0, 1).split(self.settings.batch_size)
            logits = torch.cat([self.model(batch) for batch in batches])
            logits_of_views = logits.unflatten(0, version.shape[:2])
            leads.append(logit_gap(logits_of_views, criterion.source, criterion.target))
        # Shape (A, V) each.
        smallest, largest = torch.stack(leads).aminmax(dim=0)
        needed_lead = self.settings.lead_over_noise * (largest - smallest)
        return (smallest >= needed_lead).all(1)

    def _step(self, state: State) -> None:
        """Move each active example from its accepted values to a new candidate.

        The state keeps the accepted values until the candidate is evaluated.
        """
        active_rows = state.active_rows
        state.candidate[active_rows] = self.problem.take_step(
            values=state.values[active_rows],
            gradient=state.gradient[active_rows],
            examples=state.examples[active_rows],
            length=state.length[active_rows],
        )
        state.result.steps[active_rows] += 1


@dataclass(frozen=True)
class Score:
    """Cost, logit gap and predicted classes of N examples, or of N single images.

    Attributes:
        cost: Cost (equation 1), summed over the views of an example,
            shape (N,).
        gap: Lead of the wanted class in the logits, shape (N,). For an example,
            it is the smallest lead among the views. It is negative if the criterion
            is not reached.
        predicted: Predicted classes of the images without EOT transformations.
            Shape (N, V) for examples, (N,) for single images.
    """

    cost: Tensor
    gap: Tensor
    predicted: Tensor

    @classmethod
    def of_examples(cls, batches: Sequence[Score], view_count: int) -> Score:
        """Return the score of examples from the scores of batches of single images.

        Args:
            batches: Scores of all images, in order.
            view_count: Number of views of each example.
        """
        cost = torch.cat([score.cost for score in batches]).unflatten(0, (-1, view_count))
        gap = torch.cat([score.gap for score in batches]).unflatten(0, (-1, view_count))
        predicted = torch.cat([score.predicted for score in batches]).unflatten(0, (-1, view_count))
        return cls(cost=cost.sum(1), gap=gap.amin(1), predicted=predicted)


@dataclass(frozen=True)
class Evaluation:
    """Images, scores and gradients of the candidates of the N active examples.

    Attributes:
        values: The candidates, shape (N, D).
        images: Rendered images, shape (N, V, 3, H, W).
        score: Cost, logit gap and predictions of the N examples.
        is_criterion_met: Mask of the examples whose predictions reach the criterion
            in every view, shape (N,).
        gradient: Gradient of the cost with respect to the candidates,
            shape (N, D). None if none was computed.
        candidate_count: Number of candidates of each example that were
            evaluated. The other attributes are those of the best one.
    """

    values: Tensor
    images: Tensor
    score: Score
    is_criterion_met: Tensor
    gradient: Tensor | None = None
    candidate_count: int = 1

    @property
    def is_gradient_zero(self) -> Tensor:
        """Whether the gradient of each example was computed and is zero, shape (N,)."""
        if self.gradient is None:
            return torch.zeros_like(self.is_criterion_met)
        return self.gradient.abs().amax(1) == 0


@dataclass(frozen=True)
class Decision:
    """Decisions about the candidates of the N active examples, as tensors of shape (N,).

    Attributes:
        is_finished: The candidate reaches the criterion with the required margin,
            also over noise.
        is_accepted: The next step starts from the candidate.
        is_kept: The candidate is the result of its example unless a later
            candidate replaces it.
        length_factor: Factor of the length of the next step.
    """

    is_finished: Tensor
    is_accepted: Tensor
    is_kept: Tensor
    length_factor: Tensor


@dataclass
class State:
    """State of a descent of A examples, of which N are still active.

    A step starts from the accepted values and leads to the candidate, which is
    evaluated next. A row is the position of an example in the tensors of the
    state and the result.

    Attributes:
        criterion: Source and target classes of the A examples.
        examples: Indices of the examples in the problem, shape (A,).
        batch_size: Images per classifier pass. It is halved when memory runs
            out.
        active_rows: Rows of the examples that are not finished, shape (N,).
        values: Accepted values, shape (A, D).
        gradient: Gradient of the cost at the accepted values, shape (A, D).
        cost: Cost of the accepted values, shape (A,).
        length: Length of the next step, shape (A, 1).
        candidate: Values to evaluate next, shape (A, D).
        result: Result if the descent ended now. It exists after the first
            evaluation.
    """

    criterion: Criterion
    examples: Tensor
    batch_size: BatchSize
    active_rows: Tensor
    values: Tensor
    gradient: Tensor
    cost: Tensor
    length: Tensor
    candidate: Tensor
    result: DescentResult = field(init=False)

    @classmethod
    def at_start(
        cls, criterion: Criterion, examples: Tensor, start: Tensor, batch_size: int
    ) -> State:
        """Create the state before the first evaluation. The initial values are its candidates.

        Args:
            criterion: Source and target classes of the A examples.
            examples: Indices of the attacked examples in the problem,
                shape (A,).
            start: Initial values, shape (A, D).
            batch_size: Images per classifier pass.
        """
        values = start.detach().clone()
        return cls(
            criterion=criterion,
            examples=examples,
            batch_size=BatchSize(batch_size),
            active_rows=torch.arange(len(values), device=values.device),
            values=values,
            gradient=torch.zeros_like(values),
            cost=values.new_full((len(values),), torch.inf),
            length=values.new_ones(len(values), 1),
            candidate=values.clone(),
        )

    def begin_result(self, evaluation: Evaluation) -> None:
        """Create `result` from the evaluation of the initial values.

        The result has 0 steps and no success. All A examples are still active
        here. `record` then decides about the initial values as about every
        candidate.

        Args:
            evaluation: Evaluation of the initial values of the A examples.
        """
        zeros = torch.zeros_like(self.active_rows)
        self.result = DescentResult(
            values=self.values.clone(),
            images=evaluation.images.clone(),
            steps=zeros,
            queries=zeros.clone(),
            backward_passes=zeros.clone(),
            success_before=evaluation.is_criterion_met,
            success=zeros.bool(),
            cost_before=evaluation.score.cost,
            cost=self.cost.clone(),
            predicted=torch.zeros_like(self.criterion.source),
            zero_gradient=evaluation.is_gradient_zero,
        )

    def record(self, evaluation: Evaluation, decision: Decision) -> None:
        """Carry out the decisions about the candidates of the N active examples.

        Args:
            evaluation: Images, scores and gradients of the candidates.
            decision: Decisions about the candidates.
        """
        self.length[self.active_rows] *= decision.length_factor[:, None]
        accepted, kept, unfinished = _indices_of_masks(
            decision.is_accepted,
            decision.is_kept,
            ~decision.is_finished,
        )
        self._accept(accepted, evaluation)
        self._keep(kept, evaluation)
        self.active_rows = self.active_rows[unfinished]

    def _accept(self, chosen: Tensor, evaluation: Evaluation) -> None:
        """Make the chosen candidates the values from which the next step starts.

        Args:
            chosen: Indices of candidates among those of the evaluation.
            evaluation: Images, scores and gradients of the N candidates.
        """
        rows = self.active_rows[chosen]
        self.values[rows] = evaluation.values[chosen]
        if evaluation.gradient is not None:
            self.gradient[rows] = evaluation.gradient[chosen]
        self.cost[rows] = evaluation.score.cost[chosen]

    def _keep(self, chosen: Tensor, evaluation: Evaluation) -> None:
        """Write the chosen candidates to the result.

        Args:
            chosen: Indices of candidates among those of the evaluation.
            evaluation: Images, scores and gradients of the N candidates.
        """
        rows = self.active_rows[chosen]
        self.result.values[rows] = evaluation.values[chosen]
        self.result.images[rows] = evaluation.images[chosen]
        self.result.success[rows] = evaluation.is_criterion_met[chosen]
        self.result.cost[rows] = evaluation.score.cost[chosen]
        self.result.predicted[rows] = evaluation.score.predicted[chosen]


def _indices_of_masks(*masks: Tensor) -> list[Tensor]:
    """Return the indices of the true entries of each mask of shape (N,).

    All masks are copied to the CPU at once, because each copy waits for the
    GPU.
    """
    device = masks[0].device
    masks_on_cpu = torch.stack(masks).cpu()
    return [mask.nonzero()[:, 0].to(device, non_blocking=True) for mask in masks_on_cpu]
