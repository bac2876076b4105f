"""What an attack is worth: random search, success by radius, transfer, and re-render checks."""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.attacks.adversary import MITSUBA, Adversary, read_adversary
from augment.attacks.attack import AttackResult, AttackSettings, logits_of, predictions
from augment.attacks.criteria import Goal
from augment.attacks.descent import Part, descend, descend_in_parts
from augment.attacks.eot import as_jpeg
from augment.classifiers import Classifier
from augment.objects import SceneObject
from augment.utils import Phases, generator, progress
from renderer.errors import InputError, require_choice
from renderer.image import background_term, clamp, to_bytes, to_unit, tonemap_composite
from renderer.io.mitsuba import SCENE, mitsuba, render_mitsuba_scene
from renderer.rasterizer import Rasterizer

GROWTH = (1, 3, 10)


@dataclass(frozen=True)
class Checks:
    """Shares of the examples, in [0, 1], and mean costs.

    cost_fell: of those that were not fooled to begin with. success, random_search and success_by_steps: of those that
    were recognized before. random_search: fooled by any of as many draws as the attack had passes, each as far from the
    start as the attack may go or went. success_by_steps: fooled within the steps, ×3 and ×10.
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
        """What a reader must know before believing the attack."""
        found = {
            "random search does as well or better": self.success > 0 and self.random_search >= self.success,
            "the cost rose in some examples": self.cost_fell < 1,
            "some first gradients are exactly zero": self.zero_gradient > 0,
        }
        return [warning for warning, holds in found.items() if holds]


def check(attacked: AttackResult) -> Checks:
    """Search at random and descend for ten times as long, beside an attack that is done."""
    result, draws = attacked.descent, generator(attacked.seed, "random search")
    open_cases = ~result.success_before
    fell = (result.cost < result.cost_before) | result.success
    draw = partial(attacked.problem.sample_as_far, result.values, draws)
    random = success_by_draws(attacked, result.success_before, draw)
    return Checks(
        cost_before=float(result.cost_before.mean()),
        cost=float(result.cost.mean()),
        cost_fell=_share(fell[open_cases]) if open_cases.any() else 1.0,
        zero_gradient=_share(result.zero_gradient),
        success=_share(attacked.success[attacked.clean_correct]),
        random_search=_share(random[attacked.clean_correct]),
        success_by_steps=_success_by_steps(attacked),
    )


def success_by_draws(attacked: AttackResult, success: Tensor, draw: Callable[[], Tensor]) -> Tensor:
    """(E,) bool: whether `success` (E,) says so, or any of as many draws (E, D) as the attack had steps fools."""
    success = success.clone()
    for _ in range(attacked.settings.max_steps):
        left = torch.nonzero(~success).squeeze(1)
        if not len(left):
            break
        drawn = draw()[left]
        with torch.no_grad():
            images = attacked.problem.render(drawn, left)
        predicted = logits_of(attacked.preprocessed_model, images, attacked.settings.batch_size).argmax(2)
        success[left] = attacked.goal.of(left).reached(predicted)
    return success


def _success_by_steps(attacked: AttackResult) -> dict[int, float]:
    settings, phases = attacked.settings, Phases(attacked.problem.start.device)
    longest = replace(settings, max_steps=settings.max_steps * max(GROWTH))
    seen = settings.eot_model(attacked.classifier, attacked.seed)
    result = descend(seen, attacked.problem, attacked.goal, longest, phases)
    limits = [settings.max_steps * factor for factor in GROWTH]
    return {limit: _share((result.success & (result.success_at <= limit))[attacked.clean_correct]) for limit in limits}


def _share(values: Tensor) -> float:
    return float(values.double().mean()) if len(values) else 0.0


@dataclass(frozen=True)
class Sweep:
    """What norm-balls of R radii hold for the N examples that were recognized before.

    radii: of each kind of parameter by name, R times, ascending. adversarial, random: (R, N) bool, whether a descent or
    a random search has fooled the classifier in this ball or in a smaller one, which lies within it.
    """

    radii: list[dict[str, float]]
    adversarial: Tensor
    random: Tensor


def sweep(attacked: AttackResult, scales: Sequence[float]) -> Sweep:
    """Search the balls around an attack's start from the smallest on, in both ways with as many renders.

    scales: times the radius of each kind, or where that is None, times 1. In each ball, examples that are not fooled
    yet go on from where they ended in the one before, for `max_steps` more, or get as many uniform draws.
    """
    if not scales:
        raise InputError("scales is empty: give what to multiply the radii by")
    settings, problem, goal = attacked.settings, attacked.problem, attacked.goal
    parameters = settings.parameters
    seen, draws = settings.eot_model(attacked.classifier, attacked.seed), generator(attacked.seed, "sweep")
    values, success = problem.start.clone(), attacked.descent.success_before.clone()
    random, radii, found = success.clone(), [], []
    for scale in progress(sorted(set(scales)), "radii"):
        radii.append({name: scale * (1.0 if kind.radius is None else kind.radius) for name, kind in parameters.items()})
        balls = within(settings, radii[-1]).problem(problem.scene)
        left = torch.nonzero(~success).squeeze(1)
        if len(left):
            part, phases = Part(balls, left, values[left]), Phases(values.device)
            result = descend_in_parts(seen, part, goal.of(left), settings, phases, (), problem.scene.at_once)
            values[left], success[left] = result.values, result.success
        random = success_by_draws(attacked, random, partial(balls.sample, draws))
        found.append((success[attacked.clean_correct].cpu(), random[attacked.clean_correct].cpu()))
    return Sweep(radii, *map(torch.stack, zip(*found, strict=True)))


def within(settings: AttackSettings, radii: Mapping[str, float]) -> AttackSettings:
    """The settings with radii by kind."""
    parameters: dict[str, Any] = {name: replace(kind, radius=radii[name]) for name, kind in settings.parameters.items()}
    return replace(settings, **parameters)


Pair = tuple[Adversary, Adversary]  # an example before the attack, and after
OF_MESH, OF_VIEW = ("geometry", "albedo", "pixels"), ("pixels",)  # kinds of which no other has what was changed


@dataclass(frozen=True)
class Transfer:
    """What the A adversaries, examples that were recognized and then fooled, do elsewhere.

    kind: "network", "azimuth" or "mesh"; name: which. classes: the network's. before, after: (A, V, C) logits.
    clean_correct: (A,) bool, in every view before the attack. success: (A,) bool, whether the attack's criterion is met
    in every view after it; it counts only of what was recognized.
    """

    kind: str
    name: str
    classes: Sequence[str]
    before: Tensor
    after: Tensor
    clean_correct: Tensor
    success: Tensor


def transfer(
    attacked: AttackResult,
    classifiers: Sequence[Classifier] = (),
    azimuths: Sequence[float] = (),
    objects: Sequence[SceneObject] = (),
) -> Iterator[Transfer]:
    """Render an attack's adversaries anew for each classifier, at its size; for the one that was attacked, from cameras
    turned by degrees around the vertical; and, in place of its object, for each of others.

    What is added to pixels or is behind the object is resized for another network. InputError: as
    `require_transferable`, and where a classifier lacks a class.
    """
    require_transferable([kind.name for kind in attacked.problem.parameters], azimuths, objects)
    pairs, own = _pairs(attacked), attacked.classifier

    def judged(change: Callable[[Adversary], Adversary], kind: str, name: str, by: Classifier) -> Transfer:
        return _judged(attacked, [(change(old), change(new)) for old, new in pairs], kind, name, by)

    for classifier in classifiers:
        yield judged(partial(_resized, size=classifier.size), "network", classifier.name, classifier)
    for angle in azimuths:
        yield judged(partial(_turned, angle=math.radians(angle)), "azimuth", f"{angle:+g}°", own)
    for shown in objects:
        yield judged(partial(replace, shown=shown), "mesh", Path(shown.name).name, own)


def require_transferable(parameters: Collection[str], azimuths: Collection[float], objects: Collection[Any]) -> None:
    """InputError where kinds of parameters belong to a view or a mesh that is to be another."""
    for name, wanted, bound in (("azimuths", azimuths, OF_VIEW), ("meshes", objects, OF_MESH)):
        if wanted and (mine := [kind for kind in parameters if kind in bound]):
            raise InputError(f"transfer.{name}: attack={mine[0]} belongs to what was attacked: leave one of them out")


def _pairs(attacked: AttackResult) -> list[Pair]:
    scene, problem = attacked.problem.scene, attacked.problem
    ends = problem.conditions(problem.start, problem.everything), attacked.conditions
    found = []
    for example in torch.nonzero(attacked.clean_correct & attacked.success).flatten().tolist():
        images = attacked.images_before[example], attacked.images[example]
        old, new = (Adversary.of(scene, example, each, *images) for each in ends)
        found.append((old, new))
    return found


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


def _judged(attacked: AttackResult, pairs: Sequence[Pair], kind: str, name: str, classifier: Classifier) -> Transfer:
    goal, settings = _goal(attacked, [new.shown.label for _, new in pairs], classifier), attacked.settings
    rasterizer, views, preprocessed_model = (
        attacked.problem.scene.rasterizer,
        attacked.problem.scene.views,
        settings.preprocessed_model(classifier),
    )

    def logits(adversaries: Sequence[Adversary]) -> Tensor:
        if not adversaries:
            return torch.empty(0, views, len(classifier.classes))
        images = torch.stack([each.render(rasterizer) for each in adversaries]).to(attacked.images)
        return logits_of(preprocessed_model, images, settings.batch_size).cpu()

    before, after = (logits([pair[side] for pair in pairs]) for side in (0, 1))
    clean_correct = (before.argmax(2) == goal.source).all(1)
    return Transfer(kind, name, classifier.classes, before, after, clean_correct, goal.reached(after.argmax(2)))


def _goal(attacked: AttackResult, labels: Sequence[str], classifier: Classifier) -> Goal:
    """The attack's own, by the names of its classes, for adversaries that show things with labels (A,)."""
    own, views = attacked.goal, attacked.problem.scene.views
    source = torch.tensor([[classifier.label(label)] * views for label in labels], dtype=torch.int64).view(-1, views)
    if own.target is None:
        return Goal(source)
    wanted = own.target[attacked.clean_correct & attacked.success].tolist()
    names = attacked.classifier.classes
    target = [[classifier.label(names[index]) for index in row] for row in wanted]
    return Goal(source, torch.tensor(target, dtype=torch.int64).view(-1, views))


