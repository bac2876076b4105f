"""One call that attacks a classifier through a scene: its settings and its result."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from numbers import Integral
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from augment.attacks.adversary import Adversary
from augment.attacks.descent import DescentResult, Goal, descend
from augment.attacks.eot import EOTSettings, Rounded, stored
from augment.attacks.norm_ball import StepSettings
from augment.attacks.parameters import (
    PARAMETERS,
    AttackProblem,
    MaterialSettings,
    PoseSettings,
    SkylightSettings,
    lighting,
)
from augment.batches import BatchSize
from augment.classifiers.adapter import Classifier, class_index, require_classifier
from augment.degree import NOTICED, with_needed_degree
from augment.losses import logit_gap
from augment.progress import Phases, progress
from augment.random_streams import generator
from augment.scene import Conditions, Scene
from renderer.errors import FACTOR, InputError, require_range
from renderer.light.basis import parts_of
from renderer.light.harmonics import irradiance_error
from renderer.validation import (
    as_list,
    is_whole,
    require_field_types,
    require_flag,
    require_kind,
    require_seed,
)

LEAST_LIKELY = "least_likely"  # in place of a target class
MOST_NOISE = 255.0  # steps of 8 bits: the whole range of values
UNSTEADY = ("pose", "material")  # whose adversaries often end where noise still decides
NOISE_MARGIN = 2.0  # times the range of the leads with noise and without


@dataclass
class AttackSettings:
    """What an attack changes, and how it descends. The defaults are careful: the light stays physically possible, and a
    success survives a camera's noise and 8 bits; the paper has allow_negative=True, margin=0, rounded=False and
    sensor_noise=0.

    lighting, skylight, projector, lamps, positions (of lamps), geometry, pose, material, albedo, pixels: norm-ball and
    steps of each parameter; None leaves it as it is.
    max_steps: renders after the first; the paper's appendix C has 30. shorten: undo a step that did not lower the cost,
    and try half its length, since the gradient of geometry holds visibility fixed. restarts: further starts, drawn from
    the norm-balls, for examples without success. margin: stop an example once its logits lead by this margin, in every
    view. rounded: the classifier gets images of 8 bits. eot: descend on the mean over random transformations.
    sensor_noise: a success counts if it remains in each of three images that a camera stores, with Gaussian noise of
    this standard deviation before they are rounded to 8 bits, in steps of 8 bits (1/255); 0 counts without noise. It is
    counted once, at the end. noise_margin: an example also goes on until its least lead, with such noise and without,
    is this many times the range of these leads; None is 2 where pose or material is attacked, and 0 otherwise.
    allow_negative: any coefficients of light. If False, the light is first made one that something can emit (of
    harmonics: radiance nowhere negative, of the same mean and the most alike irradiance), whatever is attacked. Each
    step on the light then ends in the nearest such coefficients, whose mean may differ from what the step asked for.
    batch_size: images per pass through the classifier, fewer where memory runs out.
    """

    lighting: StepSettings | None = None
    skylight: SkylightSettings | None = None
    projector: StepSettings | None = None
    lamps: StepSettings | None = None
    positions: StepSettings | None = None
    geometry: StepSettings | None = None
    pose: PoseSettings | None = None
    material: MaterialSettings | None = None
    albedo: StepSettings | None = None
    pixels: StepSettings | None = None
    max_steps: int = 30
    shorten: bool = False
    restarts: int = 0
    margin: float = 2.0
    rounded: bool = True
    sensor_noise: float = 1.0
    noise_margin: float | None = None
    eot: EOTSettings = field(default_factory=EOTSettings)
    allow_negative: bool = False
    batch_size: int = 32

    def __post_init__(self) -> None:
        require_field_types(self)
        require_range("max_steps", self.max_steps, 0, 10**6)
        require_range("restarts", self.restarts, 0, 10**6)
        require_range("margin", self.margin, 0, FACTOR)
        require_range("sensor_noise", self.sensor_noise, 0, MOST_NOISE)
        require_range("noise_margin", self.noise_margin, 0, FACTOR)
        require_range("batch_size", self.batch_size, 1, 10**6)
        if self.lighting and self.skylight:
            raise InputError("lighting and skylight both set the light: choose one of them")
        unlimited = any(settings.radius is None for settings in self.parameters.values())
        if self.restarts and unlimited:
            raise InputError("restarts draws from the norm-balls: set the radius of every parameter, or restarts=0")

    @property
    def parameters(self) -> dict[str, StepSettings]:
        """The settings of the parameters to change, by name."""
        return {name: settings for name in PARAMETERS if (settings := getattr(self, name)) is not None}

    @property
    def lead_over_noise(self) -> float:
        """The `noise_margin` in use: 0 where the noise is not to be asked about."""
        if not self.sensor_noise:
            return 0.0
        if self.noise_margin is not None:
            return self.noise_margin
        return NOISE_MARGIN if any(name in UNSTEADY for name in self.parameters) else 0.0

    def require_parameters(self) -> None:
        """InputError where nothing is to be changed."""
        if not self.parameters:
            raise InputError(f"attack: name what to change, such as attack=lighting; there are {', '.join(PARAMETERS)}")

    def preprocessed_model(self, classifier: nn.Module) -> nn.Module:
        """The classifier, behind rounding to 8 bits if the images are rounded."""
        return Rounded(classifier) if self.rounded else classifier

    def problem(self, scene: Scene) -> AttackProblem:
        """The parameters to change of a scene, whose light is made physically possible unless it may be negative."""
        if not self.allow_negative:
            scene = replace(scene, lights=scene.basis.project_nonnegative(scene.lights))
        make = PARAMETERS | {"lighting": partial(lighting, nonnegative=not self.allow_negative)}
        return AttackProblem(scene, [make[name](scene, settings) for name, settings in self.parameters.items()])


@dataclass(frozen=True)
class AttackResult:
    """The result of an attack on E examples of V views, a value: `augment.check`, `augment.success_by_radius`,
    `augment.transfer` and `augment.save` take it.

    images_before, images: (E, V, 3, size, size), not rounded, with the shadows and bounces of each shape in its own
    colors. logits_before, logits: (E, V, C), of the preprocessed images. success: (E,) bool, whether the goal is
    reached in every view, as `fooled_in_views` counts it; success_without_noise: by these logits alone;
    success_with_margin: a success that also leads by `settings.margin` or more in these logits. descent: where the
    descent ended, whose own success is by its images alone; while shape and colors change, it holds shadows and bounces
    fixed. seconds: of the descent.
    """

    problem: AttackProblem
    classifier: Classifier
    goal: Goal
    settings: AttackSettings
    seed: int
    images_before: Tensor
    images: Tensor
    logits_before: Tensor
    logits: Tensor
    success_in_views: Tensor
    descent: DescentResult
    seconds: dict[str, float]

    @property
    def preprocessed_model(self) -> nn.Module:
        """See `AttackSettings.preprocessed_model`."""
        return self.settings.preprocessed_model(self.classifier)

    @property
    def success(self) -> Tensor:
        """(E,) bool: whether the criterion is met in every view, also with the noise of a sensor."""
        return self.success_in_views.all(1)

    @property
    def success_without_noise(self) -> Tensor:
        """(E,) bool: whether the criterion is met in every view, by the images as the classifier gets them."""
        return self.goal.reached(self.logits.argmax(2))

    @property
    def success_with_margin(self) -> Tensor:
        """(E,) bool: whether the logits lead by `settings.margin`, too, in every view."""
        gaps = logit_gap(self.logits, self.goal.source, self.goal.target)
        return self.success & (gaps >= self.settings.margin).all(1)

    @property
    def success_before(self) -> Tensor:
        """(E,) bool: whether the criterion was met in every view before the attack."""
        return self.goal.reached(self.logits_before.argmax(2))

    @property
    def clean_correct(self) -> Tensor:
        """(E,) bool: whether every view was classified correctly before, so that success is the attack's merit."""
        return (self.logits_before.argmax(2) == self.goal.source).all(1)

    @property
    def steps(self) -> Tensor:
        """(E,) int64: number of steps."""
        return self.descent.steps

    @property
    def conditions(self) -> Conditions:
        """The lights (E, 49, 3), vertices (E, N, 3), albedos and pixels after the attack; `Conditions`."""
        return self.problem.conditions(self.descent.values, self.problem.everything)


