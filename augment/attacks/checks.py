"""Checks of an attack: random search, more steps, success by radius, and transfer."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
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
from augment.attacks.objective import Criterion, Examples, Images, Objective, Values
from augment.attacks.parameters import parameter_class
from augment.attacks.problem import SceneProblem, build_problem
from augment.attacks.result import AttackResult, predictions, require_result
from augment.classifier import UNIT_RANGE, Classifier, Normalization, as_classifier
from augment.network import gradient_flags_kept
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from renderer.errors import MAX_MAGNITUDE, MAX_SCALE, InputError, as_list, require_number

# `check` repeats an attack with these multiples of its number of steps.
GROWTH = (3, 10)


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
    minimum = result.minimum
    is_clean = result.clean_correct
    # A successful example counts as one with a lower cost, even if its cost is higher.
    has_lower_cost = (minimum.cost < minimum.cost_before) | result.success_without_noise
    is_no_success_before = ~result.success_before
    cost_fell = _fraction(has_lower_cost[is_no_success_before])

    random = Successes(result.success_before, result.success_before)
    draws = generator(result.seed, "random search")
    random.add_draws(result, partial(result.problem.sample, draws, minimum.values))
    random_rate, random_rate_without_noise = random.rates(is_clean)
    # The same examples are attacked again from their start, with more steps or queries.
    found = Successes(result.success, result.success_without_noise)
    rates = {result.settings.step_limit: found.rates(is_clean)}
    for factor in GROWTH:
        longer = replace(result, settings=result.settings.with_budget(factor))
        found.attack(longer, result.problem, result.problem.start.clone())
        rates[longer.settings.step_limit] = found.rates(is_clean)
    return {
        "cost_before": float(minimum.cost_before.mean()),
        "cost": float(minimum.cost.mean()),
        "cost_fell": cost_fell if is_no_success_before.any() else 1.0,
        "zero_gradient": _fraction(minimum.zero_gradient),
        "success": _fraction(result.success[is_clean]),
        "success_without_noise": _fraction(result.success_without_noise[is_clean]),
        "success_with_margin": _fraction(result.success_with_margin[is_clean]),
        "random_search": random_rate,
        "random_search_without_noise": random_rate_without_noise,
        "success_by_steps": {steps: rate for steps, (rate, _) in rates.items()},
        "success_by_steps_without_noise": {steps: rate for steps, (_, rate) in rates.items()},
    }


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
    adversarial = Successes(result.success_before, result.success_before)
    random = Successes(result.success_before, result.success_before)
    rows = []
    for scale in progress(sorted(set(scales)), "radii"):
        parameters = result.settings.parameters.items()
        balls = {name: _scaled(settings, scale) for name, settings in parameters}
        scaled_settings = replace(result.settings, **balls)  # type: ignore[arg-type]
        problem = build_problem(scaled_settings, result.problem.scene)
        adversarial.attack(result, problem, values)
        random.add_draws(result, partial(problem.sample, draws))
        row: dict[str, Any] = {"radii": {name: ball.radius for name, ball in balls.items()}}
        for method, found in (("adversarial", adversarial), ("random", random)):
            row[method] = found.with_noise[result.clean_correct].cpu()
            row[f"{method}_without_noise"] = found.without_noise[result.clean_correct].cpu()
        rows.append(row)
    return rows


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
    classify = partial(_classify, result, _adversaries(result))
    rows = []
    for index, network in enumerate(networks):
        with gradient_flags_kept(network):
            classifier = network
            if not isinstance(network, Classifier):
                classifier = as_classifier(
                    network,
                    attacked.size,
                    attacked.classes,
                    normalization,
                    value_range,
                    images.device,
                    f"classifiers[{index}]",
                    dtype=images.dtype,
                )
            resized = partial(_resized, size=classifier.size)
            rows.append({"network": classifier.name, **classify(classifier, resized)})
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
        for argument, values, others, fits in (
            ("azimuths", azimuths, "views", kind.fits_other_views),
            ("meshes", objects, "meshes", kind.fits_other_meshes),
        ):
            if values and not fits:
                raise InputError(
                    f"{argument}: attacked {name} cannot be transferred to other {others}: "
                    f"remove {argument}, or attack another parameter"
                )


@dataclass(frozen=True)
class Successes:
    """Masks of the examples for which an attack has succeeded, which the methods change in place.

    Attributes:
        with_noise: Whether each of the E examples meets the criterion, also with
            sensor noise, shape (E,), bool.
        without_noise: Whether each example meets the criterion without sensor
            noise, shape (E,), bool.
    """

    with_noise: Bool[Tensor, " E"]
    without_noise: Bool[Tensor, " E"]

    def rates(self, is_counted: Bool[Tensor, " E"]) -> tuple[float, float]:
        """Return the fractions of successes, with and without noise, among some examples."""
        return _fraction(self.with_noise[is_counted]), _fraction(self.without_noise[is_counted])

    def attack(self, result: AttackResult, problem: SceneProblem, values: Values) -> None:
        """Attack the examples without a success, from the given values, and add the successes.

        The values become those that the attack reaches.
        """
        examples = torch.nonzero(~self.with_noise)[:, 0]
        if len(examples):
            objective = result.objective().select(examples)
            end = minimize(problem, objective, examples=examples, start=values[examples])
            values[examples] = end.values
            self._add(result, problem, end.values, examples, end.images)

    def add_draws(self, result: AttackResult, draw: Callable[[], Tensor]) -> None:
        """Search for successes of the other examples by random draws of the attack values.

        An attack with gradients is compared with one draw for each step, another with draws that
        show as many images to the classifier.
        """
        settings = result.settings
        count = settings.max_steps
        if not settings.uses_gradients:
            count = max(1, settings.step_limit // result.objective().passes_per_candidate)
        for _ in progress(range(count), "random search"):
            examples = torch.nonzero(~self.with_noise)[:, 0]
            if not len(examples):
                break
            values = draw()[examples]
            with torch.no_grad():
                images = result.problem.render(values, examples)
            self._add(result, result.problem, values, examples, images)

    def _add(
        self,
        result: AttackResult,
        problem: SceneProblem,
        values: Values,
        examples: Examples,
        images: Images,
    ) -> None:
        """Add the examples that meet the criterion with some attack values.

        An example is first judged by its given images. If they meet the criterion, it is rendered
        again with exact shadows and bounces, and these images decide, without and with sensor
        noise.
        """
        objective = result.objective().select(examples)
        is_reached = objective.criterion.reached(objective.logits(images).argmax(2))
        rows = torch.nonzero(is_reached)[:, 0]
        if not len(rows):
            return
        examples = examples[rows]
        final = final_images(problem, values[rows], examples, images[rows])
        _, fooled_in_views, without_noise = objective.select(rows).judge(final, examples)
        self.without_noise[examples] |= without_noise
        self.with_noise[examples] |= fooled_in_views.all(1)


def _fraction(values: Tensor) -> float:
    """Return the fraction of true entries of a mask (N,), or 0 if it is empty."""
    return float(values.double().mean()) if len(values) else 0.0


def _scaled(settings: StepSettings, scale: float) -> StepSettings:
    """Return a copy of the settings of a parameter with a scaled norm-ball.

    Radius and step size are multiplied by the scale. Without a radius, the scale becomes the
    radius, and the step size stays.
    """
    if settings.radius is None:
        return replace(settings, radius=scale)
    return replace(settings, radius=scale * settings.radius, step_size=scale * settings.step_size)


def _adversaries(result: AttackResult) -> tuple[Examples, list[Adversary], list[Adversary]]:
    """Collect the examples that were correct before an attack and for which it succeeded.

    Return their indices, and the examples before and after the attack.
    """
    problem = result.problem
    examples = torch.nonzero(result.clean_correct & result.success)[:, 0]

    def state(values: Values) -> list[Adversary]:
        conditions = problem.conditions(values, problem.all_examples)
        adversaries = []
        for example in examples.tolist():
            images = result.images_in_views_before[example], result.images_in_views[example]
            adversaries.append(Adversary.of(problem.scene, example, conditions, *images))
        return adversaries

    return examples, state(problem.start), state(result.minimum.values)


def _classify(
    result: AttackResult,
    adversaries: tuple[Examples, list[Adversary], list[Adversary]],
    classifier: Classifier,
    change: Callable[[Adversary], Adversary],
) -> dict[str, Any]:
    """Change adversaries, render them before and after the attack, and classify the images."""
    examples, *states = adversaries
    before, after = ([change(adversary) for adversary in state] for state in states)
    criterion = _criterion_for(classifier, result, examples, after)
    objective = Objective(classifier, criterion, result.settings, result.seed)
    if len(examples):
        images = []
        for adversary in progress([*before, *after], "transfer"):
            images.append(adversary.render_views(result.problem.scene.rasterizer))
        images_before, images_after = torch.stack(images).to(result.images_in_views).chunk(2)
        logits_before = objective.logits(images_before)
        logits, fooled_in_views, without_noise = objective.judge(images_after, examples)
    else:
        logits_before = logits = result.logits_in_views[examples]
        fooled_in_views = result.success_in_views[examples]
        without_noise = result.success_without_noise[examples]
    return {
        "clean_correct": (logits_before.argmax(2) == criterion.source).all(1).tolist(),
        "success": fooled_in_views.all(1).tolist(),
        "success_without_noise": without_noise.tolist(),
        **predictions(logits_before, classifier.classes, "_before"),
        **predictions(logits, classifier.classes),
    }


def _criterion_for(
    classifier: Classifier,
    result: AttackResult,
    examples: Examples,
    adversaries: Sequence[Adversary],
) -> Criterion:
    """Return the source and target classes of the examples for another classifier.

    The other classifier may have the classes in another order, so classes are found by name.
    """
    criterion = result.criterion.select(examples)
    classes = result.classifier.classes
    labels = [adversary.shown.label for adversary in adversaries]
    names = [label if isinstance(label, str) else classes[label] for label in labels]
    source = torch.tensor([*map(classifier.label, names)]).long()
    target = criterion.target
    if target is not None:
        target = target.cpu().apply_(lambda index: classifier.label(classes[index]))
    found = Criterion(source[:, None].expand(-1, criterion.view_count), target)
    return found.map(lambda tensor: tensor.to(examples.device))


def _resized(adversary: Adversary, size: int) -> Adversary:
    """Return a copy of an adversary whose images have another size."""
    if adversary.settings.size == size:
        return adversary
    resize = partial(
        F.interpolate, size=(size, size), mode="bilinear", antialias=True, align_corners=False
    )
    background = resize(adversary.background[None])[0].clamp(0, 1)
    pixels = None if adversary.pixels is None else resize(adversary.pixels)
    settings = replace(adversary.settings, size=size)
    return replace(adversary, settings=settings, background=background, pixels=pixels)


def _turned(adversary: Adversary, angle: float) -> Adversary:
    """Return a copy of an adversary whose cameras are turned by an angle in degrees."""
    cameras = [replace(camera, azimuth=camera.azimuth + angle) for camera in adversary.cameras]
    return replace(adversary, cameras=tuple(cameras))
