"""Light as the coefficients of its basis; 49×3 of harmonics, unless the scene has another."""

from dataclasses import replace

from torch import Tensor

from augment.parameters.kind import Kind, StepSettings
from augment.scene import Conditions, Scene


class Lighting(Kind):
    """Every coefficient of the light, within the domain of the scene's basis; the start is the examples' own."""

    name = "lighting"

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, scene.lights.flatten(1), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, light=values.unflatten(1, (-1, 3)))

    def within_domain(self, values: Tensor) -> Tensor:
        return self.scene.basis.within_domain(values.unflatten(1, (-1, 3))).flatten(1)
