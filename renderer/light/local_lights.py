"""The kinds of local light."""

from renderer.light.basis import LocalBasis
from renderer.light.lamps import Lamps
from renderer.light.projector import Projector

# In this order, their coefficients follow those of the environment light. Each
# has its settings in a field of `augment.settings.SceneSettings`, and an attack in
# a field of `augment.attack_settings.AttackSettings`, under its name.
LOCAL_LIGHTS: tuple[type[LocalBasis], ...] = (Projector, Lamps)
