"""The networks that a training keeps: the one that learns, its averages, and the best so far."""

from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn, get_swa_avg_fn

from train.system.device import MixedPrecision


class MovingAverage(AveragedModel):
    """The exponential moving average of a model's weights and statistics.

    The first update copies the parameters and buffers of the model.

    Args:
        model: The model.
        decay: Weight of the old average in an update, in [0, 1).
    """

    def __init__(self, model: nn.Module, decay: float):
        super().__init__(model, use_buffers=True)
        self._average = get_ema_multi_avg_fn(decay)

    def update_parameters(self, model: nn.Module) -> None:
        """Move the average toward a model.

        The method of torch copies its counter to the GPU at every step, and the
        GPU waits for it. This method keeps the counter on the CPU.
        """
        if self.n_averaged == 0:
            return super().update_parameters(model)
        averages = [*self.module.parameters(), *self.module.buffers()]
        latest = [*model.parameters(), *model.buffers()]
        # `_average` takes either floating-point tensors or integer tensors.
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
    """The averages of a network in training, and which network is kept.

    The soup is the mean of the networks at the ends of all epochs (Wortsman et al. 2022, "Model
    soups"). With a moving average, it is the mean of the moving averages.

    Args:
        model: The network that learns.
        ema_decay: The decay of the moving average; 0 for none.
        soup: Whether to take the mean over all epochs.
        keeps_latest: Whether the latest network is kept in place of the one that validates best.
            A soup always keeps the latest, which has all epochs in it.

    Attributes:
        selected: The network that is validated and kept: the soup, the moving average, or else
            the network that learns.
    """

    def __init__(
        self,
        model: MixedPrecision,
        ema_decay: float,
        soup: bool,
        keeps_latest: bool = False,
    ):
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
        """Reset the network to the initial one if the run makes a soup.

        Args:
            initial: Network with which the run began. None for random weights.
            optimizer: Optimizer of the network. Its momentum is reset.
        """
        if self._soup is None or initial is None:
            return
        self._model.load_state_dict(initial.state_dict())
        optimizer.state.clear()
        if self._ema:
            self._ema.n_averaged.zero_()

    def end_step(self) -> None:
        """Move the moving average towards the network after a step."""
        if self._ema:
            self._ema.update_parameters(self._model)

    def end_epoch(self) -> None:
        """Add the network at the end of an epoch to the soup."""
        if self._soup:
            self._soup.update_parameters(self._ema.module if self._ema else self._model)

    def is_kept(self, accuracy: float) -> bool:
        """Return whether the selected network replaces the one that was kept before.

        Args:
            accuracy: Accuracy of the selected network on the validation images,
                in [0, 1].

        Returns:
            True if the accuracy is higher than in all epochs before, or if the
            latest network is always kept.
        """
        is_best = accuracy > self._best_accuracy
        self._best_accuracy = max(accuracy, self._best_accuracy)
        return is_best or self._keeps_latest

    def weights(self) -> dict[str, torch.Tensor]:
        """Return a copy of the selected network's weights on the CPU."""
        state = self.selected.network.state_dict()
        return {name: value.to("cpu", copy=True) for name, value in state.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the moving average and of the soup for a checkpoint.

        Returns:
            States under the keys "ema" and "soup". None in place of an average
            that the training does not have.
        """
        return {
            "ema": self._ema.state_dict() if self._ema else None,
            "soup": self._soup.state_dict() if self._soup else None,
        }

    def load_state_dict(self, state: Mapping[str, Any], accuracies: list[float]) -> None:
        """Restore the averages.

        Args:
            state: Mapping with the entries that `state_dict` returned.
            accuracies: Validation accuracies of the finished epochs. The
                highest one is the accuracy to exceed.
        """
        if self._ema:
            self._ema.load_state_dict(state["ema"])
        if self._soup:
            self._soup.load_state_dict(state["soup"])
        self._best_accuracy = max(accuracies, default=-1.0)
