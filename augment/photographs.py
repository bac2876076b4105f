"""Photographs in the light of a projector, and the attack on a network through this light.

A photograph is treated as a flat print, whose linear values are its albedo. A projector shows a
slide (a picture) on it. The light is multiplied by the shading of a random smooth surface and, in
attacks, by smooth factors (gain). Weak ambient light is added, and a camera exposes the result:

    radiance = albedo · (slide · gain · shading + ambient)

There are no shadows, no reflections and no depth. No mesh and no label is needed: the class of a
photograph is what the network predicts for it unchanged. What a detector or a segmenter finds in
unchanged photographs is attacked one by one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Generator, Tensor

from augment import network as wrappers
from augment.attack_settings import RANDOM_SEARCH, AttackSettings, RelightingSettings, StepSettings
from augment.attacks.loop import minimize
from augment.attacks.objective import Examples, Objective, preprocessed_model
from augment.attacks.optimizers import NormBalls, Optimizer
from augment.classifier import MAX_PROBED, UNIT_RANGE, Normalization, TaskNetwork, as_network
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.patterns import ProjectedLight, as_photographs, draw_projected_light
from augment.tasks.task import Criterion, Task
from renderer import errors
from renderer.errors import InputError
from renderer.image import decode, to_bytes, to_unit
from renderer.settings import as_size

# Names of three lights: the slide as it is, the slide multiplied by the best of several random
# factors, and the slide multiplied by factors that gradient descent finds.
SLIDE = "slide"
RANDOM = "random"
ADVERSARIAL = "adversarial"
LIGHTS = (SLIDE, RANDOM, ADVERSARIAL)
# Name of the light of the photograph itself, without a projector.
UNCHANGED = "unchanged"
# Total length of all steps of an attack, in units of the radius of the norm-ball. It is more than
# the diameter, so that the steps can cross the ball from any start (Madry et al. 2018).
TRAVELED_RADII = 2.5


class RelitPhotographs(NormBalls):
    """Photographs in the light of a projector, whose slide an attack multiplies by factors.

    The factors are one for each color channel in each cell of a grid. The attacked values are their
    logarithms, in an L∞ ball around 0.

    Args:
        albedo: Photographs, as linear light.
        light: Light of the projector, with a slide for each photograph.
        settings: Number of cells, radius, and steps in which an attack may cross the ball.
        generators: Generator of the random factors of each photograph. None to draw none.
    """

    def __init__(
        self,
        albedo: Float[Tensor, "B 3 H W"],
        light: ProjectedLight,
        settings: RelightingSettings,
        generators: Sequence[Generator] = (),
    ):
        # All steps together can cross the norm-ball. `StepSettings` refuses a step of 0.
        step_size = TRAVELED_RADII * settings.radius / max(settings.steps, 1)
        step_size = max(step_size, 1 / errors.MAX_MAGNITUDE)
        ball = StepSettings("linf", settings.radius, "sign", step_size)
        super().__init__(ball, albedo.new_zeros(len(albedo), 3 * settings.cells**2))
        self.group_size = len(albedo)
        self._albedo = albedo
        self._light = light
        self._cells = settings.cells
        self.generators = generators

    def log_gain(self, values: Float[Tensor, "A D"]) -> Float[Tensor, "A 3 cells cells"]:
        """Return the logarithms of the factors of each channel in each cell."""
        return values.unflatten(1, (3, self._cells, self._cells))

    def render(self, values: Float[Tensor, "A D"], examples: Examples) -> Tensor:
        """Show photographs in the light of the projector, each in one view."""
        light = ProjectedLight(*(values[examples] for values in self._light))
        return light.expose(self._albedo[examples], self.log_gain(values))[:, None]


class UniformDraws(Optimizer):
    """Independent draws from the norm-ball, of which the best is kept."""

    problem: RelitPhotographs

    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N 1 D"]:
        """Draw factors of each photograph, whose logarithms are uniform in the ball."""
        problem, examples = self.problem, self.examples[rows].tolist()
        return torch.stack([problem.draw(problem.generators[row], [row]) for row in examples])


@dataclass(frozen=True, repr=False)
class PhotographAttackResult(errors.ShortRepr):
    """Predictions of a network for N photographs in the light of a projector.

    For a detector or a segmenter, a photograph is counted once for each of its
    detections or segments in unchanged light. A photograph without any is left
    out.

    The projector shows S random pictures (slides) on each photograph, each in
    three lights, which are the keys of the dictionaries:

    - "slide": the slide as it is,
    - "random": the slide, multiplied by the best of several random factors,
    - "adversarial": the slide, multiplied by factors that gradient descent
      finds. A network without gradients has no such light.

    Attributes:
        classifier: The attacked network.
        photographs: Unchanged photographs, uint8, shape (N, 3, height, width).
        index: Index of each photograph in the list that was given, shape (N,).
        criterion: What an attack changes in each photograph.
        settings: Settings of the attack.
        seed: Seed of the slides, the searches and the noise.
        predicted: For each light, the predicted classes of the photographs in
            this light, shape (N, S). The number of classes stands for nothing.
        changed: For each light, a mask of the photographs whose predicted class
            changes, without noise and in each draw of the noise, shape (N, S),
            bool. If the slide as it is changes the class, no factors are
            searched, and the mask is True for all lights.
        log_gain: For each light, the logarithms of the factors of each channel
            in each cell of a grid, shape (N, S, 3, cells, cells).
    """

    classifier: TaskNetwork
    photographs: Tensor
    index: Tensor
    criterion: Criterion
    settings: RelightingSettings
    seed: int
    predicted: dict[str, Tensor]
    changed: dict[str, Tensor]
    log_gain: dict[str, Tensor]

    @property
    def source(self) -> Tensor:
        """Predicted classes of the unchanged photographs, shape (N,)."""
        return self.criterion.source[:, 0]

    def kept(self, light: str | None = None) -> Tensor:
        """Return a mask of the photographs that keep their class in the light of every slide.

        A slide is a picture that the projector shows on a photograph.

        Args:
            light: "slide" (slides as they are), "random" (slides with random
                factors) or "adversarial" (slides with factors of an attack). None
                for "adversarial", or for "random" if the network has no gradients.

        Returns:
            Mask, bool, shape (N,).

        Raises:
            InputError: If the result has no such light.
        """
        # The last light is the strongest.
        light = [*self.changed][-1] if light is None else light
        errors.require_choice("light", light, self.changed)
        return ~self.changed[light].any(1)

    def image(self, photograph: int, light: str, slide: int = 0) -> Tensor:
        """Return a photograph in the light of the projector.

        Args:
            photograph: Index of the photograph.
            light: "slide" (the slide as it is), "random" (the slide with random
                factors), "adversarial" (the slide with factors of an attack) or
                "unchanged" (no projector).
            slide: Index of the slide, which is the picture that the projector
                shows.

        Returns:
            Image of 8 bits, uint8, shape (3, height, width).
        """
        chosen = self.photographs[photograph]
        if light == UNCHANGED:
            return chosen
        projected = _draw_lights(self, [photograph], slide)
        log_gain = self.log_gain[light][photograph, slide][None]
        return to_bytes(projected.expose(decode(to_unit(chosen[None]), "srgb"), log_gain))[0]


@torch.inference_mode(False)  # Attacks need autograd.
def attack_photographs(
    network: TaskNetwork | Callable[[Tensor], Any],
    photographs: Tensor | np.ndarray,
    settings: RelightingSettings | None = None,
    *,
    classes: Sequence[str] | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    sensor_noise: float = 1.0,
    batch_size: int = 32,
    task: Task | None = None,
    limit: int | None = None,
    seed: int = 0,
) -> PhotographAttackResult:
    """Attack a network through the light of a projector on photographs.

    A projector shows a random slide (a picture) on each photograph, which is
    treated as a flat print with the shading of a random surface. The slide is
    multiplied by smooth factors. Random search and gradient descent look for
    factors that change the predicted class, with the same number of passes
    through the network. Neither meshes nor labels are needed.

    For a detector or a segmenter, what it finds in an unchanged photograph is
    the truth. Each detection or segment is attacked by itself.

    A change of the predicted class counts if it remains after rounding to 8
    bits and in three draws of sensor noise, as in other attacks.

    Args:
        network: A classifier, a detector or a segmenter, or a plain network from
            images to their outputs.
        photographs: Photographs of the size of the network, sRGB, uint8, shape
            (N, 3, height, width). Slides show them, too.
        settings: Norm-ball and passes of the attack. None for the defaults.
        classes: Names of the classes of a plain network. None for "0", "1" and
            so on, or for the names that the network has.
        normalization: Normalization of images for a plain network: "imagenet",
            or mean and standard deviation of the channels, as `attack` takes
            it. None if the network takes images in [0, 1], or normalizes them
            itself.
        value_range: Values of black and white that a plain network takes before
            normalization.
        sensor_noise: Standard deviation of the noise, in units of 1/255. 0 for
            no noise.
        batch_size: Number of photographs that the network sees at a time.
        task: Task of the network, such as `nb.Detection(threshold=0.3)`. None if
            its outputs tell.
        limit: Number of photographs, detections or segments that are attacked,
            at equal distances in the list of all. None to attack all.
        seed: Seed of the slides, the searches and the noise.

    Returns:
        Predictions for all photographs in each light.

    Raises:
        InputError: If the photographs have another dtype or shape, or another
            size than the images of the network, or if it finds nothing in them.

    Example:
        >>> import norm_balls as nb
        >>> result = nb.attack_photographs(network, photographs,
        ...     normalization="imagenet")  # doctest: +SKIP
        >>> result.kept("adversarial").float().mean()  # doctest: +SKIP
        tensor(0.4100)
    """
    photographs = as_photographs("photographs", photographs)
    settings = RelightingSettings.or_default("settings", settings)
    errors.require_whole("seed", seed)
    if limit is not None:
        errors.require_whole("limit", limit, 1)
    success_settings = AttackSettings(sensor_noise=sensor_noise, batch_size=batch_size)
    size = as_size("photographs", photographs.shape[-2:])
    with wrappers.gradient_flags_kept(network):
        given = size, classes, normalization, value_range, wrappers.device_of(network)
        classifier = as_network(network, *given, task=task, size_from="the photographs")
        if classifier.size != size:
            reason = f"photographs have the size {size} in pixels"
            raise InputError(f"{reason}, but the network takes {classifier.size}: resize them")
        return _attack(classifier, photographs, settings, success_settings, limit, seed)


def _attack(
    classifier: TaskNetwork,
    photographs: UInt8[Tensor, "N 3 height width"],
    settings: RelightingSettings,
    success: AttackSettings,
    limit: int | None,
    seed: int,
) -> PhotographAttackResult:
    """Attack all photographs with all slides, one batch after the other."""
    device = wrappers.device_of(classifier)
    probed = to_unit(photographs[:MAX_PROBED]).to(device)
    # A network without gradients has no adversarial light, which is the last one.
    lights = LIGHTS if classifier.is_differentiable(lambda: probed) else LIGHTS[:-1]
    with wrappers.frozen_eval_mode(classifier):
        quantizing = preprocessed_model(success, classifier)
        outputs = wrappers.compute_outputs(quantizing, photographs, success.batch_size, device)
    # Index of the photograph of each attacked finding, and what the network finds there.
    index, criterion = classifier.task.as_found(outputs, classifier.classes)
    if len(photographs) and not len(index):
        found, count = classifier.task.finds[0], len(photographs)
        raise InputError(f"{classifier.title} has no {found} in {count} photographs: give others")
    if limit is not None and limit < len(index):
        chosen = wrappers.evenly_spaced(len(index), limit)
        index, criterion = index[chosen], criterion.select(chosen.to(device))
    shape = (len(index), settings.slides)
    shape_of_gains = (*shape, 3, settings.cells, settings.cells)
    result = PhotographAttackResult(
        classifier=classifier,
        photographs=photographs[index],
        index=index,
        criterion=criterion.map(Tensor.cpu),
        settings=settings,
        seed=seed,
        predicted={light: torch.empty(shape, dtype=torch.int64) for light in lights},
        changed={light: torch.zeros(shape, dtype=torch.bool) for light in lights},
        log_gain={light: torch.zeros(shape_of_gains, dtype=torch.float32) for light in lights},
    )
    batches = torch.arange(len(index)).split(success.batch_size)
    with wrappers.frozen_eval_mode(classifier):
        for rows in progress(batches, "relighting photographs", len(batches)):
            images = to_unit(result.photographs[rows]).to(device)
            for slide in range(settings.slides):
                _attack_slide(result, success, images, rows, slide)
    return result


def _attack_slide(
    result: PhotographAttackResult,
    success: AttackSettings,
    images: Tensor,
    rows: Examples,
    slide: int,
) -> None:
    """Attack a batch of photographs with one slide each, and record what is found in the result.

    If a photograph keeps its class in the light of its slide, random search and gradient descent
    look for factors of the slide that change it. Each photograph has random numbers of its own.
    """
    settings = result.settings
    indices = rows.tolist()
    light_of_slide = _draw_lights(result, indices, slide).to(images.device)
    draws = [generator(result.seed, "factors", index, slide) for index in indices]
    problem = RelitPhotographs(decode(images, "srgb"), light_of_slide, settings, draws)
    criterion = result.criterion.select(rows).map(lambda values: values.to(images.device))
    examples = torch.arange(len(rows), device=images.device)
    for light in result.changed:
        # No search reaches this margin, so each uses all passes. The slide as it is takes no step.
        is_random = light == RANDOM
        search = replace(
            success,
            optimizer=RANDOM_SEARCH if is_random else None,
            max_steps=0 if light == SLIDE else settings.steps,
            max_queries=settings.passes,
            margin=errors.MAX_SCALE,
            sensor_noise=0.0,
        )
        objective = Objective(result.classifier, criterion, search)
        optimizer = UniformDraws if is_random else None
        minimum = minimize(problem, objective, examples=examples, optimizer=optimizer)
        # The sensor noise differs for each pair of a photograph and a slide.
        noise_indices = rows * settings.slides + slide
        noisy = Objective(result.classifier, criterion, success, result.seed)
        is_changed = noisy.fooled_in_views(minimum.images, minimum.predicted, noise_indices)[:, 0]
        # If factors are searched, the records of the other lights are replaced later.
        for name in result.changed if light == SLIDE else [light]:
            result.predicted[name][rows, slide] = minimum.predicted[:, 0].cpu()
            result.changed[name][rows, slide] = is_changed.cpu()
            log_gain = minimum.values.cpu().view_as(result.log_gain[name][rows, slide])
            result.log_gain[name][rows, slide] = log_gain
        if light == SLIDE:
            # Only photographs that keep their class in the light of the slide are attacked.
            criterion = criterion.select(~is_changed)
            examples = examples[~is_changed]
            rows = rows[~is_changed.cpu()]
            if not len(rows):
                return


def _draw_lights(result: PhotographAttackResult, rows: Sequence[int], slide: int) -> ProjectedLight:
    """Draw random projector light that depends on the index of a photograph, slide and seed."""
    shape = result.photographs.shape[-2:]
    indices = result.index[list(rows)].tolist()
    streams = [generator(result.seed, "light", index, slide) for index in indices]
    lights = [draw_projected_light(1, shape, draws, result.photographs) for draws in streams]
    return ProjectedLight(*map(torch.cat, zip(*lights, strict=True)))
