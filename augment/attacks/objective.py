"""What an attack makes of the outputs of a network: the cost that it lowers, and when it succeeds.

Each view of an example has a source class s, the class that it shows. In a targeted attack it also
has a target class t. CE(f(I), c) is the cross entropy of the prediction f(I) for an image I with
class c. The cost is that of the paper's equation 1, summed over the views:

    cost = Σ −CE(f(I), s) + CE(f(I), t)

An example succeeds when the predictions reach its criterion in every view. It is finished when the
logit gap (`augment.losses.logit_gap`) is also at least `AttackSettings.margin` in every view. If
the settings ask for it, or if the network is overconfident (`augment.losses.is_overconfident`), the
gap must also be larger than its changes by the noise of a sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from augment.attacks.eot import (
    NOISE_DRAWS,
    ExpectationOverTransformations,
    add_sensor_noise,
    preprocessed_model,
)
from augment.losses import NO_CLASS, adversarial_cost, is_overconfident, logit_gap
from augment.network import BatchSize, compute_outputs
from augment.progress import Phases
from augment.random_streams import generator

if TYPE_CHECKING:
    from augment.attack_settings import AttackSettings

# Gradients below this number are not scaled before they enter the network.
MIN_GRADIENT = 1e-30


@dataclass(frozen=True)
class Criterion:
    """Source and target class of each view of an attack on a classifier.

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

    source: Int[Tensor, "*E V"]
    target: Int[Tensor, "*E V"] | None = None

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

    @property
    def view_count(self) -> int:
        """Number V of views of each example."""
        return self.source.shape[1]

    def cost(self, logits: Float[Tensor, "N C"]) -> Float[Tensor, " N"]:
        """Compute the cost of single images, for a criterion that is flat."""
        return adversarial_cost(logits, self.source, self.target)

    def gap(self, logits: Float[Tensor, "... C"]) -> Float[Tensor, " ..."]:
        """Compute by how much each view reaches the criterion. It is negative if it does not."""
        return logit_gap(logits, self.source, self.target)

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Return a mask of the examples that reach the criterion in all their views."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, " ..."]) -> Bool[Tensor, " ..."]:
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


@dataclass(frozen=True)
class Score:
    """Cost, logit gap and predicted classes of N examples, or of N single images.

    The cost of an example is the sum over its views, and its gap is the smallest gap of its views.

    Attributes:
        cost: Cost that the attack lowers.
        gap: By how much the criterion is reached, see `augment.losses.logit_gap`.
        predicted: Predicted classes of the images before any random transformation. Shape (N, V)
            for examples with V views, (N,) for single images.
        is_success: Whether the predictions reach the criterion, in all views of an example.
        is_overconfident: See `augment.losses.is_overconfident`; in any view of an example.
    """

    cost: Float[Tensor, " N"]
    gap: Float[Tensor, " N"]
    predicted: Tensor
    is_success: Bool[Tensor, " N"]
    is_overconfident: Bool[Tensor, " N"]

    @classmethod
    def join(cls, parts: Sequence[Score]) -> Score:
        """Return the scores of several parts of the examples or images as one."""
        return cls(
            *(torch.cat([getattr(part, item.name) for part in parts]) for item in fields(cls))
        )

    def of_examples(self, view_count: int) -> Score:
        """Combine the scores of single images. The views of an example follow each other."""
        by_view = [getattr(self, item.name).unflatten(0, (-1, view_count)) for item in fields(self)]
        cost, gap, predicted, is_success, is_extreme = by_view
        return Score(cost.sum(1), gap.amin(1), predicted, is_success.all(1), is_extreme.any(1))

    def select(self, rows: Tensor) -> Score:
        """Return the scores of some of the examples or images."""
        return Score(*(getattr(self, item.name)[rows] for item in fields(self)))


