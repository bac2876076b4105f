"""What an attack may change, a file each: lighting, skylight, geometry, albedo, pixels.

A kind of parameter turns flat values (A, D) into a part of the conditions that a mesh is rendered under; any of them
can be attacked at once.
"""

from augment.parameters.albedo import Albedo
from augment.parameters.geometry import Geometry
from augment.parameters.kind import Kind, StepSettings
from augment.parameters.lighting import Lighting
from augment.parameters.pixels import Pixels
from augment.parameters.skylight import Skylight

KINDS = {kind.name: kind for kind in (Lighting, Skylight, Geometry, Albedo, Pixels)}

__all__ = ["KINDS", "Albedo", "Geometry", "Kind", "Lighting", "Pixels", "Skylight", "StepSettings"]
