"""Angles in files: in degrees, or in radians in the files of earlier versions."""

import math
from collections.abc import Mapping
from typing import Any

# A description with angles in degrees has this key, with this value.
ANGLE_UNIT = "angle_unit"
DEGREES = "degrees"
# The entries of a description that are angles.
ANGLES = ("polar", "azimuth", "fov")


def angles_in_degrees(description: Mapping[str, Any], unit: str | None) -> dict[str, Any]:
    """Return the description of a camera or of a projector with its angles in degrees.

    Args:
        description: The entries of a file. Those named in `ANGLES` are angles.
        unit: The file's entry `ANGLE_UNIT`. Files of earlier versions have none,
            and their angles are in radians.

    Returns:
        A copy with the angles in degrees.

    >>> angles_in_degrees({"polar": math.pi, "width": 2.0}, unit=None)
    {'polar': 180.0, 'width': 2.0}
    """
    converted = dict(description)
    if unit == DEGREES:
        return converted
    for name in ANGLES:
        if name in converted:
            converted[name] = math.degrees(converted[name])
    return converted
