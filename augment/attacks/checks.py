"""Checks of an attack: random search, more steps, success by radius, and transfer."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.attacks.adversary import Adversary
from augment.attacks.attack import (
    AttackResult,
    final_images,
    fooled_in_views,
    logits_of,
    predictions,
    require_result,
)
from augment.attacks.descent import Criterion
from augment.attacks.eot import preprocessed_model
from augment.attacks.optimizers import descend
from augment.attacks.parameters import parameter_class
from augment.attacks.problem import AttackProblem, build_problem
from augment.classifiers import Classifier
from augment.classifiers.plain_networks import (
    UNIT_RANGE,
    Normalization,
    as_classifier,
    gradient_flags_kept,
)
from augment.parameter_settings import StepSettings
from augment.progress import progress
from augment.random_streams import generator
from augment.scene.objects import SceneObject
from renderer.errors import MAX_MAGNITUDE, MAX_SCALE, InputError, require_range
from renderer.validation import as_list, require_number

# `check` repeats the attack with these multiples of its number of steps.
GROWTH = (3, 10)

# Keys of the result of `check` that `warnings` reads. `nb.save` refuses a result without them.
CHECKED = {
    "success",
    "success_without_noise",
    "random_search",
    "cost_fell",
    "zero_gradient",
}


def check(result: AttackResult) -> dict[str, Any]:
    """Compare an attack with random draws and with longer descents.

    Random search has one draw for each step of the attack or, if the classifier
    has no gradients, for each query. It draws uniformly from the norm-balls.
    Without a radius, it draws values at the same distance from the start as the
    values that the attack found. The longer searches have 3 and 10 times as many
    steps or queries. All successes are counted with the noise of a camera, as in
    the result.

    Args:
        result: The result of `nb.attack`.

    Returns:
        Fractions of examples, and mean costs. "cost_fell" is a fraction of the
        examples without success before the attack, and "zero_gradient" one of
        all examples. "success", "success_with_margin", "random_search",
        "success_by_steps" (by number of steps, or of queries without
        gradients), and the same names with "_without_noise", are fractions of
        the clean-correct examples.

    Raises:
        InputError: If `result` is no result of an attack.

    Example:
        >>> import norm_balls as nb
        >>> checks = nb.check(result)
        >>> checks["success"], checks["cost"] < checks["cost_before"]
        (1.0, True)
    """
    require_result(result)
    descent = result.descent
    # Each of these masks has shape (E,) for E examples.
    is_clean = result.clean_correct
    is_no_success_before = ~result.success_before
    # A success counts as a lower cost, whatever its cost is.
    has_lower_cost = (descent.cost < descent.cost_before) | result.success_without_noise

    cost_fell = 1.0
    if is_no_success_before.any():
        cost_fell = _fraction(has_lower_cost[is_no_success_before])

    draws = generator(result.seed, "random search")
    draw = partial(result.problem.sample, draws, descent.values)
    random = _success_by_draws(result, Successes.before(result), draw)
    # Fractions of the clean-correct examples, by number of steps or queries.
    counted_by_steps = {}
    without_noise_by_steps = {}
    for steps, successes in _success_by_steps(result).items():
        counted_by_steps[steps] = _fraction(successes.counted[is_clean])
        without_noise_by_steps[steps] = _fraction(successes.without_noise[is_clean])
    return {
        "cost_before": float(descent.cost_before.mean()),
        "cost": float(descent.cost.mean()),
        "cost_fell": cost_fell,
        "zero_gradient": _fraction(descent.zero_gradient),
        "success": _fraction(result.success[is_clean]),
        "success_without_noise": _fraction(result.success_without_noise[is_clean]),
        "success_with_margin": _fraction(result.success_with_margin[is_clean]),
        "random_search": _fraction(random.counted[is_clean]),
        "random_search_without_noise": _fraction(random.without_noise[is_clean]),
        "success_by_steps": counted_by_steps,
        "success_by_steps_without_noise": without_noise_by_steps,
    }


def warnings(checks: Mapping[str, Any]) -> list[str]:
    """Return reasons to doubt an attack.

    Args:
        checks: The result of `check`.

    Returns:
        A sentence for each reason.
    """
    success = checks["success"]
    lost_to_noise = checks["success_without_noise"] - success
    reasons = []
    if lost_to_noise > success:
        reasons.append(
            "most successes do not survive a sensor's noise, a larger margin helps",
        )
    if 0 < success <= checks["random_search"]:
        reasons.append("random search does as well or better")
    if checks["cost_fell"] < 1:
        reasons.append("the cost rose in some examples")
    if checks["zero_gradient"] > 0:
        reasons.append("some first gradients are exactly zero")
    return reasons


def success_by_radius(result: AttackResult, scales: Sequence[float]) -> list[dict[str, Any]]:
    """Search norm-balls around the start of an attack, from the smallest to the largest.

    Each ball is searched by descent and by uniform random draws. A success at
    one radius counts at all larger radii. The remaining examples are attacked
    again at the next radius. They start from their values at the previous
    radius, take `max_steps` more steps, and get as many random draws.

    Args:
        result: The result of `nb.attack`.
        scales: Factors of radii and steps or, for parameters without a radius,
            the radii.

    Returns:
        A dict for each scale, in ascending order. "radii" are by parameter.
        "adversarial" and "random", (N,) bool, tell of each of the N
        clean-correct examples whether a descent or a random search succeeds. A
        success counts as in the result, with the noise of a sensor.
        "adversarial_without_noise" and "random_without_noise" are without it.

    Raises:
        InputError: If `result` is no result of an attack, or `scales` are not
            positive numbers.

    Example:
        >>> import norm_balls as nb
        >>> small, large = nb.success_by_radius(result, [0.001, 1])
        >>> small["radii"], small["adversarial"], large["adversarial"]
        ({'lighting': 0.001}, tensor([False]), tensor([True]))
    """
    require_result(result)
    scales = _as_scales(scales)
    draws = generator(result.seed, "sweep")
    # `_descend_further` moves these values (E, D) and adds to `adversarial` in place.
    values = result.problem.start.clone()
    adversarial = Successes.before(result)
    random = adversarial.clone()
    rows = []
    for scale in progress(sorted(set(scales)), "radii"):
        parameters = result.settings.parameters.items()
        balls = {name: _scaled(settings, scale) for name, settings in parameters}
        scaled_settings = replace(result.settings, **balls)  # type: ignore[arg-type]
        problem = build_problem(scaled_settings, result.problem.scene)
        _descend_further(result, problem, values, adversarial)
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
    """Evaluate adversaries with other classifiers, other cameras and other objects.

    The A adversaries are the successful examples that were classified correctly
    before the attack. For a classifier of another image size, backgrounds and
    pixel offsets are resized.

    Args:
        result: The result of `nb.attack`.
        classifiers: Other classifiers, for each of which the adversaries are
            rendered at its size, or plain networks that take the images and
            have the classes of the attacked classifier.
        azimuths: Degrees by which all cameras are turned around the vertical.
        objects: Objects that take the place of the attacked ones.
        normalization: What plain networks need in front of them, as `attack`
            takes it.
        value_range: Values of black and white that they take before it.

    Returns:
        A dict for each, for JSON. "network", "azimuth" or "mesh" tells which.
        "clean_correct" and "success", A values each, tell whether every view is
        classified correctly before the attack, and whether every view reaches
        the criterion after it, which counts as in the result, with the noise of a
        sensor. "success_without_noise" is by the images as they are.
        "predicted_before", "confidence_before", "predicted" and "confidence"
        have A × V values.

    Raises:
        InputError: See `require_transferable`. Also if a classifier lacks a
            class.

    Example:
        >>> import norm_balls as nb
        >>> function = result.classifier.function
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
        require_number("azimuths", azimuth)
        require_range("azimuths", azimuth, -MAX_MAGNITUDE, MAX_MAGNITUDE)
    names = [parameter.name for parameter in result.problem.parameters]
    require_transferable(names, azimuths, objects)

    adversaries = _Adversaries.of(result)
    rows = []
    for index, network in enumerate(networks):
        with gradient_flags_kept(network):
            argument = f"classifiers[{index}]"
            classifier = _as_classifier(network, result, normalization, value_range, argument)
            resized = adversaries.changed(partial(_resized, size=classifier.size))
            rows.append({"network": classifier.name, **resized.shown_to(classifier)})
    for azimuth in azimuths:
        turned = adversaries.changed(partial(_turned, angle=azimuth))
        rows.append({"azimuth": f"{azimuth:+g}°", **turned.shown_to(result.classifier)})
    for item in objects:
        exchanged = adversaries.changed(partial(replace, shown=item))
        rows.append({"mesh": Path(item.name).name, **exchanged.shown_to(result.classifier)})
    return rows


