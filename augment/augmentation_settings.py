"""Settings of random variation, and of the renders that augment a training.

This module imports neither torch nor NumPy; see `renderer.settings`.
"""

import math
from dataclasses import dataclass

from augment.attack_settings import AttackSettings, StepSettings
from renderer.errors import MAX_SCALE, InputError
from renderer.settings import MIN_ROUGHNESS, Settings, pair, setting, setting_like

MODES = {
    "none": "no renders",
    "random": "randomized renders",
    "adversarial": "attacked renders",
    "folder": "images",
}
MAX_EXAMPLES = 10**6
# Limits of a random field of view in degrees. The larger it is, the closer is the camera. Beyond
# 45 degrees, the camera could be inside of a mesh that spans [-1, 1].
MIN_FOV = 1.0
MAX_FOV = 45.0
UNCHANGED = (1.0, 1.0)  # Range of a factor that is always 1.
NONE = (0.0, 0.0)  # Range of a number that is always 0.
FRACTION = (0, 1)
FACTOR = (1 / MAX_SCALE, MAX_SCALE)


@dataclass
class SpecularLayerSettings(Settings):
    """Ranges of a random specular layer, such as varnish, that each object gets in each render."""

    roughness: list[float] = pair(
        [0.4, 0.8], "roughness. Below 0.5, the lighting gets a higher degree.", (MIN_ROUGHNESS, 1)
    )
    specular_factor: list[float] = pair(list(NONE), "strength. [0, 0]: no layer.", FRACTION)


@dataclass
class CameraEffectSettings(Settings):
    """Random effects of a camera and of a projected pattern on each render.

    `white_balance`, `blur` and `noise` are upper limits. The strength for each
    render is drawn uniformly between 0 and the limit.
    """

    pattern_fraction: float = setting(0.0, "Fraction of renders with a pattern.", within=FRACTION)
    slides: str | None = setting(None, "Folder of photographs in half of the patterns. null: none.")
    pattern_fill: list[float] = pair(list(NONE), "factor of the light beneath a pattern.", FRACTION)
    white_balance: float = setting(0.0, "Largest change of each channel.", "stops", within=(0, 5))
    blur: float = setting(0.0, "Largest deviation of the blur.", "pixels", within=(0, 1.5))
    noise: float = setting(0.0, "Largest standard deviation of the pixel noise.", within=FRACTION)


@dataclass
class VariationSettings(Settings):
    """Ranges of the random pose, lighting and surroundings of each render during training.

    By default nothing is random. An attack changes the lighting of the object only. The
    background keeps the random lighting.

    >>> import norm_balls as nb
    >>> nb.VariationSettings(shift=0.1).moves, nb.VariationSettings(exposure=[0.5, 2.0]).moves
    (True, False)
    """

    shift: float = setting(0.0, "Largest shift as a fraction of the image width.", within=FRACTION)
    scale: list[float] = pair(list(UNCHANGED), "factor of the size in the image.", FACTOR)
    exposure: list[float] = pair(list(UNCHANGED), "factor of the environment light.", FACTOR)
    backgrounds: str | None = setting(None, "Folder of images for scene.backgrounds. null: none.")
    instances: bool = setting(False, "Draw another instance of each solid without a seed.")
    azimuth: float = setting(
        0.0, "Largest turn of the camera to either side, up and down.", "degrees", within=(0, 180)
    )
    fov: list[float] = pair(list(NONE), "field of view. [0, 0]: as it is.", (0, MAX_FOV), "degrees")
    rotation: float = setting(0.0, "Largest turn about a random axis.", "degrees", within=(0, 180))
    environments: list[str] = setting([], "Lightings that replace scene.light, one in each render.")
    directional_fraction: float = setting(
        0.0, "Fraction of renders in directional light from near the camera.", within=FRACTION
    )
    fill_light: list[float] = pair(list(NONE), "factor of their environment lighting.", FRACTION)
    lit_background: bool = setting(False, "Light the backgrounds as walls that face the camera.")
    tables: float = setting(0.0, "Fraction of renders on a table before a wall.", within=FRACTION)
    background_saturation: float = setting(
        0.0, "Largest saturation of a random color of each background.", within=FRACTION
    )
    gloss: SpecularLayerSettings = setting(
        SpecularLayerSettings, "A specular layer on each object, which replaces its own material."
    )
    camera: CameraEffectSettings = setting(CameraEffectSettings, "Effects of a camera.")

    def __post_init__(self) -> None:
        """Check the smallest field of view. 0 stands for the camera of the scene."""
        super().__post_init__()
        if tuple(self.fov) != NONE and self.fov[0] < MIN_FOV:
            raise self.wrong("fov", f"is wrong: give two angles from {MIN_FOV:g} to {MAX_FOV:g}")

    @property
    def moves(self) -> bool:
        """Return whether objects or cameras are random, so that they are rasterized each time."""
        new_objects = self.instances or self.rotation > 0 or any(self.gloss.specular_factor)
        moved = self.shift > 0 or tuple(self.scale) != UNCHANGED or any((self.azimuth, *self.fov))
        return moved or new_objects or self.tables > 0


