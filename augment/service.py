"""The augmentation service: fresh labelled renders, made against the current weights whenever they are asked for."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from augment import processes
from augment.attack import AttackResult, DescentSettings, Goal, Part, descend
from augment.model_state import as_found
from augment.parameters.kind import check_step, direction
from augment.phases import Phases
from augment.scene import Scene
from augment.seeding import generator
from renderer.errors import FACTOR, InputError, require_range
from renderer.lights import perturb

ARMS = ("none", "random", "adversarial")
STARTS = ("light", "random")
SCHEDULES = ("restart", "continue")
MOST_EXAMPLES = 10**6  # at 32 × 32 pixels they take 12 GB
MOST_EVERY = 10**9


@dataclass
class RandomLights:
    """Perturbations of the initial light: uniform ±amplitude, or scaled to an L2 radius (see `lights.perturb`)."""

    amplitude: float = 0.5
    radius: float | None = None

    def __post_init__(self):
        for name in ("amplitude", "radius"):  # no radius: null
            require_range(f"augment.random.{name}", getattr(self, name), 1 / FACTOR, FACTOR)


@dataclass
class LightAttackSettings:
    """The paper's appendix C: 0.05 along the gradient's direction, at most 30 steps.

    step: what "along the direction" means: the gradient at unit L2 norm per example, as it is, or its sign.
    batch_size: examples per pass through the classifier.
    """

    step: str = "unit"
    step_size: float = 0.05
    max_steps: int = 30
    batch_size: int = 128

    def __post_init__(self):
        check_step(self.step, self.step_size, "augment.attack.")
        self.descent()

    def descent(self) -> DescentSettings:
        """How long it lasts."""
        return DescentSettings(self.max_steps, batch_size=self.batch_size)


@dataclass
class AugmentationSettings:
    """What is regenerated, and when.

    every: after how many training images the renders are made anew, counted within an epoch; None: each epoch.
    start: where an attack begins, the scene's light or a random perturbation of it. lights: "restart" begins there
    each time, "continue" begins where the last attack ended.
    """

    arm: str = "adversarial"
    examples: int = 100
    every: int | None = None
    start: str = "light"
    lights: str = "restart"
    random: RandomLights = field(default_factory=RandomLights)
    attack: LightAttackSettings = field(default_factory=LightAttackSettings)

    def __post_init__(self):
        for name, value, choices in [
            ("arm", self.arm, ARMS),
            ("start", self.start, STARTS),
            ("lights", self.lights, SCHEDULES),
        ]:
            if value not in choices:
                raise InputError(f"augment.{name}={value}: choose one of {', '.join(choices)}")
        require_range("augment.examples", self.examples, 0, MOST_EXAMPLES)
        require_range("augment.every", self.every, 1, MOST_EVERY)

    @property
    def renders(self) -> bool:
        """Whether any example is rendered at all."""
        return self.arm != "none" and self.examples > 0


@dataclass(frozen=True)
class Renders:
    """Labelled examples: images (E, 3, H, W) in [0, 1], labels (E,) int64, and diagnostics as plain numbers."""

    images: Tensor
    labels: Tensor
    diagnostics: Mapping[str, float]


class AugmentationService:
    """Holds the scene and, where lights continue, the adversaries' lights from one regeneration to the next.

    Where several processes train together, each attacks its share of the examples, and all get all renders.
    """

    def __init__(
        self,
        settings: AugmentationSettings,
        scene: Scene | None,
        labels: Tensor,
        light: Tensor,
        seed: int,
        phases: Phases,
    ):
        """scene: None where nothing is rendered. labels: (E,) int64 classes. light: (49, 3), where lights begin."""
        self.settings = settings
        self._scene = scene
        self._labels = labels
        self._light = light
        self._seed = seed
        self._phases = phases
        self._continued: Tensor | None = None

    def __len__(self) -> int:
        """Examples per regeneration."""
        return len(self._labels) if self.settings.renders else 0

    def regenerate(self, model: nn.Module, number: int) -> Renders:
        """Fresh examples for the model's current weights; the model is left as it was found.

        number: counts the regenerations of a run from 0. The draw depends on it and the seed alone, so a resumed run
        repeats it.
        """
        if not self.settings.renders:
            return Renders(torch.zeros(0, 3, 1, 1), self._labels[:0], {})
        make = self._random if self.settings.arm == "random" else self._adversarial
        return make(model, number)

    def state_dict(self) -> dict[str, Tensor]:
        """The adversaries' lights, where they continue; empty otherwise."""
        return {} if self._continued is None else {"lights": self._continued.cpu()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` gave; InputError where it is from another number of examples."""
        if "lights" not in state:
            return
        if len(state["lights"]) != len(self._labels):
            raise InputError(
                f"augment.examples: the checkpoint continues {len(state['lights'])} lights and the scene has "
                f"{len(self._labels)}; resume with the settings of the run"
            )
        self._continued = state["lights"].to(self._labels.device)

    def _random(self, model: nn.Module, number: int) -> Renders:
        lights = self._perturbed(number)
        images = self._scene.render(lights)
        with as_found(model), torch.no_grad(), self._phases("attack_classifier"):
            logits = torch.cat([model(batch) for batch in images.split(self.settings.attack.batch_size)])
        diagnostics = {
            "fooled": _mean(logits.argmax(1) != self._labels),
            "loss": _mean(nn.functional.cross_entropy(logits, self._labels)),
        }
        return Renders(images, self._labels, diagnostics | self._light_diagnostics(lights))

    def _adversarial(self, model: nn.Module, number: int) -> Renders:
        attack, goal = self.settings.attack, Goal(self._labels[:, None])
        problem = _SceneLights(self._scene, self._starting_lights(number), attack)
        mine = processes.share(len(self._scene)).to(self._light.device)
        part = Part(problem, mine, problem.start[mine])
        result = descend(model, part, goal.of(mine), attack.descent(), self._phases)
        result = result.merged(mine, len(self._scene))
        lights = result.values.unflatten(1, (-1, 3))
        if self.settings.lights == "continue":
            self._continued = lights
        diagnostics = self._attack_diagnostics(result) | self._light_diagnostics(lights)
        return Renders(result.images.flatten(0, 1), self._labels, diagnostics)

    def _starting_lights(self, number: int) -> Tensor:
        if self._continued is not None:
            return self._continued
        if self.settings.start == "random":
            return self._perturbed(number)
        return self._light.expand(len(self._scene), -1, -1)

    def _perturbed(self, number: int) -> Tensor:
        random, draws = self.settings.random, generator(self._seed, number, "lights")
        lights = perturb(self._light.cpu(), len(self._scene), random.amplitude, random.radius, draws)
        return lights.to(self._light.device)

    def _attack_diagnostics(self, result: AttackResult) -> dict[str, float]:
        return {
            "fooled_before": _mean(result.fooled_before),
            "fooled": _mean(result.fooled),
            "steps": _mean(result.steps),
            "used_all_steps": _mean(result.steps == self.settings.attack.max_steps),
            "loss_before": -_mean(result.cost_before),
            "loss": -_mean(result.cost),
            "zero_gradient": _mean(result.zero_gradient),
        }

    def _light_diagnostics(self, lights: Tensor) -> dict[str, float]:
        return {
            "light_change": _mean((lights - self._light).flatten(1).norm(dim=1)),
            "clamped": _mean(self._scene.clamped_share(lights)),
        }


class _SceneLights:
    """A light of its own for each example of a scene. See `augment.attack.Problem`."""

    def __init__(self, scene: Scene, start: Tensor, settings: LightAttackSettings):
        """start: (E, 49, 3)."""
        self.start, self._scene, self._settings = start.flatten(1), scene, settings

    def render(self, values: Tensor, examples: Tensor) -> Tensor:
        return self._scene.render(values.unflatten(1, (-1, 3)), examples)[:, None]

    def step(self, gradient: Tensor) -> Tensor:
        return self._settings.step_size * direction(gradient, self._settings.step)

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        return values


def _mean(values: Tensor) -> float:
    return float(values.double().mean())
