"""Settings of each quantity that an attack can change.

`ParameterSettings` has a field for each quantity. Its name is the name of the
module with the quantity's class (see `augment.attacks.parameters`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from augment.attacks.norm_ball import StepSettings
from renderer.errors import FACTOR, InputError, require_range
from renderer.light.skylight import TURBIDITY

if TYPE_CHECKING:
    from augment.objects import SceneObject

# Names of the parts of a pose, without the joints, in the order of their values.
# The fields of `PoseSettings` with these names are their units.
POSE = ("rotation", "shift", "scale", "view", "distance")

# Names of the four values of an attack on the material, in their order. The
# fields of `MaterialSettings` with these names are their units.
MATERIAL = ("roughness", "metallic", "strength", "hue")


@dataclass
class SkylightSettings(StepSettings):
    """Norm-ball, steps and initial sky of an attack on the skylight.

    Attributes:
        zenith: Initial zenith angle of the sun in degrees, from 0 (overhead) to
            90 (horizon).
        azimuth: Initial azimuth of the sun in degrees, from +x toward +y.
        turbidity: Initial turbidity of the air, from 2 (clear) to 10 (hazy).

    Raises:
        InputError: If an angle or the turbidity is out of range.
    """

    zenith: float = 45.0
    azimuth: float = 0.0
    turbidity: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        # The sun does not go below the horizon.
        require_range("zenith", self.zenith, 0, 90)
        require_range("azimuth", self.azimuth, -FACTOR, FACTOR)
        require_range("turbidity", self.turbidity, *TURBIDITY)


@dataclass
class PoseSettings(StepSettings):
    """Norm-ball and steps of an attack on the pose, and the unit of each attack value.

    The unit says how far the pose changes when the attack value changes by 1.
    With a unit of 0, the attack does not change this part of the pose.

    Attributes:
        rotation: Unit of the rotation of the object, in degrees from 0 to 180.
        shift: Unit of the shift of the object along the table, in world units
            from 0 to 10.
        scale: Unit of the growth of the object, as a fraction of its size in
            [0, 1].
        view: Unit of the polar angle and of the azimuth of the cameras, in
            degrees from 0 to 180.
        distance: Unit of the growth of the distance of the cameras, as a
            fraction of this distance in [0, 1].
        joints: Unit of the rotation of the joints of a skinned mesh about each
            axis, in degrees from 0 to 180. The joints do not rotate further
            than this. A number applies to all joints, {name: degrees} to the
            named joints only.

    Raises:
        InputError: If a unit is out of range, or if all units are 0.
    """

    rotation: float = 10.0
    shift: float = 0.1
    scale: float = 0.1
    view: float = 10.0
    distance: float = 0.1
    joints: Any = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("rotation", self.rotation, 0, 180)
        require_range("shift", self.shift, 0, 10)
        require_range("scale", self.scale, 0, 1)
        require_range("view", self.view, 0, 180)
        require_range("distance", self.distance, 0, 1)
        degrees_by_setting = self._degrees_by_setting()
        for setting, degrees in degrees_by_setting.items():
            if isinstance(degrees, bool) or not isinstance(degrees, int | float):
                raise InputError(f"joints={self.joints}: give degrees, or {{name: degrees}}")
            require_range(setting, degrees, 0, 180)
        units = [getattr(self, name) for name in POSE]
        if not any(units) and not any(degrees_by_setting.values()):
            parts = ", ".join(POSE)
            raise InputError(f"{parts} and joints are all 0: nothing of the pose would change")

    def _degrees_by_setting(self) -> dict[str, Any]:
        """Return the degrees of the joints under the names that error messages use.

        The name is "joints", or "joints.NAME" for each named joint.
        """
        if isinstance(self.joints, Mapping):
            return {f"joints.{name}": degrees for name, degrees in self.joints.items()}
        return {"joints": self.joints}

    def joint_limits(self, item: SceneObject) -> list[float]:
        """Return the largest rotation of each joint of an object, in degrees.

        Args:
            item: Object whose joints are attacked.

        Returns:
            Degrees for each joint, in the order of the skin. Empty if `joints`
            is 0 or names no joint.

        Raises:
            InputError: If the object has no skin, or no joint of a given name.
        """
        if not self.joints:
            return []
        if item.mesh.skin is None:
            message = f"joints: {item.name} has no skin"
            raise InputError(f"{message}: give a glTF file with one, or joints=0")
        joint_names = item.mesh.skin.names
        if not isinstance(self.joints, Mapping):
            return [float(self.joints)] * len(joint_names)
        for name in self.joints:
            if name not in joint_names:
                message = f"joints: {item.name} has no joint {name}"
                raise InputError(f"{message}: choose from {', '.join(joint_names)}")
        return [float(self.joints.get(name, 0)) for name in joint_names]


@dataclass
class MaterialSettings(StepSettings):
    """Norm-ball and steps of an attack on the material, and the unit of each attack value.

    The unit says how far the material changes when the attack value changes by
    1. With a unit of 0, the attack does not change this part of the material.

    Attributes:
        roughness: Unit of the roughness (see `renderer.Gloss`), in [0, 1].
        metallic: Unit of the metallic share, in [0, 1]. Objects that are not
            metallic at all stay so.
        strength: Unit of the strength of the specular reflection, in [0, 1].
        hue: Unit of the rotation of the hue of the albedo, in degrees from 0 to
            180.

    Raises:
        InputError: If a unit is out of range, or if all units are 0.
    """

    roughness: float = 0.3
    metallic: float = 0.3
    strength: float = 1.0
    hue: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range("roughness", self.roughness, 0, 1)
        require_range("metallic", self.metallic, 0, 1)
        require_range("strength", self.strength, 0, 1)
        require_range("hue", self.hue, 0, 180)
        if not any(getattr(self, name) for name in MATERIAL):
            parts = ", ".join(MATERIAL)
            raise InputError(f"{parts} are all 0: nothing of the material would change")


@dataclass
class ParameterSettings:
    """Settings of each quantity that an attack can change; None leaves the quantity as it is.

    Where several quantities are changed, they are applied in the order of these
    fields.

    Attributes:
        lighting: The environment lighting.
        skylight: The sun's direction and the turbidity of a daylight sky.
        projector: The pattern that a projector throws.
        lamps: The intensity of each lamp.
        positions: The position of each lamp.
        geometry: The displacement of each vertex of the object.
        pose: The pose of the object, of its joints and of the cameras.
        material: The gloss of the object and the hue of its albedo.
        albedo: The color that is added to each face of the object.
        pixels: The offset of each pixel of the images.
    """

    lighting: StepSettings | None = None
    skylight: SkylightSettings | None = None
    projector: StepSettings | None = None
    lamps: StepSettings | None = None
    positions: StepSettings | None = None
    geometry: StepSettings | None = None
    pose: PoseSettings | None = None
    material: MaterialSettings | None = None
    albedo: StepSettings | None = None
    pixels: StepSettings | None = None

    @property
    def parameters(self) -> dict[str, StepSettings]:
        """The settings of the quantities to change, by name."""
        named = {name: getattr(self, name) for name in PARAMETER_NAMES}
        return {name: settings for name, settings in named.items() if settings is not None}


PARAMETER_NAMES = tuple(field.name for field in fields(ParameterSettings))