def require_result(result: object) -> None:
    """InputError unless it is the result of an attack."""
    require_kind("result", result, AttackResult, "the result of augment.attack")


def attack(
    classifier: Classifier,
    scene: Scene,
    target: str | Sequence[str] | None = None,
    settings: AttackSettings | None = None,
    *,
    seed: int = 0,
    force: bool = False,
) -> AttackResult:
    """Change a scene until a classifier errs, example by example; the classifier is left as it was found.

    target: None for any error, a class, a class for each of the views that share what is attacked, or "least_likely",
    the class of each image's lowest confidence. settings: what is changed, within which norm-balls; by default the
    light, without a limit. seed: of the restarts. force: also attack what the classifier gets wrong before. The scene
    lies on the classifier's device.
    InputError where an argument is of another type, an example is misclassified before, the classifier lacks a class,
    or a target is the right one.

    >>> def logits(images):
    ...     mean = images.mean((1, 2, 3))
    ...     return torch.stack([mean, 0.3 + 0 * mean], dim=1)
    >>> classifier = augment.Classifier(logits, size=8, classes=["orange", "other"])
    >>> scene = augment.build_scene([("solid:orange", "orange")], classifier.size)
    >>> light = augment.StepSettings(step_size=0.5)
    >>> settings = augment.AttackSettings(lighting=light, max_steps=20, allow_negative=True)
    >>> result = augment.attack(classifier, scene, settings=settings)
    >>> result.success, result.images.shape
    (tensor([True]), torch.Size([1, 1, 3, 8, 8]))
    """
    require_classifier("classifier", classifier)
    require_kind("scene", scene, Scene, "a scene, such as augment.build_scene(...)")
    require_kind("settings", settings, AttackSettings | None, "augment.AttackSettings(...) or None")
    require_seed("seed", seed)
    require_flag("force", force)
    settings = settings or AttackSettings(lighting=StepSettings())
    settings.require_parameters()
    scene = with_needed_degree(scene, settings.material)
    problem, model = settings.problem(scene), settings.preprocessed_model(classifier)
    warn_of_changed_light(scene, problem.scene)
    images_before = problem.images(problem.start)
    before = logits_of(model, images_before, settings.batch_size)
    labels = torch.tensor([classifier.label(label) for label in scene.labels], device=before.device)
    if not force:
        require_clean_correct(scene, before, labels, classifier)
    source = labels[:, None].expand(-1, scene.views)
    goal = Goal(source, target_labels(target, source, before, classifier))
    phases = Phases(problem.start.device)
    restarts = (problem.sample(generator(seed, restart + 1, "restart")) for restart in range(settings.restarts))
    with phases("attack"):
        descent = descend(model, problem, goal, settings, phases, restarts=restarts, seed=seed)
        images = final_images(problem, descent.values, problem.everything, descent.images)
    after = logits_of(model, images, settings.batch_size)
    fooled = fooled_in_views(model, images, after.argmax(2), problem.everything, goal, settings, seed)
    return AttackResult(
        problem, classifier, goal, settings, seed, images_before, images, before, after, fooled, descent, phases.take()
    )


