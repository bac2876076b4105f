"""The function `attack`, which attacks a classifier through a scene, and a search for a scene."""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from numbers import Integral
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from augment import classifier as classifiers
from augment.attack_settings import RANDOM_SEARCH, AttackSettings, StepSettings
from augment.attacks.adversary import final_images
from augment.attacks.loop import minimize
from augment.attacks.objective import NOISE_DRAWS, Images, Objective
from augment.attacks.problem import build_problem, source_labels, warn_of_changed_light
from augment.attacks.result import ZERO_GRADIENT, AttackResult
from augment.classifier import UNIT_RANGE, Classifier, Normalization, TaskNetwork
from augment.network import gradient_flags_kept
from augment.progress import Phases, progress
from augment.random_streams import generator
from augment.scene.build import warn_of_exposure, with_needed_degree
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from augment.settings import NormalizeLight, SceneSettings
from augment.tasks.classification import Classification, class_index
from augment.tasks.task import Criterion, Task
from renderer.errors import InputError, as_list, is_whole, require_flag, require_kind, require_whole
from renderer.light import basis, files
from renderer.light.basis import DEGREE

# `_candidates` draws the polar angle of a camera from the range `POLAR`, in degrees, and
# the width of the visible region from the range `WIDTH`, in world units.
POLAR = (20.0, 100.0)
WIDTH = (1.8, 3.5)

# Smallest distance of a random perspective camera from the origin, in world units. A
# normalized mesh lies within this distance, so the camera is outside of the mesh.
CLOSEST = 2.0

# If the camera of the scene is orthographic, every second camera that the search tries is a
# perspective camera with this field of view in degrees.
FOV = 45.0

# Gray value of the background that the search tries, like that of product photographs.
LIGHT_GRAY = 0.9

# Exposures that are tried, as factors of the exposure of the scene.
EXPOSURES = (1.0, 0.5, 0.7, 1.5, 2.5, 4.0)

# The search for a scene ends when the classifier gives the true class at least this probability
# in all images.
CONFIDENCE_TO_STOP = 0.5

# Number of lights and exposures of a camera that the search may render again.
RENDERED_AGAIN = 3

# Target class of an attack, or one for each view.
Target = str | int | Sequence[str | int] | None
Settings = TypeVar("Settings", bound=SceneSettings)


