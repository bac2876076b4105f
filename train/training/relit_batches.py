"""The augmentation "relight": training images appear in the light of a projector."""

import math

import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from augment import distributed
from augment.attack_settings import RelightingSettings
from augment.attacks.gain import descend_gain, draw_log_gain
from augment.network import frozen_eval_mode
from augment.projected_light import draw_projected_light
from augment.random_streams import generator
from renderer.image import decode, to_bytes, to_unit
from train.settings import TrainSettings

# The brightness of a projected slide is multiplied by smooth random factors, which are
# interpolated from a grid with this number of cells per side.
CELLS = RelightingSettings().cells


class RelitBatches:
    """Augmentation that shows the images of a batch in the light of a projector.

    A slide is the picture that the projector shows. It is a random pattern or
    another image of the batch, and each of its color channels is multiplied by
    smooth factors. The factors are random, or are changed by gradient descent
    until the network predicts another class.
    """

    def __init__(
        self,
        settings: TrainSettings,
        model: nn.Module,
        teacher: nn.Module | None,
        seed: int,
    ):
        """Store the arguments.

        The attack leads away from the classes that `teacher` predicts; without it, the light is
        random.
        """
        self._radius = math.log(settings.relight_gain)
        self._steps = settings.relight_steps
        self._model = model
        self._teacher = teacher
        self._seed = seed

    def apply(
        self, images: UInt8[Tensor, "B 3 size size"], labels: Tensor, step: int
    ) -> UInt8[Tensor, "B 3 size size"]:
        """Show the images of a batch in the light of a projector, each in a light of its own."""
        # The random numbers differ between steps, and between the processes of a run.
        draws = generator(self._seed, step, "relight", distributed.rank())
        count, _, size, _ = images.shape
        light = draw_projected_light(count, size, draws, images).to(images.device)
        # Logarithms of the factors by which the projected slide of each image is multiplied.
        log_gain = draw_log_gain(count, CELLS, self._radius, draws).to(images.device)
        unit = to_unit(images)
        if self._steps and self._teacher is not None:
            with torch.no_grad():
                original_classes = self._teacher(unit).argmax(1)
            # The linear colors of an image stand for the albedo of what it shows.
            albedo = decode(unit, "srgb")
            with frozen_eval_mode(self._model):
                log_gain = descend_gain(
                    self._model,
                    albedo,
                    light,
                    source=original_classes,
                    start=log_gain,
                    radius=self._radius,
                    steps=self._steps,
                )
        with torch.no_grad():
            return to_bytes(light.apply(unit, log_gain))
