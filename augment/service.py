"""The augmentation service: fresh labelled renders, made against the current weights whenever they are asked for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from augment import utils
from augment.attacks.attack import AttackSettings
from augment.attacks.criteria import NO_CLASS, Goal
from augment.attacks.descent import DescentResult, Part, descend_in_parts
from augment.attacks.parameters import Albedo, AttackProblem, Geometry, Lighting, StepSettings
from augment.build import Shown, build_scene
from augment.labels import is_right, label_loss, require_known
from augment.scene import Conditions, Scene
from augment.utils import BatchSize, Phases, as_found, generator, stream_seed
from augment.variation import VariationSettings, vary
from renderer.arguments import checked, require_fields
from renderer.basis import HARMONICS, Basis
from renderer.errors import FACTOR, InputError, require_choice, require_range
from renderer.lights import perturb

if TYPE_CHECKING:
    from jaxtyping import Float, Int


ARMS = ("none", "random", "adversarial")
INITS = ("scene", "random")
MOST_EXAMPLES = 10**6  # at 32 × 32 pixels they take 12 GB
MOST_EVERY = 10**9
MOST_CANDIDATES = 100


@dataclass
class RandomLightSettings:
    """Perturbations of the initial light: uniform ±amplitude, or scaled to an L2 radius (see `lights.perturb`).

    candidates: how many lights are tried of each example of the random arm, all that `vary` draws of the light and the
    camera's part included, to keep the one of the highest loss.
    """

    amplitude: float = 0.5
    radius: float | None = None
    candidates: int = 1

    def __post_init__(self) -> None:
        require_fields(self)
        require_range("augment.random_light.candidates", self.candidates, 1, MOST_CANDIDATES)
        for name in ("amplitude", "radius"):  # no radius: null
            require_range(f"augment.random_light.{name}", getattr(self, name), 1 / FACTOR, FACTOR)


@dataclass
class TrainingAttackSettings(AttackSettings):
    """Unless kinds are named, the paper's appendix C: 0.05 along the gradient's direction of the light, 30 steps, any
    coefficients.

    step, step_size: those of that light; see `StepSettings` for what "along the direction" means.
    """

    step: str = "unit"
    step_size: float = 0.05
    allow_negative: bool = True
    batch_size: int = 128

    def __post_init__(self) -> None:
        self._light = StepSettings(step=self.step, step_size=self.step_size)
        super().__post_init__()

    @property
    def parameters(self) -> dict[str, StepSettings]:
        return super().parameters or {Lighting.name: self._light}


@dataclass
class AugmentationSettings:
    """What is regenerated, and when.

    init: where an attack begins, the scene as it is ("scene") or a random perturbation of it: of the light by
    `random_light`, of all else uniform in its norm-ball. warm_start: begin where the last attack ended, not there.
    vary: what of the scene is drawn afresh each time. every: after how many training images the renders are made anew,
    counted within an epoch; None: each epoch.
    """

    arm: str = "adversarial"
    examples: int | None = 100
    init: str = "scene"
    warm_start: bool = False
    every: int | None = None
    vary: VariationSettings = field(default_factory=VariationSettings)
    random_light: RandomLightSettings = field(default_factory=RandomLightSettings)
    attack: TrainingAttackSettings = field(default_factory=TrainingAttackSettings)

    def __post_init__(self) -> None:
        require_fields(self)
        for name, choices in {"arm": ARMS, "init": INITS}.items():
            require_choice(f"augment.{name}", getattr(self, name), choices)
        require_range("augment.examples", self.examples, 0, MOST_EXAMPLES)
        require_range("augment.every", self.every, 1, MOST_EVERY)
        if self.arm == "random" or self.init == "random":
            for name, settings in self.attack.parameters.items():
                if name != Lighting.name and settings.radius is None:
                    raise InputError(f"augment.attack.{name}.radius=null has no random draw: set a radius")
        if self.warm_start and self.vary.instances:
            raise InputError("augment.warm_start=true goes on with the last shapes: set augment.vary.instances=false")

    @property
    def renders(self) -> bool:
        """Whether any example is rendered at all."""
        return self.arm != "none" and self.examples != 0

    @property
    def relights(self) -> bool:
        """Whether nothing but the light changes, so that the scene's operators last from epoch to epoch."""
        return not (self.vary.moves or {Geometry.name, Albedo.name} & self.attack.parameters.keys())


MOST = 4


@dataclass(frozen=True)
class AttackExamples:
    """S of the examples that a model errs on, as the scene had them before and under the conditions that fool.

    images_before, images: (S, 3, H, W) in [0, 1]. lights_before, lights: (S, basis.size, 3). answers_before, answers:
    (S, C) probabilities. labels: (S,) int64.
    """

    images_before: Tensor
    images: Tensor
    lights_before: Tensor
    lights: Tensor
    predictions_before: Tensor
    predictions: Tensor
    labels: Tensor
    basis: Basis = HARMONICS

    def __len__(self) -> int:
        return len(self.labels)


