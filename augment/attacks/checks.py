"""Checks of an attack: random search, more steps, success by radius, and transfer."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool
from torch import Tensor

from augment.attack_settings import StepSettings
from augment.attacks.adversary import Adversary, final_images
from augment.attacks.loop import minimize
from augment.attacks.objective import Examples, Images, Objective, Values
from augment.attacks.parameters import parameter_class
from augment.attacks.problem import build_problem
from augment.attacks.result import AttackResult, require_result
from augment.classifier import UNIT_RANGE, Classifier, Normalization, TaskNetwork, as_network
from augment.network import gradient_flags_kept
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from augment.scene.truth import Truth, unlabeled
from renderer.errors import MAX_MAGNITUDE, MAX_SCALE, InputError, as_list, require_number
from renderer.settings import Size, height_and_width

# `check` repeats an attack with these multiples of its number of steps.
GROWTH = (3, 10)
# Masks of all N examples for which an attack has succeeded: also with sensor noise, and without it.
# The functions that add successes change them in place.
Successes = Bool[Tensor, "2 N"]


@torch.inference_mode(False)  # Attacks need autograd.
def check(result: AttackResult) -> dict[str, Any]:
    """Compare an attack with random draws and with longer attacks.

    Random search draws values uniformly from the norm-balls. It has one draw for
    each step of the attack or, if the classifier has no gradients, for each
    query. If a parameter has no radius, its draws are as far from the start as
    the values that the attack found. The longer attacks have 3 and 10 times as
    many steps or queries.

    Args:
        result: The result of `nb.attack`.

    Returns:
        A dictionary with these entries:

        - "cost_before", "cost": mean cost of all examples.
        - "cost_fell": fraction of the examples whose cost fell or that succeeded,
          among those without success before the attack.
        - "zero_gradient": fraction of all examples whose first gradient is 0.
        - "success", "success_with_margin", "random_search": success rates of the
          attack, of the attack with the required margin, and of random search.
        - "success_by_steps": success rate by the number of steps, or of queries
          if the classifier has no gradients.

        A success rate is the fraction of successes with sensor noise among the
        examples that are classified correctly before the attack. The same keys
        with "_without_noise" have the rates without sensor noise.

    Raises:
        InputError: If `result` is not the result of an attack.

    Example:
        >>> import norm_balls as nb
        >>> checks = nb.check(result)
        >>> checks["success"], checks["cost"] < checks["cost_before"]
        (1.0, True)
    """
    require_result(result)
    settings = result.settings
    # The starts of the attack count as one start with all of their steps or queries.
    steps = (1 + settings.restarts) * settings.max_steps
    result = replace(result, settings=replace(settings, restarts=0, max_steps=steps))
    minimum = result.minimum
    is_clean = result.clean_correct
    # A successful example counts as one with a lower cost, even if its cost is higher.
    has_lower_cost = (minimum.cost < minimum.cost_before) | result.success_without_noise
    cost_fell = has_lower_cost[~result.success_before]

    random = torch.stack([result.success_before] * 2)
    draws = generator(result.seed, "random search")
    _add_draws(random, result, partial(result.problem.sample, draws, minimum.values))
    # The same examples are attacked again from their start, with more steps or queries.
    found = torch.stack([result.success, result.success_without_noise])
    success = _fraction(found[:, is_clean])
    rates = {result.settings.step_limit: success}
    for factor in GROWTH:
        longer = replace(result, settings=result.settings.with_budget(factor))
        _attack_others(found, longer, result.problem.start.clone())
        rates[longer.settings.step_limit] = _fraction(found[:, is_clean])
    columns = zip(*rates.values(), strict=True)
    rates_by_steps = [dict(zip(rates, column, strict=True)) for column in columns]
    return {
        "cost_before": float(minimum.cost_before.mean()),
        "cost": float(minimum.cost.mean()),
        "cost_fell": _fraction(cost_fell) if len(cost_fell) else 1.0,
        "zero_gradient": _fraction(minimum.zero_gradient),
        **_named("success", success),
        "success_with_margin": _fraction(result.success_with_margin[is_clean]),
        **_named("random_search", _fraction(random[:, is_clean])),
        **_named("success_by_steps", rates_by_steps),
    }


@torch.inference_mode(False)
def success_by_radius(result: AttackResult, scales: Sequence[float]) -> list[dict[str, Any]]:
    """Measure how the success of an attack depends on the radius of the norm-balls.

    The examples are attacked in balls of growing radius, once by the optimizer and
    once by uniform random draws. A success in a ball counts in all larger
    balls. The other examples are attacked again in the next ball, for
    `max_steps` steps from the values that they have reached, and with as many
    random draws.

    Args:
        result: The result of `nb.attack`.
        scales: Factors by which radii and step sizes are multiplied. For
            parameters without a radius, they are the radii.

    Returns:
        A dictionary for each scale, in ascending order:

        - "radii": radius of each attacked parameter by its name.
        - "adversarial", "random": whether the optimizer or the random search
          succeeds with sensor noise, for each of the N examples that are
          classified correctly before the attack, shape (N,), bool.
        - "adversarial_without_noise", "random_without_noise": the same without
          sensor noise.

    Raises:
        InputError: If `result` is not the result of an attack, or `scales` are
            not positive numbers.

    Example:
        >>> import norm_balls as nb
        >>> small, large = nb.success_by_radius(result, [0.001, 1])
        >>> small["radii"], small["adversarial"], large["adversarial"]
        ({'lighting': 0.001}, tensor([False]), tensor([True]))
    """
    require_result(result)
    scales = as_list("scales", scales, object, "a list of factors of the radii")
    for scale in scales:
        require_number("scales", scale, 1 / MAX_SCALE, MAX_SCALE)
    draws = generator(result.seed, "sweep")
    # Values that the attacks have reached, shape (E, D).
    values = result.problem.start.clone()
    adversarial, random = (torch.stack([result.success_before] * 2) for _ in range(2))
    rows = []
    for scale in progress(sorted(set(scales)), "radii"):
        parameters = result.settings.parameters.items()
        balls = {name: _scaled(settings, scale) for name, settings in parameters}
        scaled_settings = replace(result.settings, **balls)  # type: ignore[arg-type]
        problem = build_problem(scaled_settings, result.problem.scene)
        _attack_others(adversarial, replace(result, problem=problem), values)
        _add_draws(random, result, partial(problem.sample, draws))
        row: dict[str, Any] = {"radii": {name: ball.radius for name, ball in balls.items()}}
        for method, found in (("adversarial", adversarial), ("random", random)):
            row |= _named(method, found[:, result.clean_correct].cpu())
        rows.append(row)
    return rows


@torch.inference_mode(False)
def transfer(
    result: AttackResult,
    classifiers: Sequence[Classifier | Callable[[Tensor], Tensor]] = (),
    azimuths: Sequence[float] = (),
    objects: Sequence[SceneObject] = (),
    *,
    normalization: Normalization = None,
    value_range: tuple[float, float] = UNIT_RANGE,
) -> list[dict[str, Any]]:
    """Test whether successful attacks also fool other classifiers, or from other cameras.

    An adversary is an example that was classified correctly before the attack
    and for which the attack succeeded. The A adversaries are classified by each
    other classifier, seen from each turned camera, and with each other object
    in place of their own.

    Args:
        result: The result of `nb.attack`.
        classifiers: Other classifiers, or plain networks with the image size and
            the classes of the attacked classifier. For a `Classifier` of
            another image size, the adversaries are rendered at that size, and
            backgrounds and pixel offsets are resized.
        azimuths: Degrees by which all cameras are turned around the vertical
            axis.
        objects: Objects that replace the attacked ones.
        normalization: Normalization of images for plain networks, as in
            `attack`.
        value_range: Values of black and white that plain networks take before
            normalization.

    Returns:
        A dictionary for each classifier, azimuth and object, for JSON. It has
        its name under the key "network", "azimuth" or "mesh", and these lists:

        - "clean_correct": whether each adversary is classified correctly in all
          views before the attack, A values.
        - "success": whether each adversary meets the criterion in all views
          after the attack, with sensor noise, A values.
        - "success_without_noise": the same without sensor noise.
        - "predicted_before", "confidence_before", "predicted", "confidence":
          predicted class and its probability, before and after the attack, for
          each of the V views of each adversary.

    Raises:
        InputError: If an attacked parameter cannot be transferred to other views
            or meshes, or if a classifier lacks a class.

    Example:
        >>> import norm_balls as nb
        >>> function = result.classifier.network
        >>> larger = nb.Classifier(function, size=12, classes=["orange", "other"])
        >>> [network, turned] = nb.transfer(result, [larger], azimuths=[20.0])
        >>> network["predicted"], turned["azimuth"]
        ([['other']], '+20°')
    """
    require_result(result)
    expected = "a list of torch.nn.Module, functions to logits, or nb.Classifier"
    networks = as_list("classifiers", classifiers, Callable, expected)
    objects = as_list("objects", objects, SceneObject, "a list of objects, such as scene.objects")
    azimuths = as_list("azimuths", azimuths, object, "a list of degrees")
    for azimuth in azimuths:
        require_number("azimuths", azimuth, -MAX_MAGNITUDE, MAX_MAGNITUDE)
    names = [parameter.name for parameter in result.problem.parameters]
    require_transferable(names, azimuths, objects)

    attacked = result.classifier
    images = result.images_in_views
    given = attacked.size, attacked.classes, normalization, value_range, images.device
    examples = torch.nonzero(result.clean_correct & result.success)[:, 0]
    classify = partial(_classify, result, examples, _adversaries(result, examples))
    rows = []
    for index, network in enumerate(networks):
        with gradient_flags_kept(network):
            classifier = network
            if not isinstance(network, TaskNetwork):
                options: dict[str, Any] = {"dtype": images.dtype, "size_from": "the attack"}
                name = f"classifiers[{index}]"
                classifier = as_network(network, *given, name, task=attacked.task, **options)
            change = partial(resized, size=classifier.size)
            rows.append({"network": classifier.name, **classify(classifier, change)})
    for azimuth in azimuths:
        turned = partial(_turned, angle=azimuth)
        rows.append({"azimuth": f"{azimuth:+g}°", **classify(attacked, turned)})
    for item in objects:
        exchanged = partial(replace, shown=item)
        rows.append({"mesh": Path(item.name).name, **classify(attacked, exchanged)})
    return rows


def require_transferable(
    parameters: Collection[str], azimuths: Collection[float], objects: Collection[Any]
) -> None:
    """Check that the result of an attack can be rendered from other views and on other meshes.

    For example, changed pixels belong to one view, and changed vertices belong to one mesh.
    """
    for name in parameters:
        kind = parameter_class(name)
        needed = {"azimuths": (azimuths, kind.fits_other_views)}
        needed["meshes"] = (objects, kind.fits_other_meshes)
        for argument, (values, fits) in needed.items():
            if values and not fits:
                reason = f"{argument}: attacked {name} belongs to its own view or mesh"
                raise InputError(f"{reason}: remove {argument}, or attack another parameter")


def _attack_others(found: Successes, result: AttackResult, values: Values) -> None:
    """Attack the examples without a success, and add the successes and the values reached.

    `found` and `values` are changed in place. The attack starts at `values`.
    """
    # The first row of `found` has the successes with sensor noise.
    examples = torch.nonzero(~found[0])[:, 0]
    if len(examples):
        objective = result.objective().select(examples)
        end = minimize(result.problem, objective, examples=examples, start=values[examples])
        # In `success_by_radius`, the attack in the next larger norm-ball starts here.
        values[examples] = end.values
        _add_successes(found, result, end.values, examples, end.images)


def _add_draws(found: Successes, result: AttackResult, draw: Callable[[], Tensor]) -> None:
    """Search for successes of the other examples by random draws of the attack values.

    An attack with gradients is compared with one draw for each step, another with draws that
    show as many images to the classifier.
    """
    settings = result.settings
    # Number of draws of each example.
    count = settings.max_steps
    if not settings.uses_gradients:
        count = max(1, settings.step_limit // result.objective().passes_per_candidate)
    for _ in progress(range(count), "random search"):
        examples = torch.nonzero(~found[0])[:, 0]
        if not len(examples):
            break
        # Draw values of all examples, so that those of one do not depend on earlier successes.
        values = draw()[examples]
        with torch.no_grad():
            images = result.problem.render(values, examples)
        _add_successes(found, result, values, examples, images)


def _add_successes(
    found: Successes, result: AttackResult, values: Values, examples: Examples, images: Images
) -> None:
    """Add the examples that meet the criterion with some attack values.

    An example is first judged by its given images. If they meet the criterion, it is rendered
    again with exact shadows and bounces, and these images decide, without and with sensor noise.
    """
    problem = result.problem
    objective = result.objective().select(examples).moved(problem, values, examples)
    criterion = objective.criterion
    # Judge the given images, which are cheaper than the final images.
    is_reached = criterion.reached(criterion.predicted(objective.evidence(images)))
    rows = torch.nonzero(is_reached)[:, 0]
    if len(rows):
        examples = examples[rows]
        final = final_images(problem, values[rows], examples, images[rows])
        _, fooled_in_views, without_noise = objective.select(rows).judge(final, examples)
        found[:, examples] |= torch.stack([fooled_in_views.all(1), without_noise])


def _named(name: str, pair: Iterable[Any]) -> dict[str, Any]:
    """Name a value with sensor noise, and one without."""
    return dict(zip((name, f"{name}_without_noise"), pair, strict=True))


def _fraction(values: Tensor) -> Any:
    """Return the fraction of true entries of a mask, or of each row. It is 0 if a row is empty."""
    return values.double().mean(-1).nan_to_num().tolist()


def _scaled(settings: StepSettings, scale: float) -> StepSettings:
    """Return a copy of the settings of a parameter with a scaled norm-ball.

    Radius and step size are multiplied by the scale. Without a radius, the scale becomes the
    radius, and the step size stays.
    """
    if settings.radius is None:
        return replace(settings, radius=scale)
    return replace(settings, radius=scale * settings.radius, step_size=scale * settings.step_size)


def _adversaries(result: AttackResult, examples: Examples) -> list[Adversary]:
    """Collect examples before an attack and then, in the same order, after it."""
    problem = result.problem
    before, after = result.images_in_views_before, result.images_in_views
    return [
        Adversary.of(problem.scene, example, conditions, before[example], after[example])
        for values in (problem.start, result.minimum.values)
        for conditions in [problem.conditions(values, problem.all_examples)]
        for example in examples.tolist()
    ]


def _classify(
    result: AttackResult,
    examples: Examples,
    adversaries: Sequence[Adversary],
    classifier: TaskNetwork,
    change: Callable[[Adversary], Adversary],
) -> dict[str, Any]:
    """Return how a classifier classifies changed adversaries, as lists for JSON (see `transfer`).

    `adversaries` are the examples before the attack, and then the same examples after it.
    """
    changed = [change(adversary) for adversary in adversaries]
    classes = result.classifier.classes
    task, count = classifier.task, len(examples)
    labels = [adversary.shown.label for adversary in changed[count:]]
    # Classes are matched by name, because another classifier may have another order of classes.
    names = [classes[result.classifier.label(label)] for label in labels]
    source = torch.tensor([*map(classifier.label, names)]).long()
    source = source[:, None].expand(-1, result.criterion.view_count)
    target = result.criterion.select(examples).target
    if target is not None:
        target = target.cpu().apply_(lambda index: classifier.label(classes[index]))
    rasterizer = result.problem.scene.rasterizer

    def truth_of(some: Sequence[Adversary]) -> Truth:
        truths = [item.scene(rasterizer).truth(unlabeled) for item in some]
        # The attack is about the first object. Examples may have different numbers of others.
        return Truth.join([truth.map(lambda rows: rows[:, :, :1]) for truth in truths])

    # Without examples, these tensors are empty and have the right number of dimensions.
    criterion = result.criterion.select(examples)
    evidence_before = evidence = result.evidence_in_views[examples]
    fooled_in_views = result.success_in_views[examples]
    without_noise = result.success_without_noise[examples]
    if count:
        at_start = partial(truth_of, changed[:count])
        criterion = task.criterion(source, at_start, len(classifier.classes))
        # `map` moves all tensors of the criterion to the device of the attack.
        criterion = replace(criterion, target=target).map(lambda rows: rows.to(examples.device))
        objective = Objective(classifier, criterion, result.settings, result.seed)
        images = [item.render_views(rasterizer) for item in progress(changed, "transfer")]
        images_before, images_after = torch.stack(images).to(result.images_in_views).chunk(2)
        evidence_before = objective.evidence(images_before)
        if criterion.needs_truth:
            # The attack may have moved the objects, so their boxes and masks are computed again.
            objective.criterion = criterion.at(truth_of(changed[count:]))
        evidence, fooled_in_views, without_noise = objective.judge(images_after, examples)
    predicted_before, predicted = map(criterion.predicted, (evidence_before, evidence))
    return {
        "clean_correct": (predicted_before == criterion.source).all(1).tolist(),
        "success": fooled_in_views.all(1).tolist(),
        "success_without_noise": without_noise.tolist(),
        **task.found(evidence_before, predicted_before, classifier.classes, "_before"),
        **task.found(evidence, predicted, classifier.classes),
    }


def resized(adversary: Adversary, size: Size) -> Adversary:
    """Return a copy of an adversary whose images have another size."""
    if adversary.settings.size == size:
        return adversary
    resize = partial(F.interpolate, size=height_and_width(size), mode="bilinear", antialias=True)
    background = resize(adversary.background[None])[0].clamp(0, 1)
    pixels = None if adversary.pixels is None else resize(adversary.pixels)
    settings = replace(adversary.settings, size=size)
    return replace(adversary, settings=settings, background=background, pixels=pixels)


def _turned(adversary: Adversary, angle: float) -> Adversary:
    """Return a copy of an adversary whose cameras are turned by an angle in degrees."""
    cameras = [replace(camera, azimuth=camera.azimuth + angle) for camera in adversary.cameras]
    return replace(adversary, cameras=tuple(cameras))
