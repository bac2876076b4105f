"""The function `attack_photographs`, which attacks a network through the light on photographs.

No mesh and no label is needed: the class of a photograph is what the network
predicts for it unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from augment.attack_settings import (
    GRADIENT,
    RANDOM_SEARCH,
    AttackSettings,
    RelightingSettings,
    StepSettings,
)
from augment.attacks.loop import Minimum, minimize
from augment.attacks.norm_ball import NormBalls, sample
from augment.attacks.objective import Criterion, Objective
from augment.attacks.optimizers import Gradient, Optimizer
from augment.classifier import Classifier
from augment.network import Network, Quantization, frozen_eval_mode
from augment.plain_networks import (
    UNIT_RANGE,
    Normalization,
    as_classifier,
    device_of,
    gradient_flags_kept,
)
from augment.progress import progress
from augment.projected_light import ProjectedLight, draw_projected_light, require_photographs
from augment.random_streams import generator
from renderer.errors import (
    MAX_MAGNITUDE,
    MAX_SCALE,
    InputError,
    require_choice,
    require_kind,
    require_whole,
)
from renderer.image import decode, to_bytes, to_unit
from renderer.short_repr import ShortRepr

# A photograph is lit by a projector that shows a picture, the slide. These are the names of three
# lights: the slide as it is, the slide multiplied by the best of several random factors, and the
# slide multiplied by factors that gradient descent finds.
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
        cells: Number of cells per side.
        radius: Largest magnitude of a logarithm.
        steps: Number of steps in which an attack may cross the ball.
        generators: Generator of the random factors of each photograph. None to draw none.
    """

    def __init__(
        self,
        albedo: Float[Tensor, "B 3 H W"],
        light: ProjectedLight,
        cells: int,
        radius: float,
        steps: int,
        generators: Sequence[torch.Generator] = (),
    ):
        step_size = max(TRAVELED_RADII * radius / max(steps, 1), 1 / MAX_MAGNITUDE)
        settings = StepSettings("linf", radius, "sign", step_size)
        super().__init__(settings, albedo.new_zeros(len(albedo), 3 * cells**2))
        self.group_size = len(albedo)
        self._albedo = albedo
        self._light = light
        self._cells = cells
        self._generators = generators

    def log_gain(self, values: Float[Tensor, "A D"]) -> Float[Tensor, "A 3 cells cells"]:
        """Return the logarithms of the factors of each channel in each cell."""
        return values.unflatten(1, (3, self._cells, self._cells))

    def render(
        self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A 1 3 H W"]:
        """Show photographs in the light of the projector, each in one view."""
        light = self._light.select(examples)
        return light.expose(self._albedo[examples], self.log_gain(values))[:, None]

    def draw(self, examples: Int[Tensor, " A"]) -> Float[Tensor, "A D"]:
        """Draw random factors of some photographs, whose logarithms are uniform in the ball."""
        drawn = [
            sample(self.settings, self.start[[example]], self._generators[example])
            for example in examples.tolist()
        ]
        return torch.cat(drawn)


class UniformDraws(Optimizer):
    """Independent draws from the norm-ball, of which the best is kept."""

    problem: RelitPhotographs

    def ask(self, rows: Int[Tensor, " N"]) -> Float[Tensor, "N 1 D"]:
        """Draw values of each photograph."""
        return self.problem.draw(self.examples[rows])[:, None]


# Optimizers that search for factors of the slide, by the names of the lights.
OPTIMIZERS: dict[str, type[Optimizer]] = {
    SLIDE: Gradient,
    RANDOM: UniformDraws,
    ADVERSARIAL: Gradient,
}


@dataclass(frozen=True, repr=False)
class PhotographAttackResult(ShortRepr):
    """Predictions of a network for N photographs in the light of a projector.

    The projector shows S random pictures (slides) on each photograph, each in
    three lights, which are the keys of the dictionaries:

    - "slide": the slide as it is,
    - "random": the slide, multiplied by the best of several random factors,
    - "adversarial": the slide, multiplied by factors that gradient descent
      finds. A network without gradients has no such light.

    Attributes:
        classifier: The attacked network.
        photographs: Unchanged photographs, uint8, shape (N, 3, size, size).
        settings: Settings of the attack.
        seed: Seed of the slides, the searches and the noise.
        source: Predicted classes of the unchanged photographs, shape (N,).
        predicted: For each light, the predicted classes of the photographs in
            this light, shape (N, S).
        changed: For each light, a mask of the photographs whose predicted class
            changes, without noise and in each draw of the noise, shape (N, S),
            bool. If the slide as it is changes the class, no factors are
            searched, and the mask is True for all lights.
        log_gain: For each light, the logarithms of the factors of each channel
            in each cell of a grid, shape (N, S, 3, cells, cells).
    """

    classifier: Classifier
    photographs: Tensor
    settings: RelightingSettings
    seed: int
    source: Tensor
    predicted: dict[str, Tensor]
    changed: dict[str, Tensor]
    log_gain: dict[str, Tensor]

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
        require_choice("light", light, self.changed)
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
            Image of 8 bits, uint8, shape (3, size, size).
        """
        chosen = self.photographs[photograph]
        if light == UNCHANGED:
            return chosen
        projected = _draw_lights(self.photographs, [photograph], slide, self.seed)
        log_gain = self.log_gain[light][photograph, slide][None]
        return to_bytes(projected.apply(to_unit(chosen[None]), log_gain))[0]


def attack_photographs(
    network: Classifier | Callable[[Tensor], Tensor],
    photographs: Tensor,
    settings: RelightingSettings | None = None,
    *,
    classes: Sequence[str] | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    sensor_noise: float = 1.0,
    batch_size: int = 32,
    seed: int = 0,
) -> PhotographAttackResult:
    """Attack a network through the light of a projector on photographs.

    A projector shows a random slide (a picture) on each photograph, which is
    treated as a flat print with the shading of a random surface. The slide is
    multiplied by smooth factors. Random search and gradient descent look for
    factors that change the predicted class, with the same number of passes
    through the network. Neither meshes nor labels are needed.

    A change of the predicted class counts if it remains after rounding to 8
    bits and in three draws of sensor noise, as in other attacks.

    Args:
        network: A classifier, or a plain network from images to logits.
        photographs: Photographs of the size of the network, sRGB, uint8, shape
            (N, 3, size, size). Slides show them, too.
        settings: Norm-ball and passes of the attack. None for the defaults.
        classes: Names of the classes of a plain network. None for "0", "1" and
            so on.
        normalization: Normalization of images for a plain network: "imagenet",
            or mean and standard deviation of the channels, as `attack` takes
            it. None if the network takes images in [0, 1], or normalizes them
            itself.
        value_range: Values of black and white that a plain network takes before
            normalization.
        sensor_noise: Standard deviation of the noise, in units of 1/255. 0 for
            no noise.
        batch_size: Number of photographs that the network sees at a time.
        seed: Seed of the slides, the searches and the noise.

    Returns:
        Predictions for all photographs in each light.

    Raises:
        InputError: If the photographs have another dtype or shape, or another
            size than the images of the network.

    Example:
        >>> import norm_balls as nb
        >>> result = nb.attack_photographs(network, photographs,
        ...     normalization="imagenet")  # doctest: +SKIP
        >>> result.kept("adversarial").float().mean()  # doctest: +SKIP
        tensor(0.4100)
    """
    require_photographs("photographs", photographs)
    require_kind("settings", settings, RelightingSettings | None, "RelightingSettings(...) or None")
    require_whole("seed", seed)
    settings = settings or RelightingSettings()
    success_settings = AttackSettings(sensor_noise=sensor_noise, batch_size=batch_size)
    size = photographs.shape[-1]
    with gradient_flags_kept(network):
        classifier = as_classifier(
            network, size, classes, normalization, value_range, device_of(network)
        )
        if classifier.size != size:
            raise InputError(
                f"photographs have {size} pixels per side, "
                f"but the network takes {classifier.size}: resize them",
            )
        attack = _PhotographAttack(classifier, photographs, settings, success_settings, seed)
        return attack.run()


class _PhotographAttack:
    """Attack a network through projected light on photographs, one batch after the other."""

    def __init__(
        self,
        classifier: Classifier,
        photographs: UInt8[Tensor, "N 3 size size"],
        settings: RelightingSettings,
        success_settings: AttackSettings,
        seed: int,
    ):
        """Prepare the attack."""
        self.classifier = classifier
        self.photographs = photographs
        self.settings = settings
        self.success_settings = success_settings
        self.seed = seed
        self.device = device_of(classifier)
        self.model = Network(classifier, [Quantization()])
        has_gradients = classifier.is_differentiable(torch.empty(0, device=self.device))
        self.lights = LIGHTS if has_gradients else LIGHTS[:-1]

    def run(self) -> PhotographAttackResult:
        """Attack all photographs with all slides, which are pictures that a projector shows."""
        count = len(self.photographs)
        shape = (count, self.settings.slides)
        cells = self.settings.cells
        self.source = torch.empty(count, dtype=torch.int64)
        self.predicted = {name: torch.empty(shape, dtype=torch.int64) for name in self.lights}
        self.changed = {name: torch.zeros(shape, dtype=torch.bool) for name in self.lights}
        self.log_gain = {name: torch.zeros(*shape, 3, cells, cells) for name in self.lights}
        batches = torch.arange(count).split(self.success_settings.batch_size)
        with frozen_eval_mode(self.classifier):
            for rows in progress(batches, "relighting photographs", len(batches)):
                with torch.no_grad():
                    logits = self.model(self._load(rows))
                self.source[rows] = logits.argmax(1).cpu()
                for slide in range(self.settings.slides):
                    self._attack_slide(rows, slide)
        return PhotographAttackResult(
            classifier=self.classifier,
            photographs=self.photographs,
            settings=self.settings,
            seed=self.seed,
            source=self.source,
            predicted=self.predicted,
            changed=self.changed,
            log_gain=self.log_gain,
        )

    def _load(self, rows: Int[Tensor, " A"]) -> Float[Tensor, "A 3 size size"]:
        """Return photographs as images in [0, 1] on the device of the network."""
        return to_unit(self.photographs[rows]).to(self.device)

    def _attack_slide(self, rows: Int[Tensor, " B"], slide: int) -> None:
        """Attack a batch of photographs with one slide (a picture of the projector) each.

        First, each photograph is shown in the light of its slide. If it keeps its class, random
        search and gradient descent look for factors of the slide that change the class.
        """
        problem = self._problem(rows, slide)
        # Treat each photograph as an example of one view: the second axis has length 1.
        criterion = Criterion(self.source[rows].to(self.device)[:, None])
        examples = torch.arange(len(rows), device=self.device)
        for light in self.lights:
            objective = Objective(self.classifier, criterion, self._search_settings(light))
            found = minimize(problem, objective, examples=examples, optimizer=OPTIMIZERS[light])
            # If factors are searched, the records of the other lights are replaced later.
            lights = self.lights if light == SLIDE else [light]
            self._record(lights, rows, slide, criterion, found)
            if light == SLIDE:
                is_kept = ~self.changed[SLIDE][rows, slide]
                rows = rows[is_kept]
                examples = examples[is_kept.to(self.device)]
                criterion = criterion.select(is_kept.to(self.device))
            if not len(rows):
                return

    def _problem(self, rows: Int[Tensor, " B"], slide: int) -> RelitPhotographs:
        """Show photographs in the light of a slide each.

        Each photograph has random numbers of its own, so that its light and its factors do not
        depend on the other photographs.
        """
        indices = rows.tolist()
        return RelitPhotographs(
            decode(self._load(rows), "srgb"),
            _draw_lights(self.photographs, indices, slide, self.seed).to(self.device),
            self.settings.cells,
            self.settings.radius,
            self.settings.steps,
            [generator(self.seed, "factors", index, slide) for index in indices],
        )

    def _search_settings(self, light: str) -> AttackSettings:
        """Return settings of a search that uses all passes, since no search reaches its margin.

        The slide as it is takes no step.
        """
        return replace(
            self.success_settings,
            optimizer=RANDOM_SEARCH if light == RANDOM else GRADIENT,
            max_steps=0 if light == SLIDE else self.settings.steps,
            max_queries=self.settings.passes,
            margin=MAX_SCALE,
            sensor_noise=0.0,
        )

    def _record(
        self,
        lights: Sequence[str],
        rows: Int[Tensor, " A"],
        slide: int,
        criterion: Criterion,
        found: Minimum,
    ) -> None:
        """Record predictions of photographs in the result, and whether they hold with noise.

        `lights` are keys of the results: "slide", "random" or "adversarial".
        """
        # Index of the sensor noise, which differs for each pair of a photograph and a slide.
        noise_indices = rows * self.settings.slides + slide
        objective = Objective(self.classifier, criterion, self.success_settings, self.seed)
        is_changed = objective.fooled_in_views(found.images, found.predicted, noise_indices)
        for light in lights:
            self.predicted[light][rows, slide] = found.predicted[:, 0].cpu()
            self.changed[light][rows, slide] = is_changed[:, 0].cpu()
            log_gain = found.values.cpu().view_as(self.log_gain[light][rows, slide])
            self.log_gain[light][rows, slide] = log_gain


def _draw_lights(
    photographs: UInt8[Tensor, "N 3 size size"], rows: Sequence[int], slide: int, seed: int
) -> ProjectedLight:
    """Draw the random light of a projector on some photographs.

    The light on a photograph depends on the index of the photograph, on `slide` and on the seed,
    but not on the other photographs.
    """
    size = photographs.shape[-1]
    lights = []
    for row in rows:
        draws = generator(seed, "light", row, slide)
        lights.append(draw_projected_light(1, size, draws, photographs))
    return ProjectedLight.join(lights)
