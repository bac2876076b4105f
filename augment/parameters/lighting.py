"""Light as harmonics' coefficients, 49×3."""

from dataclasses import replace

from torch import Tensor

from augment.mesh_scene import Conditions, MeshScene
from augment.parameters.kind import Kind, StepSettings


class Lighting(Kind):
    """Every coefficient of the light; the start is the scene's light."""

    name = "lighting"

    def __init__(self, scene: MeshScene, settings: StepSettings):
        super().__init__(scene, scene.light.flatten().expand(len(scene), -1), settings)

    def apply(self, values: Tensor, conditions: Conditions) -> Conditions:
        return replace(conditions, light=values.unflatten(1, (-1, 3)))