@torch.inference_mode(False)  # Attacks need autograd.
def attack(
    classifier: Classifier | Callable[[Tensor], Any],
    scene: Scene,
    target: Target = None,
    settings: AttackSettings | None = None,
    *,
    task: Task | None = None,
    classes: Sequence[str] | None = None,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
    normalize_light: NormalizeLight = None,
    seed: int = 0,
    force: bool = False,
) -> AttackResult:
    """Change the examples of a scene until a network misclassifies or misses them.

    The mode and the gradient flags of the network are restored afterwards.

    Args:
        classifier: The classifier to attack, or a plain network from images of
            the scene's size to logits, such as a `torch.nn.Module`. Other tasks
            take other networks. It must be on the device of the scene.
        scene: The scene, with E examples of V views. Its labels are names or
            indices of classes.
        target: Class as which the images shall be classified. A list has one
            class for each view, and requires views that share the attacked
            values. "least_likely" is the other class with the lowest confidence.
            None accepts any misclassification.
        settings: Attacked parameters with their norm-balls, and the steps. By
            default, the light is changed without a limit.
        task: What the outputs of a plain network mean, such as
            `nb.Classification()`. None decides by the outputs for gray images,
            and says so.
        classes: Names of the classes of a plain network, in the order of its
            outputs. None for the names that the network knows, or "0", "1" and
            so on.
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
            if a target is the true class of an example, or if the renders do not
            fit in memory. Also if a plain network is in training mode, normalizes
            images twice, or does not return a row of logits for each image.

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
    settings = AttackSettings.or_default("settings", settings, lighting=StepSettings())
    require_whole("seed", seed)
    require_flag("force", force)
    like = scene.lights
    given = scene.settings.size, classes, normalization, value_range, like.device, "classifier"
    options: dict[str, Any] = {"dtype": like.dtype, "task": task, "size_from": "the scene"}
    options["normalize_light"] = normalize_light
    with gradient_flags_kept(classifier):
        adapted = classifiers.as_network(classifier, *given, **options)
        return _attack(adapted, scene, target, settings, seed, force)


def _attack(
    classifier: TaskNetwork,
    scene: Scene,
    target: Target,
    settings: AttackSettings,
    seed: int,
    force: bool,
) -> AttackResult:
    """Attack a classifier whose arguments have been checked. See `attack`."""
    settings.require_parameters()
    scene = with_needed_degree(scene, settings)
    problem = build_problem(settings, scene)
    warn_of_changed_light(scene, problem.scene, stacklevel=4)
    images_before = problem.images(problem.start)
    warn_of_exposure(problem.scene, images_before)

    has_gradients = classifier.is_differentiable(lambda: images_before.flatten(0, 1))
    if settings.optimizer is None and not has_gradients:
        settings = replace(settings, optimizer=RANDOM_SEARCH)
        limit = f"at most {settings.query_limit} queries for each example (max_queries, optimizer)"
        reason = f"classifier {classifier.name} has no gradients: random search attacks it with"
        warnings.warn(f"{reason} {limit}", stacklevel=3)
    if settings.eot.draws and not isinstance(classifier.task, Classification):
        advice = "set eot.draws=0"
        raise InputError(f"eot averages logits, but the task is {classifier.task}: {advice}", "eot")
    if not has_gradients:
        # Classify each image once only, because a function without gradients may be slow.
        classifier = classifiers.remembering(classifier)
    source = source_labels(scene, images_before.device, classifier)
    phases = Phases(images_before.device)
    truth = partial(scene.truth, classifier.label)
    criterion = classifier.task.criterion(source, truth, len(classifier.classes))
    objective = Objective(classifier, criterion, settings, seed, phases)
    evidence_before = objective.evidence(images_before)
    if not force:
        require_clean_correct(scene, evidence_before, criterion, classifier)
    # The target is set after the check of the unchanged images, since "least_likely" needs them.
    labels = target_labels(target, source, evidence_before, classifier)
    objective.criterion = replace(criterion, target=labels)
    with phases("attack"):
        numbers = range(1, settings.restarts + 1)
        restarts = (problem.sample(generator(seed, number, "restart")) for number in numbers)
        minimum = minimize(problem, objective, restarts=restarts)
        # Rendered with exact shadows and bounces. Otherwise, they are `minimum.images` themselves.
        images = final_images(problem, minimum.values, problem.all_examples, minimum.images)

    # The attack may have moved the objects.
    objective = objective.moved(problem, minimum.values, problem.all_examples)
    criterion = objective.criterion
    evidence, success_in_views, _ = objective.judge(images, problem.all_examples)
    # A detector that finds nothing may have constant scores, but a cost with a gradient.
    has_gradient = settings.uses_gradients and not minimum.zero_gradient.all()
    may_be_constant = not has_gradient and torch.equal(evidence, evidence_before)
    black_and_white = (torch.full_like(images, shade) for shade in (0.0, 1.0))
    is_constant = (torch.equal(objective.evidence(shown), evidence) for shown in black_and_white)
    if may_be_constant and all(is_constant):
        advice = "an attack finds no direction in constant scores"
        reason = "scores black and white images exactly like the renders"
        warnings.warn(f"{classifier.title} {reason}: {advice}", stacklevel=3)
    elif minimum.zero_gradient.any():
        warnings.warn(ZERO_GRADIENT, stacklevel=3)
    # Images that the search or `final_images` showed to the classifier.
    queries = minimum.queries + scene.views * (images is not minimum.images)
    if settings.sensor_noise:
        # `fooled_in_views` tests an example with noise if at least one view meets the
        # criterion. It then classifies all views of the example in each draw of the noise.
        is_tested = criterion.reached_in_views(criterion.predicted(evidence)).any(1)
        queries += NOISE_DRAWS * scene.views * is_tested
    return AttackResult(
        problem=problem,
        classifier=classifier,
        criterion=criterion,
        settings=settings,
        seed=seed,
        images_in_views_before=images_before,
        images_in_views=images,
        evidence_in_views_before=evidence_before,
        evidence_in_views=evidence,
        success_in_views=success_in_views,
        minimum=minimum,
        queries=queries,
        seconds=phases.take(),
    )


def require_clean_correct(
    scene: Scene, evidence: Float[Tensor, "E V K"], criterion: Criterion, network: TaskNetwork
) -> None:
    """Check that the network finds the true class in every image of a scene.

    The error says what it finds in the first other image.
    """
    wrong = (criterion.predicted(evidence) != criterion.source).nonzero().tolist()
    if wrong:
        example, view = wrong[0]
        item = scene.objects[scene.examples[example].object]
        found = network.task.describe(evidence[example, view], network.classes)
        count = f"in {len(wrong)} of {criterion.source.numel()} images the class is not found"
        first = f"the first, of {item.name}, class {item.label!r}: {found}"
        advice = "change the scene, or set force=True"
        raise InputError(f"force=False, and {count} ({first}): {advice}", "force")


def target_labels(
    target: Target, source: Tensor, evidence: Tensor, classifier: TaskNetwork
) -> Int[Tensor, "E V"] | None:
    """Return the target class of each view as an index of the classifier.

    None stands for an untargeted attack. A target that is the true class is refused.
    """
    if target is None:
        return None
    classifier.task.require_target(target)
    if isinstance(target, str) and target == "least_likely":
        # The last axis of the evidence has the classes. The true class is never the target.
        return evidence.scatter(2, source[..., None], torch.inf).argmin(2)
    view_count = evidence.shape[1]
    names: list[Any] = [target] * view_count
    if not isinstance(target, str) and not is_whole(target):
        advice = "the name or the index of a class, or one for each view"
        names = as_list("target", target, str | Integral, advice)
    if len(names) != view_count:
        advice = f"give one for each of the {view_count} views, in a scene with shared=True"
        raise InputError(f"target={names} names {len(names)} classes: {advice}")
    indices = [class_index(classifier.classes, name, f"target={name}") for name in names]
    labels = source.new_tensor(indices).repeat(len(source), 1)
    if torch.eq(labels, source).any():
        raise InputError(f"target={target} is the true class of an example: choose another class")
    return labels


def find_scene(
    classifier: Classifier,
    settings: Settings,
    attack_settings: AttackSettings,
    build: Callable[[Settings], Scene],
    cameras: int,
    draws: Generator,
) -> tuple[Settings, Scene]:
    """Search for settings of a scene, and the scene, that a classifier recognizes before an attack.

    The search tries several cameras. Each is tried in the light of the scene, in the built-in
    environments and in uniform light, with several exposures, and also in front of a light gray
    background. All lights of a camera are tried in drafts, and the best ones are rendered again as
    the attack does, until one is better than before. The search ends when the classifier gives the
    true class a probability of at least `CONFIDENCE_TO_STOP` in all images. The given settings are
    returned if no scene is recognized. Shadows and bounces are missing in drafts, so that a scene
    that is recognized only with them is not found.
    """
    # Confidence, settings and scene. The confidence is 0 if an image is misclassified.
    best: tuple[float, Settings, Scene | None] = 0.0, settings, None
    for candidate in progress(_candidates(settings, cameras, draws), "search for a scene"):
        draft = _draft(build(candidate))
        for drafted, found in _best_lights(draft, candidate, attack_settings, classifier):
            if drafted <= best[0]:
                break
            scene = build(found)
            problem = build_problem(attack_settings, scene)
            images = problem.images(problem.start)
            exact = float(_confidences(problem.scene, images, attack_settings, classifier))
            if exact > best[0]:
                best = exact, found, scene
                break
        if best[0] >= CONFIDENCE_TO_STOP:
            break
    _, found, chosen = best
    return found, build(found) if chosen is None else chosen


def _draft(scene: Scene) -> Scene:
    """Return a scene that takes little time for many lights, but has no shadows and bounces."""
    settings = replace(scene.settings, shadows=False, bounces=0, silhouettes=False)
    changes: dict[str, Any] = {"settings": settings, "one_light": False}
    # Unless the user chose the degree, the light has degree 6, which blurs highlights.
    if scene.lights_of_degree is not None:
        changes["basis"], lights = scene.lights_of_degree(DEGREE, None)
        changes["lights"] = lights.to(scene.lights)
    return scene.changed(**changes)


def _candidates(settings: Settings, cameras: int, draws: Generator) -> Iterator[Settings]:
    """Yield settings with other cameras, each also on light gray if the only background is gray."""
    has_one_gray = len(settings.backgrounds) == 1 and not isinstance(settings.backgrounds[0], str)
    for index in range(cameras):
        # The first candidate has the given camera.
        candidate = settings
        if index > 0:
            fov = FOV if settings.fov is None and index % 2 == 1 else settings.fov
            polar, azimuth, width = torch.rand(3, generator=draws).tolist()
            narrowest, widest = WIDTH
            if fov is not None:
                # Width of what a perspective camera sees at the origin if it is `CLOSEST` away. A
                # smaller width would bring the camera closer.
                closest_width = 2 * CLOSEST * math.tan(math.radians(fov) / 2)
                narrowest, widest = max(narrowest, closest_width), max(widest, 2 * closest_width)
            candidate = replace(
                settings,
                fov=fov,
                polar=round(POLAR[0] + (POLAR[1] - POLAR[0]) * polar, 1),
                azimuth=round(360 * azimuth, 1),
                width=round(narrowest + (widest - narrowest) * width, 2),
            )
        yield candidate
        if has_one_gray:
            yield replace(candidate, backgrounds=[LIGHT_GRAY])


def _best_lights(
    scene: Scene, settings: Settings, attack_settings: AttackSettings, classifier: Classifier
) -> list[tuple[float, Settings]]:
    """Return the highest confidences in a scene in any light and exposure, and their settings."""
    degree = basis.harmonics_of(scene.basis).degree
    candidates, coefficients = [], []
    for name in dict.fromkeys([settings.light, *files.PROBES, files.UNIFORM]):
        light = files.load_light(name, degree)
        for factor in EXPOSURES:
            coefficients.append(light * settings.given_exposure * factor)
            # The examples have the exposure that was chosen for their object, or 1.
            exposure = settings.given_exposure * factor * scene.examples[0].exposure
            candidates.append(replace(settings, light=name, exposure=exposure))
    # Row n · E + e is example e of the scene in light n. All lights are rendered and classified in
    # large batches.
    examples = torch.arange(len(scene), device=scene.lights.device).repeat(len(candidates))
    skies = torch.stack(coefficients).repeat_interleave(len(scene), dim=0).to(examples.device)
    # The first coefficients of an example are its environment light, and the others its projector
    # and lamps.
    lights = torch.cat([skies, scene.lights[examples, skies.shape[1] :]], dim=1)
    pairs = zip(lights.split(scene.group_size), examples.split(scene.group_size), strict=True)
    images = torch.cat([scene.render(Conditions(light), some) for light, some in pairs])
    confidences = _confidences(scene, images, attack_settings, classifier)
    # Of equal confidences, that of the given light and exposure comes first.
    order = confidences.argsort(descending=True, stable=True)[:RENDERED_AGAIN].tolist()
    return [(float(confidences[index]), candidates[index]) for index in order]


@torch.no_grad()
def _confidences(
    scene: Scene, images: Images, attack_settings: AttackSettings, classifier: Classifier
) -> Float[Tensor, " lights"]:
    """Compute the confidence in each light, whose images of all E examples follow each other.

    It is the lowest probability of the true class in its images, or 0 if one is misclassified.
    """
    labels = source_labels(scene, images.device, classifier)
    truth = partial(scene.truth, classifier.label)
    criterion = classifier.task.criterion(labels, truth, len(classifier.classes))
    # The objects are at the same places in all lights.
    count = len(images) // len(scene)
    criterion = criterion.map(lambda rows: rows.repeat(count, *[1] * (rows.ndim - 1)))
    evidence = Objective(classifier, criterion, attack_settings).evidence(images)
    source = criterion.source
    confidence = classifier.task.confidences(evidence).gather(2, source[..., None])[..., 0]
    is_correct = criterion.predicted(evidence) == source
    return (confidence * is_correct).view(count, -1).amin(1)
