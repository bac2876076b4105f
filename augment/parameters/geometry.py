"""The positions of a mesh's vertices."""

from dataclasses import replace

from torch import Tensor

from augment.parameters.kind import OfMesh, StepSettings
from augment.scene import Conditions, Scene


class Geometry(OfMesh):
    """Displacements of all vertices, in world units; the mesh spans [-1, 1]. The gradient sees how normals turn."""

    name = "geometry"

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, settings, [len(item.mesh.vertices) for item in scene.objects])

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        vertices = self.scene.vertices[self.scene.object_of[examples]]
        return replace(conditions, vertices=vertices + values.unflatten(1, (-1, 3)))
