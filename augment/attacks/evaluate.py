"""The worth of an attack's result: random search, more steps, success by radius, transfer, and re-render checks."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.attacks.adversary import MITSUBA, Adversary, reload
from augment.attacks.attack import AttackResult, AttackSettings, final_images, logits_of, predictions
from augment.attacks.criteria import Goal
from augment.attacks.descent import Part, descend
from augment.attacks.eot import as_jpeg
from augment.attacks.parameters import AttackProblem
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.utils import generator, progress
from renderer.errors import FACTOR, InputError, require_choice, require_range
from renderer.image import background_term, clamp, to_bytes, to_unit, tonemap_composite
from renderer.io.mitsuba import SCENE, mitsuba, render_mitsuba_scene
from renderer.rasterizer import Rasterizer

GROWTH = (1, 3, 10)


@dataclass(frozen=True)
class Checks:
    """Fractions of the examples, and mean costs.

    cost_fell: of the examples without success before. success, random_search, success_by_steps: of the clean-correct
    examples. random_search: see `random_search`. success_by_steps: by descents of 1, 3 and 10 times as many steps.
    """

    cost_before: float
    cost: float
    cost_fell: float
    zero_gradient: float
    success: float
    random_search: float
    success_by_steps: dict[int, float]

    @property
    def warnings(self) -> list[str]:
        """Reasons to doubt the attack."""
        reasons = {
            "random search does as well or better": self.success > 0 and self.random_search >= self.success,
            "the cost rose in some examples": self.cost_fell < 1,
            "some first gradients are exactly zero": self.zero_gradient > 0,
        }
        return [warning for warning, holds in reasons.items() if holds]


def check(result: AttackResult) -> Checks:
    """Compare an attack with random search, and with a descent of ten times as many steps.

    >>> checks = augment.check(result)
    >>> checks.success, checks.cost < checks.cost_before
    (1.0, True)
    """
    descent, clean = result.descent, result.clean_correct
    open_cases = ~result.success_before
    fell = (descent.cost < descent.cost_before) | result.success
    return Checks(
        cost_before=float(descent.cost_before.mean()),
        cost=float(descent.cost.mean()),
        cost_fell=_fraction(fell[open_cases]) if open_cases.any() else 1.0,
        zero_gradient=_fraction(descent.zero_gradient),
        success=_fraction(result.success[clean]),
        random_search=_fraction(random_search(result)[clean]),
        success_by_steps={limit: _fraction(success[clean]) for limit, success in _success_by_steps(result).items()},
    )


def random_search(result: AttackResult) -> Tensor:
    """(E,) bool: whether any of `max_steps` random draws is a success, each as far from the start as the attack may go
    (uniform in the norm-ball) or, without a radius, went.

    >>> augment.random_search(result).shape
    torch.Size([1])
    """
    draws = generator(result.seed, "random search")
    draw = partial(result.problem.sample_as_far, result.descent.values, draws)
    return _success_by_draws(result, result.success_before, draw)


def _success_by_draws(result: AttackResult, success: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """`success` (E,), or whether any of as many draws (E, D) as the attack had steps is one."""
    success = success.clone()
    for _ in range(result.settings.max_steps):
        left = torch.nonzero(~success).squeeze(1)
        if not len(left):
            break
        values = draw()[left]
        with torch.no_grad():
            images = result.problem.render(values, left)
        predicted = logits_of(result.preprocessed_model, images, result.settings.batch_size).argmax(2)
        reached = result.goal.of(left).reached(predicted)
        success[left] = _confirmed(result, result.problem, reached, values, left, images)
    return success


def _confirmed(
    result: AttackResult, problem: AttackProblem, success: Tensor, values: Tensor, examples: Tensor, images: Tensor
) -> Tensor:
    """`success` (A,) of images that the problem rendered, if the final images confirm it; see `final_images`."""
    rows = torch.nonzero(success).squeeze(1)
    rendered = images[rows]
    final = final_images(problem, values[rows], examples[rows], rendered)
    if final is rendered:
        return success
    predicted = logits_of(result.preprocessed_model, final, result.settings.batch_size).argmax(2)
    return success.index_put((rows,), result.goal.of(examples[rows]).reached(predicted))


def _success_by_steps(result: AttackResult) -> dict[int, Tensor]:
    """(E,) bool by number of steps, of one long descent."""
    settings, problem = result.settings, result.problem
    longest = replace(settings, max_steps=settings.max_steps * max(GROWTH))
    end = descend(result.preprocessed_model, problem, result.goal, longest, seed=result.seed)
    success = _confirmed(result, problem, end.success, end.values, problem.everything, end.images)
    limits = [settings.max_steps * factor for factor in GROWTH]
    return {limit: success & (end.success_at <= limit) for limit in limits}


def _fraction(values: Tensor) -> float:
    return float(values.double().mean()) if len(values) else 0.0


@dataclass(frozen=True)
class RadiusSweep:
    """Success in norm-balls of R radii, of the N clean-correct examples.

    radii: by parameter, R times, ascending. adversarial, random: (R, N) bool, of a descent and of a random search in
    this ball or in a smaller one, which lies within it.
    """

    radii: list[dict[str, float]]
    adversarial: Tensor
    random: Tensor


def success_by_radius(result: AttackResult, scales: Sequence[float]) -> RadiusSweep:
    """Search norm-balls around an attack's start from the smallest to the largest, by descent and at random.

    scales: factors of each parameter's radius or, without one, the radii. A success at one radius counts at all larger
    radii; only the rest is attacked again, from where it ended at the radius before, for `max_steps` more steps, and
    gets as many uniform draws.

    >>> sweep = augment.success_by_radius(result, [0.001, 1])
    >>> sweep.radii, sweep.adversarial.tolist()
    ([{'lighting': 0.001}, {'lighting': 1.0}], [[False], [True]])
    """
    if not scales:
        raise InputError("scales is empty: give factors of the radii")
    for scale in scales:
        require_range("scales", scale, 1 / FACTOR, FACTOR)
    settings, problem, goal = result.settings, result.problem, result.goal
    model, draws = result.preprocessed_model, generator(result.seed, "sweep")
    values, success = problem.start.clone(), result.success_before.clone()
    random, radii, rows = success.clone(), [], []
    own = {name: 1.0 if each.radius is None else each.radius for name, each in settings.parameters.items()}
    for scale in progress(sorted(set(scales)), "radii"):
        radii.append({name: scale * radius for name, radius in own.items()})
        balls = with_radii(settings, radii[-1]).problem(problem.scene)
        left = torch.nonzero(~success).squeeze(1)
        if len(left):
            part = Part(balls, left, values[left])
            end = descend(model, part, goal.of(left), settings, at_once=problem.scene.at_once, seed=result.seed)
            values[left] = end.values
            success[left] = _confirmed(result, balls, end.success, end.values, left, end.images)
        random = _success_by_draws(result, random, partial(balls.sample, draws))
        rows.append((success[result.clean_correct].cpu(), random[result.clean_correct].cpu()))
    return RadiusSweep(radii, *map(torch.stack, zip(*rows, strict=True)))


def with_radii(settings: AttackSettings, radii: Mapping[str, float]) -> AttackSettings:
    """The settings with other radii, by parameter."""
    parameters: dict[str, Any] = {name: replace(each, radius=radii[name]) for name, each in settings.parameters.items()}
    return replace(settings, **parameters)


Pair = tuple[Adversary, Adversary]  # an example before the attack, and after
OF_MESH, OF_VIEW = ("geometry", "albedo", "pixels"), ("pixels",)  # parameters that no other mesh or view has


@dataclass(frozen=True)
class Transfer:
    """The A adversaries, examples that were clean-correct and are successes, elsewhere.

    kind: "network", "azimuth" or "mesh"; name: which. classes: the network's. before, after: (A, V, C) logits.
    clean_correct: (A,) bool, in every view before the attack. success: (A,) bool, whether the attack's criterion is met
    in every view after it; it counts only of the clean-correct.
    """

    kind: str
    name: str
    classes: Sequence[str]
    before: Tensor
    after: Tensor
    clean_correct: Tensor
    success: Tensor


def transfer(
    result: AttackResult,
    classifiers: Sequence[Classifier] = (),
    azimuths: Sequence[float] = (),
    objects: Sequence[SceneObject] = (),
) -> list[Transfer]:
    """Render an attack's adversaries for other classifiers, each at its size; for the attacked classifier, from cameras
    turned by degrees around the vertical; and with other objects in place of the scene's.

    What is added to pixels or is behind the object is resized for another network. InputError: as
    `require_transferable`, and where a classifier lacks a class.

    >>> larger = augment.Classifier(result.classifier.function, size=12, classes=["orange", "other"])
    >>> [network, turned] = augment.transfer(result, [larger], azimuths=[20.0])
    >>> network.after.shape, turned.name
    (torch.Size([1, 1, 2]), '+20°')
    """
    require_transferable([parameter.name for parameter in result.problem.parameters], azimuths, objects)
    scene, problem = result.problem.scene, result.problem
    ends = problem.conditions(problem.start, problem.everything), result.conditions
    chosen = torch.nonzero(result.clean_correct & result.success).flatten().tolist()
    pairs = []
    for example in chosen:
        images = result.images_before[example], result.images[example]
        before, after = (Adversary.of(scene, example, end, *images) for end in ends)
        pairs.append((before, after))

    def elsewhere(change: Callable[[Adversary], Adversary], kind: str, name: str, classifier: Classifier) -> Transfer:
        changed = [(change(before), change(after)) for before, after in pairs]
        return _transfer(result, chosen, changed, kind, name, classifier)

    own = result.classifier
    return [
        *(elsewhere(partial(_resized, size=other.size), "network", other.name, other) for other in classifiers),
        *(elsewhere(partial(_turned, angle=math.radians(by)), "azimuth", f"{by:+g}°", own) for by in azimuths),
        *(elsewhere(partial(replace, shown=item), "mesh", Path(item.name).name, own) for item in objects),
    ]


def require_transferable(parameters: Collection[str], azimuths: Collection[float], objects: Collection[Any]) -> None:
    """InputError for parameters that another view or another mesh does not have."""
    for name, elsewhere, bound in (("azimuths", azimuths, OF_VIEW), ("meshes", objects, OF_MESH)):
        if elsewhere and (changed := [parameter for parameter in parameters if parameter in bound]):
            raise InputError(f"{name}: attacked {changed[0]} cannot be transferred to others, leave one of them out")


def _resized(adversary: Adversary, size: int) -> Adversary:
    """For a network of another size."""
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


def _transfer(
    result: AttackResult, chosen: Sequence[int], pairs: Sequence[Pair], kind: str, name: str, classifier: Classifier
) -> Transfer:
    rasterizer, views, settings = result.problem.scene.rasterizer, result.problem.scene.views, result.settings
    source = [[classifier.label(after.shown.label)] * views for _, after in pairs]
    target = None
    if result.goal.target is not None:
        names = [[result.classifier.classes[index] for index in result.goal.target[example]] for example in chosen]
        target = torch.tensor([[classifier.label(each) for each in row] for row in names]).long().view(-1, views)
    goal = Goal(torch.tensor(source).long().view(-1, views), target)

    def logits(adversaries: Sequence[Adversary]) -> Tensor:
        if not adversaries:
            return torch.empty(0, views, len(classifier.classes))
        images = torch.stack([adversary.render(rasterizer) for adversary in adversaries]).to(result.images)
        return logits_of(settings.preprocessed_model(classifier), images, settings.batch_size).cpu()

    before, after = (logits([pair[side] for pair in pairs]) for side in (0, 1))
    clean_correct = (before.argmax(2) == goal.source).all(1)
    return Transfer(kind, name, classifier.classes, before, after, clean_correct, goal.reached(after.argmax(2)))


JPEG_QUALITY = 90
RENDERERS = ("reload", MITSUBA)


@dataclass(frozen=True)
class RerenderCheck:
    """A classifier's view of another version of E examples' images after an attack.

    logits: (E, V, C). success: (E,) bool, in every view. largest, mean: (E,) absolute differences of pixel values.
    """

    version: str
    logits: Tensor
    success: Tensor
    largest: Tensor
    mean: Tensor

    def of(self, example: int, classes: Sequence[str]) -> dict[str, Any]:
        """One example's numbers, for JSON."""
        return {
            "success": bool(self.success[example]),
            **predictions(self.logits[example], classes),
            "largest_difference": float(self.largest[example]),
            "mean_difference": float(self.mean[example]),
        }


