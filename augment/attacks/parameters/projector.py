"""Attacks on the pattern of a projector."""

from augment.attacks.parameters.light_parameter import LightParameter, find_light
from augment.parameter_settings import StepSettings
from augment.scene.scene import Scene


class Projector(LightParameter):
    """RGB value of each pixel of a projector, from 0 to `renderer.light.projector.Projector.power`.

    Args:
        scene: Scene to attack.
        settings: Norm-ball and steps of the attack.

    Raises:
        InputError: If the scene has no projector.
    """

    name = "projector"

    def __init__(self, scene: Scene, settings: StepSettings):
        rows, basis = find_light(scene, "projector", self.name)
        super().__init__(scene, settings, rows=rows, basis=basis, nonnegative=True)