def choose_attack_examples(
    model: nn.Module, problem: AttackProblem, values: Tensor, success: Tensor, labels: Tensor
) -> AttackExamples:
    """Up to MOST of the examples that are `success` (E,), evenly drawn, under values (E, D); the model stays as it was.

    The problem's examples are of one view each.
    """
    candidates = torch.nonzero(success).squeeze(1)
    drawn = torch.linspace(0, max(len(candidates) - 1, 0), min(MOST, len(candidates))).round().long()
    rows = candidates[drawn.to(candidates.device)]
    before, after = (problem.conditions(each[rows], rows) for each in (problem.start, values))
    with as_found(model), torch.no_grad():
        images = [problem.scene.render(conditions, rows)[:, 0] for conditions in (before, after)]
        predictions = [model(side).float().softmax(1) if len(rows) else side.new_zeros(0, 0) for side in images]
    return AttackExamples(
        images[0],
        images[1],
        before.light,
        after.light,
        predictions[0],
        predictions[1],
        labels[rows],
        problem.scene.basis,
    )


@dataclass(frozen=True)
class Renders(Dataset[tuple[Tensor, int]]):
    """Labelled examples: images in [0, 1], labels, and diagnostics as plain numbers.

    attack_examples: a few of those that fool, with what they were before; None where that is not known any more.
    As a data set, pairs of an image on the CPU and its label as a number: `data + renders` is both.
    """

    images: Float[Tensor, "E 3 H W"]
    labels: Int[Tensor, " E"]
    diagnostics: Mapping[str, float]
    attack_examples: AttackExamples | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: int) -> tuple[Tensor, int]:
        return self.images[index].cpu(), int(self.labels[index])