@dataclass
class RandomLightSettings(Settings):
    """Random perturbation of the lighting of the scene."""

    amplitude: float = setting(0.5, "Largest uniform change of a coefficient.", within=FACTOR)
    radius: float | None = setting(None, "L2 norm of the change. null: amplitude.", within=FACTOR)


@dataclass
class TrainingAttackSettings(AttackSettings):
    """Attack during training.

    By default, this is the attack of appendix C of the paper, which changes all coefficients of
    the lighting. It takes 30 steps of length 0.05 along the direction of the gradient, and permits
    negative radiance. It stops when the classifier is wrong, without sensor noise and without the
    rounding of images to 8 bits.
    """

    step: str = setting_like(StepSettings, "step", "unit")
    step_size: float = setting_like(StepSettings, "step_size", 0.05)
    allow_negative: bool = True
    margin: float = 0.0
    quantized: bool = False
    sensor_noise: float = 0.0
    batch_size: int = 128

    @property
    def parameters(self) -> dict[str, StepSettings]:
        """Return the settings of the attacked parameters by their names.

        If no parameter is set, the lighting is attacked.
        """
        lighting = StepSettings(step=self.step, step_size=self.step_size)
        return super().parameters or {"lighting": lighting}


@dataclass
class AugmentationSettings(Settings):
    """Renders that augment the training, and how often they are rendered again.

    >>> import norm_balls as nb
    >>> random_light = nb.RandomLightSettings(radius=1.5)
    >>> nb.AugmentationSettings(mode="random", random_light=random_light).renders
    True
    """

    mode: str = setting("adversarial", "Kind of renders.", choices=MODES)
    folder: str | None = setting(None, "Folder for mode=folder: a folder per class, or other_NAME.")
    examples: int | None = setting(
        None,
        "Renders per regeneration, as many of each mesh as possible. null: meshes × views × "
        "backgrounds (100 without scene.views), or all images of the folder.",
        within=(0, MAX_EXAMPLES),
    )
    init: str = setting("scene", "Light at the start of attacks.", choices=("scene", "random"))
    warm_start: bool = setting(False, "Start each attack where the previous one ended.")
    regenerate_every: int | None = setting(
        None, "Maximum number of images between regenerations. null: an epoch.", within=(1, 10**9)
    )
    vary: VariationSettings = setting(VariationSettings, "What is drawn anew for each render.")
    random_light: RandomLightSettings = setting(
        RandomLightSettings, "Perturbation of the lighting for mode=random and for init=random."
    )
    attack: AttackSettings = setting(TrainingAttackSettings, "The attack during training.")

    def __post_init__(self) -> None:
        """Check that the settings do not contradict each other."""
        super().__post_init__()
        if not self.attack.parameters:
            raise InputError("attack changes nothing: name a parameter to attack", "attack")
        if self.mode == "folder" and not self.folder:
            raise self.wrong("folder", "is not set: mode=folder needs a folder of images")
        parameters = self.attack.parameters if "random" in (self.mode, self.init) else {}
        for name, steps in parameters.items():
            if name != "lighting" and steps.radius is None:
                missing = f"attack.{name}.radius"
                needed = "random values are drawn from the norm-ball: set a radius"
                raise InputError(f"{missing} is None, but {needed}", missing)
        if self.warm_start and self.vary.instances:
            reason = "continues an attack on shapes: set vary.instances=False"
            raise self.wrong("warm_start", reason)

    @property
    def renders(self) -> bool:
        """Return whether these settings ask for any renders or other images."""
        return self.mode != "none" and self.examples != 0


def views_of(examples: int, objects: int, backgrounds: int) -> int:
    """Compute how many views show each mesh at least `examples` times in all, in every background.

    For example, 100 renders of 2 meshes in front of 5 backgrounds need 10 views.
    """
    return max(1, math.ceil(examples / max(1, objects * backgrounds)))
