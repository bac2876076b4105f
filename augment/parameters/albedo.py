"""The colour of each face."""

from dataclasses import replace

from torch import Tensor

from augment.parameters.kind import OfMesh, StepSettings
from augment.scene import Conditions, Scene


class Albedo(OfMesh):
    """What is added to the linear albedo of each face, per channel; the sum is clamped to [0, 1]."""

    name = "albedo"

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, settings, [len(item.mesh.faces) for item in scene.objects])

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        return replace(conditions, albedo=values.unflatten(1, (-1, 3)))
