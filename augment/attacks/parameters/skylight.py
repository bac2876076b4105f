"""Attacks on the position of the sun and the haze of a daylight sky."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from augment.attack_settings import SkylightSettings
from augment.attacks.parameters.light_parameter import environment_light, replace_light
from augment.attacks.parameters.parameter import Parameter
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from renderer.light.ball import Ball, nearest_in_box
from renderer.light.basis import HARMONICS
from renderer.light.presets import mean_luminance
from renderer.light.ringing import nonnegative_window
from renderer.light.skylight import ZENITH
from renderer.light.skylight import coefficients as sky_coefficients
from renderer.settings import TURBIDITY

# An attack on a daylight sky changes three values: two angles of the sun, and the turbidity (haze)
# divided by this unit. The turbidity, from 2 to 10, then has the range 2. The angles in radians
# have the ranges 1.6 and 6.3. The ranges are of the same order, so one radius suits all values.
TURBIDITY_UNIT = 4.0


class Skylight(Parameter):
    """Attack on a daylight sky: zenith angle and azimuth of the sun, and turbidity (haze).

    The attack values are the angles divided by `SkylightSettings.sun`, and the
    turbidity divided by `TURBIDITY_UNIT`.

    The sky replaces the environment lighting of the scene. It is multiplied by
    a constant factor, so that the initial sky has the mean luminance of the
    lighting that it replaces. Projector and lamps stay as they are.

    The coefficients of the sky end at degree 6, so that its radiance is negative
    in some directions. If radiance must not be negative, the coefficients are
    multiplied by `nonnegative_window`, which keeps the mean.
    """

    name = "skylight"

    def __init__(self, scene: Scene, settings: SkylightSettings, nonnegative: bool = False):
        """Compute the initial sky and its brightness."""
        self._rows, self._basis = environment_light(scene)
        initial_sky = sky_coefficients(settings.zenith, settings.azimuth, settings.turbidity)
        sky_luminance = mean_luminance(initial_sky)
        replaced_lights = scene.lights[:, self._rows]
        scales = [mean_luminance(light) / sky_luminance for light in replaced_lights]
        # Factor by which the sky is multiplied in each example, shape (E,).
        self._scale = torch.tensor(scales, dtype=torch.float64, device=scene.lights.device)

        self._window = nonnegative_window(HARMONICS.degree) if nonnegative else None
        self._sun = settings.sun
        values = [
            settings.zenith / settings.sun,
            settings.azimuth / settings.sun,
            settings.turbidity / TURBIDITY_UNIT,
        ]
        start = torch.tensor(values, dtype=torch.float64).to(scene.lights)
        super().__init__(settings, start=start.expand(len(scene), -1))

    def apply(
        self, values: Float[Tensor, "A 3"], conditions: Conditions, examples: Int[Tensor, " A"]
    ) -> Conditions:
        """Return a copy of the conditions with the sky in place of the environment lighting.

        The values are zenith angle, azimuth and turbidity, each divided by its unit.
        """
        # Convert the angles to degrees in float64, so that rounding is negligible.
        zenith, azimuth = (values[:, :2].double() * self._sun).unbind(1)
        turbidity = values[:, 2] * TURBIDITY_UNIT
        # RGB of the 49 harmonic coefficients of the sky model, shape (A, 49, 3).
        sky = sky_coefficients(zenith, azimuth, turbidity)
        sky = sky * self._scale[examples, None, None]
        if self._window is not None:
            sky = sky * self._window.to(sky)[:, None]
        # The lighting of the scene may have more coefficients. Those of the sky are then 0.
        missing_count = self._basis.size - sky.shape[-2]
        sky = F.pad(sky, (0, 0, 0, missing_count))
        return replace_light(conditions, self._rows, sky.to(conditions.light))

    def project_feasible(
        self, values: Float[Tensor, "A 3"], within: Ball | None = None
    ) -> Float[Tensor, "A 3"]:
        """Find the nearest values for which the sky model is defined."""
        # The sky model is defined for all azimuths, but not for all zenith angles and turbidities.
        lowest_zenith, highest_zenith = ZENITH
        lowest_turbidity, highest_turbidity = TURBIDITY
        low = values.new_tensor(
            [lowest_zenith / self._sun, -math.inf, lowest_turbidity / TURBIDITY_UNIT]
        )
        high = values.new_tensor(
            [highest_zenith / self._sun, math.inf, highest_turbidity / TURBIDITY_UNIT]
        )
        return nearest_in_box(values, low, high, within)
