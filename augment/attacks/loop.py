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
every view. It is finished when the logit gap (`augment.losses.logit_gap`) is
also at least `AttackSettings.margin` in every view. If the settings ask for it,
or if the classifier is overconfident (`augment.losses.is_overconfident`), the gap
must also be larger than its changes by the noise of a sensor. Until then the
example stays active: it takes further steps, and its successful values of lowest
cost are kept.
Whether a success counts is decided after the descent
(`augment.attacks.attack.fooled_in_views`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from augment.attacks.eot import NOISE_DRAWS, ExpectationOverTransformations, add_sensor_noise
from augment.losses import NO_CLASS, adversarial_cost, is_overconfident, logit_gap
from augment.network import BatchSize, frozen_eval_mode
from augment.progress import Phases, progress
from renderer.short_repr import ShortRepr

# Gradients below this number are not scaled before they enter the network.
MIN_GRADIENT = 1e-30

if TYPE_CHECKING:
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
        source: Source class of each view, one row for each example. NO_CLASS
            removes the source from the cost of a view, so that only its target
            counts.
        target: Target class of each view, one row for each example. NO_CLASS
            makes the attack on a view untargeted. None makes the attack on all
            views untargeted.
    """

    source: Int[Tensor, "E V"]
    target: Int[Tensor, "E V"] | None = None

    def select(self, examples: Tensor | slice) -> Criterion:
        """Return the criterion of some of the examples."""
        if self.target is None:
            return Criterion(self.source[examples])
        return Criterion(self.source[examples], self.target[examples])

    def flatten(self) -> Criterion:
        """Return the classes of all V views of all E examples as one list, shape (E · V,)."""
        if self.target is None:
            return Criterion(self.source.flatten())
        return Criterion(self.source.flatten(), self.target.flatten())

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Return a mask of the examples that reach the criterion in all their views."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, "E V"]:
        """Return a mask of the views that reach the criterion.

        A view reaches it if its predicted class is the target class or, without
        a target, is not the source class.
        """
        is_misclassified = predicted != self.source
        if self.target is None:
            return is_misclassified
        # The target `NO_CLASS` stands for a view without a target.
        is_untargeted = self.target == NO_CLASS
        return torch.where(is_untargeted, is_misclassified, predicted == self.target)


@dataclass(frozen=True, repr=False)
class DescentResult(ShortRepr):
    """Values that a descent found for E examples, with their images and costs.

    A candidate is a vector of D values that the descent evaluated. For each
    example, one candidate is returned. It is

    - the candidate that reached the criterion with the required margin,
    - if there is none, the candidate of lowest cost that reached the criterion,
    - if there is none, the last candidate from which a step was taken.

    Each tensor has one row for each example, and lies on the device of the
    attacked values.

    Attributes:
        values: Values of the returned candidate.
        images: Images of the V views of the returned candidate, in [0, 1].
        steps: Number of steps taken, including those of restarts.
        queries: Number of images of the example that the classifier was shown,
            including those of restarts.
        backward_passes: Number of these images for which a gradient was
            computed.
        success_before: Whether the initial values reach the criterion.
        success: Whether the returned candidate reaches the criterion, without noise.
        cost_before: Cost of the initial values, see `augment.losses.adversarial_cost`.
        cost: Cost of the returned candidate.
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
        """Return a result with uninitialized tensors for another number of examples.

        Apart from the number of rows, each tensor has the shape, the dtype and
        the device of the same tensor of this result.
        """
        tensors = {}
        for item in fields(self):
            tensor = getattr(self, item.name)
            tensors[item.name] = tensor.new_empty(example_count, *tensor.shape[1:])
        return DescentResult(**tensors)

    def write(self, rows: Int[Tensor, " A"], group: DescentResult) -> None:
        """Copy the result of a group of examples into the given rows of this result."""
        for item in fields(self):
            getattr(self, item.name)[rows] = getattr(group, item.name)

    def add_restart(self, rows: Int[Tensor, " A"], restart: DescentResult) -> None:
        """Add a restart, which attacks some examples again from other initial values.

        Its steps and passes are added to the counts. Where the restart
        succeeds, its values, images, cost and predictions replace those of the
        example.
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
        problem: Scene, and the parameters of it that are attacked. It renders images from
            values of the parameters.
        settings: Number of steps, margin, backtracking and batch size.
        expectation: Average of the model output over random transformations of
            an image.
        phases: Timer of the classifier passes.
        seed: Seed of the sensor noise that successes must survive, and of the
            random numbers of searches without gradients.
    """

    model: nn.Module
    problem: AttackProblem
    settings: AttackSettings
    expectation: ExpectationOverTransformations
    phases: Phases
    seed: int

    def run_with_restarts(
        self,
        criterion: Criterion,
        examples: Int[Tensor, " A"],
        start: Float[Tensor, "A D"],
        restarts: Iterable[Tensor],
    ) -> DescentResult:
        """Attack A examples from one or more initial values, until they succeed.

        Further initial values are used for the examples that have not succeeded, or whose success
        does not survive sensor noise, unless their share of the queries is less than one
        evaluation.
        """
        result = self.run(criterion, examples, start)
        limit = self.settings.query_limit_of_start
        if limit is not None and limit < self._passes_of_candidate(criterion):
            return result
        # The last start, and the rows of its examples in the result.
        latest = result
        rows = torch.arange(len(examples), device=examples.device)
        for restart in restarts:
            checked = self._successes_to_check(latest)
            result.queries[rows[checked]] += NOISE_DRAWS * criterion.source.shape[1]
            is_success = latest.success.clone()
            with frozen_eval_mode(self.model):
                is_success[checked] = self._is_robust_to_noise(
                    latest.images[checked],
                    examples[rows[checked]],
                    criterion.select(rows[checked]),
                )
            rows = rows[~is_success]
            if not len(rows):
                break
            latest = self.run(criterion.select(rows), examples[rows], restart[rows])
            result.add_restart(rows, latest)
        return result

    def _successes_to_check(self, result: DescentResult) -> Tensor:
        """Return the rows of the successes of a start that must also survive sensor noise.

        A success whose start has too few queries left for the noisy images counts without them.
        """
        is_checked = result.success & bool(self.settings.sensor_noise)
        limit = self.settings.query_limit_of_start
        if limit is not None:
            needed = NOISE_DRAWS * result.images.shape[1]
            is_checked &= result.queries + needed <= limit
        return is_checked.nonzero().squeeze(1)

    @torch.enable_grad()
    def run(
        self, criterion: Criterion, examples: Int[Tensor, " A"], start: Float[Tensor, "A D"]
    ) -> DescentResult:
        """Attack A examples from one set of initial values.

        Each example takes steps until it reaches its criterion with the
        required margin, or has used up its steps or queries.
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
        """Count the images that an evaluation showed to the classifier."""
        pass_count = evaluation.candidate_count * self._passes_of_candidate(state.criterion)
        state.result.queries[state.active_rows] += pass_count
        if evaluation.gradient is not None:
            state.result.backward_passes[state.active_rows] += pass_count

    def _passes_of_candidate(self, criterion: Criterion) -> int:
        """Return how many images the classifier sees to evaluate one candidate of an example.

        These are all views of the example, each as it is and in each of its
        random transformations.
        """
        view_count = criterion.source.shape[1]
        return view_count * (1 + self.settings.eot.draws)

    def _drop_examples_without_budget(self, state: State) -> None:
        """Make examples inactive whose next step would exceed the limit of queries."""
        limit = self.settings.query_limit_of_start
        if limit is None or not len(state.active_rows):
            return
        needed = self._candidates_per_step(state) * self._passes_of_candidate(state.criterion)
        is_affordable = state.result.queries[state.active_rows] + needed <= limit
        state.active_rows = state.active_rows[is_affordable]

    def _candidates_per_step(self, state: State) -> int:
        """Return how many candidates of each example a step evaluates."""
        return 1

    def _evaluate(self, state: State) -> Evaluation:
        """Render and classify one candidate of each active example."""
        candidate = state.candidate[state.active_rows].requires_grad_(True)
        criterion = state.criterion.select(state.active_rows)
        rendered = self.problem.render(candidate, state.examples[state.active_rows])
        images = rendered.detach()
        with self.phases("attack_classifier"):
            score, image_gradient = self._score(images, criterion, state.batch_size)
        # Chain rule: the gradient with respect to the images gives the gradient with
        # respect to the candidate values.
        (gradient,) = torch.autograd.grad(rendered, candidate, image_gradient)
        return Evaluation(
            values=candidate.detach(),
            images=images,
            score=score,
            is_criterion_met=criterion.reached(score.predicted),
            gradient=gradient,
        )

    def _score(
        self, images: Float[Tensor, "N V _ H W"], criterion: Criterion, batch_size: BatchSize
    ) -> tuple[Score, Tensor]:
        """Compute the costs, logit gaps and predictions of N examples, batch by batch.

        Return also the gradients of the costs with respect to the images.
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
        all_images: Float[Tensor, "_ _ H W"],
        criterion: Criterion,
        all_gradients: Float[Tensor, "_ _ H W"],
        batch_rows: slice,
    ) -> Score:
        """Compute the cost, logit gap and prediction of each image of a batch.

        The gradient of the cost with respect to the batch is written to its
        rows of `all_gradients`.
        """
        batch = all_images[batch_rows].detach().requires_grad_(True)
        classes = criterion.select(batch_rows)
        # The network may compute in half precision.
        logits = self.model(batch).to(batch.dtype)
        expected_logits = self.expectation(self.model, batch, logits)
        cost = adversarial_cost(expected_logits, classes.source, classes.target)
        (logit_gradient,) = torch.autograd.grad(cost.sum(), expected_logits)
        # The gradient of a confident prediction is so small that it would round to zero in a
        # network of half precision. A factor that is a power of two changes no other digits.
        largest = logit_gradient.abs().amax(1, keepdim=True).clamp(min=MIN_GRADIENT)
        power = largest / torch.frexp(largest).mantissa
        (batch_gradient,) = torch.autograd.grad(expected_logits, batch, logit_gradient / power)
        # The network may return its gradient in another memory layout. The copy has the
        # layout of the images.
        all_gradients[batch_rows] = batch_gradient * power[:, :, None, None]
        return Score.of_logits(cost.detach(), logits.detach(), expected_logits.detach(), classes)

    def _decide(self, state: State, evaluation: Evaluation) -> Decision:
        """Decide what happens to the candidates of the active examples."""
        active_rows = state.active_rows
        is_success = evaluation.is_criterion_met
        cost = evaluation.score.cost
        is_finished = is_success & (evaluation.score.gap >= self.settings.margin)
        if self.settings.overconfident_noise_margin:
            is_finished = self._finished_despite_noise(is_finished, state, evaluation)
        is_accepted = is_finished | self._is_accepted(state, evaluation)
        # An example without a success takes each accepted candidate as its result. An
        # example with a success takes only successful candidates of lower cost.
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

        Without backtracking, these are all candidates. With backtracking, these are the
        candidates that lower the cost.
        """
        is_cheaper = evaluation.score.cost < state.cost[state.active_rows]
        if self.settings.backtracking:
            return is_cheaper
        return torch.ones_like(is_cheaper)

    def _finished_despite_noise(
        self,
        is_finished: Bool[Tensor, " N"],
        state: State,
        evaluation: Evaluation,
    ) -> Bool[Tensor, " N"]:
        """Return a mask of the finished examples that remain successes with sensor noise.

        Only examples with a noise margin are checked. The images that the classifier sees for this
        are counted as queries.
        """
        has_margin = self._noise_margin(evaluation.score.is_overconfident) > 0
        # Indices of the checked examples among the N active examples.
        checked = (is_finished & has_margin).nonzero()[:, 0]
        rows = state.active_rows[checked]
        state.result.queries[rows] += NOISE_DRAWS * evaluation.images.shape[1]
        with self.phases("attack_classifier"):
            is_robust = self._is_robust_to_noise(
                evaluation.images[checked],
                state.examples[rows],
                state.criterion.select(rows),
            )
        return is_finished.index_copy(0, checked, is_robust)

    def _noise_margin(self, is_overconfident: Tensor) -> Tensor:
        """Return how many times the range of the gaps with noise the smallest gap must be."""
        return torch.where(
            is_overconfident,
            self.settings.overconfident_noise_margin,
            self.settings.applied_noise_margin,
        )

    @torch.no_grad()
    def _is_robust_to_noise(
        self, images: Float[Tensor, "A V _ H W"], examples: Int[Tensor, " A"], criterion: Criterion
    ) -> Bool[Tensor, " A"]:
        """Return a mask of the examples whose logit gaps change little with sensor noise.

        The logit gap tells by how much a view reaches the criterion. It is
        computed without noise and with several draws of noise. In every view,
        the smallest of these gaps must be at least `_noise_margin` times the
        difference between the largest and the smallest. This noise differs from
        the noise that later decides whether a success counts.
        """
        if not len(images):
            return examples.new_zeros(0, dtype=torch.bool)
        noisy_versions = add_sensor_noise(
            images,
            self.settings.sensor_noise,
            examples,
            self.seed,
            "noise margin",
        )
        gaps = []
        overconfident = []
        for version in (images, *noisy_versions):
            batches = version.flatten(0, 1).split(self.settings.batch_size)
            logits = torch.cat([self.model(batch) for batch in batches])
            logits_of_views = logits.unflatten(0, version.shape[:2])
            gaps.append(logit_gap(logits_of_views, criterion.source, criterion.target))
            overconfident.append(is_overconfident(logits_of_views))
        # Smallest and largest logit gap of each view, each of shape (A, V).
        smallest, largest = torch.stack(gaps).aminmax(dim=0)
        noise_margin = self._noise_margin(torch.stack(overconfident).any(0))
        return (smallest >= noise_margin * (largest - smallest)).all(1)

    def _step(self, state: State) -> None:
        """Compute the next candidate of each active example by a step along its gradient.

        The step starts from the accepted values, which the state keeps until
        the candidate is evaluated.
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
        cost: Cost that the attack lowers, shape (N,), see
            `augment.losses.adversarial_cost`. For an example, it is the sum over
            its views.
        gap: Logit gap, shape (N,). It tells by how much the criterion is reached,
            and is negative if the criterion is not reached. For an example, it is
            the smallest gap of its views.
        predicted: Predicted classes of the images before any random
            transformation. Shape (N, V) for examples with V views, (N,) for
            single images.
        is_overconfident: Mask, shape (N,), see `augment.losses.is_overconfident`. For an
            example, it is whether any of its views is.
    """

    cost: Float[Tensor, " N"]
    gap: Float[Tensor, " N"]
    predicted: Tensor
    is_overconfident: Bool[Tensor, " N"]

    @classmethod
    def of_logits(
        cls, cost: Tensor, logits: Float[Tensor, "N C"], expected_logits: Tensor, classes: Criterion
    ) -> Score:
        """Return the scores of N images.

        `expected_logits` are averages over random transformations of the images.
        """
        return cls(
            cost=cost,
            gap=logit_gap(expected_logits, classes.source, classes.target),
            predicted=logits.argmax(1),
            is_overconfident=is_overconfident(expected_logits),
        )

    @classmethod
    def of_examples(cls, batches: Sequence[Score], view_count: int) -> Score:
        """Combine the scores of single images to scores of examples.

        Batches are in order, and the views of an example follow each other. Costs are summed, and
        the smallest logit gap counts.
        """
        cost = torch.cat([score.cost for score in batches]).unflatten(0, (-1, view_count))
        gap = torch.cat([score.gap for score in batches]).unflatten(0, (-1, view_count))
        predicted = torch.cat([score.predicted for score in batches]).unflatten(0, (-1, view_count))
        is_extreme = torch.cat([score.is_overconfident for score in batches])
        return cls(
            cost=cost.sum(1),
            gap=gap.amin(1),
            predicted=predicted,
            is_overconfident=is_extreme.unflatten(0, (-1, view_count)).any(1),
        )

    def select(self, rows: Tensor) -> Score:
        """Return the scores of some of the examples or images."""
        return Score(*(getattr(self, item.name)[rows] for item in fields(self)))


@dataclass(frozen=True)
class Evaluation:
    """Images, scores and gradients of one candidate of each of the N active examples.

    A candidate is a vector of D attack values that is evaluated.

    Attributes:
        values: The candidates, shape (N, D).
        images: Rendered images of the V views, shape (N, V, 3, H, W).
        score: Cost, logit gap and predictions of each candidate.
        is_criterion_met: Mask of the candidates whose predictions reach the
            criterion in every view, shape (N,).
        gradient: Gradient of the cost with respect to the values, shape (N, D).
            None if no gradient was computed.
        candidate_count: Number of candidates of each example that were
            evaluated. The other attributes describe the best of them.
    """

    values: Float[Tensor, "N D"]
    images: Float[Tensor, "N V 3 H W"]
    score: Score
    is_criterion_met: Bool[Tensor, " N"]
    gradient: Float[Tensor, "N D"] | None = None
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
        is_finished: Whether the candidate reaches the criterion with the required
            margin, so that its example takes no further step.
        is_accepted: Whether the next step starts from the candidate.
        is_kept: Whether the candidate becomes the result of its example, until a
            later candidate replaces it.
        length_factor: Factor by which the length of the next step is multiplied.
    """

    is_finished: Tensor
    is_accepted: Tensor
    is_kept: Tensor
    length_factor: Tensor


