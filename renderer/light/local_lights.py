"""The kinds of local light, by name."""

from renderer.light.basis import LocalBasis
from renderer.light.lamps import Lamps
from renderer.light.projector import Projector

# The coefficients of local lights follow those of the environment light in this
# order. The name of a kind is also that of a field of
# `augment.settings.SceneSettings`, with its settings, and of a field of
# `augment.attack_settings.AttackSettings`, for its attack.
LOCAL_LIGHTS: dict[str, type[LocalBasis]] = {kind.name: kind for kind in (Projector, Lamps)}
