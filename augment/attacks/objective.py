"""What an attack makes of the outputs of a network: the cost that it lowers, and when it succeeds.

Each view of an example has a source class s, the class that it shows. In a targeted attack it also
has a target class t. CE(f(I), c) is the cross entropy of the prediction f(I) for an image I with
class c. The cost is that of the paper's equation 1, summed over the views:

    cost = Σ −CE(f(I), s) + CE(f(I), t)

An example succeeds when the predictions reach its criterion in every view. It is finished when the
logit gap (`Criterion.gap`) is also at least `AttackSettings.margin` in every view. If the settings
ask for it, or if the network is overconfident (`is_overconfident`), the gap must also be larger
than its changes by the noise of a sensor.

A label is the index of a class. A complementary label says that an image does not show a class. It
is the number −1 − class. If there are several positive classes, the argument `absent` contains the
other classes that images with a complementary label do not show, either.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from PIL import Image
from torch import Tensor, nn

from augment.network import BatchSize, Network, Quantization, compute_outputs, straight_through
from augment.progress import Phases
from augment.random_streams import generator
from renderer.errors import require_range
from renderer.image import clamp, to_bytes, to_unit

if TYPE_CHECKING:
    from augment.attack_settings import AttackSettings, EOTSettings

# Attack values of E examples, the indices of examples, and images of their V views.
Values = Float[Tensor, "E D"]
Examples = Int[Tensor, " E"]
Images = Float[Tensor, "E V _ H W"]

# Index that stands for "no class" in attacks without a source or a target class. It differs from
# all labels.
NO_CLASS = -(10**9)
# A network is overconfident where its log-odds exceed this number. Networks rarely do so, unless
# their logits are multiplied by a factor.
OVERCONFIDENT = 50.0
# Gradients below this number are not scaled before they enter the network.
MIN_GRADIENT = 1e-30
# Number of noisy versions of an image that `add_sensor_noise` yields. An attack counts as a success
# only if the classifier is wrong in all of them.
NOISE_DRAWS = 3


@dataclass(frozen=True)
class Rows:
    """Base of data classes whose tensors have one row for each example."""

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Return a copy with changed tensors."""
        tensors = {name: item for name, item in vars(self).items() if isinstance(item, Tensor)}
        changed = {name: change(tensor) for name, tensor in tensors.items()}
        return replace(self, **changed)

    def select(self, rows: Tensor | slice) -> Self:
        """Return some of the rows."""
        return self.map(lambda tensor: tensor[rows])

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of several parts, one after the other."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*map(torch.cat, columns))


@dataclass(frozen=True)
class Criterion(Rows):
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

    @property
    def view_count(self) -> int:
        """Number V of views of each example."""
        return self.source.shape[1]

    def cost(self, logits: Float[Tensor, "N C"]) -> Float[Tensor, " N"]:
        """Compute the cost of single images, for a criterion that is flat.

        Without a target, the cost and its gradient round to 0 if the log-odds o of the source are
        large. Where they exceed 50, o − 50 is therefore added.
        """
        # `require_known` refuses NO_CLASS, which is negative. Class 0 stands for it.
        source = self.source.clamp(min=0)
        require_known(source, logits)
        # The logarithm of the probability is log σ of the log-odds. Its gradient is accurate even
        # if the probability rounds to 1. The gradient of `cross_entropy` then loses the term of
        # the class.
        other_logits = logits.scatter(1, source[:, None], -torch.inf)
        odds = logits.gather(1, source[:, None])[:, 0] - other_logits.logsumexp(1)
        is_added = odds > OVERCONFIDENT
        if self.target is not None:
            is_added = is_added & (self.target == NO_CLASS)
        cost = F.logsigmoid(odds) + torch.where(is_added, odds - OVERCONFIDENT, 0)
        cost = torch.where(self.source == NO_CLASS, 0, cost)
        if self.target is not None:
            target_cost = F.cross_entropy(
                logits, self.target, reduction="none", ignore_index=NO_CLASS
            )
            cost = cost + target_cost
        return cost

    def gap(self, logits: Float[Tensor, "... C"]) -> Float[Tensor, " ..."]:
        """Compute by how much each view reaches the criterion: its logit gap.

        With a target class, it is the logit of the target minus the largest other logit. Without
        one, it is the largest logit of the other classes minus the logit of the source class. It is
        negative if the view does not reach the criterion.
        """
        target = torch.full_like(self.source, NO_CLASS) if self.target is None else self.target
        has_target = target != NO_CLASS
        # Class whose logit is compared with the others, shape (..., 1).
        compared_class = torch.where(has_target, target, self.source)[..., None]
        compared_logit = logits.gather(-1, compared_class)[..., 0]
        largest_other = logits.scatter(-1, compared_class, -torch.inf).amax(-1)
        difference = compared_logit - largest_other
        return torch.where(has_target, difference, -difference)

    def reached(self, predicted: Int[Tensor, "E V"]) -> Bool[Tensor, " E"]:
        """Return a mask of the examples that reach the criterion in all their views."""
        return self.reached_in_views(predicted).all(1)

    def reached_in_views(self, predicted: Int[Tensor, " ..."]) -> Bool[Tensor, " ..."]:
        """Return a mask of the views that reach the criterion."""
        is_misclassified = predicted != self.source
        if self.target is None:
            return is_misclassified
        # The target `NO_CLASS` stands for a view without a target.
        is_untargeted = self.target == NO_CLASS
        return torch.where(is_untargeted, is_misclassified, predicted == self.target)


