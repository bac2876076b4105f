"""Settings of attacks, and of each quantity that an attack can change.

`ParameterSettings` has a field for each quantity. Its name is the name of the module with the
quantity's class (see `augment.attacks.parameters`). This module imports neither torch nor NumPy;
see `renderer.settings`.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

from renderer.errors import MAX_MAGNITUDE, MAX_SCALE, InputError
from renderer.settings import TURBIDITY, Settings, setting

NORMS = ("linf", "l2")
STEPS = ("unit", "raw", "sign")


@dataclass
class StepSettings(Settings):
    """Norm-ball around the values at which an attack starts, and steps of gradient descent in it.

    The radii of the paper (Section 4.1) are 0.1 per coefficient of the lighting and 0.002 per
    axis of a vertex, both with norm="linf".

    >>> import norm_balls as nb
    >>> nb.StepSettings(norm="l2", radius=1.0).step
    'unit'
    """

    # Names of the fields of which at least one must not be 0, so that an attack changes something.
    parts: ClassVar[tuple[str, ...]] = ()

    norm: str = setting("linf", "Norm of the ball.", choices=NORMS)
    radius: float | None = setting(None, "Ball's radius. null: no limit.", within=(0, MAX_SCALE))
    step: str = setting(
        "unit", "Step: the gradient of L2 norm 1 (unit), itself (raw) or its sign.", choices=STEPS
    )
    step_size: float = setting(0.05, "Factor of each step.", within=(1 / MAX_MAGNITUDE, MAX_SCALE))

    def __post_init__(self) -> None:
        """Check that the attack can change something."""
        super().__post_init__()
        if self.parts and not any(getattr(self, name) for name in self.parts):
            reason = f"{', '.join(self.parts)} are all 0, so nothing can change"
            raise InputError(f"{reason}: set one of them above 0")


@dataclass
class SkylightSettings(StepSettings):
    """Attack on the position of the sun and the haze of a clear sky, and the initial sky.

    Attack values are the angles of the sun divided by `sun`, and the turbidity divided by 4. With
    the default of `sun` and the norm "linf", a radius of 0.1 permits changes of the angles by 5.7
    degrees, and of the turbidity by 0.4. Step sizes have the same units.
    """

    zenith: float = setting(45.0, "Initial zenith angle of the sun.", "degrees", within=(0, 90))
    azimuth: float = setting(0.0, "Its initial azimuth.", "degrees", within=(-MAX_SCALE, MAX_SCALE))
    turbidity: float = setting(3.0, "Initial turbidity: 2 (clear) to 10 (hazy).", within=TURBIDITY)
    sun: float = setting(math.degrees(1), "Unit of both angles.", "degrees", within=(0.1, 360))


@dataclass
class PoseSettings(StepSettings):
    """Attack on the pose of the object and of the camera.

    An attack value of 1 changes a part of the pose, such as the rotation, by the number in the
    field of this part. 0 leaves the part as it is.
    """

    parts = ("rotation", "shift", "scale", "view", "distance")

    rotation: float = setting(10.0, "Rotation of the object per unit.", "degrees", within=(0, 180))
    shift: float = setting(0.1, "Shift of the object, whose size is 2, per unit.", within=(0, 10))
    scale: float = setting(0.1, "Growth of the object per unit. 0.1: factor 1.1.", within=(0, 1))
    view: float = setting(10.0, "Turn of the camera per unit.", "degrees", within=(0, 180))
    distance: float = setting(0.1, "Growth of the camera's distance per unit.", within=(0, 1))


@dataclass
class MaterialSettings(StepSettings):
    """Attack on the specular material and the hue of the object.

    An attack value of 1 changes a part of the material, such as the roughness, by the number in
    the field of this part. 0 leaves the part as it is. `nb.Gloss` explains the parts.
    """

    parts = ("roughness", "metallic", "specular_factor", "hue")

    roughness: float = setting(
        0.3, "Change of the roughness per unit. A matte mesh starts at 0.5.", within=(0, 1)
    )
    metallic: float = setting(0.3, "Change of metals' metallic factor per unit.", within=(0, 1))
    specular_factor: float = setting(1.0, "Change of the highlight per unit.", within=(0, 1))
    hue: float = setting(0.0, "Turn of the albedo about gray per unit.", "degrees", within=(0, 180))


@dataclass
class ParameterSettings(Settings):
    """Settings of each quantity that an attack can change.

    None leaves a quantity as it is. If several quantities are changed, they are
    changed in the order of these fields.
    """

    lighting: StepSettings | None = setting(None, "Attack on the coefficients of the lighting.")
    skylight: SkylightSettings | None = setting(None, "Attack on the sun and the air of a sky.")
    projector: StepSettings | None = setting(None, "Attack on the pattern of the projector.")
    lamps: StepSettings | None = setting(None, "Attack on the powers of the lamps.")
    positions: StepSettings | None = setting(None, "Attack on the positions of the lamps.")
    geometry: StepSettings | None = setting(None, "Attack on the positions of the vertices.")
    pose: PoseSettings | None = setting(None, "Attack on the pose of object and camera.")
    material: MaterialSettings | None = setting(None, "Attack on the specular material.")
    albedo: StepSettings | None = setting(None, "Attack on the albedo of each face.")
    pixels: StepSettings | None = setting(None, "Attack on the pixels of the image.")

    @property
    def parameters(self) -> dict[str, StepSettings]:
        """Return the settings of the quantities that are attacked, by their names."""
        named = {name: getattr(self, name) for name in PARAMETER_NAMES}
        return {name: settings for name, settings in named.items() if settings is not None}


PARAMETER_NAMES = tuple(field.name for field in fields(ParameterSettings))


# File with one JSON line for each attacked example, and a last line with the checks.
LINES = "attack.jsonl"
# Default of `AttackSettings.noise_margin`.
NOISE_MARGIN = 2.0

GRADIENT = "gradient"
RANDOM_SEARCH = "random_search"
CMA_ES = "cma_es"
OPTIMIZERS = (GRADIENT, RANDOM_SEARCH, CMA_ES)
# Default number of images that an optimizer without gradients shows to the classifier for each
# example.
DEFAULT_QUERIES = 1000


@dataclass
class EOTSettings(Settings):
    """Random transformations of an image over which an attack averages (Athalye et al. 2018)."""

    draws: int = setting(0, "Transformations of an image at each step. 0: none.", within=(0, 1000))
    jitter: float = setting(
        0.03, "Largest relative shift and approach of the camera, and roll (rad).", within=(0, 0.5)
    )
    exposure: float = setting(0.2, "Largest change of the exposure.", "stops", within=(0, 5))
    noise: float = setting(0.02, "Standard deviation of the pixel noise.", within=(0, 1))
    jpeg: int = setting(75, "Lowest JPEG quality.", within=(1, 100))


@dataclass
class RelightingSettings(Settings):
    """Attack on photographs in the light of a projector; see `augment.photographs`.

    The projector shows a random slide. The attack multiplies each channel of the slide by a smooth
    factor, which is at most `gain` and at least 1 / gain. Its logarithm is interpolated linearly
    between the centers of the cells. Random search draws as many factors as it has passes. The
    gradient attack takes half as many steps.
    """

    gain: float = setting(3.0, "Largest factor of a channel, and largest divisor.", within=(1, 100))
    cells: int = setting(6, "Cells per side with factors of their own.", within=(1, 64))
    passes: int = setting(21, "Forward and backward passes of each search.", within=(1, 10**6))
    slides: int = setting(1, "Number of random slides for each photograph.", within=(1, 10**4))

    @property
    def radius(self) -> float:
        """Largest magnitude of the logarithm of a factor of the projected light."""
        return math.log(self.gain)

    @property
    def steps(self) -> int:
        """Number of steps along the gradient.

        A step takes a forward and a backward pass. The image after the last step takes another
        forward pass.
        """
        return (self.passes - 1) // 2


@dataclass
class AttackSettings(ParameterSettings):
    """Attacked parameters, and the optimizer, restarts and checks of an attack.

    By default, the lighting stays physically possible, and a success must survive the noise of a
    camera and the rounding to 8 bits. The paper has allow_negative=True, margin=0,
    quantized=False and sensor_noise=0.
    """

    optimizer: str | None = setting(
        None,
        "How the values are changed: along the gradient, or by random_search or cma_es, which "
        "need no gradients. null: gradient, or random_search if the classifier has no gradients.",
        choices=OPTIMIZERS,
    )
    max_steps: int = setting(30, "Largest number of steps along the gradient.", within=(0, 10**9))
    max_queries: int | None = setting(
        None,
        "Largest number of forward passes for each example. All starts have the same share of it. "
        f"null: {DEFAULT_QUERIES}, and no limit besides max_steps for optimizer=gradient.",
        within=(1, 10**9),
    )
    backtracking: bool = setting(False, "Halve steps that do not lower the cost (backtracking).")
    restarts: int = setting(0, "More random starts of examples without success.", within=(0, 10**6))
    margin: float = setting(
        2.0,
        "Stop an example when, in every view, the logit gap is at least this large: the target "
        "logit minus the largest other logit or, without a target, the largest other logit minus "
        "the logit of the true class. Its unit is that of the classifier's logits.",
        within=(0, MAX_SCALE),
    )
    quantized: bool = setting(True, "Round the images to 8 bits before the classifier.")
    sensor_noise: float = setting(
        1.0,
        "Standard deviation of the noise of a camera. A success counts only if it survives three "
        "draws of this noise. 0 counts without noise.",
        "steps of 8 bits",
        within=(0, 255),
    )
    noise_margin: float | None = setting(
        None,
        "Continue with an example until sensor noise changes its logit gap little: the smallest "
        "gap, with noise and without, must be this many times the range of the gaps. null is 2 if "
        "the pose or the material is attacked, or if log-odds exceed 50 and `margin` is not 0. "
        "Otherwise it is 0.",
        within=(0, MAX_SCALE),
    )
    eot: EOTSettings = setting(EOTSettings, "Attack the mean over random transformations.")
    allow_negative: bool = setting(False, "Permit lighting with negative, unphysical radiance.")
    batch_size: int = setting(32, "Images per pass, or fewer if memory is full.", within=(1, 10**6))

    def __post_init__(self) -> None:
        """Check that the settings do not contradict each other."""
        super().__post_init__()
        if self.lighting and self.skylight:
            raise InputError("lighting and skylight both set the light: choose one of them")
        has_radius = all(steps.radius is not None for steps in self.parameters.values())
        if self.restarts and not has_radius:
            reason = "restarts draws from the norm-balls, but a parameter has no radius"
            advice = "set the radius of every parameter, or restarts=0"
            raise InputError(f"{reason}: {advice}", "restarts")

    @property
    def uses_gradients(self) -> bool:
        """Whether the optimizer computes gradients."""
        return self.optimizer in (None, GRADIENT)

    @property
    def query_limit(self) -> int | None:
        """Largest number of images that an example may show to the classifier. None for no limit.

        It is `max_queries`. If that is None, optimizers without gradients have a default limit.
        """
        if self.max_queries is not None or self.uses_gradients:
            return self.max_queries
        return DEFAULT_QUERIES

    @property
    def query_limit_of_start(self) -> int | None:
        """Largest number of images that an example may show in each start. None for no limit."""
        return self.query_limit and self.query_limit // (1 + self.restarts)

    @property
    def step_limit(self) -> int:
        """Largest number of steps.

        An optimizer without gradients has no limit of its own: it takes at most one step for each
        query, which is an image that it shows to the classifier.
        """
        return self.max_steps if self.uses_gradients else self.query_limit_of_start or 0

    def with_budget(self, factor: int) -> Self:
        """Return settings whose largest numbers of steps and queries are multiplied by a factor."""
        max_queries = self.query_limit and factor * self.query_limit
        return replace(self, max_steps=factor * self.max_steps, max_queries=max_queries)

    @property
    def applied_noise_margin(self) -> float:
        """Return the number that `noise_margin` stands for. It is 0 if `sensor_noise` is 0."""
        if not self.sensor_noise:
            return 0.0
        if self.noise_margin is not None:
            return self.noise_margin
        # Attacks on these two often find images that sensor noise makes correct again.
        return NOISE_MARGIN if self.pose or self.material else 0.0

    @property
    def overconfident_noise_margin(self) -> float:
        """Return the number that `noise_margin` stands for where a classifier is overconfident.

        A margin of 2 is less there than the change of the logits by the noise.
        """
        if self.noise_margin is None and self.sensor_noise and self.margin:
            return NOISE_MARGIN
        return self.applied_noise_margin

    def require_parameters(self) -> None:
        """Check that the attack changes something.

        Raises:
            InputError: If no parameter is set.
        """
        if not self.parameters:
            choices = ", ".join(PARAMETER_NAMES)
            raise InputError(f"no parameter is attacked: set one or more of {choices}")
