"""Attacks on the colors of an object."""

from dataclasses import replace

from jaxtyping import Float, Int
from torch import Tensor

from augment.attack_settings import StepSettings
from augment.attacks.parameters.mesh_parameter import MeshParameter
from augment.scene.objects import Conditions
from augment.scene.scene import Scene


class Albedo(MeshParameter):
    """Attack on the colors: a linear RGB offset that is added to the albedo of each face.

    The renderer clamps the sum to [0, 1].

    Args:
        scene: Scene to attack. Props and table stay as they are.
        settings: Norm-ball and steps of the attack.
    """

    name = "albedo"
    fits_other_meshes = False

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, settings, [item.own_faces for item in scene.objects])

    def apply(
        self, values: Float[Tensor, "A D"], conditions: Conditions, examples: Int[Tensor, " A"]
    ) -> Conditions:
        """Return a copy of the conditions with a color offset for each face.

        The values are linear RGB offsets of the F faces of the largest mesh.
        """
        return replace(conditions, albedo=self.offsets(values, examples))
