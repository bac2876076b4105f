"""Averages of the weights of a network over the training, and the choice of the best network."""

from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn, get_swa_avg_fn

from train.device import MixedPrecision


class MovingAverage(AveragedModel):
    """Exponential moving average of the parameters and buffers of a model.

    An update computes average = decay * average + (1 - decay) * model. The first
    update copies the model.

    Args:
        model: The model.
        decay: Weight of the old average in an update, in [0, 1).
    """

    def __init__(self, model: nn.Module, decay: float):
        super().__init__(model, use_buffers=True)
        self._average = get_ema_multi_avg_fn(decay)

    def update_parameters(self, model: nn.Module) -> None:
        """Update the average with the present parameters and buffers of a model.

        The method of the base class copies a counter to the GPU in each step,
        which the GPU waits for. This method keeps the counter on the CPU.
        """
        if self.n_averaged == 0:
            return super().update_parameters(model)
        averages = [*self.module.parameters(), *self.module.buffers()]
        latest = [*model.parameters(), *model.buffers()]
        # The function of torch that averages lists of tensors needs lists in which
        # either all tensors or none have floating-point numbers.
        for is_floating in (True, False):
            old = []
            new = []
            for average, value in zip(averages, latest, strict=True):
                if average.is_floating_point() == is_floating:
                    old.append(average.detach())
                    new.append(value.detach())
            if old:
                self._average(old, new, None)
        self.n_averaged += 1


class Averages:
    """Averages of a network in training, and the choice of the network that the training keeps.

    There are two averages, and both are optional: an exponential moving average of the weights
    over the steps, and a model soup, the mean of the weights after each epoch (Wortsman et al.
    2022, "Model soups"). With both, the soup is the mean of the moving averages.

    Attributes:
        selected: Network that is validated after each epoch: the soup, the moving average, or
            else the network in training.
    """

    def __init__(
        self,
        model: MixedPrecision,
        ema_decay: float,
        soup: bool,
        keeps_latest: bool = False,
    ):
        """Create the averages, which are empty at first.

        `ema_decay` is the decay in a step, or 0 for no moving average. With `keeps_latest` or a
        soup, the last network is kept instead of the one with the highest validation accuracy.
        """
        self._model = model
        self._ema: MovingAverage | None = None
        if ema_decay:
            self._ema = MovingAverage(model, ema_decay)
        self._soup: AveragedModel | None = None
        if soup:
            self._soup = AveragedModel(model, avg_fn=get_swa_avg_fn(), use_buffers=True)
        self._keeps_latest = soup or keeps_latest
        self._best_accuracy = -1.0
        average = self._soup or self._ema
        self.selected = cast(MixedPrecision, average.module) if average else model

    def begin_epoch(self, initial: nn.Module | None, optimizer: torch.optim.Optimizer) -> None:
        """Restart the training from the initial weights if the run makes a soup.

        A soup averages networks that all begin with the same weights. `initial` is None if the run
        began with random weights.
        """
        if self._soup is None or initial is None:
            return
        self._model.load_state_dict(initial.state_dict())
        optimizer.state.clear()
        if self._ema:
            self._ema.n_averaged.zero_()

    def end_step(self) -> None:
        """Update the moving average, if there is one, after a step of the optimizer."""
        if self._ema:
            self._ema.update_parameters(self._model)

    def end_epoch(self) -> None:
        """Add the network after an epoch to the soup, if there is one."""
        if self._soup:
            self._soup.update_parameters(self._ema.module if self._ema else self._model)

    def is_kept(self, accuracy: float) -> bool:
        """Return whether to keep the network of this epoch instead of that of an earlier epoch."""
        is_best = accuracy > self._best_accuracy
        self._best_accuracy = max(accuracy, self._best_accuracy)
        return is_best or self._keeps_latest

    def weights(self) -> dict[str, torch.Tensor]:
        """Return a copy of the weights of the selected network on the CPU, by name."""
        state = self.selected.network.state_dict()
        return {name: value.to("cpu", copy=True) for name, value in state.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the moving average and of the soup for a checkpoint."""
        return {
            "ema": self._ema.state_dict() if self._ema else None,
            "soup": self._soup.state_dict() if self._soup else None,
        }

    def load_state_dict(self, state: Mapping[str, Any], accuracies: list[float]) -> None:
        """Restore the averages from a checkpoint."""
        if self._ema:
            self._ema.load_state_dict(state["ema"])
        if self._soup:
            self._soup.load_state_dict(state["soup"])
        self._best_accuracy = max(accuracies, default=-1.0)