def warn_of_changed_light(given: Scene, physical: Scene) -> None:
    """Warn where making light physical changes its irradiance by more than 5 %.

    Measured is the rms over normals and channels of the error of irradiance of the environment light, relative to the
    rms irradiance of the given one (`irradiance_error`); the largest of all examples.

    Args:
        given: The scene before `AttackSettings.problem`.
        physical: The scene of that problem.
    """
    where, harmonics = parts_of(given.basis)[0]
    if physical.lights is given.lights or torch.equal(physical.lights, given.lights):
        return
    error = float(irradiance_error(physical.lights[:, where], given.lights[:, where]).max())
    if error > NOTICED:
        told = f"the light is negative in places, and without that its irradiance is off by {error:.0%} (rms)"
        advice = "a higher scene.degree is closer, and attack.allow_negative=true leaves the light as it is"
        warnings.warn(f"{told} in {harmonics}: {advice}", stacklevel=3)


def target_labels(
    target: str | Sequence[str] | None, source: Tensor, logits: Tensor, classifier: Classifier
) -> Tensor | None:
    """The target classes (E, V), given the right ones (E, V) and the logits (E, V, C) before; None for any error."""
    if target is None:
        return None
    if isinstance(target, str) and target == LEAST_LIKELY:
        return logits.argmin(2)
    views = logits.shape[1]
    if isinstance(target, str):
        names = [target] * views
    else:
        known = is_whole(target) and 0 <= int(target) < len(classifier.classes)  # type: ignore[call-overload]
        example = classifier.classes[target] if known else classifier.classes[0]  # type: ignore[call-overload]
        advice = f"the name of a class, such as {example!r}, or a name for each view"
        names = [str(name) for name in as_list("target", target, str | Integral, advice)]
    if len(names) != views:
        counts = f"{len(names)} classes for {views} views that share what is attacked"
        raise InputError(f"target={names} names {counts}: give one class per view, and shared=True")
    indices = [class_index(classifier.classes, name, f"target={name}") for name in names]
    labels = torch.tensor(indices, device=logits.device).expand(len(logits), views)
    if torch.eq(labels, source).any():
        raise InputError(f"target={target} is the right class of an example: name another class")
    return labels


