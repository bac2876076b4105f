"""What an attack may change, by which steps, and for how long: the same for a training and for a single attack."""

from dataclasses import dataclass, field, replace
from functools import partial

from torch import nn

from augment.attacks.observation import Expected, Rounded, TransformationSettings
from augment.descent import DescentSettings
from augment.kind import StepSettings
from augment.parameters import KINDS, Lighting, SkylightSettings
from augment.perturbation import Perturbation
from augment.scene import Scene
from augment.seeding import generator
from renderer.arguments import require_fields
from renderer.errors import InputError, require_choice, require_range

PHYSICAL, SIGNED = "physical", "signed"
LIGHTS = (PHYSICAL, SIGNED)


@dataclass
class AttackSettings(DescentSettings):
    """None for what stays as it is. restarts: further starts, drawn from the norm-balls, where nothing is fooled yet.

    light: "physical", only what something can emit (of harmonics: radiance nowhere negative), whatever is attacked,
    beginning with the nearest such light to the scene's; or "signed", any coefficients.
    rounded: the classifier is given images of 8 bits. expectation: over random changes of them.
    """

    lighting: StepSettings | None = None
    skylight: SkylightSettings | None = None
    projector: StepSettings | None = None
    lamps: StepSettings | None = None
    places: StepSettings | None = None
    geometry: StepSettings | None = None
    albedo: StepSettings | None = None
    pixels: StepSettings | None = None
    light: str = "physical"
    restarts: int = 0
    batch_size: int = 32
    rounded: bool = False
    expectation: TransformationSettings = field(default_factory=TransformationSettings)

    def __post_init__(self) -> None:
        require_fields(self)
        super().__post_init__()
        if self.lighting and self.skylight:
            raise InputError("attack: lighting and skylight both set the light: choose one of them")
        require_choice("attack.light", self.light, LIGHTS)
        require_range("attack.restarts", self.restarts, 0, 10**6)
        if self.restarts and any(settings.radius is None for settings in self.kinds.values()):
            raise InputError("attack.restarts draws from the norm-balls: set the radius of every kind, or restarts=0")

    @property
    def kinds(self) -> dict[str, StepSettings]:
        """The settings of what is changed, by name."""
        return {name: settings for name in KINDS if (settings := getattr(self, name)) is not None}

    def require_kinds(self) -> None:
        """InputError where nothing is to be changed."""
        if not self.kinds:
            raise InputError(f"attack: name what to change, such as attack=lighting; there are {', '.join(KINDS)}")

    def judge(self, classifier: nn.Module) -> nn.Module:
        """A classifier that is given 8 bits, where they are rounded."""
        return Rounded(classifier) if self.rounded else classifier

    def observed(self, classifier: nn.Module, seed: int) -> nn.Module:
        """The judge's mean over the random changes of its images, if there are any: what a descent goes by."""
        judge, draws = self.judge(classifier), generator(seed, "expectation")
        return Expected(judge, self.expectation, draws) if self.expectation.draws else judge

    def problem(self, scene: Scene) -> Perturbation:
        """What is changed of a scene, in light that is possible."""
        if self.light == PHYSICAL:
            scene = replace(scene, lights=scene.basis.nearest_physical(scene.lights))
        kinds = KINDS | {Lighting.name: partial(Lighting, physical=self.light == PHYSICAL)}
        return Perturbation(scene, [kinds[name](scene, settings) for name, settings in self.kinds.items()])
