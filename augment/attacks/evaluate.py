"""The worth of an attack's result: random search, more steps, success by radius, and transfer."""

from __future__ import annotations

import math
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
from augment.attacks.descent import Goal, descend
from augment.attacks.problem import AttackProblem
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.progress import progress
from augment.random_streams import generator
from renderer.errors import FACTOR, LARGEST, InputError, require_range
from renderer.validation import as_list, require_number

GROWTH = (3, 10)  # times as many steps as the attack had
CHECKED = {  # results of `check` that `warnings` reads
    "success",
    "success_without_noise",
    "random_search",
    "cost_fell",
    "zero_gradient",
}
OF_MESH, OF_VIEW = ("geometry", "pose", "material", "albedo", "pixels"), ("pixels",)  # that no other mesh or view has


def check(result: AttackResult) -> dict[str, Any]:
    """Compare an attack with as many random draws as it has steps, and with descents of 3 and 10 times as many.

    Draws are as far from the start as the attack may go (uniform in the norm-ball) or, without a radius, went. A
    success counts as in the result, with the noise of a sensor, and also for all longer descents. Returns fractions of
    the examples and mean costs. cost_fell: of the examples without success before. success, success_with_margin,
    random_search, success_by_steps, and NAME_without_noise of these but the second: of the clean-correct examples.

    >>> checks = augment.check(result)
    >>> checks["success"], checks["cost"] < checks["cost_before"]
    (1.0, True)
    """
    require_result(result)
    descent, problem, clean = result.descent, result.problem, result.clean_correct
    open_cases = ~result.success_before
    fell = (descent.cost < descent.cost_before) | result.success_without_noise
    draw = partial(problem.sample, generator(result.seed, "random search"), descent.values)
    random = _success_by_draws(result, Successes.before(result), draw)
    by_steps = _success_by_steps(result)
    return {
        "cost_before": float(descent.cost_before.mean()),
        "cost": float(descent.cost.mean()),
        "cost_fell": _fraction(fell[open_cases]) if open_cases.any() else 1.0,
        "zero_gradient": _fraction(descent.zero_gradient),
        "success": _fraction(result.success[clean]),
        "success_without_noise": _fraction(result.success_without_noise[clean]),
        "success_with_margin": _fraction(result.success_with_margin[clean]),
        "random_search": _fraction(random.counted[clean]),
        "random_search_without_noise": _fraction(random.without_noise[clean]),
        "success_by_steps": {steps: _fraction(found.counted[clean]) for steps, found in by_steps.items()},
        "success_by_steps_without_noise": {
            steps: _fraction(found.without_noise[clean]) for steps, found in by_steps.items()
        },
    }


@dataclass(frozen=True)
class Successes:
    """Which of E examples are a success, (E,) bool each: counted as `fooled_in_views` does, and without noise."""

    counted: Tensor
    without_noise: Tensor

    @staticmethod
    def before(result: AttackResult) -> Successes:
        """Those before any step, which nothing goes on with."""
        return Successes(result.success_before.clone(), result.success_before.clone())

    def clone(self) -> Successes:
        return Successes(self.counted.clone(), self.without_noise.clone())

    @property
    def left(self) -> Tensor:
        """The numbers of the examples that are not counted."""
        return torch.nonzero(~self.counted).squeeze(1)

    def add(
        self,
        result: AttackResult,
        problem: AttackProblem,
        values: Tensor,
        examples: Tensor,
        images: Tensor,
    ) -> None:
        """Count examples (A,) under values (A, D), by the images (A, V, 3, H, W) that the problem rendered of them.

        Where these show a success, the final images decide; see `final_images`.
        """
        reached = result.goal.of(examples).reached(_predicted(result, images))
        rows = torch.nonzero(reached).squeeze(1)
        if not len(rows):
            return
        chosen = examples[rows]
        goal = result.goal.of(chosen)
        final = final_images(problem, values[rows], chosen, images[rows])
        predicted = _predicted(result, final)
        fooled = fooled_in_views(
            result.preprocessed_model, final, predicted, chosen, goal, result.settings, result.seed
        )
        self.without_noise[chosen] |= goal.reached(predicted)
        self.counted[chosen] |= fooled.all(1)


def _success_by_steps(result: AttackResult) -> dict[int, Successes]:
    """By number of steps, the successes of descents from the start; examples that count already are left out."""
    settings, problem = result.settings, result.problem
    found = Successes(result.success, result.success_without_noise)
    by_steps = {settings.max_steps: found}
    for factor in GROWTH:
        longer = replace(settings, max_steps=factor * settings.max_steps)
        found = found.clone()
        left = found.left
        if len(left):
            goal = result.goal.of(left)
            model = result.preprocessed_model
            end = descend(model, problem, goal, longer, examples=left, seed=result.seed)
            found.add(result, problem, end.values, left, end.images)
        by_steps[longer.max_steps] = found
    return by_steps


