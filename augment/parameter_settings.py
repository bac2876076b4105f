"""Settings of each quantity that an attack can change.

`ParameterSettings` has a field for each quantity. Its name is the name of the
module with the quantity's class (see `augment.attacks.parameters`). This module
imports neither torch nor NumPy; see `renderer.settings`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar

from renderer.errors import MAX_MAGNITUDE, MAX_SCALE, InputError
from renderer.settings import TURBIDITY, Settings, setting

NORMS = ("linf", "l2")
STEPS = ("unit", "raw", "sign")

# Names of the fields of `PoseSettings` that have the units of an attack on the pose.
POSE_PARTS = ("rotation", "shift", "scale", "view", "distance")

# Names of the fields of `MaterialSettings` that have the units of the four values of an attack on
# the material, in the order of these values.
MATERIAL_PARTS = ("roughness", "metallic", "specular_factor", "hue")


@dataclass
class StepSettings(Settings):
    """Norm-ball around the values at which an attack starts, and steps of gradient descent in it.

    The radii of the paper (Section 4.1) are 0.1 per coefficient of the lighting and 0.002 per
    axis of a vertex, both with norm="linf".

    >>> import norm_balls as nb
    >>> nb.StepSettings(norm="l2", radius=1.0).step
    'unit'

    Attributes:
        needs_noise_margin: Whether attacks on this quantity often find images
            that sensor noise makes correct again. Such attacks need the
            `AttackSettings.noise_margin`.
    """

    needs_noise_margin: ClassVar[bool] = False

    norm: str = setting("linf", "Norm of the ball.", choices=NORMS)
    radius: float | None = setting(
        None,
        "Radius of the norm-ball. null permits all values.",
        minimum=0,
        maximum=MAX_SCALE,
    )
    step: str = setting(
        "unit",
        "Direction of a step: the gradient with L2 norm 1 (unit), the gradient (raw) or its sign.",
        choices=STEPS,
    )
    step_size: float = setting(
        0.05, "Factor of each step.", minimum=1 / MAX_MAGNITUDE, maximum=MAX_SCALE
    )


@dataclass
class SkylightSettings(StepSettings):
    """Attack on the position of the sun and the haze of a clear sky, and the initial sky.

    Attack values are the angles of the sun divided by `sun`, and the turbidity divided by 4. With
    the default of `sun` and the norm "linf", a radius of 0.1 permits changes of the angles by 5.7
    degrees, and of the turbidity by 0.4. Step sizes have the same units.
    """

    zenith: float = setting(
        45.0, "Zenith angle of the sun at the start.", "degrees", minimum=0, maximum=90
    )
    azimuth: float = setting(
        0.0,
        "Azimuth of the sun at the start.",
        "degrees",
        minimum=-MAX_SCALE,
        maximum=MAX_SCALE,
    )
    turbidity: float = setting(
        3.0,
        "Turbidity of the air at the start, from 2 (clear) to 10 (hazy).",
        minimum=TURBIDITY[0],
        maximum=TURBIDITY[1],
    )
    sun: float = setting(
        math.degrees(1),
        "Change of the zenith angle and the azimuth of the sun for a value of 1.",
        "degrees",
        minimum=0.1,
        maximum=360,
    )


@dataclass
class PoseSettings(StepSettings):
    """Attack on the pose of the object and of the camera.

    An attack value of 1 changes a part of the pose, such as the rotation, by the number in the
    field of this part. 0 leaves the part as it is.
    """

    needs_noise_margin = True

    rotation: float = setting(
        10.0,
        "Rotation of the object about its center for a value of 1.",
        "degrees",
        minimum=0,
        maximum=180,
    )
    shift: float = setting(
        0.1,
        "Shift of the object along x and y for a value of 1. The mesh spans [-1, 1].",
        minimum=0,
        maximum=10,
    )
    scale: float = setting(
        0.1,
        "Growth of the object for a value of 1. 0.1 is a factor of 1.1.",
        minimum=0,
        maximum=1,
    )
    view: float = setting(
        10.0,
        "Change of the polar angle and the azimuth of the camera for a value of 1.",
        "degrees",
        minimum=0,
        maximum=180,
    )
    distance: float = setting(
        0.1,
        "Growth of the distance of the camera for a value of 1. 0.1 is a factor of 1.1.",
        minimum=0,
        maximum=1,
    )

    def __post_init__(self) -> None:
        """Check that the attack can change something.

        Raises:
            InputError: If all settings are 0.
        """
        super().__post_init__()
        if not any(getattr(self, name) for name in POSE_PARTS):
            raise InputError(
                f"{', '.join(POSE_PARTS)} are all 0, so the pose cannot change: "
                "set one of them above 0",
            )


@dataclass
class MaterialSettings(StepSettings):
    """Attack on the specular material and the hue of the object.

    An attack value of 1 changes a part of the material, such as the roughness, by the number in
    the field of this part. 0 leaves the part as it is. `nb.Gloss` explains the parts.
    """

    needs_noise_margin = True

    roughness: float = setting(
        0.3,
        "Change of the roughness for a value of 1. The roughness stays between 0.2 and 1. "
        "A matte mesh starts with a dielectric specular layer of roughness 0.5 and strength 1.",
        minimum=0,
        maximum=1,
    )
    metallic: float = setting(
        0.3,
        "Change of the metallic factor for a value of 1, of meshes that are metallic.",
        minimum=0,
        maximum=1,
    )
    specular_factor: float = setting(
        1.0,
        "Change of the strength of the highlight for a value of 1. "
        "The strength is the specularFactor of KHR_materials_specular.",
        minimum=0,
        maximum=1,
    )
    hue: float = setting(
        0.0,
        "Rotation of the albedo about the gray axis for a value of 1.",
        "degrees",
        minimum=0,
        maximum=180,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(getattr(self, name) for name in MATERIAL_PARTS):
            message = f"{', '.join(MATERIAL_PARTS)} are all 0: nothing of the material would change"
            raise InputError(message)


@dataclass
class ParameterSettings(Settings):
    """Settings of each quantity that an attack can change.

    None leaves a quantity as it is. If several quantities are changed, they are
    changed in the order of these fields.
    """

    lighting: StepSettings | None = setting(None, "Attack on the coefficients of the lighting.")
    skylight: SkylightSettings | None = setting(None, "Attack on the sun and the air of a sky.")
    projector: StepSettings | None = setting(None, "Attack on the pattern of the projector.")
    lamps: StepSettings | None = setting(None, "Attack on the powers of the lamps.")
    positions: StepSettings | None = setting(None, "Attack on the positions of the lamps.")
    geometry: StepSettings | None = setting(None, "Attack on the positions of the vertices.")
    pose: PoseSettings | None = setting(None, "Attack on the pose of object and camera.")
    material: MaterialSettings | None = setting(None, "Attack on the specular material.")
    albedo: StepSettings | None = setting(None, "Attack on the albedo of each face.")
    pixels: StepSettings | None = setting(None, "Attack on the pixels of the image.")

    @property
    def parameters(self) -> dict[str, StepSettings]:
        """Return the settings of the quantities that are attacked, by their names."""
        named = {name: getattr(self, name) for name in PARAMETER_NAMES}
        return {name: settings for name, settings in named.items() if settings is not None}


PARAMETER_NAMES = tuple(field.name for field in fields(ParameterSettings))
