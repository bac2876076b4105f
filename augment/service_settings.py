"""What an augmentation service regenerates, and when."""

from dataclasses import dataclass, field

from augment.attacks.settings import SIGNED, AttackSettings
from augment.kind import StepSettings
from augment.parameters import Albedo, Geometry, Lighting
from augment.variation import VariationSettings
from renderer.arguments import require_fields
from renderer.errors import FACTOR, InputError, require_choice, require_range

ARMS = ("none", "random", "adversarial")
STARTS = ("light", "random")
SCHEDULES = ("restart", "continue")
MOST_EXAMPLES = 10**6  # at 32 × 32 pixels they take 12 GB
MOST_EVERY = 10**9
MOST_CANDIDATES = 100


@dataclass
class RandomLights:
    """Perturbations of the initial light: uniform ±amplitude, or scaled to an L2 radius (see `lights.perturb`).

    candidates: how many lights are tried of each example of the random arm, all that `vary` draws of the light and the
    camera's part included, to keep the one of the highest loss.
    """

    amplitude: float = 0.5
    radius: float | None = None
    candidates: int = 1

    def __post_init__(self) -> None:
        require_fields(self)
        require_range("augment.random.candidates", self.candidates, 1, MOST_CANDIDATES)
        for name in ("amplitude", "radius"):  # no radius: null
            require_range(f"augment.random.{name}", getattr(self, name), 1 / FACTOR, FACTOR)


@dataclass
class TrainingAttackSettings(AttackSettings):
    """Unless kinds are named, the paper's appendix C: 0.05 along the gradient's direction of the light, 30 steps, any
    coefficients.

    step, step_size: those of that light; see `StepSettings` for what "along the direction" means.
    """

    step: str = "unit"
    step_size: float = 0.05
    light: str = SIGNED
    batch_size: int = 128

    def __post_init__(self) -> None:
        self._light = StepSettings(step=self.step, step_size=self.step_size)
        super().__post_init__()

    @property
    def kinds(self) -> dict[str, StepSettings]:
        return super().kinds or {Lighting.name: self._light}


@dataclass
class AugmentationSettings:
    """What is regenerated, and when.

    start: where an attack begins, the scene as it is ("light") or a random perturbation of it: of the light by
    `random`, of all else uniform in its norm-ball. lights: "restart" begins there each time, "continue" begins where
    the last attack ended. vary: what of the scene is drawn afresh each time.
    every: after how many training images the renders are made anew, counted within an epoch; None: each epoch.
    """

    arm: str = "adversarial"
    examples: int | None = 100
    start: str = "light"
    lights: str = "restart"
    every: int | None = None
    vary: VariationSettings = field(default_factory=VariationSettings)
    random: RandomLights = field(default_factory=RandomLights)
    attack: TrainingAttackSettings = field(default_factory=TrainingAttackSettings)

    def __post_init__(self) -> None:
        require_fields(self)
        for name, choices in {"arm": ARMS, "start": STARTS, "lights": SCHEDULES}.items():
            require_choice(f"augment.{name}", getattr(self, name), choices)
        require_range("augment.examples", self.examples, 0, MOST_EXAMPLES)
        require_range("augment.every", self.every, 1, MOST_EVERY)
        if self.arm == "random" or self.start == "random":
            for name, settings in self.attack.kinds.items():
                if name != Lighting.name and settings.radius is None:
                    raise InputError(f"augment.attack.{name}.radius=null has no random draw: set a radius")
        if self.lights == "continue" and self.vary.individuals:
            raise InputError("augment.lights=continue goes on with the last shapes: set augment.vary.individuals=false")

    @property
    def renders(self) -> bool:
        """Whether any example is rendered at all."""
        return self.arm != "none" and self.examples != 0

    @property
    def relights(self) -> bool:
        """Whether nothing but the light changes, so that the scene's operators last from epoch to epoch."""
        return not (self.vary.moves or {Geometry.name, Albedo.name} & self.attack.kinds.keys())