def final_images(problem: AttackProblem, values: Tensor, examples: Tensor, images: Tensor) -> Tensor:
    """Images (A, V, 3, size, size) of examples (A,) under values (A, D), which `problem` rendered; where it holds
    shadows and bounces fixed while shape, colors or gloss change, rendered again with those of the values."""
    scene, after = problem.scene, problem.conditions(values, examples)
    unmoved = after.vertices is after.albedo is after.gloss is None
    if unmoved or not len(examples) or not scene.settings.global_illumination:
        return images
    rows = zip(examples.tolist(), images, strict=True)
    adversaries = (Adversary.of(scene, example, after, image, image, row) for row, (example, image) in enumerate(rows))
    renders = progress((adversary.render(scene.rasterizer) for adversary in adversaries), "final images", len(images))
    return torch.stack([*renders]).to(images)


@torch.no_grad()
def logits_of(model: nn.Module, images: Tensor, batch_size: int) -> Tensor:
    """(E, V, C) of images (E, V, 3, H, W)."""
    flat = images.flatten(0, 1)
    logits = BatchSize(batch_size).map(lambda part: model(flat[part]), len(flat))
    return torch.cat([*progress(logits, "predictions")]).unflatten(0, images.shape[:2])


def fooled_in_views(
    model: nn.Module,
    images: Tensor,
    predicted: Tensor,
    examples: Tensor,
    goal: Goal,
    settings: AttackSettings,
    seed: int,
) -> Tensor:
    """Which views count as a success: this alone decides it, for attacks, their checks, sweeps, transfers and files.

    A view counts if it reaches the goal as it is and in each of the images that a camera stores of it, as
    `augment.attacks.eot.stored` makes them. An example has the same noise wherever it is counted under a seed, so that
    a search with many tries does not draw the noise again.

    Args:
        model: images (N, 3, H, W) in [0, 1] to logits, with its preprocessing.
        images: (A, V, 3, H, W) in [0, 1], without noise.
        predicted: (A, V) int64, the classes of these images.
        examples: (A,) int64, the examples' numbers, on which their noise depends.
        goal: of these A examples.
        settings: of the attack; with `sensor_noise=0`, the images as they are decide.
        seed: of the noise.

    Returns:
        (A, V) bool, on the device of `predicted`.
    """
    fooled = goal.reached_in_views(predicted)
    rows = torch.nonzero(fooled.any(1)).squeeze(1)
    if not settings.sensor_noise or not len(rows):
        return fooled
    rows_of_images = rows.to(images.device)
    noisy_images = stored(
        images[rows_of_images], settings.sensor_noise, examples.to(rows.device)[rows], seed, "sensor noise"
    )
    for noisy in noisy_images:
        classes = logits_of(model, noisy, settings.batch_size).argmax(2).to(fooled.device)
        fooled[rows] &= goal.of(rows).reached_in_views(classes)
    return fooled


def predictions(logits: Tensor, classes: Sequence[str]) -> dict[str, Any]:
    """The predicted classes of logits (..., C) by name and their probabilities, as nested lists for JSON."""
    best = logits.softmax(-1).max(-1)
    return {"predicted": np.asarray(classes)[best.indices.cpu().numpy()].tolist(), "confidence": best.values.tolist()}


def require_clean_correct(scene: Scene, logits: Tensor, labels: Tensor, classifier: Classifier) -> None:
    """InputError, with the five most probable classes, unless every image (E, V) has its label (E,)."""
    wrong = (logits.argmax(2) != labels[:, None]).nonzero().tolist()
    if wrong:
        example, view = wrong[0]
        item = scene.objects[scene.examples[example].object]
        confidence, best = logits[example, view].softmax(0).topk(min(5, len(classifier.classes)))
        names = (classifier.classes[index] for index in best.tolist())
        most_probable = ", ".join(f"{name} {p:.1%}" for name, p in zip(names, confidence.tolist(), strict=True))
        images = f"{len(wrong)} of {logits[..., 0].numel()} images of {item.name} are not classified as {item.label!r}"
        remedy = "change the scene, or set force=True"
        raise InputError(f"{images} before any attack (the first: {most_probable}): {remedy}")