def warnings(checks: Mapping[str, Any]) -> list[str]:
    """Reasons to doubt an attack with these results of `check`."""
    lost = checks["success_without_noise"] - checks["success"]
    reasons = {
        "most successes do not survive a sensor's noise, a larger attack.margin helps": lost > checks["success"],
        "random search does as well or better": 0 < checks["success"] <= checks["random_search"],
        "the cost rose in some examples": checks["cost_fell"] < 1,
        "some first gradients are exactly zero": checks["zero_gradient"] > 0,
    }
    return [warning for warning, holds in reasons.items() if holds]


def _success_by_draws(result: AttackResult, found: Successes, draw: Callable[[], Tensor]) -> Successes:
    """What was found, with what as many draws (E, D) as the attack had steps add to it."""
    found = found.clone()
    for _ in progress(range(result.settings.max_steps), "random search"):
        left = found.left
        if not len(left):
            break
        values = draw()[left]
        with torch.no_grad():
            images = result.problem.render(values, left)
        found.add(result, result.problem, values, left, images)
    return found


def _predicted(result: AttackResult, images: Tensor) -> Tensor:
    return logits_of(result.preprocessed_model, images, result.settings.batch_size).argmax(2)


def _fraction(values: Tensor) -> float:
    return float(values.double().mean()) if len(values) else 0.0


def success_by_radius(result: AttackResult, scales: Sequence[float]) -> list[dict[str, Any]]:
    """Search norm-balls around an attack's start from the smallest to the largest, by descent and at random.

    scales: factors of radii and steps or, without a radius, the radii. A success at one radius counts at all larger
    radii; only the rest is attacked again, from where it ended at the radius before, for `max_steps` more steps, and
    gets as many uniform draws. Returns for each scale, ascending: radii, by parameter; adversarial and random, (N,)
    bool of the N clean-correct examples, whether a descent or a random search succeeds, which counts as in the result,
    with the noise of a sensor; adversarial_without_noise and random_without_noise.

    >>> small, large = augment.success_by_radius(result, [0.001, 1])
    >>> small["radii"], small["adversarial"], large["adversarial"]
    ({'lighting': 0.001}, tensor([False]), tensor([True]))
    """
    require_result(result)
    scales = as_list("scales", scales, object, "a list of factors of the radii")
    if not scales:
        raise InputError("scales is empty: give factors of the radii")
    for scale in scales:
        require_number("scales", scale)
        require_range("scales", scale, 1 / FACTOR, FACTOR)
    settings, problem, goal, clean = result.settings, result.problem, result.goal, result.clean_correct
    draws = generator(result.seed, "sweep")
    values, found = problem.start.clone(), Successes.before(result)
    random, rows = found.clone(), []
    for scale in progress(sorted(set(scales)), "radii"):
        balls: dict[str, Any] = {
            name: replace(steps, radius=scale)
            if steps.radius is None
            else replace(steps, radius=scale * steps.radius, step_size=scale * steps.step_size)
            for name, steps in settings.parameters.items()
        }
        scaled = replace(settings, **balls).problem(problem.scene)
        left = found.left
        if len(left):
            end = descend(
                result.preprocessed_model,
                scaled,
                goal.of(left),
                settings,
                examples=left,
                start=values[left],
                seed=result.seed,
            )
            values[left] = end.values
            found.add(result, scaled, end.values, left, end.images)
        random = _success_by_draws(result, random, partial(scaled.sample, draws))
        row: dict[str, Any] = {"radii": {name: ball.radius for name, ball in balls.items()}}
        for method, successes in (("adversarial", found), ("random", random)):
            row[method] = successes.counted[clean].cpu()
            row[f"{method}_without_noise"] = successes.without_noise[clean].cpu()
        rows.append(row)
    return rows


