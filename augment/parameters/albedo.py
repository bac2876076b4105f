"""The colour of each face."""

from dataclasses import replace

from torch import Tensor

from augment.mesh_scene import Conditions, MeshScene
from augment.parameters.kind import Kind, StepSettings


class Albedo(Kind):
    """What is added to the linear albedo of each face, per channel; the sum is clamped to [0, 1]."""

    name = "albedo"

    def __init__(self, scene: MeshScene, settings: StepSettings):
        super().__init__(scene, scene.vertices.new_zeros(len(scene), scene.faces.numel()), settings)

    def apply(self, values: Tensor, conditions: Conditions) -> Conditions:
        return replace(conditions, albedo=values.unflatten(1, (-1, 3)))