def require_renderers(names: Sequence[str]) -> None:
    """InputError unless each is known and installed."""
    for name in names:
        require_choice("verify", name, RENDERERS)
    if MITSUBA in names:
        with mitsuba():
            pass


def rerender(result: AttackResult, folders: Sequence[Path], renderers: Sequence[str]) -> list[RerenderCheck]:
    """Check the images as floats, rounded to 8 bits, as JPEG, and as each renderer renders them from the examples'
    folders.

    renderers: "reload", ours; "mitsuba", Mitsuba's direct illumination, in which concave meshes shade themselves.
    """
    images = result.images.cpu()
    rounded = to_unit(to_bytes(images))
    versions = {"float": images, "8 bits": rounded, f"JPEG {JPEG_QUALITY}": as_jpeg(images, JPEG_QUALITY)}
    again = [_rendered(folder, renderers, result.problem.scene.rasterizer) for folder in folders if renderers]
    versions |= {name: torch.stack([example[name] for example in again]) for name in renderers}
    return [_rerender_check(result, name, version.to(result.images)) for name, version in versions.items()]


def _rendered(folder: Path, renderers: Sequence[str], rasterizer: Rasterizer) -> dict[str, Tensor]:
    """(V, 3, size, size) by each renderer, from an example's files alone, which are read once."""
    adversary = reload(folder)

    def by_mitsuba() -> Tensor:
        encoding = adversary.settings.encoding
        rgba = render_mitsuba_scene(folder / MITSUBA / SCENE, len(adversary.cameras))
        images = tonemap_composite(rgba[:, :3] + background_term(rgba[:, 3:], adversary.background, encoding), encoding)
        return images if adversary.pixels is None else clamp(images + adversary.pixels)

    by: dict[str, Callable[[], Tensor]] = {"reload": lambda: adversary.render(rasterizer), MITSUBA: by_mitsuba}
    return {name: by[name]() for name in renderers}


def _rerender_check(result: AttackResult, version: str, images: Tensor) -> RerenderCheck:
    logits = logits_of(result.preprocessed_model, images, result.settings.batch_size)
    off = (images - result.images).abs().flatten(1)
    return RerenderCheck(version, logits, result.goal.reached(logits.argmax(2)), off.amax(1), off.mean(1))
