"""Convert the angles in files to degrees. Files of earlier versions have angles in radians."""

import math
from collections.abc import Mapping
from typing import Any

# Files with angles in degrees have the entry `ANGLE_UNIT` with the value `DEGREES`.
ANGLE_UNIT = "angle_unit"
DEGREES = "degrees"
# Names of the entries of a file that are angles.
ANGLES = ("polar", "azimuth", "fov")


def angles_in_degrees(description: Mapping[str, Any], unit: str | None) -> dict[str, Any]:
    """Convert the angles of a camera or of a projector from a file to degrees.

    Args:
        description: Entries of the file. Entries with names in `ANGLES` are
            angles.
        unit: Value of the entry `ANGLE_UNIT` of the file. None for files of
            earlier versions, whose angles are in radians.

    Returns:
        Copy of the entries, with angles in degrees.

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
