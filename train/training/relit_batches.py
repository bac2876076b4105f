"""The augmentation "relight": training images appear in the light of a projector."""

import math

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from augment import distributed
from augment.attack_settings import AttackSettings, RelightingSettings
from augment.attacks.loop import minimize_from
from augment.attacks.objective import Criterion, Objective
from augment.attacks.optimizers import Gradient
from augment.photographs import RelitPhotographs
from augment.projected_light import draw_projected_light
from augment.random_streams import generator
from renderer.errors import MAX_SCALE
from renderer.image import decode, to_bytes, to_unit
from train.train_settings import TrainSettings

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
        unit = to_unit(images)
        # The linear colors of an image stand for the albedo of what it shows.
        problem = RelitPhotographs(decode(unit, "srgb"), light, CELLS, self._radius, self._steps)
        values = problem.sample(draws)
        if self._steps and self._radius and self._teacher is not None:
            values = self._attack(problem, values, unit)
        with torch.no_grad():
            return to_bytes(light.apply(unit, problem.log_gain(values)))

    def _attack(
        self,
        problem: RelitPhotographs,
        start: Float[Tensor, "B D"],
        images: Float[Tensor, "B 3 size size"],
    ) -> Float[Tensor, "B D"]:
        """Take all steps away from the classes that the teacher predicts for the images."""
        assert self._teacher is not None
        with torch.no_grad():
            original_classes = self._teacher(images).argmax(1)
        settings = AttackSettings(
            max_steps=self._steps,
            margin=MAX_SCALE,
            quantized=False,
            sensor_noise=0.0,
            batch_size=len(images),
        )
        objective = Objective(self._model, Criterion(original_classes[:, None]), settings)
        rows = torch.arange(len(images), device=images.device)
        optimizer = Gradient(problem, settings, seed=0)
        return minimize_from(start, optimizer, objective, rows, scores_last=False).values
