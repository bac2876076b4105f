"""What an attack makes of the outputs of a network: the cost that it lowers, and when it succeeds.

A criterion of a task (`augment.tasks`) gives the cost of each view, and its evidence: a row of
numbers that says how strongly the network finds each class. The costs are summed over the views.

An example succeeds when the evidence reaches its criterion in every view. It is finished when the
gap (`Criterion.gap`) is also at least `AttackSettings.margin` in every view. If the settings ask
for it, or if the network is overconfident, the gap must also be larger than its changes by the
noise of a sensor.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import InitVar, dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import Image
from torch import Generator, Tensor, nn

from augment.attack_settings import AttackSettings, EOTSettings
from augment.network import BatchSize, Network, Quantization, eval_mode
from augment.progress import Phases
from augment.random_streams import generator
from augment.scene.truth import Rows
from augment.tasks.task import NO_GRADIENT, Criterion, gradient_of
from renderer.errors import InputError
from renderer.image import clamp, straight_through, to_bytes, to_unit

# Attack values of E examples, the indices of examples, and images of their V views.
Values = Float[Tensor, "E D"]
Examples = Int[Tensor, " E"]
Images = Float[Tensor, "E V _ H W"]
SingleImages = Float[Tensor, "N _ H W"]

# Function that puts the rows of all views of examples one after the other.
of_single_images = partial(torch.flatten, start_dim=0, end_dim=1)
# Gradients below this number are not scaled before they enter the network.
MIN_GRADIENT = 1e-30
# Number of noisy versions of an image that `add_sensor_noise` yields. An attack counts as a success
# only if the classifier is wrong in all of them.
NOISE_DRAWS = 3


@dataclass(frozen=True)
class Score(Rows):
    """Cost, gap and predicted classes of N examples, or of N single images.

    The cost of an example is the sum over its views, and its gap is the smallest gap of its views.

    Attributes:
        cost: Cost that the attack lowers.
        gap: By how much the criterion is reached, see `Criterion.gap`.
        predicted: Predicted classes of the images before any random transformation. Shape (N, V)
            for examples with V views, (N,) for single images.
        is_success: Whether the predictions reach the criterion, in all views of an example.
        is_overconfident: See `Criterion.is_overconfident`; in any view of an example.
    """

    cost: Float[Tensor, " N"]
    gap: Float[Tensor, " N"]
    predicted: Tensor
    is_success: Bool[Tensor, " N"]
    is_overconfident: Bool[Tensor, " N"]

    def of_examples(self, view_count: int) -> Score:
        """Combine the scores of single images. The views of an example follow each other."""
        # Each tensor gets the shape (E, V).
        cost, gap, predicted, is_success, is_extreme = (
            tensor.unflatten(0, (-1, view_count)) for tensor in vars(self).values()
        )
        return Score(cost.sum(1), gap.amin(1), predicted, is_success.all(1), is_extreme.any(1))


@dataclass(eq=False, repr=False)
class Objective:
    """Cost and success of E examples of V views, against one network.

    Args:
        network: Network from images in [0, 1] to its outputs.
        criterion: What the outputs shall be, for the truth of the images.
        settings: Rounding to 8 bits, random transformations, margin, sensor noise and batch size.
        seed: Seed of the random transformations and of the sensor noise.
        phases: Timer of the passes through the network.
    """

    network: InitVar[nn.Module]
    criterion: Criterion
    settings: AttackSettings
    seed: int = 0
    phases: Phases = field(default_factory=Phases)

    def __post_init__(self, network: nn.Module) -> None:
        """Prepare the network, the random transformations and the size of the batches."""
        self.model = preprocessed_model(self.settings, network)
        source = self.criterion.source
        self._rows = torch.arange(len(source), device=source.device)
        # Each example has its own random transformations, whichever others are attacked with it.
        rows = self._rows.tolist() if self.settings.eot.draws else []
        self._transformations = [generator(self.seed, "expectation", row) for row in rows]
        self._batch_size = BatchSize(self.settings.batch_size)

    def select(self, examples: Tensor | slice) -> Objective:
        """Return the objective of some of the examples, with the same random numbers."""
        selected = copy(self)
        selected.criterion = self.criterion.select(examples)
        selected._rows = self._rows[examples]
        return selected

    def moved(self, problem: Any, values: Values, examples: Examples) -> Objective:
        """Return the objective for the positions that the objects have with some attack values."""
        truth = problem.truth(values, examples) if self.criterion.needs_truth else None
        if truth is None:
            return self
        moved = copy(self)
        moved.criterion = self.criterion.at(truth)
        return moved

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
        # One list of the views of all examples. The criterion gets one row for each image, too.
        all_images = images.flatten(0, 1)
        criterion = self.criterion.map(of_single_images)
        gradients = torch.empty_like(all_images) if needs_gradient else None
        shown = self._rows.tolist() if self._transformations else []
        # The views of an example follow each other. An example draws a seed for each of its images,
        # so that the random numbers of an image do not depend on the batches.
        streams = [self._transformations[row] for row in shown for _ in range(images.shape[1])]
        seeds = [int(torch.randint(2**62, (), generator=stream)) for stream in streams]

        def score_batch(rows: slice) -> Score:
            part = None if gradients is None else gradients[rows]
            return self._score_batch(all_images[rows], criterion.select(rows), seeds[rows], part)

        with self.phases("attack_classifier"), torch.set_grad_enabled(needs_gradient):
            batches = list(self._batch_size.map(score_batch, len(all_images)))
        if gradients is not None:
            gradients = gradients.unflatten(0, images.shape[:2])
        return Score.join(batches).of_examples(images.shape[1]), gradients

    def _score_batch(
        self, batch: Tensor, criterion: Criterion, seeds: Sequence[int], gradients: Tensor | None
    ) -> Score:
        """Score single images, and write the gradients of their costs if a tensor is given."""
        batch = batch.detach().requires_grad_(gradients is not None)
        outputs = self._outputs(batch)
        # Costs and gaps are those of the mean over random transformations, if there are any.
        # The success is that of the image as it is.
        expected = self._expected(outputs, batch, [*map(generator, seeds)])
        cost = criterion.cost(expected)
        if gradients is not None:
            # The network may return its gradient in another memory layout. The copy has the
            # layout of the images.
            gradients.copy_(_image_gradient(cost, expected, batch))
        with torch.no_grad():
            predicted = criterion.predicted(criterion.evidence(outputs))
            expected_evidence = criterion.evidence(expected)
            return Score(
                cost=cost.detach(),
                gap=criterion.gap(expected_evidence),
                predicted=predicted,
                is_success=criterion.reached_in_views(predicted),
                is_overconfident=criterion.is_overconfident(expected_evidence),
            )

    def _expected(self, outputs: Any, images: SingleImages, draws: Sequence[Generator]) -> Any:
        """Average predictions over random transformations of images (EOT, Athalye et al. 2018).

        The log-probabilities of each image and of its transformed copies are averaged. Gradients
        ignore the JPEG compression (straight-through estimator). Without draws, the outputs stay.
        """
        settings = self.settings.eot
        if not settings.draws:
            return outputs
        transformed = (
            self._outputs(_transformed(images, settings, draws)) for _ in range(settings.draws)
        )
        return torch.stack([one.log_softmax(1) for one in (outputs, *transformed)]).mean(0)

    def _outputs(self, batch: SingleImages) -> Any:
        """Compute the outputs of single images. The network may compute in half precision."""
        outputs = self.model(batch)
        return outputs.to(batch.dtype) if isinstance(outputs, Tensor) else outputs

    def finished(
        self, score: Score, images: Images, examples: Examples, tests_noise: bool = True
    ) -> tuple[Tensor, Tensor]:
        """Return a mask of the successes with the required margin, also with sensor noise.

        Only overconfident networks, and settings with a noise margin, are shown noisy images. Their
        number for each example is the second result. `examples` are the keys of the noise. Without
        `tests_noise`, what needs the test is not finished: a CPU would wait to find it.
        """
        is_finished = score.is_success & (score.gap >= self.settings.margin)
        noisy_count = torch.zeros_like(examples)
        if self.settings.overconfident_noise_margin:
            has_margin = self._noise_margin(score.is_overconfident) > 0
            if not tests_noise:
                return is_finished & ~has_margin, noisy_count
            checked = (is_finished & has_margin).nonzero()[:, 0]
            noisy_count[checked] = NOISE_DRAWS * self.criterion.view_count
            with self.phases("attack_classifier"):
                is_robust = self.select(checked).is_robust(images[checked], examples[checked])
            # The examples that were tested with noise get the result of this test.
            is_finished = is_finished.index_copy(0, checked, is_robust)
        return is_finished, noisy_count

    def _noise_margin(self, is_overconfident: Tensor) -> Tensor:
        """Return how many times the range of the gaps with noise the smallest gap must be."""
        settings = self.settings
        margins = settings.overconfident_noise_margin, settings.applied_noise_margin
        return torch.where(is_overconfident, *margins)

    @torch.no_grad()
    def is_robust(self, images: Images, examples: Examples) -> Bool[Tensor, " E"]:
        """Return a mask of the examples whose gaps change little with sensor noise.

        In every view, the smallest gap, without noise and in several draws of it, must be at least
        `_noise_margin` times the difference between the largest and the smallest. This noise
        differs from the noise that later decides whether a success counts.
        """
        if not len(images):
            return examples.new_zeros(0, dtype=torch.bool)
        noise = self.settings.sensor_noise
        versions = add_sensor_noise(images, noise, examples, self.seed, "noise margin")
        evidence = [self.evidence(version) for version in (images, *versions)]
        # Smallest and largest gap of each view, each of shape (E, V).
        smallest, largest = torch.stack([*map(self.criterion.gap, evidence)]).aminmax(dim=0)
        is_extreme = torch.stack([*map(self.criterion.is_overconfident, evidence)]).any(0)
        return (smallest >= self._noise_margin(is_extreme) * (largest - smallest)).all(1)

    @torch.no_grad()
    def evidence(self, images: Images) -> Float[Tensor, "E V K"]:
        """Compute the evidence of all views, batch by batch."""
        all_images = images.flatten(0, 1)
        criterion = self.criterion.map(of_single_images)

        def compute(rows: slice) -> Tensor:
            return criterion.select(rows).evidence(self._outputs(all_images[rows]))

        with eval_mode(self.model):
            # Without images, an empty batch is shown, because its evidence tells the number K.
            batches = [*self._batch_size.map(compute, len(all_images) or 1)]
        return torch.cat(batches).unflatten(0, images.shape[:2])

    def judge(
        self, images: Images, examples: Examples
    ) -> tuple[Float[Tensor, "E V K"], Bool[Tensor, "E V"], Bool[Tensor, " E"]]:
        """Decide about images that an attack found.

        Return the evidence, a mask of the views that count as a success (`fooled_in_views`), and a
        mask of the examples that reach the criterion without sensor noise.
        """
        evidence = self.evidence(images)
        predicted = self.criterion.predicted(evidence)
        fooled_in_views = self.fooled_in_views(images, predicted, examples)
        return evidence, fooled_in_views, self.criterion.reached(predicted)

    def fooled_in_views(self, images: Images, predicted: Tensor, examples: Examples) -> Tensor:
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
            evidence = self.select(tested).evidence(noisy_images)
            noisy_predicted = criterion.predicted(evidence).to(is_fooled.device)
            # A view must be fooled in every draw of the noise.
            is_fooled[tested] &= criterion.reached_in_views(noisy_predicted)
        return is_fooled


def _image_gradient(cost: Tensor, outputs: Any, batch: SingleImages) -> Tensor:
    """Compute the gradient of the costs with respect to the images."""
    # Detections are lists of several tensors.
    if not isinstance(outputs, Tensor):
        if not cost.requires_grad:
            # A detector that finds nothing returns nothing that depends on the image.
            return torch.zeros_like(batch)
        return _required(gradient_of(cost.sum(), batch))
    output_gradient = _required(gradient_of(cost.sum(), outputs))
    # The gradient of a confident prediction is so small that it would round to zero in a
    # network of half precision. A factor that is a power of two changes no other digits.
    largest = output_gradient.flatten(1).abs().amax(1).clamp(min=MIN_GRADIENT)
    power = (largest / torch.frexp(largest).mantissa).view(-1, *[1] * (outputs.ndim - 1))
    gradient = _required(gradient_of(outputs, batch, output_gradient / power))
    return gradient * power.view(-1, 1, 1, 1)


def _required(gradient: Tensor | None) -> Tensor:
    """Return a gradient, or raise InputError if a network has none."""
    if gradient is None:
        raise InputError(f"the network {NO_GRADIENT}")
    return gradient


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


def _transformed(
    images: SingleImages, settings: EOTSettings, draws: Sequence[Generator]
) -> SingleImages:
    """Transform each image at random, with its own generator.

    A transformation shifts, rotates and scales the image, changes the exposure, adds noise and
    compresses the image as JPEG.
    """

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.stack([torch.rand(shape, generator=each) for each in draws]) - 1

    # Two shifts, a rotation and a relative change of size for each image, shape (N, 4).
    moved = _moved(images, (settings.jitter * uniform(4)).to(images))
    # Change of the exposure in stops. One stop doubles the exposure.
    stops = settings.exposure * uniform(1, 1, 1)
    exposed = clamp(moved * (2**stops).to(images))
    noise = torch.stack([torch.randn(images.shape[1:], generator=each) for each in draws])
    noisy = clamp(exposed + (settings.noise * noise).to(images))
    qualities = [int(torch.randint(settings.jpeg, 101, (), generator=each)) for each in draws]
    return straight_through(noisy, lambda exact: as_jpeg(exact.cpu(), qualities).to(exact))


def as_jpeg(
    images: Float[Tensor, "... 3 H W"], quality: int | Sequence[int]
) -> Float[Tensor, "... 3 H W"]:
    """Compress images as JPEG and decompress them. A quality is from 1 to 100."""
    decompressed = []
    given = to_bytes(images).flatten(0, -4)
    qualities = [quality] * len(given) if isinstance(quality, int) else quality
    for image, chosen in zip(given, qualities, strict=True):
        file = io.BytesIO()
        # pillow has the channels last.
        Image.fromarray(image.permute(1, 2, 0).numpy()).save(file, "JPEG", quality=chosen)
        with Image.open(file) as read:
            decompressed.append(torch.from_numpy(np.array(read)).permute(2, 0, 1))
    return to_unit(torch.stack(decompressed)).view(images.shape)


def _moved(images: Tensor, movements: Float[Tensor, "N 4"]) -> SingleImages:
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
    # Rotations are those of square pixels.
    aspect = images.shape[-1] / images.shape[-2]
    matrices *= matrices.new_tensor([[1, 1 / aspect, 1], [aspect, 1, 1]])
    grid = torch.nn.functional.affine_grid(matrices, list(images.shape), align_corners=False)
    return torch.nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)
