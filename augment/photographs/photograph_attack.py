"""The function `attack_photographs`, which attacks a network through the light on photographs.

No mesh and no label is needed: the class of a photograph is what the network
predicts for it unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from augment.attack_settings import AttackSettings, RelightingSettings
from augment.attacks.attack import fooled_in_views
from augment.attacks.descent import Criterion
from augment.attacks.eot import Quantized
from augment.classifiers.adapter import Classifier
from augment.classifiers.plain_networks import (
    UNIT_RANGE,
    Normalization,
    as_classifier,
    device_of,
    gradient_flags_kept,
)
from augment.model_passes import frozen_eval_mode
from augment.photographs.gain import Best, descend_gain, draw_log_gain, search_gain
from augment.photographs.projected_light import (
    ProjectedLight,
    draw_projected_light,
    require_photographs,
)
from augment.progress import progress
from augment.random_streams import generator
from renderer.errors import InputError
from renderer.image import decode, to_bytes, to_unit
from renderer.validation import require_kind, require_seed

# Keys of the results: the light of the slide as it is, with the best of several random factors,
# and with factors that the gradient finds. `UNCHANGED` names the photograph without a projector
# in `PhotographAttackResult.image`.
SLIDE = "slide"
RANDOM = "random"
ADVERSARIAL = "adversarial"
LIGHTS = (SLIDE, RANDOM, ADVERSARIAL)
UNCHANGED = "unchanged"


@dataclass(frozen=True)
class PhotographAttackResult:
    """Predictions of a network for photographs in the light of a projector.

    The dictionaries have the keys "slide" (a random slide), "random" (the slide
    with the best of several random factors) and "adversarial" (the slide with
    factors that the gradient finds). A network without gradients has no
    "adversarial". S is the number of slides for each photograph.

    Attributes:
        classifier: The attacked network.
        photographs: Unchanged photographs, uint8, shape (N, 3, size, size).
        settings: Settings of the attack.
        seed: Seed of the slides, the searches and the noise.
        source: Predicted classes of the unchanged photographs, shape (N,).
        predicted: Predicted classes of the relit photographs, shape (N, S), for
            each light.
        changed: Mask of the relit photographs with another predicted class,
            without noise and with each draw of the noise, shape (N, S), bool,
            for each light. If the slide as it is changes the class, the
            searches count as successful, too.
        log_gain: Logarithms of the factors of each light, shape
            (N, S, 3, cells, cells).
    """

    classifier: Classifier
    photographs: Tensor
    settings: RelightingSettings
    seed: int
    source: Tensor
    predicted: dict[str, Tensor]
    changed: dict[str, Tensor]
    log_gain: dict[str, Tensor]

    def kept(self, light: str = ADVERSARIAL) -> Tensor:
        """Return a mask of the photographs that keep their class under all of their slides.

        Args:
            light: "slide", "random" or "adversarial".

        Returns:
            Mask, bool, shape (N,).
        """
        return ~self.changed[light].any(1)

    def image(self, photograph: int, light: str, slide: int = 0) -> Tensor:
        """Return a photograph in one of its lights.

        Args:
            photograph: Index of the photograph.
            light: "unchanged", "slide", "random" or "adversarial".
            slide: Index of the slide.

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

    A projector shows a random slide on each photograph, which is treated as a
    flat print with the shading of a random surface. Two searches change the
    slide by smooth factors: random search, and the gradient at the same number
    of passes through the network. Neither meshes nor labels are needed.

    As in other attacks, a change of the predicted class counts if it remains
    after rounding to 8 bits and in three draws of sensor noise.

    Args:
        network: A classifier, or a plain network from images to logits.
        photographs: Photographs of the size of the network, sRGB, uint8, shape
            (N, 3, size, size). Slides show them, too.
        settings: Norm-ball and passes of the attack. None for the defaults.
        classes: Names of the classes of a plain network. None for "0", "1" and
            so on.
        normalization: "imagenet", or mean and standard deviation, as `attack`
            takes it.
        value_range: Values of black and white that a plain network takes before
            normalization.
        sensor_noise: Standard deviation of the noise, in steps of 8 bits. 0
            for none.
        batch_size: Photographs per pass.
        seed: Seed of the slides, the searches and the noise.

    Returns:
        Predictions for all photographs under each light.

    Raises:
        InputError: If the photographs are no such tensor, or do not fit the
            network.

    Example:
        >>> import norm_balls as nb
        >>> result = nb.attack_photographs(network, photographs,
        ...     normalization="imagenet")  # doctest: +SKIP
        >>> result.kept("adversarial").float().mean()  # doctest: +SKIP
        tensor(0.4100)
    """
    require_photographs("photographs", photographs)
    require_kind("settings", settings, RelightingSettings | None, "RelightingSettings(...) or None")
    require_seed("seed", seed)
    settings = settings or RelightingSettings()
    counting = AttackSettings(sensor_noise=sensor_noise, batch_size=batch_size)
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
        attack = _PhotographAttack(classifier, photographs, settings, counting, seed)
        return attack.run()


class _PhotographAttack:
    """Attack on all photographs, one batch after the other.

    Args:
        classifier: The attacked network.
        photographs: Photographs, uint8, shape (N, 3, size, size).
        settings: Settings of the searches.
        counting: Sensor noise and batch size.
        seed: Seed of all draws.
    """

    def __init__(
        self,
        classifier: Classifier,
        photographs: Tensor,
        settings: RelightingSettings,
        counting: AttackSettings,
        seed: int,
    ):
        self.classifier = classifier
        self.photographs = photographs
        self.settings = settings
        self.counting = counting
        self.seed = seed
        self.device = device_of(classifier)
        self.model = Quantized(classifier)
        self.lights = LIGHTS if classifier.has_gradients else LIGHTS[:-1]

    def run(self) -> PhotographAttackResult:
        """Attack all photographs under all slides."""
        count = len(self.photographs)
        shape = (count, self.settings.slides)
        cells = self.settings.cells
        self.source = torch.empty(count, dtype=torch.int64)
        self.predicted = {name: torch.empty(shape, dtype=torch.int64) for name in self.lights}
        self.changed = {name: torch.zeros(shape, dtype=torch.bool) for name in self.lights}
        self.log_gain = {name: torch.zeros(*shape, 3, cells, cells) for name in self.lights}
        batches = torch.arange(count).split(self.counting.batch_size)
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

    def _load(self, rows: Tensor) -> Tensor:
        """Return photographs with the given indices as images on the device of the network.

        Args:
            rows: Indices of the photographs, shape (A,).

        Returns:
            Images in [0, 1], shape (A, 3, size, size).
        """
        return to_unit(self.photographs[rows]).to(self.device)

    def _attack_slide(self, rows: Tensor, slide: int) -> None:
        """Show a slide on photographs, and search factors for those that keep their class.

        Args:
            rows: Indices of the photographs of a batch, shape (B,).
            slide: Index of the slide of each photograph.
        """
        # The slide as it is has the factor 1, whose logarithm is 0. Its predictions are recorded
        # for all lights, and replaced below for the photographs that are searched.
        no_gain = self.log_gain[SLIDE][rows, slide]
        for light in self.lights:
            self._count(light, rows, slide, no_gain)
        left = rows[~self.changed[SLIDE][rows, slide]]
        if not len(left):
            return
        log_gain_of_light = {RANDOM: self._search_randomly(left, slide)}
        if ADVERSARIAL in self.lights:
            log_gain_of_light[ADVERSARIAL] = self._descend(left, slide)
        for light, log_gain in log_gain_of_light.items():
            self._count(light, left, slide, log_gain)

    def _light(self, rows: Tensor, slide: int) -> ProjectedLight:
        """Draw the light of a slide on the photographs with the given indices (A,)."""
        lights = _draw_lights(self.photographs, rows.tolist(), slide, self.seed)
        return lights.to(self.device)

    def _search_randomly(self, rows: Tensor, slide: int) -> Tensor:
        """Search for factors of a slide by random draws.

        Args:
            rows: Indices of the photographs, shape (A,).
            slide: Index of the slide of each photograph.

        Returns:
            Logarithms of the best factors, shape (A, 3, cells, cells).
        """
        # Each photograph has a generator of its own, so its factors do not depend on the batch.
        generators = [generator(self.seed, "factors", row, slide) for row in rows.tolist()]
        candidates = []
        for _ in range(self.settings.passes):
            drawn = [
                draw_log_gain(1, self.settings.cells, self.settings.radius, draws)
                for draws in generators
            ]
            candidates.append(torch.cat(drawn).to(self.device))
        albedo = decode(self._load(rows), "srgb")
        light = self._light(rows, slide)
        source = self.source[rows].to(self.device)
        return search_gain(self.model, albedo, light, source, candidates).cpu()

    def _descend(self, rows: Tensor, slide: int) -> Tensor:
        """Search for factors of a slide by gradient descent.

        Args:
            rows: Indices of the photographs, shape (A,).
            slide: Index of the slide of each photograph.

        Returns:
            Logarithms of the best factors of all steps, shape (A, 3, cells, cells).
        """
        albedo = decode(self._load(rows), "srgb")
        light = self._light(rows, slide)
        source = self.source[rows].to(self.device)
        start = torch.zeros_like(self.log_gain[ADVERSARIAL][rows, slide]).to(self.device)
        best = Best(start)
        last = descend_gain(
            self.model,
            albedo,
            light,
            source,
            start,
            self.settings.radius,
            self.settings.steps,
            best,
        )
        # `descend_gain` has not classified the factors of its last step.
        with torch.no_grad():
            best.update(last, self.model(light.expose(albedo, last)), source)
        return best.log_gain.cpu()

    @torch.no_grad()
    def _count(self, light: str, rows: Tensor, slide: int, log_gain: Tensor) -> None:
        """Record the predictions under a light, and which photographs change their class.

        Args:
            light: Key of the results: "slide", "random" or "adversarial".
            rows: Indices of the photographs, shape (A,).
            slide: Index of the slide of each photograph.
            log_gain: Logarithms of the factors of the slide, shape (A, 3, cells, cells).
        """
        relit = self._light(rows, slide).apply(self._load(rows), log_gain.to(self.device))
        predicted = self.model(relit).argmax(1)
        # `fooled_in_views` expects examples of several views. A photograph has one view.
        criterion = Criterion(self.source[rows].to(self.device)[:, None])
        # Each pair of a photograph and a slide has sensor noise of its own.
        noise_indices = rows * self.settings.slides + slide
        is_changed = fooled_in_views(
            self.model,
            relit[:, None],
            predicted[:, None],
            noise_indices,
            criterion,
            self.counting,
            self.seed,
        )
        self.predicted[light][rows, slide] = predicted.cpu()
        self.changed[light][rows, slide] = is_changed[:, 0].cpu()
        self.log_gain[light][rows, slide] = log_gain


def _draw_lights(photographs: Tensor, rows: Sequence[int], slide: int, seed: int) -> ProjectedLight:
    """Draw the light of a slide on some photographs.

    Args:
        photographs: All N photographs, uint8, shape (N, 3, size, size). Slides may show them.
        rows: Indices of the photographs that are lit.
        slide: Index of the slide of each photograph.
        seed: Seed of the attack.

    Returns:
        One light for each index. It depends on this index, `slide` and the seed, and not on the
        other indices.
    """
    size = photographs.shape[-1]
    lights = []
    for row in rows:
        draws = generator(seed, "light", row, slide)
        lights.append(draw_projected_light(1, size, draws, photographs))
    return ProjectedLight(
        slide=torch.cat([light.slide for light in lights]),
        shading=torch.cat([light.shading for light in lights]),
        ambient=torch.cat([light.ambient for light in lights]),
        stops=torch.cat([light.stops for light in lights]),
    )