def _as_classifier(
    network: Classifier | Callable[[Tensor], Tensor],
    result: AttackResult,
    normalization: Normalization,
    value_range: tuple[float, float],
    argument: str,
) -> Classifier:
    """Convert a plain network to a classifier. A classifier is returned as it is.

    Args:
        network: Classifier or plain network.
        result: Result of an attack. The plain network has the image size, the classes and the
            device of the attacked classifier.
        normalization: Normalization of images for a plain network, as `attack` takes it.
        value_range: Values of black and white that a plain network takes.
        argument: Name of the network in error messages.

    Returns:
        The classifier.
    """
    if isinstance(network, Classifier):
        return network
    attacked = result.classifier
    device = result.images_in_views.device
    options = (attacked.size, attacked.classes, normalization, value_range, device)
    return as_classifier(network, *options, argument)


def require_transferable(
    parameters: Collection[str],
    azimuths: Collection[float],
    objects: Collection[Any],
) -> None:
    """Check that what an attack changed can be shown in other views and on other meshes.

    Args:
        parameters: Names of the attacked parameters.
        azimuths: Degrees by which cameras are turned.
        objects: Other meshes.

    Raises:
        InputError: If a parameter belongs to its view or its mesh alone.
    """
    bound_to_view = [name for name in parameters if not parameter_class(name).fits_other_views]
    bound_to_mesh = [name for name in parameters if not parameter_class(name).fits_other_meshes]
    for argument, requested, bound_parameters in (
        ("azimuths", azimuths, bound_to_view),
        ("meshes", objects, bound_to_mesh),
    ):
        if requested and bound_parameters:
            raise InputError(
                f"{argument}: attacked {bound_parameters[0]} cannot be transferred to others, "
                "leave one of them out",
            )


