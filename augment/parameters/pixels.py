"""The pixels themselves: the perturbation that the paper argues against, as a baseline."""

from dataclasses import replace

from torch import Tensor

from augment.parameters.kind import Kind, StepSettings
from augment.scene import Conditions, Scene


class Pixels(Kind):
    """What is added to each image's values, background included; the sum is clamped to [0, 1].

    One step of the radius along the sign is FGSM (Goodfellow et al. 2014); several smaller ones are the iterated
    method, and with random restarts PGD (Madry et al. 2017).
    """

    name = "pixels"

    def __init__(self, scene: Scene, settings: StepSettings):
        values = scene.views * 3 * scene.settings.size**2
        super().__init__(scene, scene.lights.new_zeros(len(scene), values), settings)

    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        size = self.scene.settings.size
        return replace(conditions, pixels=values.unflatten(1, (self.scene.views, 3, size, size)))