@dataclass
class State:
    """State of a descent of A examples, of which N are still active.

    A step starts from the accepted values and leads to the candidate, which is
    evaluated next. The tensors of the state and of its result have one row for
    each of the A examples.

    Attributes:
        criterion: Source and target classes of the A examples.
        examples: Index of each example in the scene, shape (A,).
        batch_size: Number of images that the classifier sees at a time. It is
            halved when memory runs out.
        active_rows: Rows of the examples that still take steps, shape (N,).
        values: Accepted values, shape (A, D).
        gradient: Gradient of the cost at the accepted values, shape (A, D).
        cost: Cost of the accepted values, shape (A,).
        length: Length of the next step, shape (A, 1).
        candidate: Values to evaluate next, shape (A, D).
        result: What the descent returns if it takes no further step. It exists
            after the first evaluation.
    """

    criterion: Criterion
    examples: Int[Tensor, " A"]
    batch_size: BatchSize
    active_rows: Int[Tensor, " N"]
    values: Float[Tensor, "A D"]
    gradient: Float[Tensor, "A D"]
    cost: Float[Tensor, " A"]
    length: Float[Tensor, "A 1"]
    candidate: Float[Tensor, "A D"]
    result: DescentResult = field(init=False)

    @classmethod
    def at_start(
        cls,
        criterion: Criterion,
        examples: Int[Tensor, " A"],
        start: Float[Tensor, "A D"],
        batch_size: int,
    ) -> State:
        """Create the state before the first evaluation, with the initial values as candidates."""
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

        The result has 0 steps and no success. A call of `record` must follow,
        which treats the initial values like every candidate.
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
        """Carry out the decisions about the candidates of the N active examples."""
        self.length[self.active_rows] *= decision.length_factor[:, None]
        accepted, kept, unfinished = _indices_of_masks(
            decision.is_accepted,
            decision.is_kept,
            ~decision.is_finished,
        )
        self._accept(accepted, evaluation)
        self._keep(kept, evaluation)
        self.active_rows = self.active_rows[unfinished]

    def _accept(self, accepted: Tensor, evaluation: Evaluation) -> None:
        """Let the next step of some examples start from their evaluated candidates.

        `accepted` are indices among the candidates of the evaluation.
        """
        rows = self.active_rows[accepted]
        self.values[rows] = evaluation.values[accepted]
        if evaluation.gradient is not None:
            self.gradient[rows] = evaluation.gradient[accepted]
        self.cost[rows] = evaluation.score.cost[accepted]

    def _keep(self, kept: Tensor, evaluation: Evaluation) -> None:
        """Make the candidates of some examples their present results.

        `kept` are indices among the candidates of the evaluation.
        """
        rows = self.active_rows[kept]
        self.result.values[rows] = evaluation.values[kept]
        self.result.images[rows] = evaluation.images[kept]
        self.result.success[rows] = evaluation.is_criterion_met[kept]
        self.result.cost[rows] = evaluation.score.cost[kept]
        self.result.predicted[rows] = evaluation.score.predicted[kept]


def _indices_of_masks(*masks: Tensor) -> list[Tensor]:
    """Return the indices of the true entries of each mask.

    All masks are copied from the GPU to the CPU at once, because each copy
    waits until the GPU is idle.
    """
    device = masks[0].device
    masks_on_cpu = torch.stack(masks).cpu()
    return [mask.nonzero()[:, 0].to(device, non_blocking=True) for mask in masks_on_cpu]