@dataclass(frozen=True)
class Successes:
    """Masks of the E examples that are a success. `add` adds successes in place.

    Attributes:
        counted: With the noise of a sensor, as `fooled_in_views` counts,
            shape (E,), bool.
        without_noise: By the images as they are, shape (E,), bool.
    """

    counted: Tensor
    without_noise: Tensor

    @staticmethod
    def before(result: AttackResult) -> Successes:
        """Return the examples that meet the criterion before an attack.

        Args:
            result: The result of the attack.

        Returns:
            Masks that `add` may change.
        """
        return Successes(result.success_before.clone(), result.success_before.clone())

    def clone(self) -> Successes:
        """Return an independent copy."""
        return Successes(self.counted.clone(), self.without_noise.clone())

    @property
    def left(self) -> Tensor:
        """Return the indices of the A examples that are no success with noise, shape (A,)."""
        return torch.nonzero(~self.counted).squeeze(1)

    def add(
        self,
        result: AttackResult,
        problem: AttackProblem,
        values: Tensor,
        examples: Tensor,
        images: Tensor,
    ) -> None:
        """Mark the examples that are a success under some values.

        An example is tested further if its images are a success. The images of
        `final_images` then decide, whose shadows and bounces fit the values.

        Args:
            result: The attack, with its criterion and classifier.
            problem: Scene and parameters to which the values belong.
            values: Values of the A examples, shape (A, D).
            examples: Indices of the A examples among all E, shape (A,).
            images: Images of these examples that the problem rendered under
                the values, shape (A, V, 3, H, W).
        """
        is_reached = result.criterion.select(examples).reached(_predicted(result, images))
        rows = torch.nonzero(is_reached).squeeze(1)
        if not len(rows):
            return
        chosen = examples[rows]
        criterion = result.criterion.select(chosen)
        final = final_images(problem, values[rows], chosen, images[rows])
        predicted = _predicted(result, final)
        fooled = fooled_in_views(
            result.preprocessed_model,
            final,
            predicted,
            chosen,
            criterion,
            result.settings,
            result.seed,
        )
        self.without_noise[chosen] |= criterion.reached(predicted)
        self.counted[chosen] |= fooled.all(1)


