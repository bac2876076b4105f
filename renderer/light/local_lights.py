"""The kinds of local light, by name."""

from renderer.light.basis import LocalBasis
from renderer.light.lamps import Lamps
from renderer.light.projector import Projector

# In this order, their coefficients follow those of the environment light. Each
# has its settings in a field of `augment.settings.SceneSettings`, and an attack in
# a field of `augment.attack_settings.AttackSettings`, under its name.
LOCAL_LIGHTS: dict[str, type[LocalBasis]] = {kind.name: kind for kind in (Projector, Lamps)}
