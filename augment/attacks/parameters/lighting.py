"""Attacks on the environment lighting."""

from augment.attack_settings import StepSettings
from augment.attacks.parameters.light_parameter import LightParameter, environment_light
from augment.scene.scene import Scene


class Lighting(LightParameter):
    """Attack on the spherical-harmonic coefficients of the environment lighting.

    Args:
        scene: Scene to attack. Its projector and lamps stay as they are.
        settings: Norm-ball and steps of the attack.
        nonnegative: Whether radiance must not be negative in any direction.
    """

    name = "lighting"

    def __init__(self, scene: Scene, settings: StepSettings, nonnegative: bool = False):
        rows, basis = environment_light(scene)
        super().__init__(scene, settings, rows=rows, basis=basis, nonnegative=nonnegative)
