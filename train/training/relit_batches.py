"""The augmentation `relight`: training images in the light of a projector."""

import math

import torch
from torch import Tensor, nn

from augment import distributed
from augment.attack_settings import RelightingSettings
from augment.model_passes import frozen_eval_mode
from augment.photographs.gain import descend_gain, draw_log_gain
from augment.photographs.projected_light import draw_projected_light
from augment.random_streams import generator
from renderer.image import decode, to_bytes, to_unit
from train.settings import TrainSettings

# Cells per side of the grid of factors of a slide, as in the attack on photographs.
CELLS = RelightingSettings().cells


class RelitBatches:
    """Shows the images of a batch in the light of a projector with random slides.

    The slides also show other images of the batch. Each channel of a slide has
    smooth factors, which are random or found by gradient.

    Args:
        settings: Settings of the training.
        model: Network that the gradient attacks.
        teacher: Network whose predictions the attack leads away from. None if
            the factors are random.
        seed: Seed of the run.
    """

    def __init__(
        self,
        settings: TrainSettings,
        model: nn.Module,
        teacher: nn.Module | None,
        seed: int,
    ):
        self._radius = math.log(settings.relight_gain)
        self._steps = settings.relight_steps
        self._model = model
        self._teacher = teacher
        self._seed = seed

    def apply(self, images: Tensor, labels: Tensor, step: int) -> Tensor:
        """Relight the images of a batch.

        Args:
            images: The images, uint8, shape (B, 3, size, size).
            labels: Not used. All augmentations are called with labels.
            step: The number of the step in the run.

        Returns:
            The relit images, uint8, shape (B, 3, size, size).
        """
        # Each step and each process has random draws of its own.
        draws = generator(self._seed, step, "relight", distributed.rank())
        count, _, size, _ = images.shape
        light = draw_projected_light(count, size, draws, images).to(images.device)
        log_gain = draw_log_gain(count, CELLS, self._radius, draws).to(images.device)
        unit = to_unit(images)
        if self._steps and self._teacher is not None:
            with torch.no_grad():
                source = self._teacher(unit).argmax(1)
            albedo = decode(unit, "srgb")
            with frozen_eval_mode(self._model):
                log_gain = descend_gain(
                    self._model, albedo, light, source, log_gain, self._radius, self._steps
                )
        with torch.no_grad():
            return to_bytes(light.apply(unit, log_gain))
