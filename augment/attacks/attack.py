"""The function `attack`, which attacks a classifier through a scene."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from numbers import Integral

import torch
from jaxtyping import Float, Int
from torch import Tensor

from augment.attack_settings import RANDOM_SEARCH, AttackSettings, StepSettings
from augment.attacks.adversary import final_images
from augment.attacks.loop import Minimum, minimize
from augment.attacks.objective import NOISE_DRAWS, Criterion, Objective, preprocessed_model
from augment.attacks.problem import (
    SceneProblem,
    build_problem,
    source_labels,
    warn_of_changed_light,
)
from augment.attacks.result import ZERO_GRADIENT, AttackResult
from augment.classifier import Classifier, class_index, remembering
from augment.network import compute_outputs
from augment.plain_networks import UNIT_RANGE, Normalization, as_classifier, gradient_flags_kept
from augment.progress import Phases
from augment.random_streams import generator
from augment.scene.build import with_needed_degree
from augment.scene.scene import Scene
from augment.settings import NormalizeLight
from renderer.errors import InputError, as_list, is_whole, require_flag, require_kind, require_whole

# `attack(..., target="least_likely")` makes the target the class with the lowest confidence
# before the attack.
LEAST_LIKELY = "least_likely"


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
    require_whole("seed", seed)
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

    images_before = problem.images(problem.start)
    model = preprocessed_model(settings, classifier)
    logits_before = compute_outputs(model, images_before, settings.batch_size)
    source = source_labels(scene, logits_before, classifier)
    if not force:
        require_clean_correct(scene, logits_before, source, classifier)
    criterion = Criterion(source, target_labels(target, source, logits_before, classifier))

    phases = Phases(problem.start.device)
    objective = Objective(classifier, criterion, settings, seed, phases)
    with phases("attack"):
        restarts = random_starts(problem, settings.restarts, seed)
        minimum = minimize(problem, objective, restarts=restarts)
        images = final_images(problem, minimum.values, problem.all_examples, minimum.images)

    if minimum.zero_gradient.any():
        warnings.warn(ZERO_GRADIENT, stacklevel=3)

    logits = objective.logits(images)
    success_in_views = objective.fooled_in_views(images, logits.argmax(2), problem.all_examples)
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
        minimum=minimum,
        queries=_count_queries(minimum, images, logits.argmax(2), criterion, settings),
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
    minimum: Minimum,
    images: Float[Tensor, "E V 3 size size"],
    predicted: Int[Tensor, "E V"],
    criterion: Criterion,
    settings: AttackSettings,
) -> Int[Tensor, " E"]:
    """Count the different images of each example that an attack showed to the classifier."""
    view_count = images.shape[1]
    queries = minimum.queries.clone()
    # `final_images` may render images again that differ from those of the search. The
    # classifier saw them, too.
    if images is not minimum.images:
        queries += view_count
    if settings.sensor_noise:
        # `fooled_in_views` tests an example with noise if at least one view meets the
        # criterion. It then classifies all views of the example in each draw of the noise.
        is_tested = criterion.reached_in_views(predicted).any(1)
        queries += NOISE_DRAWS * view_count * is_tested
    return queries


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


def random_starts(problem: SceneProblem, count: int, seed: int) -> Iterator[Tensor]:
    """Draw the initial attack values of restarts from the norm-balls."""
    for number in range(1, count + 1):
        yield problem.sample(generator(seed, number, "restart"))
