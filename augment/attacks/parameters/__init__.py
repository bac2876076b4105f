"""Quantities of a scene that an attack changes: light, shape, pose, material, colors and pixels.

Each quantity is a subclass of `Parameter`, and `ParameterSettings` has a field of its name for its
settings. `Light` stands for the coefficients of the environment and of any kind of local light. An
attack can change several quantities at once (see `augment.attacks.problem`).
"""

from collections.abc import Callable
from typing import Any

from augment.attack_settings import PARAMETER_NAMES, StepSettings
from augment.attacks.parameters.lights import Light, Positions, Skylight
from augment.attacks.parameters.material import Material
from augment.attacks.parameters.offsets import Albedo, Geometry, Pixels
from augment.attacks.parameters.parameter import Parameter
from augment.attacks.parameters.pose import Pose
from augment.scene.scene import Scene
from renderer.errors import require_choice

KINDS = (Albedo, Geometry, Material, Pixels, Pose, Positions, Skylight)


def parameter_class(name: str) -> type[Parameter]:
    """Return the class of a quantity that an attack changes."""
    require_choice("name", name, PARAMETER_NAMES)
    return {kind.name: kind for kind in KINDS}.get(name, Light)


def make_parameter(name: str, scene: Scene, settings: StepSettings, **options: Any) -> Parameter:
    """Create an attack parameter by its name."""
    kind: Callable[..., Parameter] = parameter_class(name)
    if kind is Light:
        return kind(scene, settings, name, **options)
    return kind(scene, settings, **options)