class Objective:
    """Cost and success of E examples of V views, against one network.

    Args:
        network: Network from images in [0, 1] to its outputs.
        criterion: What the outputs shall be.
        settings: Rounding to 8 bits, random transformations, margin, sensor noise and batch size.
        seed: Seed of the random transformations and of the sensor noise.
        phases: Timer of the passes through the network.
    """

    def __init__(
        self,
        network: nn.Module,
        criterion: Criterion,
        settings: AttackSettings,
        seed: int = 0,
        phases: Phases | None = None,
    ):
        self.model = preprocessed_model(settings, network)
        self.criterion = criterion
        self.settings = settings
        self.seed = seed
        self.phases = phases or Phases()
        self._expectation = ExpectationOverTransformations(
            settings.eot, generator(seed, "expectation")
        )
        self._batch_size = BatchSize(settings.batch_size)

    def select(self, examples: Tensor | slice) -> Objective:
        """Return the objective of some of the examples, with the same random numbers."""
        selected = copy(self)
        selected.criterion = self.criterion.select(examples)
        return selected

    @property
    def passes_per_candidate(self) -> int:
        """Number of images that the network sees to evaluate one candidate of an example.

        These are all its views, each as it is and in each of its random transformations.
        """
        return self.criterion.view_count * (1 + self.settings.eot.draws)

    def score(
        self, images: Float[Tensor, "E V _ H W"], needs_gradient: bool
    ) -> tuple[Score, Tensor | None]:
        """Score all examples, batch by batch.

        Return also the gradients of the costs with respect to the images, if they are needed.
        """
        all_images = images.flatten(0, 1)
        criterion = self.criterion.flatten()
        gradients = torch.empty_like(all_images) if needs_gradient else None

        def score_batch(rows: slice) -> Score:
            batch_gradients = None if gradients is None else gradients[rows]
            return self._score_batch(all_images[rows], criterion.select(rows), batch_gradients)

        with self.phases("attack_classifier"), torch.set_grad_enabled(needs_gradient):
            batches = list(self._batch_size.map(score_batch, len(all_images)))
        if gradients is not None:
            gradients = gradients.unflatten(0, images.shape[:2])
        return Score.join(batches).of_examples(images.shape[1]), gradients

    def _score_batch(
        self, batch: Float[Tensor, "N _ H W"], criterion: Criterion, gradients: Tensor | None
    ) -> Score:
        """Score single images, and write the gradients of their costs if a tensor is given."""
        batch = batch.detach().requires_grad_(gradients is not None)
        # The network may compute in half precision.
        logits = self.model(batch).to(batch.dtype)
        expected = self._expectation(self.model, batch, logits)
        cost = criterion.cost(expected)
        if gradients is not None:
            (logit_gradient,) = torch.autograd.grad(cost.sum(), expected)
            # The gradient of a confident prediction is so small that it would round to zero in a
            # network of half precision. A factor that is a power of two changes no other digits.
            largest = logit_gradient.abs().amax(1, keepdim=True).clamp(min=MIN_GRADIENT)
            power = largest / torch.frexp(largest).mantissa
            (batch_gradient,) = torch.autograd.grad(expected, batch, logit_gradient / power)
            # The network may return its gradient in another memory layout. The copy has the
            # layout of the images.
            gradients.copy_(batch_gradient * power[:, :, None, None])
        expected = expected.detach()
        predicted = logits.detach().argmax(1)
        return Score(
            cost=cost.detach(),
            gap=criterion.gap(expected),
            predicted=predicted,
            is_success=criterion.reached_in_views(predicted),
            is_overconfident=is_overconfident(expected),
        )

    def finished(
        self, score: Score, images: Float[Tensor, "E V _ H W"], examples: Int[Tensor, " E"]
    ) -> tuple[Bool[Tensor, " E"], Int[Tensor, " E"]]:
        """Return a mask of the successes with the required margin, also with sensor noise.

        Only overconfident networks, and settings with a noise margin, are shown noisy images. Their
        number for each example is the second result. `examples` are the keys of the noise.
        """
        is_finished = score.is_success & (score.gap >= self.settings.margin)
        noisy_count = torch.zeros_like(examples)
        if self.settings.overconfident_noise_margin:
            has_margin = self._noise_margin(score.is_overconfident) > 0
            checked = (is_finished & has_margin).nonzero()[:, 0]
            noisy_count[checked] = NOISE_DRAWS * self.criterion.view_count
            with self.phases("attack_classifier"):
                is_robust = self.select(checked).is_robust(images[checked], examples[checked])
            is_finished = is_finished.index_copy(0, checked, is_robust)
        return is_finished, noisy_count

    def _noise_margin(self, is_overconfident: Tensor) -> Tensor:
        """Return how many times the range of the gaps with noise the smallest gap must be."""
        return torch.where(
            is_overconfident,
            self.settings.overconfident_noise_margin,
            self.settings.applied_noise_margin,
        )

    @torch.no_grad()
    def is_robust(
        self, images: Float[Tensor, "E V _ H W"], examples: Int[Tensor, " E"]
    ) -> Bool[Tensor, " E"]:
        """Return a mask of the examples whose logit gaps change little with sensor noise.

        In every view, the smallest gap, without noise and in several draws of it, must be at least
        `_noise_margin` times the difference between the largest and the smallest. This noise
        differs from the noise that later decides whether a success counts.
        """
        if not len(images):
            return examples.new_zeros(0, dtype=torch.bool)
        noisy_versions = add_sensor_noise(
            images, self.settings.sensor_noise, examples, self.seed, "noise margin"
        )
        gaps = []
        overconfident = []
        for version in (images, *noisy_versions):
            batches = version.flatten(0, 1).split(self.settings.batch_size)
            logits = torch.cat([self.model(batch) for batch in batches])
            logits_of_views = logits.unflatten(0, version.shape[:2])
            gaps.append(self.criterion.gap(logits_of_views))
            overconfident.append(is_overconfident(logits_of_views))
        # Smallest and largest logit gap of each view, each of shape (E, V).
        smallest, largest = torch.stack(gaps).aminmax(dim=0)
        noise_margin = self._noise_margin(torch.stack(overconfident).any(0))
        return (smallest >= noise_margin * (largest - smallest)).all(1)

    def logits(self, images: Float[Tensor, "E V _ H W"]) -> Float[Tensor, "E V C"]:
        """Compute the logits of all views, batch by batch."""
        return compute_outputs(self.model, images, self.settings.batch_size)

    def fooled_in_views(
        self,
        images: Float[Tensor, "E V _ H W"],
        predicted: Int[Tensor, "E V"],
        examples: Int[Tensor, " E"],
    ) -> Bool[Tensor, "E V"]:
        """Decide which views count as a success of an attack.

        A view is a success if it meets the criterion without noise and with each of `NOISE_DRAWS`
        draws of sensor noise. The noise of an example depends only on the seed and on its number in
        `examples`. An attack that tries many images therefore cannot succeed by drawing the noise
        again. With `sensor_noise=0`, only the images without noise count.
        """
        is_fooled = self.criterion.reached_in_views(predicted)
        # Noise is tested only in examples with a view that is fooled without noise.
        tested = torch.nonzero(is_fooled.any(1)).squeeze(1)
        if not self.settings.sensor_noise or not len(tested):
            return is_fooled
        criterion = self.criterion.select(tested)
        noisy_versions = add_sensor_noise(
            images[tested.to(images.device)],
            self.settings.sensor_noise,
            examples.to(tested.device)[tested],
            self.seed,
            "sensor noise",
        )
        for noisy_images in noisy_versions:
            noisy_predicted = self.logits(noisy_images).argmax(2).to(is_fooled.device)
            # A view must be fooled in every draw of the noise.
            is_fooled[tested] &= criterion.reached_in_views(noisy_predicted)
        return is_fooled
