"""The positions of a mesh's vertices."""

from dataclasses import replace

from torch import Tensor

from augment.mesh_scene import Conditions, MeshScene
from augment.parameters.kind import Kind, StepSettings


class Geometry(Kind):
    """Displacements of all vertices, in world units; the mesh spans [-1, 1]. The gradient sees how normals turn."""

    name = "geometry"

    def __init__(self, scene: MeshScene, settings: StepSettings):
        super().__init__(scene, scene.vertices.new_zeros(len(scene), scene.vertices.numel()), settings)

    def apply(self, values: Tensor, conditions: Conditions) -> Conditions:
        return replace(conditions, vertices=self.scene.vertices + values.unflatten(1, (-1, 3)))
