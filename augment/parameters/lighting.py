"""Light as harmonics' coefficients, 49×3."""

from dataclasses import replace

from torch import Tensor

from augment.parameters.kind import Kind, StepSettings
from augment.scene import Conditions, Scene


class Lighting(Kind):
    """Every coefficient of the light; the start is the examples' own."""

    name = "lighting"

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, scene.lights.flatten(1), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, light=values.unflatten(1, (-1, 3)))