@dataclass(frozen=True)
class Score(Rows):
    """Cost, logit gap and predicted classes of N examples, or of N single images.

    The cost of an example is the sum over its views, and its gap is the smallest gap of its views.

    Attributes:
        cost: Cost that the attack lowers.
        gap: By how much the criterion is reached, see `Criterion.gap`.
        predicted: Predicted classes of the images before any random transformation. Shape (N, V)
            for examples with V views, (N,) for single images.
        is_success: Whether the predictions reach the criterion, in all views of an example.
        is_overconfident: See `is_overconfident`; in any view of an example.
    """

    cost: Float[Tensor, " N"]
    gap: Float[Tensor, " N"]
    predicted: Tensor
    is_success: Bool[Tensor, " N"]
    is_overconfident: Bool[Tensor, " N"]

    def of_examples(self, view_count: int) -> Score:
        """Combine the scores of single images. The views of an example follow each other."""
        cost, gap, predicted, is_success, is_extreme = (
            tensor.unflatten(0, (-1, view_count)) for tensor in vars(self).values()
        )
        return Score(cost.sum(1), gap.amin(1), predicted, is_success.all(1), is_extreme.any(1))


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
        self._transformations = generator(seed, "expectation")
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

    def score(self, images: Images, needs_gradient: bool) -> tuple[Score, Tensor | None]:
        """Score all examples, batch by batch.

        Return also the gradients of the costs with respect to the images, if they are needed.
        """
        all_images = images.flatten(0, 1)
        criterion = self.criterion.map(torch.flatten)
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
        expected = average_transformed(
            self.model, batch, logits, self.settings.eot, self._transformations
        )
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
        self, score: Score, images: Images, examples: Examples
    ) -> tuple[Bool[Tensor, " E"], Examples]:
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
        settings = self.settings
        margins = settings.overconfident_noise_margin, settings.applied_noise_margin
        return torch.where(is_overconfident, *margins)

    @torch.no_grad()
    def is_robust(self, images: Images, examples: Examples) -> Bool[Tensor, " E"]:
        """Return a mask of the examples whose logit gaps change little with sensor noise.

        In every view, the smallest gap, without noise and in several draws of it, must be at least
        `_noise_margin` times the difference between the largest and the smallest. This noise
        differs from the noise that later decides whether a success counts.
        """
        if not len(images):
            return examples.new_zeros(0, dtype=torch.bool)
        noise = self.settings.sensor_noise
        versions = add_sensor_noise(images, noise, examples, self.seed, "noise margin")
        logits = [self.logits(version) for version in (images, *versions)]
        # Smallest and largest logit gap of each view, each of shape (E, V).
        smallest, largest = torch.stack([*map(self.criterion.gap, logits)]).aminmax(dim=0)
        is_extreme = torch.stack([*map(is_overconfident, logits)]).any(0)
        return (smallest >= self._noise_margin(is_extreme) * (largest - smallest)).all(1)

    def logits(self, images: Images) -> Float[Tensor, "E V C"]:
        """Compute the logits of all views, batch by batch."""
        return compute_outputs(self.model, images, self.settings.batch_size)

    def judge(
        self, images: Images, examples: Examples
    ) -> tuple[Float[Tensor, "E V C"], Bool[Tensor, "E V"], Bool[Tensor, " E"]]:
        """Decide about images that an attack found.

        Return the logits, a mask of the views that count as a success (`fooled_in_views`), and a
        mask of the examples that reach the criterion without sensor noise.
        """
        logits = self.logits(images)
        predicted = logits.argmax(2)
        fooled_in_views = self.fooled_in_views(images, predicted, examples)
        return logits, fooled_in_views, self.criterion.reached(predicted)

    def fooled_in_views(
        self, images: Images, predicted: Int[Tensor, "E V"], examples: Examples
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
        noise = self.settings.sensor_noise
        if not noise or not len(tested):
            return is_fooled
        criterion = self.criterion.select(tested)
        shown = images[tested.to(images.device)]
        keys = examples.to(tested.device)[tested]
        for noisy_images in add_sensor_noise(shown, noise, keys, self.seed, "sensor noise"):
            noisy_predicted = self.logits(noisy_images).argmax(2).to(is_fooled.device)
            # A view must be fooled in every draw of the noise.
            is_fooled[tested] &= criterion.reached_in_views(noisy_predicted)
        return is_fooled


def preprocessed_model(settings: AttackSettings, classifier: nn.Module) -> nn.Module:
    """Return a classifier that rounds images to 8 bits, if `settings.quantized` asks for it."""
    return Network(classifier, [Quantization()]) if settings.quantized else classifier


def add_sensor_noise(
    images: Images, deviation: float, examples: Examples, *key: int | str
) -> Iterator[Tensor]:
    """Add sensor noise to images and round them to 8 bits, as a camera does.

    This is repeated `NOISE_DRAWS` times with different noise. The noise of an example depends only
    on the key and on the index of the example. The deviation is in units of 1/255, and the noisy
    images are rounded to 8 bits.
    """
    generators = [generator(*key, example) for example in examples.tolist()]
    for _ in range(NOISE_DRAWS):
        noise = [torch.randn(images.shape[1:], generator=draws) for draws in generators]
        noisy = images + deviation / 255 * torch.stack(noise).to(images)
        yield to_unit(to_bytes(clamp(noisy))).to(images)


def average_transformed(
    model: nn.Module,
    images: Float[Tensor, "N _ H W"],
    logits: Float[Tensor, "N C"],
    settings: EOTSettings,
    draws: torch.Generator,
) -> Float[Tensor, "N C"]:
    """Average predictions over random transformations of images (EOT, Athalye et al. 2018).

    The log-probabilities of each image and of its transformed copies are averaged. Gradients ignore
    the JPEG compression (straight-through estimator). With 0 transformations, the given logits are
    returned as they are.
    """
    if not settings.draws:
        return logits
    log_probabilities = [logits.log_softmax(1)]
    for _ in range(settings.draws):
        transformed_logits = model(_transformed(images, settings, draws)).to(logits.dtype)
        log_probabilities.append(transformed_logits.log_softmax(1))
    return torch.stack(log_probabilities).mean(0)


def _transformed(
    images: Float[Tensor, "N 3 H W"], settings: EOTSettings, draws: torch.Generator
) -> Float[Tensor, "N 3 H W"]:
    """Transform each image at random.

    A transformation shifts, rotates and scales the image, changes the exposure, adds noise and
    compresses the image as JPEG. The quality of the compression is the same for all images of a
    call. Everything else differs between images.
    """

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=draws) - 1

    # Two shifts, a rotation and a relative change of size for each image, shape (N, 4).
    moved = _moved(images, (settings.jitter * uniform(len(images), 4)).to(images))
    # Change of the exposure in stops. One stop doubles the exposure.
    stops = settings.exposure * uniform(len(images), 1, 1, 1)
    exposed = clamp(moved * (2**stops).to(images))
    noise = settings.noise * torch.randn(images.shape, generator=draws)
    noisy = clamp(exposed + noise.to(images))
    quality = int(torch.randint(settings.jpeg, 101, (), generator=draws))
    return straight_through(noisy, lambda exact: as_jpeg(exact.cpu(), quality).to(exact))


