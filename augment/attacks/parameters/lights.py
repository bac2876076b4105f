"""Attacks on the light of a scene: its environment, a daylight sky, a projector, and lamps."""

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from augment.attack_settings import SkylightSettings, StepSettings
from augment.attacks.objective import Examples, Values
from augment.attacks.parameters.parameter import Parameter
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from renderer.errors import InputError
from renderer.light.basis import HARMONICS
from renderer.light.files import mean_luminance
from renderer.light.lamps import LOCAL_LIGHTS
from renderer.light.ringing import nonnegative_window
from renderer.light.skylight import ZENITH
from renderer.light.skylight import coefficients as sky_coefficients
from renderer.settings import TURBIDITY
from renderer.vectors import Ball


class Light(Parameter):
    """Attack on all RGB coefficients of one light: the environment, a projector or lamps.

    Those of the environment are spherical-harmonic coefficients. Those of a projector are its
    pixels, and those of lamps their powers, between 0 and the power of the light.

    The attack starts at the light of the scene. If radiance must not be
    negative, the start is the nearest light without negative radiance that has
    the same mean. Each step then ends in the nearest coefficients that lie in
    the norm-ball and have no negative radiance.

    Args:
        scene: Scene to attack. Its other lights stay as they are.
        settings: Norm-ball and steps of the attack.
        name: "lighting" for the environment, or the name of a local light.
        nonnegative: Whether radiance must not be negative in any direction. That of local lights
            never is.
    """

    def __init__(self, scene: Scene, settings: StepSettings, name: str, nonnegative: bool = False):
        """Find the light in the scene, and compute the values at which the attack starts."""
        self.name = name
        # The environment is the first light of a scene.
        lights = {"lighting": scene.basis.lights[0]}
        lights |= {light.basis.name: light for light in scene.basis.local_lights}
        if name not in lights:
            fault = f"{name} cannot be attacked, because the scene has none"
            raise InputError(f"{fault}: build the scene with {name}=...", name)
        self._rows, self._basis = lights[name]
        self._nonnegative = nonnegative or not self._basis.allow_negative
        initial_light = scene.lights[:, self._rows]
        if self._nonnegative:
            initial_light = self._basis.project_nonnegative(initial_light)
        super().__init__(settings, start=initial_light.flatten(1))

    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions with other coefficients of this light."""
        return replace_light(conditions, self._rows, values.unflatten(1, (-1, 3)))

    def project_feasible(
        self, values: Values, within: Ball | None = None, examples: Examples | slice = slice(None)
    ) -> Values:
        """Find the nearest coefficients whose radiance is not negative."""
        if not self._nonnegative:
            return super().project_feasible(values, within)
        # RGB of each of the K coefficients, shape (E, K, 3).
        ball = None if within is None else within.unflatten(-1, 3)
        return self._basis.nearest_nonnegative(values.unflatten(1, (-1, 3)), ball).flatten(1)


def replace_light(
    conditions: Conditions, rows: slice, coefficients: Float[Tensor, "E K 3"]
) -> Conditions:
    """Return a copy of the conditions with other coefficients for one light.

    `rows` are the rows of this light in the coefficients of all lights.
    """
    all_lights = conditions.light
    # A scene with a single light needs no concatenation.
    if coefficients.shape[1] == all_lights.shape[1]:
        return replace(conditions, light=coefficients)
    parts = [all_lights[:, : rows.start], coefficients, all_lights[:, rows.stop :]]
    return replace(conditions, light=torch.cat(parts, dim=1))


# An attack on a daylight sky changes three values: two angles of the sun, and the turbidity (haze)
# divided by this unit. The turbidity, from 2 to 10, then has the range 2. The angles in radians
# have the ranges 1.6 and 6.3. The ranges are of the same order, so one radius suits all values.
TURBIDITY_UNIT = 4.0


# Attack values of a sky, and names of the settings with their initial values.
SKY = "zenith", "azimuth", "turbidity"


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
        # The environment, which is the first light of a scene.
        self._rows, self._basis = scene.basis.lights[0]
        initial_sky = sky_coefficients(settings.zenith, settings.azimuth, settings.turbidity)
        sky_luminance = mean_luminance(initial_sky)
        scales = [mean_luminance(light) / sky_luminance for light in scene.lights[:, self._rows]]
        # Factor by which the sky is multiplied in each example, shape (E,).
        self._scale = torch.tensor(scales, dtype=torch.float64, device=scene.lights.device)

        self._window = nonnegative_window(HARMONICS.degree) if nonnegative else None
        self._units = settings.sun, settings.sun, TURBIDITY_UNIT
        units = torch.tensor(self._units, dtype=torch.float64)
        initial = units.new_tensor([getattr(settings, name) for name in SKY])
        # The sky model is defined for all azimuths, but not for all zenith angles and turbidities.
        limits = units.new_tensor([ZENITH, (-math.inf, math.inf), TURBIDITY])
        self.box = (limits.T / units).to(scene.lights)
        super().__init__(settings, start=(initial / units).to(scene.lights).expand(len(scene), -1))

    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions with the sky in place of the environment lighting.

        The values are zenith angle, azimuth and turbidity, each divided by its unit.
        """
        # Convert the angles to degrees in float64, so that rounding is negligible.
        zenith, azimuth = (values[:, :2].double() * self._units[0]).unbind(1)
        sky = sky_coefficients(zenith, azimuth, values[:, 2] * TURBIDITY_UNIT)
        sky = sky * self._scale[examples, None, None]
        if self._window is not None:
            sky = sky * self._window.to(sky, non_blocking=True)[:, None]
        # The lighting of the scene may have more coefficients. Those of the sky are then 0.
        sky = F.pad(sky, (0, 0, 0, self._basis.size - sky.shape[-2]))
        return replace_light(conditions, self._rows, sky.to(conditions.light))

    def described(self, values: Float[Tensor, " 3"]) -> dict[str, float]:
        """Return zenith angle and azimuth in degrees, and turbidity, by name."""
        parts = zip(SKY, values.tolist(), self._units, strict=True)
        return {name: round(value * unit, 4) for name, value, unit in parts}


class Positions(Parameter):
    """Attack on the position of each lamp: x, y and z in world units.

    Shadows are cast from the changed positions. The gradient treats shadows as
    fixed.
    """

    name = "positions"

    def __init__(self, scene: Scene, settings: StepSettings):
        """Start at the positions of the lamps of the scene."""
        light = scene.basis.movable_light
        if light is None:
            kinds = " or ".join(name for name, kind in LOCAL_LIGHTS.items() if kind.is_movable)
            fault = f"{self.name} cannot be attacked, because the scene has no {kinds}"
            raise InputError(f"{fault}: build the scene with {kinds}=...", self.name)
        # All examples start at the same positions of the L lamps, shape (L, 3).
        positions = torch.tensor(light.basis.positions).to(scene.lights)
        super().__init__(settings, start=positions.flatten().expand(len(scene), -1))

    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions with moved lamps.

        The values are x, y and z of the L lamps in world units.
        """
        return replace(conditions, positions=values.unflatten(1, (-1, 3)))
