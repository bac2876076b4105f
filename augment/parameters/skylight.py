"""The daylight sky: sun zenith and azimuth in radians, and turbidity."""

from dataclasses import replace

import torch
from torch import Tensor

from augment.parameters.kind import Kind, StepSettings
from augment.scene import Conditions, Scene
from renderer.lights import mean_luminance
from renderer.skylight import TURBIDITY, ZENITH, coefficients

TURBIDITY_UNIT = 4.0  # its domain spans 2 of them, as the zenith's and the azimuth's span about 1.6 and 6


class Skylight(Kind):
    """Three values: zenith, azimuth, turbidity / 4. The sky is scaled to the mean luminance of the example's own light
    where the attack starts, and by the same factor elsewhere."""

    name = "skylight"

    def __init__(self, scene: Scene, settings: StepSettings, zenith: float, azimuth: float, turbidity: float):
        start = torch.tensor([zenith, azimuth, turbidity / TURBIDITY_UNIT], dtype=torch.float64).to(scene.lights)
        super().__init__(scene, start.expand(len(scene), -1), settings)
        sky = mean_luminance(coefficients(zenith, azimuth, turbidity))
        scales = [mean_luminance(light) / sky for light in scene.lights]
        self._scale = torch.tensor(scales, dtype=torch.float64, device=start.device)[:, None, None]

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        zenith, azimuth, turbidity = values.unbind(1)
        sky = coefficients(zenith, azimuth, turbidity * TURBIDITY_UNIT) * self._scale[examples]
        return replace(conditions, light=sky.to(conditions.light))

    def within_domain(self, values: Tensor) -> Tensor:
        zenith, azimuth, turbidity = values.unbind(1)
        low, high = (limit / TURBIDITY_UNIT for limit in TURBIDITY)
        return torch.stack([zenith.clamp(*ZENITH), azimuth, turbidity.clamp(low, high)], dim=1)