def as_jpeg(images: Float[Tensor, "... 3 H W"], quality: int) -> Float[Tensor, "... 3 H W"]:
    """Compress images as JPEG and decompress them. The quality is from 1 to 100."""
    decompressed = []
    for image in to_bytes(images).flatten(0, -4):
        file = io.BytesIO()
        # pillow has the channels last.
        Image.fromarray(image.permute(1, 2, 0).numpy()).save(file, "JPEG", quality=quality)
        with Image.open(file) as read:
            decompressed.append(torch.from_numpy(np.array(read)).permute(2, 0, 1))
    return to_unit(torch.stack(decompressed)).view(images.shape)


def _moved(
    images: Float[Tensor, "N 3 H W"], movements: Float[Tensor, "N 4"]
) -> Float[Tensor, "N 3 H W"]:
    """Shift, rotate and scale images. The pixels at the border are repeated beyond the border.

    Each new pixel takes its value from a position in the given image. The movement is that of these
    positions, so the content of the image moves in the opposite direction. The four numbers of a
    movement are the shift across and the shift down as fractions of the image size, the rotation in
    radians, and g. Distances from the center are multiplied by 1 + g.
    """
    across, down, angle, growth = movements.unbind(1)
    cos = (1 + growth) * angle.cos()
    sin = (1 + growth) * angle.sin()
    # `affine_grid` uses coordinates from -1 to 1. A shift by the whole image is therefore 2.
    matrices = torch.stack([cos, -sin, 2 * across, sin, cos, 2 * down], dim=1).view(-1, 2, 3)
    grid = F.affine_grid(matrices, list(images.shape), align_corners=False)
    return F.grid_sample(images, grid, padding_mode="border", align_corners=False)


