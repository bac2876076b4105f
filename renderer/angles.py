"""Convert the angles in files to degrees. Files of earlier versions have angles in radians."""

import math
from collections.abc import Mapping
from typing import Any

# Name of the entry of a file that says the unit of the angles in the file.
ANGLE_UNIT = "angle_unit"
# Value of the entry "angle_unit" in files whose angles are in degrees.
DEGREES = "degrees"
# Names of the entries that are angles, in files with cameras or projectors.
ANGLES = ("polar", "azimuth", "fov")


def angles_in_degrees(description: Mapping[str, Any], unit: str | None) -> dict[str, Any]:
    """Convert the angles of a camera or of a projector from a file to degrees.

    The angles are "polar", "azimuth" and "fov". `unit` is "degrees", or None for files of
    earlier versions, whose angles are in radians.
    """
    converted = dict(description)
    if unit == DEGREES:
        return converted
    for name in ANGLES:
        if name in converted:
            converted[name] = math.degrees(converted[name])
    return converted