@dataclass(eq=False, repr=False)
class AugmentationService:
    """Holds the scene and, where they are kept (`warm_start`), the adversaries' values from one regeneration to the
    next.

    Where several processes train together, each attacks its share of the examples, and all get all renders.
    scene: None where nothing is rendered; one view per example. labels: (E,) int64, see `augment.labels`.
    label: the class that is to be told from hard negatives, the examples of all other labels: attacks light these
    towards it. None: every attack leads away from the example's own class.
    """

    settings: AugmentationSettings
    scene: Scene | None
    labels: Tensor
    seed: int
    phases: Phases
    label: int | None = None
    _continued: Tensor | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        require_fields(self)
        settings = self.settings
        if self.scene is None and settings.renders:
            raise InputError(f"augment.arm={settings.arm} renders augment.examples={settings.examples}: give a scene")

    @classmethod
    @checked
    def from_meshes(
        cls,
        meshes: Sequence[tuple[Shown, int]],
        size: int,
        settings: AugmentationSettings | None = None,
        *,
        views: int = 10,
        backgrounds: Sequence[float | str | Path] = (0.0, 0.25, 0.5, 0.75, 1.0),
        seed: int = 0,
        device: torch.device | str = "cpu",
        **of_scene: Any,
    ) -> AugmentationService:
        """For any training loop: meshes × views × backgrounds renders, as the paper has them unless told otherwise.

        meshes: (file, solid:NAME or `Mesh`; the index of its class) each. size: pixels per side. of_scene: further
        arguments of `build_scene`; as in the paper, 8 × 8 samples per pixel and flat shading are the default.
        """
        named = [(mesh, str(label)) for mesh, label in meshes]
        choices = {"samples": 8, "normals": "flat", "backgrounds": backgrounds, "device": device, **of_scene}
        scene = build_scene(named, size, views, **choices)
        labels = torch.tensor([int(label) for label in scene.labels], device=device)
        settings = replace(settings or AugmentationSettings(), examples=len(scene))
        return cls(settings, scene, labels, seed, Phases(device))

    def __len__(self) -> int:
        """Examples per regeneration."""
        return len(self.labels) if self.settings.renders else 0

    @checked
    def regenerate(self, model: nn.Module, number: int) -> Renders:
        """Fresh examples for the model's current weights; the model is left as it was found.

        number: counts the regenerations of a run from 0. The draw depends on it and the seed alone, so a resumed run
        repeats it.
        """
        require_range("number", number, 0, math.inf)
        if self.scene is None or not self.settings.renders:
            return Renders(torch.zeros(0, 3, 1, 1), self.labels[:0], {})
        random = self.settings.arm == "random"
        lights = self.settings.random_light.candidates if random else 1
        scene = vary(self.scene, self.settings.vary, generator(self.seed, number, "rows"), lights)
        make = self._random if random else self._adversarial
        return make(model, self.settings.attack.problem(scene), number)

    def state_dict(self) -> dict[str, Tensor]:
        """The adversaries' values (E, D), where they continue; empty otherwise."""
        return {} if self._continued is None else {"values": self._continued.cpu()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` gave; InputError where it is from another number of examples or an old version."""
        if not state:
            return
        if "values" not in state:
            raise InputError("the checkpoint continues lights as an older version kept them: resume with that version")
        if len(state["values"]) != len(self.labels):
            raise InputError(
                f"augment.examples: the checkpoint continues {len(state['values'])} examples and the scene has "
                f"{len(self.labels)}; resume with the settings of the run"
            )
        self._continued = state["values"].to(self.labels.device)

    def _random(self, model: nn.Module, problem: AttackProblem, number: int) -> Renders:
        values = self._perturbed(problem, number)
        images = problem.images(values)[:, 0]
        with as_found(model), torch.no_grad(), self.phases("attack_classifier"):
            batches = BatchSize(self.settings.attack.batch_size).map(lambda part: model(images[part]), len(images))
            logits = torch.cat(list(batches))
        labels = self.labels.repeat(self.settings.random_light.candidates)
        require_known(labels, logits)
        success, losses = ~is_right(logits.argmax(1), labels), label_loss(logits, labels)
        worst = losses.unflatten(0, (-1, len(self))).argmax(0) * len(self) + torch.arange(len(self)).to(labels)
        diagnostics = {"attack_success": _mean(success[worst]), "loss": _mean(losses[worst])}
        kept = torch.zeros_like(success).index_fill(0, worst, True)
        attack_examples = choose_attack_examples(model, problem, values, success & kept, labels)
        return Renders(images[worst], self.labels, diagnostics | _changes(problem, values), attack_examples)

    def _adversarial(self, model: nn.Module, problem: AttackProblem, number: int) -> Renders:
        attack, goal = self.settings.attack, self._goal()
        mine = utils.shard(len(problem.start)).to(problem.start.device)
        part = Part(problem, mine, self._start(problem, number)[mine])
        draws = generator(self.seed, number, "restart")
        restarts = (problem.sample(draws)[mine] for _ in range(attack.restarts))
        seen = attack.eot_model(model, stream_seed(self.seed, number))
        result = descend_in_parts(seen, part, goal.of(mine), attack, self.phases, restarts, problem.scene.at_once)
        result = result.merged(mine, len(problem.start))
        if self.settings.warm_start:
            self._continued = result.values
        diagnostics = self._attack_diagnostics(result) | _changes(problem, result.values)
        new_success = result.success & ~result.success_before
        attack_examples = choose_attack_examples(model, problem, result.values, new_success, self.labels)
        return Renders(result.images[:, 0], self.labels, diagnostics, attack_examples)

    def _goal(self) -> Goal:
        if self.label is None:
            return Goal(self.labels[:, None])
        source = torch.where(self.labels < 0, NO_CLASS, self.labels)
        target = torch.where(self.labels == self.label, NO_CLASS, self.label)
        return Goal(source[:, None], target[:, None])

    def _start(self, problem: AttackProblem, number: int) -> Tensor:
        if self._continued is not None:
            return self._continued
        return self._perturbed(problem, number) if self.settings.init == "random" else problem.start

    def _perturbed(self, problem: AttackProblem, number: int) -> Tensor:
        """Random values (E, D), within the norm-balls."""
        random, drawn = self.settings.random_light, []
        for parameter, start in zip(problem.parameters, problem.split(problem.start), strict=True):
            if isinstance(parameter, Lighting):
                none = torch.zeros(start.shape[1] // 3, 3, dtype=start.dtype)
                draws = generator(self.seed, number, "lights")
                offsets = perturb(none, len(start), random.amplitude, random.radius, draws)
                drawn.append(start + offsets.flatten(1).to(start))
            else:
                drawn.append(
                    parameter.sample(generator(self.seed, number, parameter.name), problem.everything).to(start)
                )
        return problem.project(torch.cat(drawn, dim=1), problem.everything)

    def _attack_diagnostics(self, result: DescentResult) -> dict[str, float]:
        attack = self.settings.attack
        return {
            "attack_success_before": _mean(result.success_before),
            "attack_success": _mean(result.success),
            "steps": _mean(result.steps),
            "used_all_steps": _mean(result.steps == attack.max_steps * (1 + attack.restarts)),
            "loss_before": -_mean(result.cost_before),
            "loss": -_mean(result.cost),
            "zero_gradient": _mean(result.zero_gradient),
        }


def _changes(problem: AttackProblem, values: Tensor) -> dict[str, float]:
    """The mean L2 norm of what changed of each condition, and the share of values that are clamped."""
    before, after = (problem.conditions(each, problem.everything) for each in (problem.start, values))
    changes = {
        f"{part.name}_change": _mean((value - getattr(before, part.name)).flatten(1).norm(dim=1))
        for part in fields(Conditions)
        if (value := getattr(after, part.name)) is not None
    }
    return changes | {"clamped": _mean(problem.scene.clamped_share(after, problem.everything))}


def _mean(values: Tensor) -> float:
    return float(values.double().mean())
