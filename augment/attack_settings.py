"""Settings of attacks. This module imports neither torch nor NumPy; see `renderer.settings`."""

from __future__ import annotations

from dataclasses import dataclass

from augment.parameter_settings import PARAMETER_NAMES, ParameterSettings
from renderer.errors import MAX_SCALE, InputError
from renderer.settings import Settings, setting

# Largest standard deviation of noise, in units of 1/255.
MAX_NOISE = 255.0
# Default of `AttackSettings.noise_margin`.
NOISE_MARGIN = 2.0


@dataclass
class EOTSettings(Settings):
    """Random transformations of an image over which an attack averages (Athalye et al. 2018)."""

    draws: int = setting(
        0,
        "Number of transformations of each image at each step. 0 transforms nothing.",
        minimum=0,
        maximum=1000,
    )
    jitter: float = setting(
        0.03,
        "Largest motion of the camera: its shift as a fraction of the width of the image, and its "
        "approach as a fraction of the distance. It also rolls by up to 57 degrees times this "
        "number, which is 1.7 degrees for 0.03.",
        minimum=0,
        maximum=0.5,
    )
    exposure: float = setting(0.2, "Largest change of the exposure.", "stops", minimum=0, maximum=5)
    noise: float = setting(0.02, "Standard deviation of the pixel noise.", minimum=0, maximum=1)
    jpeg: int = setting(75, "Lowest JPEG quality.", minimum=1, maximum=100)


@dataclass
class AttackSettings(ParameterSettings):
    """Attacked parameters, and the steps, restarts and checks of an attack.

    The defaults are careful: the lighting stays physically possible, and a success survives the
    noise of a camera and its 8 bits. The paper has allow_negative=True, margin=0, quantized=False
    and sensor_noise=0.
    """

    max_steps: int = setting(
        30,
        "Largest number of steps. The paper takes 30 (appendix C).",
        minimum=0,
        maximum=10**6,
    )
    backtracking: bool = setting(
        False, "Take back a step that did not lower the cost, and try half of it (backtracking)."
    )
    restarts: int = setting(
        0,
        "Number of additional starts, drawn from the norm-balls, for examples without success.",
        minimum=0,
        maximum=10**6,
    )
    margin: float = setting(
        2.0,
        "Stop an example when the adversarial logit leads by this margin in every view.",
        minimum=0,
        maximum=MAX_SCALE,
    )
    quantized: bool = setting(True, "Round the images to 8 bits before the classifier.")
    sensor_noise: float = setting(
        1.0,
        "Standard deviation of the noise of a camera. A success counts only if it survives three "
        "draws of this noise. 0 counts without noise.",
        "steps of 8 bits",
        minimum=0,
        maximum=MAX_NOISE,
    )
    noise_margin: float | None = setting(
        None,
        "Continue with an example until its smallest lead, with noise and without, is this many "
        "times the range of these leads. null is 2 if the pose or the material is attacked, "
        "and otherwise 0.",
        minimum=0,
        maximum=MAX_SCALE,
    )
    eot: EOTSettings = setting(
        EOTSettings, "Attack the mean over random transformations of the image."
    )
    allow_negative: bool = setting(
        False,
        "Permit lighting with negative radiance, as in the paper. Otherwise the lighting stays "
        "physically possible.",
    )
    batch_size: int = setting(
        32,
        "Images per pass through the classifier. Fewer are passed if memory runs out.",
        minimum=1,
        maximum=10**6,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lighting and self.skylight:
            raise InputError("lighting and skylight both set the light: choose one of them")
        has_radius = all(steps.radius is not None for steps in self.parameters.values())
        if self.restarts and not has_radius:
            remedy = "set the radius of every parameter, or restarts=0"
            raise InputError(f"restarts draws from the norm-balls: {remedy}", "restarts")

    @property
    def lead_over_noise(self) -> float:
        """Return the `noise_margin` to apply, which is 0 without noise."""
        if not self.sensor_noise:
            return 0.0
        if self.noise_margin is not None:
            return self.noise_margin
        needed = any(settings.needs_noise_margin for settings in self.parameters.values())
        return NOISE_MARGIN if needed else 0.0

    def require_parameters(self) -> None:
        """Check that the attack changes something.

        Raises:
            InputError: If no parameter is set.
        """
        if not self.parameters:
            raise InputError(f"name what to attack: one or more of {', '.join(PARAMETER_NAMES)}")
