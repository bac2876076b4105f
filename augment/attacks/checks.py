"""Checks of an attack: random search, more steps, success by radius, and transfer."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.attack_settings import StepSettings
from augment.attacks.adversary import Adversary, final_images
from augment.attacks.loop import minimize
from augment.attacks.objective import Criterion, Objective
from augment.attacks.parameters import parameter_class
from augment.attacks.problem import SceneProblem, build_problem
from augment.attacks.result import AttackResult, predictions, require_result
from augment.classifier import Classifier
from augment.plain_networks import UNIT_RANGE, Normalization, as_classifier, gradient_flags_kept
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
    # Masks of the E examples, shape (E,) each.
    is_clean = result.clean_correct
    is_no_success_before = ~result.success_before
    # A successful example counts as one with a lower cost, even if its cost is higher.
    has_lower_cost = (minimum.cost < minimum.cost_before) | result.success_without_noise

    cost_fell = 1.0
    if is_no_success_before.any():
        cost_fell = _fraction(has_lower_cost[is_no_success_before])

    draws = generator(result.seed, "random search")
    draw = partial(result.problem.sample, draws, minimum.values)
    random = _success_by_draws(result, Successes.before(result), draw)
    # Success rates with and without sensor noise. The keys are numbers of steps or of queries.
    rate_by_steps = {}
    rate_by_steps_without_noise = {}
    for steps, successes in _success_by_steps(result).items():
        rate_by_steps[steps] = _fraction(successes.with_noise[is_clean])
        rate_by_steps_without_noise[steps] = _fraction(successes.without_noise[is_clean])
    return {
        "cost_before": float(minimum.cost_before.mean()),
        "cost": float(minimum.cost.mean()),
        "cost_fell": cost_fell,
        "zero_gradient": _fraction(minimum.zero_gradient),
        "success": _fraction(result.success[is_clean]),
        "success_without_noise": _fraction(result.success_without_noise[is_clean]),
        "success_with_margin": _fraction(result.success_with_margin[is_clean]),
        "random_search": _fraction(random.with_noise[is_clean]),
        "random_search_without_noise": _fraction(random.without_noise[is_clean]),
        "success_by_steps": rate_by_steps,
        "success_by_steps_without_noise": rate_by_steps_without_noise,
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
    scales = _as_scales(scales)
    draws = generator(result.seed, "sweep")
    # `attack` changes both of the following in place: the D attack values of each of the E
    # examples, shape (E, D), and the successes of the search.
    values = result.problem.start.clone()
    adversarial = Successes.before(result)
    random = adversarial.clone()
    rows = []
    for scale in progress(sorted(set(scales)), "radii"):
        parameters = result.settings.parameters.items()
        balls = {name: _scaled(settings, scale) for name, settings in parameters}
        scaled_settings = replace(result.settings, **balls)  # type: ignore[arg-type]
        problem = build_problem(scaled_settings, result.problem.scene)
        adversarial.attack(result, problem, values)
        random = _success_by_draws(result, random, partial(problem.sample, draws))
        rows.append(
            {
                "radii": {name: ball.radius for name, ball in balls.items()},
                **_of_clean_examples("adversarial", adversarial, result),
                **_of_clean_examples("random", random, result),
            }
        )
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
    objects = as_list(
        "objects",
        objects,
        SceneObject,
        "a list of scene objects, such as scene.objects",
    )
    azimuths = as_list("azimuths", azimuths, object, "a list of degrees")
    for azimuth in azimuths:
        require_number("azimuths", azimuth, -MAX_MAGNITUDE, MAX_MAGNITUDE)
    names = [parameter.name for parameter in result.problem.parameters]
    require_transferable(names, azimuths, objects)

    adversaries = _Adversaries.of(result)
    rows = []
    for index, network in enumerate(networks):
        with gradient_flags_kept(network):
            argument = f"classifiers[{index}]"
            classifier = _as_classifier(network, result, normalization, value_range, argument)
            resized = adversaries.changed(partial(_resized, size=classifier.size))
            rows.append({"network": classifier.name, **resized.classify(classifier)})
    for azimuth in azimuths:
        turned = adversaries.changed(partial(_turned, angle=azimuth))
        rows.append({"azimuth": f"{azimuth:+g}°", **turned.classify(result.classifier)})
    for item in objects:
        exchanged = adversaries.changed(partial(replace, shown=item))
        rows.append({"mesh": Path(item.name).name, **exchanged.classify(result.classifier)})
    return rows


def _as_classifier(
    network: Classifier | Callable[[Tensor], Tensor],
    result: AttackResult,
    normalization: Normalization,
    value_range: tuple[float, float],
    argument: str,
) -> Classifier:
    """Convert a plain network to a classifier like the attacked one. Others stay as they are."""
    if isinstance(network, Classifier):
        return network
    attacked = result.classifier
    return as_classifier(
        network,
        attacked.size,
        attacked.classes,
        normalization,
        value_range,
        result.images_in_views.device,
        argument,
        dtype=result.images_in_views.dtype,
    )


def require_transferable(
    parameters: Collection[str],
    azimuths: Collection[float],
    objects: Collection[Any],
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
                    f"remove {argument}, or attack another parameter",
                )


@dataclass(frozen=True)
class Successes:
    """Masks of the examples for which an attack has succeeded. `add` changes them in place.

    Attributes:
        with_noise: Whether each of the E examples meets the criterion, also with
            sensor noise, shape (E,), bool.
        without_noise: Whether each example meets the criterion without sensor
            noise, shape (E,), bool.
    """

    with_noise: Bool[Tensor, " E"]
    without_noise: Bool[Tensor, " E"]

    @staticmethod
    def before(result: AttackResult) -> Successes:
        """Return the masks of the examples that meet the criterion before an attack."""
        # The masks are copied, because `add` changes them.
        return Successes(result.success_before.clone(), result.success_before.clone())

    def clone(self) -> Successes:
        """Return an independent copy."""
        return Successes(self.with_noise.clone(), self.without_noise.clone())

    @property
    def unsuccessful(self) -> Tensor:
        """Return the indices of the examples without a success with sensor noise."""
        return torch.nonzero(~self.with_noise).squeeze(1)

    def attack(
        self, result: AttackResult, problem: SceneProblem, values: Float[Tensor, "E D"]
    ) -> None:
        """Attack the examples without a success, from the given values, and add the successes.

        The values become those that the attack reaches.
        """
        examples = self.unsuccessful
        if len(examples):
            objective = result.objective().select(examples)
            end = minimize(problem, objective, examples=examples, start=values[examples])
            values[examples] = end.values
            self.add(result, problem, values=end.values, examples=examples, images=end.images)

    def add(
        self,
        result: AttackResult,
        problem: SceneProblem,
        values: Float[Tensor, "A D"],
        examples: Int[Tensor, " A"],
        images: Float[Tensor, "A V _ H W"],
    ) -> None:
        """Add the examples that meet the criterion with some attack values.

        An example is first judged by its given images. If they meet the
        criterion, it is rendered again with exact shadows and bounces, and
        these images decide, without and with sensor noise.
        """
        objective = result.objective().select(examples)
        is_reached = objective.criterion.reached(objective.logits(images).argmax(2))
        candidates = torch.nonzero(is_reached).squeeze(1)
        if not len(candidates):
            return
        candidate_examples = examples[candidates]
        objective = objective.select(candidates)
        final = final_images(problem, values[candidates], candidate_examples, images[candidates])
        predicted = objective.logits(final).argmax(2)
        fooled = objective.fooled_in_views(final, predicted, candidate_examples)
        self.without_noise[candidate_examples] |= objective.criterion.reached(predicted)
        self.with_noise[candidate_examples] |= fooled.all(1)


def _success_by_draws(
    result: AttackResult,
    found: Successes,
    draw: Callable[[], Tensor],
) -> Successes:
    """Search for successes by random draws of the attack values.

    Only examples without a success in `found` are searched. An attack with gradients is compared
    with one draw for each step, another with draws that show as many images to the classifier.
    Return a copy of `found` with the additional successes.
    """
    found = found.clone()
    settings = result.settings
    count = settings.max_steps
    if not settings.uses_gradients:
        count = max(1, settings.step_limit // result.objective().passes_per_candidate)
    for _ in progress(range(count), "random search"):
        examples = found.unsuccessful
        if not len(examples):
            break
        values = draw()[examples]
        with torch.no_grad():
            images = result.problem.render(values, examples)
        found.add(result, result.problem, values=values, examples=examples, images=images)
    return found


def _success_by_steps(result: AttackResult) -> dict[int, Successes]:
    """Repeat an attack with 3 and 10 times as many steps, and find the successes.

    An attack without gradients is repeated with 3 and 10 times as many queries. Only the examples
    without a success so far are attacked again, each from its start. The keys are numbers of steps
    or queries. Successes with fewer steps are included.
    """
    settings = result.settings
    successes = Successes(result.success, result.success_without_noise)
    successes_by_budget = {settings.step_limit: successes}
    for factor in GROWTH:
        longer_settings = settings.with_budget(factor)
        successes = successes.clone()
        start = result.problem.start.clone()
        successes.attack(replace(result, settings=longer_settings), result.problem, start)
        successes_by_budget[longer_settings.step_limit] = successes
    return successes_by_budget


def _fraction(values: Tensor) -> float:
    """Return the fraction of true entries of a mask (N,), or 0 if it is empty."""
    return float(values.double().mean()) if len(values) else 0.0


def _as_scales(scales: Sequence[float]) -> list[float]:
    """Convert the argument `scales` of `success_by_radius` to a list, or raise InputError."""
    listed = as_list("scales", scales, object, "a list of factors of the radii")
    if not listed:
        raise InputError("scales is empty: give factors of the radii, such as [0.5, 1, 2]")
    for scale in listed:
        require_number("scales", scale, 1 / MAX_SCALE, MAX_SCALE)
    return listed


def _scaled(settings: StepSettings, scale: float) -> StepSettings:
    """Return a copy of the settings of a parameter with a scaled norm-ball.

    Radius and step size are multiplied by the scale. Without a radius, the scale becomes the
    radius, and the step size stays.
    """
    if settings.radius is None:
        return replace(settings, radius=scale)
    return replace(settings, radius=scale * settings.radius, step_size=scale * settings.step_size)


def _of_clean_examples(method: str, found: Successes, result: AttackResult) -> dict[str, Tensor]:
    """Select the successes among the N examples that are correct before the attack.

    Keys: `method` with sensor noise, and `method` + "_without_noise".
    """
    is_clean = result.clean_correct
    return {
        method: found.with_noise[is_clean].cpu(),
        f"{method}_without_noise": found.without_noise[is_clean].cpu(),
    }


@dataclass(frozen=True)
class _Adversaries:
    """The A examples that an attack turned from correct to misclassified.

    Attributes:
        result: The attack.
        examples: Index of each of the A examples in the attacked scene.
        before: The A examples before the attack.
        after: The A examples after the attack.
    """

    result: AttackResult
    examples: list[int]
    before: list[Adversary]
    after: list[Adversary]

    @staticmethod
    def of(result: AttackResult) -> _Adversaries:
        """Collect the examples that were correct before an attack and for which it succeeded."""
        problem = result.problem
        is_adversary = result.clean_correct & result.success
        examples = torch.nonzero(is_adversary).flatten().tolist()
        conditions_before = problem.conditions(problem.start, problem.all_examples)
        conditions_after = result.conditions
        before = []
        after = []
        for example in examples:
            images = result.images_in_views_before[example], result.images_in_views[example]
            before.append(Adversary.of(problem.scene, example, conditions_before, *images))
            after.append(Adversary.of(problem.scene, example, conditions_after, *images))
        return _Adversaries(result, examples, before, after)

    def changed(self, change: Callable[[Adversary], Adversary]) -> _Adversaries:
        """Return a copy whose examples have other cameras, objects or image sizes."""
        before = [change(adversary) for adversary in self.before]
        after = [change(adversary) for adversary in self.after]
        return replace(self, before=before, after=after)

    def classify(self, classifier: Classifier) -> dict[str, Any]:
        """Render the examples before and after the attack, and classify the images."""
        result = self.result
        criterion = self._criterion_for(classifier)
        objective = Objective(classifier, criterion, result.settings, result.seed)
        logits_before = self._logits(self._render(self.before, classifier.size), objective)
        images = self._render(self.after, classifier.size)
        logits = self._logits(images, objective)
        predicted_before = predictions(logits_before, classifier.classes)
        examples = torch.tensor(self.examples, dtype=torch.long)
        success_in_views = objective.fooled_in_views(images, logits.argmax(2), examples)
        return {
            "clean_correct": (logits_before.argmax(2) == criterion.source).all(1).tolist(),
            "success": success_in_views.all(1).tolist(),
            "success_without_noise": criterion.reached(logits.argmax(2)).tolist(),
            "predicted_before": predicted_before["predicted"],
            "confidence_before": predicted_before["confidence"],
            **predictions(logits, classifier.classes),
        }

    def _criterion_for(self, classifier: Classifier) -> Criterion:
        """Return the source and target classes of the A examples for another classifier.

        The other classifier may have the classes in another order, so classes are found by name.
        """
        criterion = self.result.criterion
        classes = self.result.classifier.classes
        labels = [adversary.shown.label for adversary in self.after]
        names = [label if isinstance(label, str) else classes[label] for label in labels]
        indices = [[classifier.label(name)] * criterion.view_count for name in names]
        source = torch.tensor(indices).long().view(-1, criterion.view_count)
        if criterion.target is None:
            return Criterion(source)
        targets = criterion.target[self.examples].flatten().tolist()
        target = torch.tensor([classifier.label(classes[index]) for index in targets]).long()
        return Criterion(source, target.view_as(source))

    def _render(self, adversaries: list[Adversary], size: int) -> Float[Tensor, "A V 3 size size"]:
        """Render the V views of adversaries."""
        scene = self.result.problem.scene
        if not adversaries:
            return self.result.images_in_views.new_empty(0, scene.views, 3, size, size)
        images = []
        for adversary in progress(adversaries, "transfer"):
            images.append(adversary.render_views(scene.rasterizer))
        return torch.stack(images).to(self.result.images_in_views)

    def _logits(
        self, images: Float[Tensor, "A V 3 size size"], objective: Objective
    ) -> Float[Tensor, "A V C"]:
        """Compute the logits of images with the preprocessing of the attack."""
        if not len(images):
            return torch.empty(0, images.shape[1], len(self.result.classifier.classes))
        return objective.logits(images).cpu()


def _resized(adversary: Adversary, size: int) -> Adversary:
    """Return a copy of an adversary whose images have another size."""
    if adversary.settings.size == size:
        return adversary
    background = _with_size(adversary.background[None], size)[0].clamp(0, 1)
    pixels = None if adversary.pixels is None else _with_size(adversary.pixels, size)
    settings = replace(adversary.settings, size=size)
    return replace(adversary, settings=settings, background=background, pixels=pixels)


def _with_size(images: Float[Tensor, "N C H W"], size: int) -> Tensor:
    """Resize images by bilinear interpolation with antialiasing."""
    return F.interpolate(images, (size, size), mode="bilinear", antialias=True, align_corners=False)


def _turned(adversary: Adversary, angle: float) -> Adversary:
    """Return a copy of an adversary whose cameras are turned by an angle in degrees."""
    cameras = [replace(camera, azimuth=camera.azimuth + angle) for camera in adversary.cameras]
    return replace(adversary, cameras=tuple(cameras))
