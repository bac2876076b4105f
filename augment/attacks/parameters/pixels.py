"""Attacks on the pixels of the rendered images."""

import math
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from augment.attack_settings import StepSettings
from augment.attacks.parameters.parameter import Parameter
from augment.scene.objects import Conditions
from augment.scene.scene import Scene


class Pixels(Parameter):
    """Attack on the pixels: an offset that is added to each pixel value of an image.

    The sum of image and offset is clamped to [0, 1]. With one step of the kind
    "sign" that is as long as the radius, the attack is FGSM (Goodfellow et al.
    2014). With several smaller steps, it is the basic iterative method (Kurakin
    et al. 2016). With random restarts in addition, it is PGD (Madry et al. 2017).

    Args:
        scene: Scene to attack.
        settings: Norm-ball and steps of the attack.
    """

    name = "pixels"
    fits_other_meshes = False
    fits_other_views = False

    def __init__(self, scene: Scene, settings: StepSettings):
        size = scene.settings.size
        self._images_shape = (scene.views, 3, size, size)
        start = scene.lights.new_zeros(len(scene), math.prod(self._images_shape))
        super().__init__(settings, start)

    def apply(
        self, values: Float[Tensor, "A _"], conditions: Conditions, examples: Tensor
    ) -> Conditions:
        """Return a copy of the conditions with an offset for each pixel value.

        The values are in the order (V, 3, size, size) of the images.
        """
        return replace(conditions, pixels=values.unflatten(1, self._images_shape))
