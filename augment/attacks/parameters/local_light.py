"""Attacks on the coefficients of a light within the scene, such as lamps or a projector."""

from augment.attack_settings import StepSettings
from augment.attacks.parameters.light_parameter import LightParameter
from augment.scene.scene import Scene
from renderer.errors import InputError


class LocalLight(LightParameter):
    """Attack on the RGB coefficients of a projector (its pixels) or of lamps (their powers).

    A coefficient lies between 0 and the power of the light.
    """

    def __init__(self, scene: Scene, settings: StepSettings, name: str):
        """Find the light among the local lights of the scene."""
        self.name = name
        for rows, basis in scene.basis.local_lights:
            if basis.name == name:
                super().__init__(scene, settings, rows=rows, basis=basis, nonnegative=True)
                return
        raise InputError(
            f"{name} cannot be attacked, because the scene has none: "
            f"build the scene with {name}=...",
            name,
        )
