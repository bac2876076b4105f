"""The kinds of local light, by name."""

from renderer.light.basis import LocalBasis
from renderer.light.lamps import Lamps
from renderer.light.projector import Projector

# Classes of local light by their names. In the basis of a scene, the coefficients of the
# environment light come first, and then the coefficients of local lights in this order. A
# field of `augment.settings.SceneSettings` has the name and holds the settings of the
# light. A field of `augment.parameter_settings.ParameterSettings` has the name and holds
# the settings of attacks on the light.
LOCAL_LIGHTS: dict[str, type[LocalBasis]] = {kind.name: kind for kind in (Projector, Lamps)}
