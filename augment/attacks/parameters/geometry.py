"""Attacks on the shape of an object."""

from dataclasses import replace

from jaxtyping import Float, Int
from torch import Tensor

from augment.attack_settings import StepSettings
from augment.attacks.parameters.mesh_parameter import MeshParameter
from augment.scene.objects import Conditions
from augment.scene.scene import Scene


class Geometry(MeshParameter):
    """Attack on the shape: a displacement of each vertex of the object.

    Displacements are in world units, in which the object spans [-1, 1]. The
    gradient takes into account that normals turn as vertices move. If
    `ImageSettings.silhouettes` is set, it also takes into account that the
    silhouette of the object moves.

    Args:
        scene: Scene to attack. Props and table stay as they are.
        settings: Norm-ball and steps of the attack.
    """

    name = "geometry"
    fits_other_meshes = False

    def __init__(self, scene: Scene, settings: StepSettings):
        self._vertices = scene.vertices
        self._object_of = scene.object_of
        super().__init__(scene, settings, [item.own_vertices for item in scene.objects])

    def apply(
        self, values: Float[Tensor, "A D"], conditions: Conditions, examples: Int[Tensor, " A"]
    ) -> Conditions:
        """Return a copy of the conditions with displaced vertices.

        The values are displacements of the N vertices of the largest mesh in world units.
        """
        # Vertices before the attack, shape (A, N, 3).
        vertices = self._vertices[self._object_of[examples]]
        return replace(conditions, vertices=vertices + self.offsets(values, examples))
