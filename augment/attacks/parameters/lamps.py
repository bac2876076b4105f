"""Attacks on the intensity of lamps."""

from augment.attacks.parameters.light_parameter import LightParameter, find_light
from augment.parameter_settings import StepSettings
from augment.scene.scene import Scene


class Lamps(LightParameter):
    """RGB intensity of each lamp, from 0 to `renderer.light.lamps.Lamps.power`.

    Args:
        scene: Scene to attack.
        settings: Norm-ball and steps of the attack.

    Raises:
        InputError: If the scene has no lamps.
    """

    name = "lamps"

    def __init__(self, scene: Scene, settings: StepSettings):
        rows, basis = find_light(scene, "lamps", self.name)
        super().__init__(scene, settings, rows=rows, basis=basis, nonnegative=True)
