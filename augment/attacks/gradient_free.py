"""Base class of random search and CMA-ES, which need no gradients of the classifier."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.attacks.loop import Criterion, Descent, DescentResult, Evaluation, Score, State
from augment.losses import adversarial_cost
from augment.network import BatchSize
from augment.random_streams import generator


@dataclass(frozen=True)
class GradientFree(Descent):
    """Base class of searches that need forward passes of the classifier only.

    In a step, one or several candidates (vectors of attack values) of each
    example are evaluated. The best one is accepted if it lowers the cost.

    Attributes:
        draws: Generator of the random numbers of each example. The key is the
            index of the example. Restarts continue with the same generator.
    """

    draws: dict[int, torch.Generator] = field(default_factory=dict, init=False)

    @torch.no_grad()
    def run(
        self, criterion: Criterion, examples: Int[Tensor, " A"], start: Float[Tensor, "A D"]
    ) -> DescentResult:
        """Attack A examples from one set of initial values, without gradients."""
        # This method exists for its decorator `no_grad`: `Descent.run` enables gradients.
        return super().run(criterion, examples, start)

    def _draw_normal(self, state: State, count: int) -> Float[Tensor, "N count D"]:
        """Draw vectors of normal numbers for each active example.

        Each example has a generator of its own, so that its numbers do not
        depend on the other examples.
        """
        shape = (count, state.values.shape[1])
        numbers = []
        for example in state.examples[state.active_rows].tolist():
            if example not in self.draws:
                self.draws[example] = generator(self.seed, example, "directions")
            numbers.append(torch.randn(shape, generator=self.draws[example]))
        return torch.stack(numbers).to(state.values)

    def _evaluate(self, state: State) -> Evaluation:
        """Render and classify several candidates of each active example.

        Return images and scores of the best candidate of each example.
        """
        # P candidates of D values for each example, shape (N, P, D).
        candidates = self._candidates(state)
        count = candidates.shape[1]
        # The candidates of all examples as one list, shape (N · P, D).
        all_candidates = candidates.flatten(0, 1)
        # Row of the example to which each candidate belongs, shape (N · P,).
        rows = state.active_rows.repeat_interleave(count)
        criterion = state.criterion.select(rows)
        images, score = self._score_values(all_candidates, state.examples[rows], criterion, state)
        is_met = criterion.reached(score.predicted)
        self._learn(state, candidates, score.cost.unflatten(0, (-1, count)))
        best = _best_candidates(score.cost, is_met, count)
        return Evaluation(
            values=all_candidates[best],
            images=images[best],
            score=score.select(best),
            is_criterion_met=is_met[best],
            candidate_count=count,
        )

    def _candidates(self, state: State) -> Float[Tensor, "N P D"]:
        """Return the candidates to evaluate next. By default, each example has one."""
        return state.candidate[state.active_rows][:, None]

    def _learn(
        self, state: State, candidates: Float[Tensor, "N P D"], costs: Float[Tensor, "N P"]
    ) -> None:
        """Adapt the search to the costs of the candidates. By default, do nothing."""

    def _score_values(
        self,
        values: Float[Tensor, "A D"],
        examples: Int[Tensor, " A"],
        criterion: Criterion,
        state: State,
    ) -> tuple[Tensor, Score]:
        """Render and classify candidates, in groups that fit in memory.

        `examples` has the index of the example to which each candidate belongs.
        """
        image_groups = []
        scores = []
        for group in torch.arange(len(values)).split(self.problem.group_size):
            images = self.problem.render(values[group], examples[group])
            image_groups.append(images)
            with self.phases("attack_classifier"):
                scores += self._score_images(images, criterion.select(group), state.batch_size)
        view_count = criterion.source.shape[1]
        return torch.cat(image_groups), Score.of_examples(scores, view_count)

    def _score_images(
        self, images: Float[Tensor, "A V _ H W"], criterion: Criterion, batch_size: BatchSize
    ) -> list[Score]:
        """Classify images batch by batch."""
        all_images = images.flatten(0, 1)
        score_part = partial(self._score_part, all_images, criterion.flatten())
        return list(batch_size.map(score_part, len(all_images)))

    def _score_part(
        self, all_images: Float[Tensor, "N _ H W"], criterion: Criterion, rows: slice
    ) -> Score:
        """Compute the cost, the logit gap and the prediction of each image of a batch."""
        batch = all_images[rows]
        classes = criterion.select(rows)
        # The network may compute in half precision.
        logits = self.model(batch).to(batch.dtype)
        expected_logits = self.expectation(self.model, batch, logits)
        cost = adversarial_cost(expected_logits, classes.source, classes.target)
        return Score.of_logits(cost, logits, expected_logits, classes)

    def _is_accepted(self, state: State, evaluation: Evaluation) -> Tensor:
        """Return a mask of the candidates that lower the cost of their examples, shape (N,)."""
        return evaluation.score.cost < state.cost[state.active_rows]


def _best_candidates(
    cost: Float[Tensor, " _"], is_met: Bool[Tensor, " _"], count: int
) -> Int[Tensor, " N"]:
    """Choose the best candidate of each of N examples.

    It is the candidate of lowest cost among those that reach the criterion. If none reaches the
    criterion, it is the candidate of lowest cost. The candidates of an example follow each other,
    and the result has indices among all N · count.
    """
    # One row for each example, one column for each of its candidates.
    costs = cost.unflatten(0, (-1, count))
    is_met = is_met.unflatten(0, (-1, count))
    has_success = is_met.any(1, keepdim=True)
    is_excluded = has_success & ~is_met
    best_column = costs.masked_fill(is_excluded, torch.inf).argmin(1)
    first_of_row = torch.arange(len(costs), device=cost.device) * count
    return first_of_row + best_column
