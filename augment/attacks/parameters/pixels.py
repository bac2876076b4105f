"""Attacks on the pixels of the rendered images."""

import math
from dataclasses import replace

from torch import Tensor

from augment.attacks.parameters.parameter import Parameter
from augment.parameter_settings import StepSettings
from augment.scene.conditions import Conditions
from augment.scene.scene import Scene


class Pixels(Parameter):
    """Offset of each pixel value of the V images of an example, background included.

    The scene clamps the sum of image and offset to [0, 1]. A single step along
    the sign of the gradient, as long as the radius, is FGSM (Goodfellow et al.
    2014). Several smaller steps are the basic iterative method. With random
    restarts, they are PGD (Madry et al. 2017).

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

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        """Return a copy of the conditions with an offset for each pixel value.

        Args:
            values: Offsets of all pixel values of the V images of each example, shape
                (A, V · 3 · size²).
            conditions: Conditions of the A examples.
            examples: Not used. All parameters have this argument.

        Returns:
            Conditions with the offsets, differentiable with respect to the values.
        """
        return replace(conditions, pixels=values.unflatten(1, self._images_shape))
