"""The function `attack`, which attacks a classifier through a scene, and its result."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from augment.attack_settings import RANDOM_SEARCH, AttackSettings
from augment.attacks import animation
from augment.attacks.adversary import Adversary
from augment.attacks.eot import NOISE_DRAWS, add_sensor_noise, preprocessed_model
from augment.attacks.loop import Criterion, DescentResult
from augment.attacks.optimizers import descend
from augment.attacks.parameters.light_parameter import environment_light
from augment.attacks.problem import AttackProblem, build_problem
from augment.losses import logit_gap
from augment.network import (
    Classifier,
    class_index,
    compute_outputs,
    remembering,
)
from augment.parameter_settings import StepSettings
from augment.plain_networks import UNIT_RANGE, Normalization, as_classifier, gradient_flags_kept
from augment.progress import Phases, progress
from augment.random_streams import generator
from augment.scene.conditions import Conditions
from augment.scene.degree import MAX_IRRADIANCE_ERROR, with_needed_degree
from augment.scene.scene import Scene
from augment.settings import NormalizeLight
from renderer.errors import InputError, is_whole, require_choice, require_range
from renderer.io.images import write_image
from renderer.light.harmonics import irradiance_error
from renderer.rendering import light_sphere
from renderer.short_repr import ShortRepr
from renderer.validation import (
    as_list,
    as_path,
    require_flag,
    require_kind,
    require_seed,
    require_whole,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# `attack(..., target="least_likely")` makes the target the class with the lowest confidence
# before the attack.
LEAST_LIKELY = "least_likely"
# Pixels per side of the white ball with which `AttackResult.plot` shows the light.
BALL_SIZE = 96
# File formats that `AttackResult.save_animation` can write.
ANIMATION_SUFFIXES = (".gif", ".webp")
# Largest number of frames that `AttackResult.save_animation` writes.
MAX_FRAME_COUNT = 1000
# What `attack` and its checks say if gradient descent finds no direction.
ZERO_GRADIENT = (
    "the first gradient of some examples is exactly zero: optimizer=random_search needs none"
)


@dataclass(frozen=True, repr=False)
class AttackResult(ShortRepr):
    """Result of an attack on E examples of V views, with a classifier of C classes.

    `nb.check`, `nb.success_by_radius`, `nb.transfer` and `nb.save` take it as
    an argument.

    Attributes:
        problem: The attacked scene, and the parameters that were changed.
        classifier: The attacked classifier, without the rounding to 8 bits.
        criterion: Source and target class of each view.
        settings: Settings of the attack.
        seed: Seed of the attack.
        images_in_views_before: Images before the attack, in [0, 1] and not
            rounded, shape (E, V, 3, size, size).
        images_in_views: Images after the attack, with the same shape and range.
            Their shadows and bounces are those of the attacked shape and colors.
        logits_in_views_before: Logits of the preprocessed images before the
            attack, shape (E, V, C).
        logits_in_views: Logits of the preprocessed images after the attack,
            shape (E, V, C).
        success_in_views: Whether each view meets the criterion without noise and
            in each draw of sensor noise, shape (E, V), bool.
        descent: Result of the optimizer, before the final images are rendered. If
            the attack changes shape or colors, the images of the descent have
            the shadows and bounces of the original shape. `descent.success` is
            the success of these images without noise.
        queries: Number of images of each example that the attack showed to the
            classifier, (E,) int64. Images with sensor noise, which decide about
            successes, are included. An image that is shown again counts once.
        seconds: Seconds of the attack in total, and of its parts by name.
    """

    problem: AttackProblem
    classifier: Classifier
    criterion: Criterion
    settings: AttackSettings
    seed: int
    images_in_views_before: Tensor
    images_in_views: Tensor
    logits_in_views_before: Tensor
    logits_in_views: Tensor
    success_in_views: Tensor
    descent: DescentResult
    queries: Tensor
    seconds: dict[str, float]

    @property
    def images_before(self) -> Tensor:
        """Images before the attack in [0, 1], one row for each example.

        The shape is (E, V, 3, size, size), or (E, 3, size, size) if an example has one view.
        """
        return self.images_in_views_before.squeeze(1)

    @property
    def images(self) -> Tensor:
        """Images after the attack in [0, 1], one row for each example.

        The shape is (E, V, 3, size, size), or (E, 3, size, size) if an example has one view.
        """
        return self.images_in_views.squeeze(1)

    @property
    def logits_before(self) -> Tensor:
        """Logits of the C classes before the attack, one row for each example.

        The shape is (E, V, C), or (E, C) if an example has one view.
        """
        return self.logits_in_views_before.squeeze(1)

    @property
    def logits(self) -> Tensor:
        """Logits of the C classes after the attack, one row for each example.

        The shape is (E, V, C), or (E, C) if an example has one view.
        """
        return self.logits_in_views.squeeze(1)

    @property
    def preprocessed_model(self) -> nn.Module:
        """Return the attacked classifier with its preprocessing: the rounding to 8 bits, if any."""
        return preprocessed_model(self.settings, self.classifier)

    @property
    def success(self) -> Tensor:
        """Return a mask of the examples for which the attack succeeded, shape (E,).

        All views of the example meet the criterion, also with sensor noise. Before the attack,
        the example did not meet it.
        """
        return self.success_in_views.all(1) & ~self.success_before

    @property
    def success_without_noise(self) -> Tensor:
        """Return a mask of the examples for which the attack succeeded without noise, shape (E,).

        All views of the example meet the criterion in their images without sensor noise. Before
        the attack, the example did not meet it.
        """
        return self.criterion.reached(self.logits_in_views.argmax(2)) & ~self.success_before

    @property
    def success_with_margin(self) -> Tensor:
        """Return a mask of the successful examples with a sufficient logit gap, shape (E,).

        The logit gap, see `augment.losses.logit_gap`, is at least `settings.margin` in all views.
        """
        gaps = logit_gap(self.logits_in_views, self.criterion.source, self.criterion.target)
        return self.success & (gaps >= self.settings.margin).all(1)

    @property
    def success_before(self) -> Tensor:
        """Return a mask of the examples that met the criterion before the attack, shape (E,)."""
        return self.criterion.reached(self.logits_in_views_before.argmax(2))

    @property
    def clean_correct(self) -> Tensor:
        """Return a mask of the examples that were classified correctly before the attack.

        All views of such an example are correct. Success rates count only these examples. Shape
        (E,).
        """
        return (self.logits_in_views_before.argmax(2) == self.criterion.source).all(1)

    @property
    def steps(self) -> Tensor:
        """Number of steps of each example, (E,) int64."""
        return self.descent.steps

    @property
    def backward_passes(self) -> Tensor:
        """Number of images of each example whose gradient was computed, shape (E,), int64."""
        return self.descent.backward_passes

    @property
    def conditions(self) -> Conditions:
        """Light, shape, colors and pose of the E examples after the attack."""
        return self.problem.conditions(self.descent.values, self.problem.all_examples)

    def plot(self, example: int | None = None, view: int | None = None) -> Figure:
        """Draw a view of an example as a figure with four parts.

        The parts are the image before the attack, a white ball in the attacked
        light, the image after the attack, and the probabilities of the true
        class and of the most probable classes before and after.

        Args:
            example: Index of the example. None for the first one with a view
                that was correct before the attack and that the attack fooled.
                If there is none, it is the first that was correct before, or
                else 0.
            view: Index of the view. None chooses it in the same way.

        Returns:
            Figure of matplotlib. `figure.savefig(path)` writes it.

        Raises:
            InputError: If there is no such example or view.
        """
        # Importing matplotlib takes half a second.
        from augment.attacks.plots import draw_attack

        example, view = self._shown_view(example, view)
        conditions = self.conditions
        basis = self.problem.scene.basis_under(conditions, example)
        before = self.logits_in_views_before[example, view].softmax(0)
        after = self.logits_in_views[example, view].softmax(0)
        return draw_attack(
            self.images_in_views_before[example, view].cpu(),
            light_sphere(conditions.light[example], BALL_SIZE, basis=basis),
            self.images_in_views[example, view].cpu(),
            before.cpu(),
            after.cpu(),
            self.classifier.classes,
            int(self.criterion.source[example, view]),
        )

    def _shown_view(self, example: int | None, view: int | None) -> tuple[int, int]:
        """Return an example and a view, where None is replaced by what shows the attack best."""
        example_count, view_count = self.images_in_views.shape[:2]
        if example is not None:
            _require_index("example", example, example_count)
        if view is not None:
            _require_index("view", view, view_count)
        was_correct = self.logits_in_views_before.argmax(2) == self.criterion.source
        # 2 for views that the attack turned from correct to wrong, 1 for others that were correct.
        scores = was_correct * (1 + self.success_in_views.to(was_correct.device).int())
        rows = slice(None) if example is None else example
        columns = slice(None) if view is None else view
        # Views that are not chosen from have a score of -1.
        chosen = torch.full_like(scores, -1)
        chosen[rows, columns] = scores[rows, columns]
        return divmod(int(chosen.argmax()), view_count)

    def save_animation(
        self, path: str | Path, example: int = 0, view: int = 0, frame_count: int = 20
    ) -> None:
        """Save how one view changes from the scene's light to the adversarial light.

        Every frame shows the image, its predicted class with its probability,
        and a white ball in the light. The values that the attack found (light,
        shape, colors or pose) are interpolated linearly, so the frames between
        the first and the last are not steps of the descent.

        Args:
            path: File to write, with the suffix .gif or .webp.
            example: Index of the example.
            view: Index of the view.
            frame_count: Number of frames, from 2 to 1000. With 20 frames, the
                file has at most 2 MB.

        Raises:
            InputError: If the suffix is another, or if there is no such example
                or view.
            OSError: If the file cannot be written.

        Example:
            >>> from pathlib import Path
            >>> import torch
            >>> import norm_balls as nb
            >>> def logits(images):
            ...     mean = images.mean((1, 2, 3))
            ...     return torch.stack([mean, 0.3 + 0 * mean], dim=1)
            >>> scene = nb.build_scene([("solid:orange", "0")], 8)
            >>> settings = nb.AttackSettings(lighting=nb.StepSettings(step_size=0.5), max_steps=2)
            >>> result = nb.attack(logits, scene, settings=settings)
            >>> result.save_animation("attack.gif", frame_count=4)
            >>> Path("attack.gif").exists()
            True
        """
        path = as_path("path", path)
        require_choice("path: its suffix", path.suffix.lower(), ANIMATION_SUFFIXES)
        example, view = self._shown_view(example, view)
        require_whole("frame_count", frame_count)
        require_range("frame_count", frame_count, 2, MAX_FRAME_COUNT)
        fractions = [index / (frame_count - 1) for index in range(frame_count)]
        images = [self._image_between(fraction, example, view) for fraction in fractions]
        balls = [self._ball_between(fraction, example) for fraction in fractions]
        logits = compute_outputs(self.preprocessed_model, torch.stack(images), 1)
        predicted = predictions(logits, self.classifier.classes)
        captions = []
        for name, confidence in zip(predicted["predicted"], predicted["confidence"], strict=True):
            captions.append(f"{name} {confidence:.0%}")
        first, *others = animation.draw_frames(images, balls, captions)
        times = animation.frame_times(frame_count)
        write_image(path, first, save_all=True, append_images=others, duration=times, loop=0)

    def _values_between(self, fraction: float) -> Float[Tensor, "E D"]:
        """Interpolate linearly between the attack values before and after the attack.

        The fraction is 0 before the attack and 1 after it.
        """
        start = self.problem.start
        return start + fraction * (self.descent.values.to(start) - start)

    def _image_between(
        self, fraction: float, example: int, view: int
    ) -> Float[Tensor, "3 size size"]:
        """Render a view with values that are interpolated between before and after the attack."""
        if fraction == 0:
            return self.images_in_views_before[example, view]
        if fraction == 1:
            return self.images_in_views[example, view]
        examples = self.problem.all_examples[[example]]
        # Shape (1, V, 3, size, size).
        images = self.problem.images(self._values_between(fraction), examples)
        return images[0, view]

    def _ball_between(self, fraction: float, example: int) -> Float[Tensor, "3 size size"]:
        """Render a white ball in light that is interpolated between before and after the attack."""
        examples = self.problem.all_examples[[example]]
        conditions = self.problem.conditions(self._values_between(fraction)[examples], examples)
        # `conditions` contain one example only, at index 0.
        basis = self.problem.scene.basis_under(conditions, 0)
        return light_sphere(conditions.light[0], animation.SIDE, basis=basis)

    def _repr_png_(self) -> bytes:
        """Return `plot()` as a PNG file. Notebooks display it."""
        content = BytesIO()
        self.plot().savefig(content, format="png")
        return content.getvalue()


def _require_index(name: str, index: int, count: int) -> None:
    """Raise InputError unless an index is a whole number from 0 to count - 1."""
    require_whole(name, index)
    require_range(name, index, 0, count - 1)


def require_result(result: object) -> None:
    """Check that a value is the result of an attack."""
    require_kind("result", result, AttackResult, "the result of norm_balls.attack")


def attack(
    classifier: Classifier | Callable[[Tensor], Tensor],
    scene: Scene,
    target: str | int | Sequence[str | int] | None = None,
    settings: AttackSettings | None = None,
    *,
    classes: Sequence[str] | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    normalize_light: NormalizeLight = None,
    seed: int = 0,
    force: bool = False,
) -> AttackResult:
    """Change the examples of a scene until a classifier misclassifies them.

    The mode and the gradient flags of the classifier are restored afterwards.

    Args:
        classifier: The classifier to attack, or a plain network from images of
            the scene's size to logits, such as a `torch.nn.Module`. It must be
            on the device of the scene.
        scene: The scene, with E examples of V views. Its labels are names or
            indices of classes.
        target: Class as which the images shall be classified. A list has one
            class for each view, and requires views that share the attacked
            values. "least_likely" is the class with the lowest confidence. None
            accepts any misclassification.
        settings: Attacked parameters with their norm-balls, and the steps. By
            default, the light is changed without a limit.
        classes: Names of the classes of a plain network, in the order of its
            outputs. None for "0", "1" and so on.
        normalization: Normalization of images for a plain network: "imagenet",
            or mean and standard deviation of the channels red, green and blue,
            in units of `value_range`. None if the network takes images in
            [0, 1], or normalizes them itself.
        value_range: Values of black and white that a plain network takes before
            normalization. "imagenet" stands for the mean and standard deviation
            of ImageNet, scaled to this range.
        normalize_light: Whether the light of each image is normalized before
            the classifier sees it, as in `load_classifier`. The attack computes
            gradients through this step.
        seed: Seed of the restarts and of the noise.
        force: Whether examples that are misclassified before the attack are
            accepted, and attacked too.

    Returns:
        The images, logits and successes of the E examples, before the attack
        and after it. If each example has one view, images and logits have no
        dimension for the views.

    Raises:
        InputError: If an argument has a wrong type, if an example is
            misclassified before the attack, if the classifier lacks a class, or
            if a target is the true class of an example. Also if a plain network
            is in training mode, normalizes images twice, or does not return a
            row of logits for each image.

    Example:
        >>> import torch
        >>> import norm_balls as nb
        >>> def logits(images):
        ...     mean = images.mean((1, 2, 3))
        ...     return torch.stack([mean, 0.3 + 0 * mean], dim=1)
        >>> classifier = nb.Classifier(logits, size=8, classes=["orange", "other"])
        >>> scene = nb.build_scene([("solid:orange", "orange")], classifier.size)
        >>> light = nb.StepSettings(step_size=0.5)
        >>> settings = nb.AttackSettings(lighting=light, max_steps=20, allow_negative=True)
        >>> result = nb.attack(classifier, scene, settings=settings)
        >>> result.success, result.images.shape
        (tensor([True]), torch.Size([1, 3, 8, 8]))
    """
    require_kind("scene", scene, Scene, "a scene, such as nb.build_scene(...)")
    require_kind("settings", settings, AttackSettings | None, "nb.AttackSettings(...) or None")
    require_seed("seed", seed)
    require_flag("force", force)
    if torch.is_inference_mode_enabled():
        raise InputError(
            "torch.inference_mode() computes no gradients: "
            "call norm_balls.attack outside of this mode"
        )
    size = scene.settings.size
    lights = scene.lights
    with gradient_flags_kept(classifier):
        adapted = as_classifier(
            classifier,
            size,
            classes,
            normalization,
            value_range,
            lights.device,
            "classifier",
            normalize_light=normalize_light,
            dtype=lights.dtype,
        )
        return _attack(adapted, scene, target, settings, seed, force)


def _attack(
    classifier: Classifier,
    scene: Scene,
    target: str | int | Sequence[str | int] | None,
    settings: AttackSettings | None,
    seed: int,
    force: bool,
) -> AttackResult:
    """Attack a classifier whose arguments have been checked. See `attack`.

    A target of None accepts any misclassification, and settings of None change the light without a
    limit.
    """
    settings = settings or AttackSettings(lighting=StepSettings())
    settings.require_parameters()
    has_gradients = classifier.is_differentiable(scene.lights)
    settings = with_optimizer(settings, classifier, has_gradients)
    if not has_gradients:
        # Classify each image once only, because a function without gradients may be slow.
        classifier = remembering(classifier)
    scene = with_needed_degree(scene, settings.material)
    problem = build_problem(settings, scene)
    # `stacklevel` makes Python name the user's call of `attack` in the warning.
    warn_of_changed_light(scene, problem.scene, stacklevel=4)
    model = preprocessed_model(settings, classifier)

    images_before = problem.images(problem.start)
    logits_before = compute_outputs(model, images_before, settings.batch_size)
    source = source_labels(scene, logits_before, classifier)
    if not force:
        require_clean_correct(scene, logits_before, source, classifier)
    criterion = Criterion(source, target_labels(target, source, logits_before, classifier))

    phases = Phases(problem.start.device)
    with phases("attack"):
        restarts = random_starts(problem, settings.restarts, seed)
        descent = descend(model, problem, criterion, settings, phases, restarts=restarts, seed=seed)
        images = final_images(problem, descent.values, problem.all_examples, descent.images)

    if descent.zero_gradient.any():
        warnings.warn(ZERO_GRADIENT, stacklevel=3)

    logits = compute_outputs(model, images, settings.batch_size)
    success_in_views = fooled_in_views(
        model,
        images,
        logits.argmax(2),
        problem.all_examples,
        criterion,
        settings,
        seed,
    )
    return AttackResult(
        problem=problem,
        classifier=classifier,
        criterion=criterion,
        settings=settings,
        seed=seed,
        images_in_views_before=images_before,
        images_in_views=images,
        logits_in_views_before=logits_before,
        logits_in_views=logits,
        success_in_views=success_in_views,
        descent=descent,
        queries=_count_queries(descent, images, logits.argmax(2), criterion, settings),
        seconds=phases.take(),
    )


def with_optimizer(
    settings: AttackSettings, classifier: Classifier, has_gradients: bool
) -> AttackSettings:
    """Choose random search for a classifier without gradients, and warn."""
    if settings.optimizer is not None or has_gradients:
        return settings
    chosen = replace(settings, optimizer=RANDOM_SEARCH)
    # `stacklevel` makes Python name the user's call of `attack` in the warning.
    warnings.warn(
        f"classifier {classifier.name} has no gradients: random search attacks it with at most "
        f"{chosen.query_limit} queries for each example (max_queries, optimizer)",
        stacklevel=4,
    )
    return chosen


def _count_queries(
    descent: DescentResult,
    images: Float[Tensor, "E V 3 size size"],
    predicted: Int[Tensor, "E V"],
    criterion: Criterion,
    settings: AttackSettings,
) -> Int[Tensor, " E"]:
    """Count the different images of each example that an attack showed to the classifier."""
    view_count = images.shape[1]
    queries = descent.queries.clone()
    # `final_images` may render images again that differ from those of the descent. The
    # classifier saw them, too.
    if images is not descent.images:
        queries += view_count
    if settings.sensor_noise:
        # `fooled_in_views` tests an example with noise if at least one view meets the
        # criterion. It then classifies all views of the example in each draw of the noise.
        is_tested = criterion.reached_in_views(predicted).any(1)
        queries += NOISE_DRAWS * view_count * is_tested
    return queries


def warn_of_changed_light(given: Scene, physical: Scene, stacklevel: int = 3) -> None:
    """Warn if the removal of negative radiance changes the irradiance by more than 5 %.

    The change is the rms error of the irradiance over all normals and channels,
    divided by the rms irradiance of the given environment light. The largest
    change of all examples counts.
    """
    if physical.lights is given.lights or torch.equal(physical.lights, given.lights):
        return
    rows, harmonics = environment_light(given)
    error = float(irradiance_error(physical.lights[:, rows], given.lights[:, rows]).max())
    if error > MAX_IRRADIANCE_ERROR:
        message = (
            "the light has negative radiance, and after its removal the irradiance is off by "
            f"{error:.0%} (rms) in {harmonics}: give a higher degree, "
            "or set allow_negative=True to keep the light as it is"
        )
        warnings.warn(message, stacklevel=stacklevel)


def source_labels(scene: Scene, logits: Tensor, classifier: Classifier) -> Int[Tensor, "E V"]:
    """Return the true class of each view as an index of the classifier."""
    labels = [classifier.label(label) for label in scene.labels]
    return torch.tensor(labels, device=logits.device)[:, None].expand(-1, scene.views)


def require_clean_correct(
    scene: Scene,
    logits: Float[Tensor, "E V C"],
    source: Int[Tensor, "E V"],
    classifier: Classifier,
) -> None:
    """Check that every image of a scene is classified correctly.

    The error names the five most probable classes of the first image that is misclassified.
    """
    misclassified = (logits.argmax(2) != source).nonzero().tolist()
    if not misclassified:
        return
    example, view = misclassified[0]
    item = scene.objects[scene.examples[example].object]
    shown_count = min(5, len(classifier.classes))
    confidences, classes = logits[example, view].softmax(0).topk(shown_count)
    most_probable = [
        f"{classifier.classes[index]} {confidence:.1%}"
        for confidence, index in zip(confidences.tolist(), classes.tolist(), strict=True)
    ]
    wrong = f"{len(misclassified)} of {source.numel()} images"
    raise InputError(
        f"force=False, and {wrong} are not classified as their class before any attack "
        f"(the first, of {item.name}, class {item.label!r}: {', '.join(most_probable)}): "
        "change the scene, or set force=True",
        "force",
    )


def target_labels(
    target: str | int | Sequence[str | int] | None,
    source: Int[Tensor, "E V"],
    logits: Float[Tensor, "E V C"],
    classifier: Classifier,
) -> Int[Tensor, "E V"] | None:
    """Return the target class of each view as an index of the classifier.

    None stands for an untargeted attack. A target that is the true class is refused.
    """
    if target is None:
        return None
    if isinstance(target, str) and target == LEAST_LIKELY:
        return logits.argmin(2)
    view_count = logits.shape[1]
    is_one_class = isinstance(target, str) or is_whole(target)
    names = _targets([target] * view_count if is_one_class else target)
    if len(names) != view_count:
        raise InputError(
            f"target={names} names "
            f"{len(names)} classes for {view_count} views of each example: "
            "give one class for each view, and build the scene with shared=True",
        )
    indices = [class_index(classifier.classes, name, f"target={name}") for name in names]
    labels = torch.tensor(indices, device=logits.device).expand(len(logits), view_count)
    if torch.eq(labels, source).any():
        raise InputError(
            f"target={target} is the true class of an example: choose another target class"
        )
    return labels


def _targets(target: object) -> list[str | int]:
    """Return a list of names and indices of classes, or raise InputError if it is not a list."""
    advice = "the name or the index of a class, or one for each view"
    names = as_list("target", target, str | Integral, advice)
    # An integer of NumPy is no `int`.
    return [name if isinstance(name, str) else int(name) for name in names]


def random_starts(problem: AttackProblem, count: int, seed: int) -> Iterator[Tensor]:
    """Draw the initial attack values of restarts from the norm-balls."""
    for number in range(1, count + 1):
        yield problem.sample(generator(seed, number, "restart"))


def final_images(
    problem: AttackProblem,
    values: Float[Tensor, "A D"],
    examples: Int[Tensor, " A"],
    images: Float[Tensor, "A V 3 size size"],
) -> Float[Tensor, "A V 3 size size"]:
    """Return the images after a descent, with the shadows and bounces of the attacked shape.

    A descent that changes shape, colors or gloss computes shadows and bounces
    once, for the original shape. This function renders its images again. The
    images of all other descents are returned as they are.
    """
    scene = problem.scene
    conditions = problem.conditions(values, examples)
    surface_changes = (conditions.vertices, conditions.albedo, conditions.gloss)
    has_changed_surface = any(change is not None for change in surface_changes)
    needs_renders = has_changed_surface and scene.settings.global_illumination
    if not needs_renders or not len(examples):
        return images
    rendered = []
    for row, example in enumerate(progress(examples.tolist(), "final images")):
        # `Adversary` needs images, but does not use them for rendering.
        adversary = Adversary.of(scene, example, conditions, images[row], images[row], row)
        rendered.append(adversary.render_views(scene.rasterizer))
    return torch.stack(rendered).to(images)


def fooled_in_views(
    model: nn.Module,
    images: Float[Tensor, "A V 3 H W"],
    predicted: Int[Tensor, "A V"],
    examples: Int[Tensor, " A"],
    criterion: Criterion,
    settings: AttackSettings,
    seed: int,
) -> Bool[Tensor, "A V"]:
    """Decide which views count as a success of an attack.

    A view is a success if it meets the criterion without noise and with each of `NOISE_DRAWS` draws
    of sensor noise. The noise of an example depends only on the seed and on the index of the
    example. An attack that tries many images therefore cannot succeed by drawing the noise again.
    With `sensor_noise=0`, only the images without noise count.
    """
    is_fooled = criterion.reached_in_views(predicted)
    # Noise is tested only in examples with a view that is fooled without noise.
    tested = torch.nonzero(is_fooled.any(1)).squeeze(1)
    if not settings.sensor_noise or not len(tested):
        return is_fooled
    tested_criterion = criterion.select(tested)
    noisy_versions = add_sensor_noise(
        images[tested.to(images.device)],
        settings.sensor_noise,
        examples.to(tested.device)[tested],
        seed,
        "sensor noise",
    )
    for noisy_images in noisy_versions:
        logits = compute_outputs(model, noisy_images, settings.batch_size)
        noisy_predicted = logits.argmax(2).to(is_fooled.device)
        # A view must be fooled in every draw of the noise.
        is_fooled[tested] &= tested_criterion.reached_in_views(noisy_predicted)
    return is_fooled


def predictions(logits: Float[Tensor, "... C"], classes: Sequence[str]) -> dict[str, Any]:
    """Return the names and the probabilities of the predicted classes, for a JSON file."""
    highest = logits.softmax(-1).max(-1)
    names = np.asarray(classes)[highest.indices.cpu().numpy()]
    return {"predicted": names.tolist(), "confidence": highest.values.tolist()}