def transfer(
    result: AttackResult,
    classifiers: Sequence[Classifier] = (),
    azimuths: Sequence[float] = (),
    objects: Sequence[SceneObject] = (),
) -> list[dict[str, Any]]:
    """Render an attack's A adversaries, its clean-correct examples with success, elsewhere: for other classifiers, each
    at its size; for the attacked one, from cameras turned by degrees around the vertical, and with other objects.

    Returns a dict for each, for JSON. network, azimuth or mesh: which. clean_correct, success: A times whether every
    view is classified correctly before the attack, and whether the goal is reached in every view after it, which counts
    only of the clean-correct, and as in the result with the noise of a sensor; success_without_noise: by the images as
    they are. predicted_before, confidence_before, predicted, confidence: A × V. Added pixels and the background are
    resized for another network. InputError: as `require_transferable`, and a class that one lacks.

    >>> larger = augment.Classifier(result.classifier.function, size=12, classes=["orange", "other"])
    >>> [network, turned] = augment.transfer(result, [larger], azimuths=[20.0])
    >>> network["predicted"], turned["azimuth"]
    ([['other']], '+20°')
    """
    require_result(result)
    classifiers = as_list("classifiers", classifiers, Classifier, "a list of augment.Classifier")
    objects = as_list("objects", objects, SceneObject, "a list of scene objects, such as scene.objects")
    azimuths = as_list("azimuths", azimuths, object, "a list of degrees")
    for azimuth in azimuths:
        require_number("azimuths", azimuth)
        require_range("azimuths", azimuth, -LARGEST, LARGEST)
    require_transferable([parameter.name for parameter in result.problem.parameters], azimuths, objects)
    problem, attacked, scene = result.problem, result.classifier, result.problem.scene
    ends = problem.conditions(problem.start, problem.everything), result.conditions
    chosen = torch.nonzero(result.clean_correct & result.success).flatten().tolist()
    images = [*zip(result.images_before, result.images, strict=True)]
    sides = [[Adversary.of(scene, row, end, *images[row]) for row in chosen] for end in ends]

    def elsewhere(
        kind: str, name: str, change: Callable[[Adversary], Adversary], classifier: Classifier = attacked
    ) -> dict[str, Any]:
        before, after = ([change(adversary) for adversary in side] for side in sides)
        source, target = labels([[adversary.shown.label] * scene.views for adversary in after], classifier), None
        if result.goal.target is not None:
            names = [[attacked.classes[index] for index in result.goal.target[example]] for example in chosen]
            target = labels(names, classifier)
        images_after = rendered(after, classifier)
        logits_before = logits(rendered(before, classifier), classifier)
        logits_after = logits(images_after, classifier)
        predicted_before = predictions(logits_before, classifier.classes)
        goal = Goal(source, target)
        success = fooled_in_views(
            result.settings.preprocessed_model(classifier),
            images_after,
            logits_after.argmax(2),
            torch.tensor(chosen, dtype=torch.long),
            goal,
            result.settings,
            result.seed,
        )
        return {
            kind: name,
            "clean_correct": (logits_before.argmax(2) == source).all(1).tolist(),
            "success": success.all(1).tolist(),
            "success_without_noise": goal.reached(logits_after.argmax(2)).tolist(),
            **{f"{key}_before": values for key, values in predicted_before.items()},
            **predictions(logits_after, classifier.classes),
        }

    def labels(names: list[list[str]], classifier: Classifier) -> Tensor:
        indices = [classifier.label(name) for views in names for name in views]
        return torch.tensor(indices).long().view(-1, scene.views)

    def rendered(adversaries: Sequence[Adversary], classifier: Classifier) -> Tensor:
        if not adversaries:
            return result.images.new_empty(0, scene.views, 3, classifier.size, classifier.size)
        renders = [adversary.render(scene.rasterizer) for adversary in progress(adversaries, "transfer")]
        return torch.stack(renders).to(result.images)

    def logits(images: Tensor, classifier: Classifier) -> Tensor:
        if not len(images):
            return torch.empty(0, scene.views, len(classifier.classes))
        model = result.settings.preprocessed_model(classifier)
        return logits_of(model, images, result.settings.batch_size).cpu()

    return [
        *(elsewhere("network", other.name, partial(_resized, size=other.size), other) for other in classifiers),
        *(elsewhere("azimuth", f"{by:+g}°", partial(_turned, angle=math.radians(by))) for by in azimuths),
        *(elsewhere("mesh", Path(item.name).name, partial(replace, shown=item)) for item in objects),
    ]


def require_transferable(parameters: Collection[str], azimuths: Collection[float], objects: Collection[Any]) -> None:
    """InputError for parameters that another view or another mesh does not have."""
    for name, elsewhere, bound in (("azimuths", azimuths, OF_VIEW), ("meshes", objects, OF_MESH)):
        if elsewhere and (changed := [parameter for parameter in parameters if parameter in bound]):
            raise InputError(f"{name}: attacked {changed[0]} cannot be transferred to others, leave one of them out")


def _resized(adversary: Adversary, size: int) -> Adversary:
    if adversary.settings.size == size:
        return adversary

    def fit(images: Tensor) -> Tensor:
        return F.interpolate(images, (size, size), mode="bilinear", antialias=True, align_corners=False)

    return replace(
        adversary,
        settings=replace(adversary.settings, size=size),
        background=fit(adversary.background[None])[0].clamp(0, 1),
        pixels=None if adversary.pixels is None else fit(adversary.pixels),
    )


def _turned(adversary: Adversary, angle: float) -> Adversary:
    cameras = tuple(replace(camera, azimuth=camera.azimuth + angle) for camera in adversary.cameras)
    return replace(adversary, cameras=cameras)
