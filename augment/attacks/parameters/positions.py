"""Attacks on the positions of lamps."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from augment.attack_settings import StepSettings
from augment.attacks.parameters.parameter import Parameter
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from renderer.errors import InputError
from renderer.light.lamps import LOCAL_LIGHTS


class Positions(Parameter):
    """Attack on the position of each lamp: x, y and z in world units.

    Shadows are cast from the changed positions. The gradient treats shadows as
    fixed.
    """

    name = "positions"

    def __init__(self, scene: Scene, settings: StepSettings):
        """Start at the positions of the lamps of the scene."""
        light = scene.basis.movable_light
        if light is None:
            kinds = " or ".join(name for name, kind in LOCAL_LIGHTS.items() if kind.is_movable)
            raise InputError(
                f"{self.name} cannot be attacked, because the scene has no {kinds}: "
                f"build the scene with {kinds}=...",
                self.name,
            )
        # All examples start at the same positions of the L lamps, shape (L, 3).
        positions = light.basis.source_positions().to(scene.lights)
        super().__init__(settings, start=positions.flatten().expand(len(scene), -1))

    def apply(
        self, values: Float[Tensor, "A D"], conditions: Conditions, examples: Tensor
    ) -> Conditions:
        """Return a copy of the conditions with moved lamps.

        The values are x, y and z of the L lamps in world units.
        """
        return replace(conditions, positions=values.unflatten(1, (-1, 3)))