def is_overconfident(logits: Float[Tensor, "... classes"]) -> Bool[Tensor, " ..."]:
    """Return a mask of the images with a class of log-odds above 50 or below −50."""
    lowest, highest = logits.aminmax(dim=-1)
    return highest - lowest > OVERCONFIDENT


def complementary_label(label: int) -> int:
    """Return the complementary label of a class. It says that images do not show the class."""
    return -1 - label


def require_known(labels: Int[Tensor, " N"], logits: Float[Tensor, "_ classes"]) -> None:
    """Check that every label has a logit. Labels may be complementary."""
    require_range("label", int(_class_of(labels).amax()), 0, logits.shape[1] - 1)


def label_loss(
    logits: Float[Tensor, "N classes"],
    labels: Int[Tensor, " N"],
    label_smoothing: float = 0.0,
    absent: Sequence[int] = (),
) -> Float[Tensor, " N"]:
    """Compute the loss of each image by its label.

    An image of class c has the label c. Its loss is the cross entropy. An image that does not
    show class c has the complementary label −1 − c. Its loss is −log(1 − p), where p is the sum
    of the probabilities of c and of the classes `absent`.
    """
    classes = _class_of(labels)
    # Set the logits of the classes that are not shown to -∞. Only the logits of the other
    # classes remain.
    other_logits = logits.scatter(1, classes[:, None], -torch.inf)
    for index in absent:
        other_logits[:, index] = -torch.inf
    # The other classes have the probability Σ exp(other_logits) / Σ exp(logits) = 1 - p.
    complementary = logits.logsumexp(1) - other_logits.logsumexp(1)
    cross_entropy = F.cross_entropy(
        logits, classes, reduction="none", label_smoothing=label_smoothing
    )
    return torch.where(labels < 0, complementary, cross_entropy)


def is_correct(
    predicted: Int[Tensor, " N"], labels: Int[Tensor, " N"], absent: Sequence[int] = ()
) -> Bool[Tensor, " N"]:
    """Return a mask of the predictions that agree with the labels.

    A label that is a class demands the prediction of this class. The complementary label
    −1 − c says that the image does not show class c. It demands a prediction that is neither c
    nor one of the classes `absent`.
    """
    is_class_of_label = predicted == _class_of(labels)
    is_excluded = is_class_of_label
    for index in absent:
        is_excluded = is_excluded | (predicted == index)
    return torch.where(labels < 0, ~is_excluded, is_class_of_label)


def _class_of(labels: Tensor) -> Tensor:
    """Return the class c of each label, which is c or, if it is complementary, −1 − c."""
    return torch.where(labels < 0, -1 - labels, labels)
