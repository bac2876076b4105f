"""Base class of random search and CMA-ES, which need no gradients of the classifier."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from augment.attacks.descent import Criterion, Descent, DescentResult, Evaluation, Score, State
from augment.losses import adversarial_cost
from augment.model_passes import BatchSize
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
    def run(self, criterion: Criterion, examples: Tensor, start: Tensor) -> DescentResult:
        """Attack A examples from one set of initial values, without gradients.

        Args:
            criterion: Source and target classes of the A examples.
            examples: Index of each attacked example in the scene, shape (A,).
            start: Initial values, shape (A, D).

        Returns:
            Result of the A examples.
        """
        # This method exists for its decorator `no_grad`: `Descent.run` enables gradients.
        return super().run(criterion, examples, start)

    def _draw_normal(self, state: State, count: int) -> Tensor:
        """Draw vectors of normal numbers for each active example.

        Each example has a generator of its own, so that its numbers do not
        depend on the other examples.

        Args:
            state: State of the search, with N active examples of D values.
            count: Number of vectors for each example.

        Returns:
            Numbers with mean 0 and standard deviation 1, shape (N, count, D).
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

        Args:
            state: State of the search, with N active examples.

        Returns:
            Images and score of the best candidate of each of the N examples.
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

    def _candidates(self, state: State) -> Tensor:
        """Return the candidates to evaluate next. By default, each example has one.

        Args:
            state: State of the search, with N active examples.

        Returns:
            D attack values of P candidates of each active example, shape (N, P, D).
        """
        return state.candidate[state.active_rows][:, None]

    def _learn(self, state: State, candidates: Tensor, costs: Tensor) -> None:
        """Adapt the search to the costs of the candidates. By default, do nothing.

        Args:
            state: State of the search, with N active examples.
            candidates: D attack values of P candidates of each active example, shape (N, P, D).
            costs: Cost of each candidate, shape (N, P).
        """

    def _score_values(
        self, values: Tensor, examples: Tensor, criterion: Criterion, state: State
    ) -> tuple[Tensor, Score]:
        """Render and classify candidates, in groups that fit in memory.

        Args:
            values: Attack values of A candidates, shape (A, D).
            examples: Index of the example to which each candidate belongs, shape (A,).
            criterion: Source and target classes of the A candidates.
            state: State of the search, which has the batch size.

        Returns:
            Images of the V views of each candidate, shape (A, V, 3, H, W), and the scores of the
            candidates.
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
        self, images: Tensor, criterion: Criterion, batch_size: BatchSize
    ) -> list[Score]:
        """Classify images batch by batch.

        Args:
            images: Images of V views of A candidates, shape (A, V, 3, H, W).
            criterion: Source and target classes of the A candidates.
            batch_size: Number of images of a batch.

        Returns:
            Scores of the images of each batch. The images are in the order of their candidates.
        """
        all_images = images.flatten(0, 1)
        score_part = partial(self._score_part, all_images, criterion.flatten())
        return list(batch_size.map(score_part, len(all_images)))

    def _score_part(self, all_images: Tensor, criterion: Criterion, rows: slice) -> Score:
        """Compute the cost, the logit gap and the prediction of each image of a batch.

        Args:
            all_images: All images, shape (N, 3, H, W).
            criterion: Source and target class of each of the N images.
            rows: The images of the batch among the N images.

        Returns:
            Scores of the images of the batch.
        """
        batch = all_images[rows]
        classes = criterion.select(rows)
        # The network may compute in half precision.
        logits = self.model(batch).to(batch.dtype)
        expected_logits = self.expectation(self.model, batch, logits)
        cost = adversarial_cost(expected_logits, classes.source, classes.target)
        return Score.of_logits(cost, logits, expected_logits, classes)

    def _is_accepted(self, state: State, evaluation: Evaluation) -> Tensor:
        """Return a mask of the candidates that lower the cost of their examples, shape (N,).

        Args:
            state: State of the search, with the costs before the last step.
            evaluation: Scores of one candidate for each of the N active examples.
        """
        return evaluation.score.cost < state.cost[state.active_rows]


def _best_candidates(cost: Tensor, is_met: Tensor, count: int) -> Tensor:
    """Choose the best candidate of each of N examples.

    It is the candidate of lowest cost among those that reach the criterion. If
    none reaches the criterion, it is the candidate of lowest cost.

    Args:
        cost: Cost of each candidate. The candidates of an example follow each
            other, shape (N · count,).
        is_met: Mask of the candidates that reach the criterion, shape (N · count,).
        count: Number of candidates of each example.

    Returns:
        Index of the best candidate of each example among all N · count, shape (N,).
    """
    # One row for each example, one column for each of its candidates.
    costs = cost.unflatten(0, (-1, count))
    is_met = is_met.unflatten(0, (-1, count))
    has_success = is_met.any(1, keepdim=True)
    is_excluded = has_success & ~is_met
    best_column = costs.masked_fill(is_excluded, torch.inf).argmin(1)
    first_of_row = torch.arange(len(costs), device=cost.device) * count
    return first_of_row + best_column