JPEG_QUALITY = 90
RENDERERS = ("reload", "mitsuba")


@dataclass(frozen=True)
class RerenderCheck:
    """What a classifier makes of another version of E examples' images after an attack.

    logits: (E, V, C). success: (E,) bool, in every view. largest, mean: (E,) absolute differences of values.
    """

    version: str
    logits: Tensor
    success: Tensor
    largest: Tensor
    mean: Tensor

    def of(self, example: int, classes: Sequence[str]) -> dict[str, Any]:
        """One example's numbers."""
        return {
            "success": bool(self.success[example]),
            **predictions(self.logits[example], classes),
            "largest_difference": float(self.largest[example]),
            "mean_difference": float(self.mean[example]),
        }


def require_renderers(names: Sequence[str]) -> None:
    """InputError unless each is known and installed."""
    for name in names:
        require_choice("attack.verify", name, RENDERERS)
    if MITSUBA in names:
        with mitsuba():
            pass


def verify(attacked: AttackResult, folders: Sequence[Path], renderers: Sequence[str]) -> list[RerenderCheck]:
    """A verdict on the images as floats, rounded to 8 bits, as JPEG, and on what each renderer makes of the folders.

    renderers: "reload", ours; "mitsuba", Mitsuba's direct illumination, in which concave meshes shade themselves.
    """
    images = attacked.images.cpu()
    rounded = to_unit(to_bytes(images))
    versions = {"float": images, "8 bits": rounded, f"JPEG {JPEG_QUALITY}": as_jpeg(images, JPEG_QUALITY)}
    anew = [rendered(folder, renderers, attacked.problem.scene.rasterizer) for folder in folders if renderers]
    versions |= {name: torch.stack([each[name] for each in anew]) for name in renderers}
    return [_verdict(attacked, name, seen.to(attacked.images)) for name, seen in versions.items()]


def rendered(folder: Path, renderers: Sequence[str], rasterizer: Rasterizer) -> dict[str, Tensor]:
    """(V, 3, size, size) by each renderer, from an adversary's files alone, which are read once."""
    adversary = read_adversary(folder)
    by = {
        "reload": lambda: adversary.render(rasterizer),
        "mitsuba": lambda: _by_mitsuba(adversary, folder / MITSUBA / SCENE),
    }
    return {name: by[name]() for name in renderers}


def _by_mitsuba(adversary: Adversary, scene: Path) -> Tensor:
    seen = render_mitsuba_scene(scene, len(adversary.cameras))
    encoding = adversary.settings.encoding
    images = tonemap_composite(seen[:, :3] + background_term(seen[:, 3:], adversary.background, encoding), encoding)
    return images if adversary.pixels is None else clamp(images + adversary.pixels)


def _verdict(attacked: AttackResult, version: str, images: Tensor) -> RerenderCheck:
    logits = logits_of(attacked.classifier, images, attacked.settings.batch_size)
    off = (images - attacked.images).abs().flatten(1)
    return RerenderCheck(version, logits, attacked.goal.reached(logits.argmax(2)), off.amax(1), off.mean(1))
