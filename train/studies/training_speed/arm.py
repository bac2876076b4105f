"""An arm of an experiment in the real `Trainer`, an epoch at a time."""

from pathlib import Path
from typing import cast

import torch

from augment.utils import Phases
from train.data import DataSet, Split
from train.experiment import build_trainer
from train.run_folder.logs import RunLog
from train.settings import ExperimentSettings
from train.wideresnet import WideResNet

EPOCH = "epoch"  # the phase that all others are part of
MARGIN = 30.0  # of a logit: more than any other class reaches, and a gradient that float32 still holds


class Arm:
    """A turn is one epoch: renders, training, evaluation, checkpoint and logs, as `python -m train` does them.

    Before each, the network is made sure of the class under study, so that every attack takes all its steps: the most
    that it can cost, whatever a network has learnt.
    """

    def __init__(self, settings: ExperimentSettings, data: DataSet, folder: Path, train: Split, validation: Split):
        """train, validation: of an epoch here, on the device; data: whose statistics and classes the network gets."""
        folder.mkdir()
        device = train.images.device
        self.trainer = build_trainer(settings, data, folder, device)
        self._label = data.classes.index(settings.label)
        self._splits = train, validation
        self._phases = Phases(device)

    def __call__(self) -> dict[str, float]:
        """Seconds by phase, and `epoch` the whole; the first turn has the operators', too. steps: attacks' mean."""
        trainer = self.trainer
        self._make_sure()
        trainer.settings.epochs = trainer.epoch + 1
        with self._phases(EPOCH):
            trainer.fit(*self._splits, RunLog(trainer.folder, trainer.history))
        line = trainer.history[-1]
        seconds = {name.partition("/")[2]: value for name, value in line.items() if name.startswith("seconds/")}
        seconds["input_output"] += trainer.phases.take()["input_output"]  # the checkpoint, written after the line
        return seconds | self._phases.take() | {"steps": line.get("augment/steps", 0.0)}

    @torch.no_grad()
    def _make_sure(self) -> None:
        head = cast(WideResNet, self.trainer.learner.model.network).head
        head.weight[self._label] = 0
        head.bias[self._label] = MARGIN
