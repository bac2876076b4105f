"""Quantities of a scene that an attack changes: light, shape, pose, material, colors and pixels.

Each quantity is a subclass of `Parameter`. The class `Pose` of the quantity
"pose" is in the module `pose`, and `ParameterSettings` has the field `pose` for
its settings. `LocalLight` stands for the coefficients of any kind of local light.
An attack can change several quantities at once (see `augment.attacks.problem`).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from augment.attack_settings import PARAMETER_NAMES
from augment.attacks.parameters.local_light import LocalLight
from renderer.errors import require_choice
from renderer.light.lamps import LOCAL_LIGHTS

if TYPE_CHECKING:
    from collections.abc import Callable

    from augment.attack_settings import StepSettings
    from augment.attacks.parameters.parameter import Parameter
    from augment.scene.scene import Scene


def parameter_class(name: str) -> type[Parameter]:
    """Return the class of a quantity that an attack changes."""
    require_choice("name", name, PARAMETER_NAMES)
    if name in LOCAL_LIGHTS:
        return LocalLight
    module = import_module(f"{__name__}.{name}")
    kind: type[Parameter] = getattr(module, name.capitalize())
    return kind


def make_parameter(name: str, scene: Scene, settings: StepSettings, **options: Any) -> Parameter:
    """Create an attack parameter by its name."""
    if name in LOCAL_LIGHTS:
        return LocalLight(scene, settings, name)
    constructor: Callable[..., Parameter] = parameter_class(name)
    return constructor(scene, settings, **options)
