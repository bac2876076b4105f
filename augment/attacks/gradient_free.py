"""What random search and CMA-ES share: candidates are evaluated by forward passes alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from augment.attacks.descent import Criterion, Descent, DescentResult, Evaluation, Score, State
from augment.losses import adversarial_cost, logit_gap
from augment.model_passes import BatchSize
from augment.random_streams import generator


@dataclass(frozen=True)
class GradientFree(Descent):
    """Search of an example by forward passes, with random numbers of its own.

    A step evaluates one or several candidates of each example. The best of them
    is accepted if its cost is lower.

    Attributes:
        draws: Generators of the random numbers, by the index of the example.
            They go on in the restarts.
    """

    draws: dict[int, torch.Generator] = field(default_factory=dict, init=False)

    @torch.no_grad()
    def run(self, criterion: Criterion, examples: Tensor, start: Tensor) -> DescentResult:
        """Search until all examples are finished or have used up their queries."""
        # This method exists for its decorator: `Descent.run` would enable gradients.
        return super().run(criterion, examples, start)

    def _draw_normal(self, state: State, count: int) -> Tensor:
        """Draw normal numbers, each example with a generator of its own.

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
        """Render and classify the candidates of the active examples.

        Args:
            state: State of the search, with N active examples.

        Returns:
            The best candidate of each of the N examples, as `_best_rows` chooses it.
        """
        # Shape (N, P, D): P candidates of D values for each example. Below, they are one list of
        # N · P candidates.
        candidates = self._candidates(state)
        count = candidates.shape[1]
        criterion = state.criterion.select(state.active_rows.repeat_interleave(count))
        examples = state.examples[state.active_rows].repeat_interleave(count)
        images, score = self._score_values(candidates.flatten(0, 1), examples, criterion, state)
        is_met = criterion.reached(score.predicted)
        self._learn(state, candidates, score.cost.unflatten(0, (-1, count)))
        best = _best_rows(score.cost, is_met, count)
        return Evaluation(
            values=candidates.flatten(0, 1)[best],
            images=images[best],
            score=Score(score.cost[best], score.gap[best], score.predicted[best]),
            is_criterion_met=is_met[best],
            candidate_count=count,
        )

    def _candidates(self, state: State) -> Tensor:
        """Return the P candidates that are evaluated next for each of the N active examples.

        By default, P is 1.

        Args:
            state: State of the search.

        Returns:
            Attack values, shape (N, P, D).
        """
        return state.candidate[state.active_rows][:, None]

    def _learn(self, state: State, candidates: Tensor, costs: Tensor) -> None:
        """Use the costs of the candidates for later steps. By default, do nothing.

        Args:
            state: State of the search.
            candidates: P candidates of each of the N active examples, shape (N, P, D).
            costs: Cost of each candidate, shape (N, P).
        """

    def _score_values(
        self, values: Tensor, examples: Tensor, criterion: Criterion, state: State
    ) -> tuple[Tensor, Score]:
        """Render and classify candidates, as many at a time as memory permits.

        Args:
            values: Attack values of A candidates, shape (A, D).
            examples: Index of the example of each candidate, shape (A,).
            criterion: Source and target classes of the A candidates.
            state: State of the search, which has the batch size.

        Returns:
            Images of the V views, shape (A, V, 3, H, W), and the scores of the A candidates.
        """
        images = []
        scores = []
        for rows in torch.arange(len(values)).split(self.problem.group_size):
            part = self.problem.render(values[rows], examples[rows])
            images.append(part)
            with self.phases("attack_classifier"):
                scores += self._score_images(part, criterion.select(rows), state.batch_size)
        view_count = criterion.source.shape[1]
        return torch.cat(images), Score.of_examples(scores, view_count)

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
        logits = self.model(batch)
        expected_logits = self.expectation(self.model, batch, logits)
        # In float32, the cross entropy rounds to zero for logit gaps above 17, so
        # candidates could not be compared. In float64, they can.
        cost = adversarial_cost(expected_logits.double(), classes.source, classes.target)
        return Score(
            cost=cost.to(batch),
            gap=logit_gap(expected_logits, classes.source, classes.target),
            predicted=logits.argmax(1),
        )

    def _is_accepted(self, state: State, evaluation: Evaluation) -> Tensor:
        """Return whether each candidate has a lower cost than the accepted values, shape (N,)."""
        return evaluation.score.cost < state.cost[state.active_rows]


def _best_rows(cost: Tensor, is_met: Tensor, count: int) -> Tensor:
    """Choose the best candidate of each of N examples.

    If some candidates of an example reach the criterion, the best is the one
    with the lowest cost among these. Otherwise it is the one with the lowest
    cost of all candidates of the example.

    Args:
        cost: Cost of each candidate, shape (N · count,).
        is_met: Mask of the candidates that reach the criterion, shape (N · count,).
        count: Number of candidates of each example.

    Returns:
        Index of the best candidate of each example among all N · count, shape (N,).
    """
    costs = cost.unflatten(0, (-1, count))
    is_met = is_met.unflatten(0, (-1, count))
    is_excluded = is_met.any(1, keepdim=True) & ~is_met
    # Index among the candidates of the same example, shape (N,).
    chosen = costs.masked_fill(is_excluded, torch.inf).argmin(1)
    return torch.arange(len(costs), device=cost.device) * count + chosen
