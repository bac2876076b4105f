"""The kinds of local light, by name."""

from renderer.light.basis import LocalBasis
from renderer.light.lamps import Lamps
from renderer.light.projector import Projector

# All kinds of local light by name. In this order, their coefficients follow those of the
# environment light in a scene. The name is also the name of two settings: a field of
# `augment.settings.SceneSettings` for the light, and a field of
# `augment.attack_settings.ParameterSettings` for attacks on the light.
LOCAL_LIGHTS: dict[str, type[LocalBasis]] = {kind.name: kind for kind in (Projector, Lamps)}