def _predicted(result: AttackResult, images: Tensor) -> Tensor:
    """Return the classes (A, V) that the attacked classifier sees in images (A, V, 3, H, W)."""
    logits = logits_of(result.preprocessed_model, images, result.settings.batch_size)
    return logits.argmax(2)


def _success_by_draws(
    result: AttackResult,
    found: Successes,
    draw: Callable[[], Tensor],
) -> Successes:
    """Search for successes by random draws of the attack values.

    Args:
        result: The attack. There is one draw for each of its steps, or as many as its queries
            allow if the classifier has no gradients.
        found: Successes so far. Examples with a success are not searched.
        draw: Function that draws values of all E examples, shape (E, D).

    Returns:
        A copy of the successes, with those of the draws.
    """
    found = found.clone()
    for _ in progress(range(_count_draws(result)), "random search"):
        # Indices of the examples without a success so far.
        left = found.left
        if not len(left):
            break
        values = draw()[left]
        with torch.no_grad():
            images = result.problem.render(values, left)
        found.add(result, result.problem, values=values, examples=left, images=images)
    return found


def _count_draws(result: AttackResult) -> int:
    """Return the number of random draws with which the attack is compared.

    With gradients, it is the number of steps. Without, the draws need as many forward passes
    as the attack may use.
    """
    settings = result.settings
    if settings.uses_gradients:
        return settings.max_steps
    # A draw needs passes of the image of each view and of its transformations.
    view_count = result.images_in_views.shape[1]
    passes_per_draw = view_count * (1 + settings.eot.draws)
    return max(1, settings.step_limit // passes_per_draw)


def _success_by_steps(result: AttackResult) -> dict[int, Successes]:
    """Repeat an attack with 3 and 10 times its budget, and count the successes.

    The budget is a number of steps or, without gradients, a number of queries.
    Only the examples without a success so far are attacked again, each from its
    start.

    Args:
        result: Result of the attack with its own budget.

    Returns:
        Successes by budget: those of the attack, and those of each repetition.
        The successes of a smaller budget count for a larger budget, too.
    """
    settings = result.settings
    successes = Successes(result.success, result.success_without_noise)
    successes_by_budget = {settings.step_limit: successes}
    for factor in GROWTH:
        longer_settings = settings.with_budget(factor)
        successes = successes.clone()
        unsuccessful = successes.left
        if len(unsuccessful):
            descent = descend(
                result.preprocessed_model,
                result.problem,
                result.criterion.select(unsuccessful),
                longer_settings,
                examples=unsuccessful,
                seed=result.seed,
            )
            successes.add(
                result,
                result.problem,
                values=descent.values,
                examples=unsuccessful,
                images=descent.images,
            )
        successes_by_budget[longer_settings.step_limit] = successes
    return successes_by_budget


def _fraction(values: Tensor) -> float:
    """Return the mean of values (N,), or 0 if there are none."""
    return float(values.double().mean()) if len(values) else 0.0


def _as_scales(scales: Sequence[float]) -> list[float]:
    """Return factors of radii as a list, or raise InputError."""
    listed = as_list("scales", scales, object, "a list of factors of the radii")
    if not listed:
        raise InputError("scales is empty: give factors of the radii")
    for scale in listed:
        require_number("scales", scale)
        require_range("scales", scale, 1 / MAX_SCALE, MAX_SCALE)
    return listed


def _scaled(settings: StepSettings, scale: float) -> StepSettings:
    """Return settings of a parameter with a scaled norm-ball.

    Args:
        settings: Norm-ball and steps of the parameter.
        scale: Factor of the radius and of the step size. If there is no radius, the scale
            becomes the radius, and the step size stays as it is.

    Returns:
        Changed copy of the settings.
    """
    if settings.radius is None:
        return replace(settings, radius=scale)
    return replace(settings, radius=scale * settings.radius, step_size=scale * settings.step_size)


def _descend_further(
    result: AttackResult,
    problem: AttackProblem,
    values: Tensor,
    found: Successes,
) -> None:
    """Attack the examples without a success further, from the values that they have reached.

    Args:
        result: The attack, with its classifier and settings.
        problem: The scene, and the parameters with their present norm-balls.
        values: Values of all E examples, shape (E, D). Those of the attacked examples are
            replaced by the values at the end of the descent.
        found: Successes so far, to which the new ones are added.
    """
    # Indices of the examples without a success so far.
    left = found.left
    if not len(left):
        return
    end = descend(
        result.preprocessed_model,
        problem,
        result.criterion.select(left),
        result.settings,
        examples=left,
        start=values[left],
        seed=result.seed,
    )
    values[left] = end.values
    found.add(result, problem, values=end.values, examples=left, images=end.images)


def _of_clean_examples(method: str, found: Successes, result: AttackResult) -> dict[str, Tensor]:
    """Select the successes of the N clean-correct examples.

    Args:
        method: Key of the result: "adversarial" or "random".
        found: Successes of all E examples.
        result: The attack, which tells the clean-correct examples.

    Returns:
        Masks (N,) of the examples that are a success: with sensor noise under the key METHOD,
        and without under the key METHOD_without_noise.
    """
    is_clean = result.clean_correct
    return {
        method: found.counted[is_clean].cpu(),
        f"{method}_without_noise": found.without_noise[is_clean].cpu(),
    }


@dataclass(frozen=True)
class _Adversaries:
    """The A adversaries of an attack, and the same examples before the attack.

    Attributes:
        result: The attack.
        examples: Index of each of the A adversaries among the examples.
        before: The A examples before the attack.
        after: The A examples after the attack.
    """

    result: AttackResult
    examples: list[int]
    before: list[Adversary]
    after: list[Adversary]

    @staticmethod
    def of(result: AttackResult) -> _Adversaries:
        """Collect the clean-correct examples for which an attack succeeded.

        Args:
            result: The attack.
        """
        problem = result.problem
        chosen = torch.nonzero(result.clean_correct & result.success).flatten().tolist()
        conditions_before = problem.conditions(problem.start, problem.all_examples)
        conditions_after = result.conditions
        before = []
        after = []
        for example in chosen:
            images = result.images_in_views_before[example], result.images_in_views[example]
            before.append(Adversary.of(problem.scene, example, conditions_before, *images))
            after.append(Adversary.of(problem.scene, example, conditions_after, *images))
        return _Adversaries(result, chosen, before, after)

    def changed(self, change: Callable[[Adversary], Adversary]) -> _Adversaries:
        """Return a copy in which a function has changed each example before and after the attack.

        Args:
            change: Function that changes the cameras, the object or the image size.
        """
        before = [change(adversary) for adversary in self.before]
        after = [change(adversary) for adversary in self.after]
        return replace(self, before=before, after=after)

    def shown_to(self, classifier: Classifier) -> dict[str, Any]:
        """Render the adversaries and classify them.

        Args:
            classifier: Classifier, which has the classes of the adversaries.

        Returns:
            Predictions and successes by name, as `transfer` describes them.
        """
        settings = self.result.settings
        criterion = self._criterion_in(classifier)
        logits_before = self._logits(self._rendered(self.before, classifier), classifier)
        images = self._rendered(self.after, classifier)
        logits = self._logits(images, classifier)
        predicted_before = predictions(logits_before, classifier.classes)
        success_in_views = fooled_in_views(
            preprocessed_model(settings, classifier),
            images,
            logits.argmax(2),
            torch.tensor(self.examples, dtype=torch.long),
            criterion,
            settings,
            self.result.seed,
        )
        return {
            "clean_correct": (logits_before.argmax(2) == criterion.source).all(1).tolist(),
            "success": success_in_views.all(1).tolist(),
            "success_without_noise": criterion.reached(logits.argmax(2)).tolist(),
            "predicted_before": predicted_before["predicted"],
            "confidence_before": predicted_before["confidence"],
            **predictions(logits, classifier.classes),
        }

    def _criterion_in(self, classifier: Classifier) -> Criterion:
        """Return the criterion of the adversaries with class indices of another classifier.

        The attacked classifier may have the same classes in another order, so class names are
        compared.
        """
        view_count = self.result.problem.scene.views
        sources = [[adversary.shown.label] * view_count for adversary in self.after]
        source = self._labels(sources, classifier)
        if self.result.criterion.target is None:
            return Criterion(source)
        attacked_classes = self.result.classifier.classes
        targets = [
            [attacked_classes[index] for index in self.result.criterion.target[example].tolist()]
            for example in self.examples
        ]
        return Criterion(source, self._labels(targets, classifier))

    def _labels(self, names: list[list[str]], classifier: Classifier) -> Tensor:
        """Convert class names to indices.

        Args:
            names: V class names for each of the A adversaries.
            classifier: Classifier whose indices are returned.

        Returns:
            Indices, shape (A, V).
        """
        indices = [classifier.label(name) for views in names for name in views]
        return torch.tensor(indices).long().view(-1, self.result.problem.scene.views)

    def _rendered(self, adversaries: list[Adversary], classifier: Classifier) -> Tensor:
        """Render adversaries.

        Args:
            adversaries: A adversaries, whose images have the size of the classifier.
            classifier: Classifier that gets the images.

        Returns:
            Images in [0, 1], shape (A, V, 3, size, size).
        """
        scene = self.result.problem.scene
        size = classifier.size
        if not adversaries:
            return self.result.images_in_views.new_empty(0, scene.views, 3, size, size)
        images = []
        for adversary in progress(adversaries, "transfer"):
            images.append(adversary.render_views(scene.rasterizer))
        return torch.stack(images).to(self.result.images_in_views)

    def _logits(self, images: Tensor, classifier: Classifier) -> Tensor:
        """Return the logits (A, V, C) of images (A, V, 3, size, size), on the CPU."""
        settings = self.result.settings
        if not len(images):
            return torch.empty(0, images.shape[1], len(classifier.classes))
        model = preprocessed_model(settings, classifier)
        return logits_of(model, images, settings.batch_size).cpu()


def _resized(adversary: Adversary, size: int) -> Adversary:
    """Return an adversary whose images have another size in pixels."""
    if adversary.settings.size == size:
        return adversary
    background = _with_size(adversary.background[None], size)[0].clamp(0, 1)
    pixels = None if adversary.pixels is None else _with_size(adversary.pixels, size)
    settings = replace(adversary.settings, size=size)
    return replace(adversary, settings=settings, background=background, pixels=pixels)


def _with_size(images: Tensor, size: int) -> Tensor:
    """Return images (N, C, H, W) in another size in pixels."""
    return F.interpolate(images, (size, size), mode="bilinear", antialias=True, align_corners=False)


def _turned(adversary: Adversary, angle: float) -> Adversary:
    """Return an adversary seen by cameras that are turned around the vertical, in degrees."""
    cameras = [replace(camera, azimuth=camera.azimuth + angle) for camera in adversary.cameras]
    return replace(adversary, cameras=tuple(cameras))
