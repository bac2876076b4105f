"""Attacks on the coefficients of a light within the scene, such as lamps or a projector."""

from augment.attacks.parameters.light_parameter import LightParameter
from augment.parameter_settings import StepSettings
from augment.scene.scene import Scene
from renderer.errors import InputError


class LocalLight(LightParameter):
    """RGB coefficients of a local light, from 0 to its power, such as the pixels of a projector.

    Args:
        scene: Scene to attack.
        settings: Norm-ball and steps of the attack.
        name: Name of the kind of light, which is also the name of the quantity.

    Raises:
        InputError: If the scene has no such light.
    """

    def __init__(self, scene: Scene, settings: StepSettings, name: str):
        self.name = name
        for rows, basis in scene.basis.local_lights:
            if basis.name == name:
                super().__init__(scene, settings, rows=rows, basis=basis, nonnegative=True)
                return
        raise InputError(f"{name}: the scene has no {name}: build it with {name}=...", name)
