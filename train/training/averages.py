"""Averages of the weights of a network over the training, and interpolation between weights."""

from collections.abc import Mapping
from copy import copy
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn, get_swa_avg_fn

from augment.network import compute_outputs, device_of
from augment.progress import progress
from augment.random_streams import stream_seed
from train import console
from train.data.sets import Split
from train.device import MixedPrecision
from train.results.scoring import Model
from train.settings import RELIGHT, TrainSettings
from train.training.augmentations import relit
from train.training.recipe import kl_divergence

# Factors of the interpolation that are tried: 0 gives the weights before the training, and
# 1 the weights after it.
FACTORS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Entry of a checkpoint with interpolated weights. Its value is the factor.
INTERPOLATION = "interpolation"
# Number of images in a pass through a network.
BATCH = 32
Weights = Mapping[str, Tensor]


def weights_on_cpu(network: nn.Module) -> dict[str, Tensor]:
    """Return a copy of the state dict of a network on the CPU."""
    state = network.state_dict()
    # A new dictionary would lose the versions of modules, without which MNASNet cannot be loaded.
    state.update({name: value.to("cpu", copy=True) for name, value in state.items()})
    return state


class MovingAverage(AveragedModel):
    """Exponential moving average of the parameters and buffers of a model.

    An update computes average = decay * average + (1 - decay) * model. The first
    update copies the model. `decay` is in [0, 1).
    """

    def __init__(self, model: nn.Module, decay: float):
        super().__init__(model, use_buffers=True)
        self._average = get_ema_multi_avg_fn(decay)

    def update_parameters(self, model: nn.Module) -> None:
        """Update the average with the present parameters and buffers of a model.

        The method of the base class copies a counter to the GPU in each step,
        which the GPU waits for. This method keeps the counter on the CPU.
        """
        # The first call copies the weights, as the base class does.
        if self.n_averaged == 0:
            return super().update_parameters(model)
        averages = [*self.module.parameters(), *self.module.buffers()]
        pairs = [*zip(averages, [*model.parameters(), *model.buffers()], strict=True)]
        # The function of torch needs lists in which either all tensors or none are floating.
        for is_floating in (True, False):
            chosen = [pair for pair in pairs if pair[0].is_floating_point() == is_floating]
            if chosen:
                old, new = zip(*chosen, strict=True)
                self._average(old, new, None)
        self.n_averaged += 1


class Averages:
    """Averages of a network in training.

    There are two averages, and both are optional: an exponential moving average of the weights
    over the steps, and a model soup, the mean of the weights after each epoch (Wortsman et al.
    2022, "Model soups"). With both, the soup is the mean of the moving averages.

    Attributes:
        selected: Network that is validated after each epoch: the soup, the moving average, or
            else the network in training.
    """

    def __init__(self, model: MixedPrecision, decay: float, soup: bool):
        """Create the averages, which are empty at first.

        `decay` is that of a step, or 0 for no moving average.
        """
        self._model = model
        self._ema = MovingAverage(model, decay) if decay else None
        # The function updates the equal-weight mean of all networks so far, as for SWA.
        mean = get_swa_avg_fn()
        self._soup = AveragedModel(model, avg_fn=mean, use_buffers=True) if soup else None
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

    def weights(self) -> dict[str, torch.Tensor]:
        """Return a copy of the weights of the selected network on the CPU, by name."""
        return weights_on_cpu(self.selected.network)

    def state_dict(self) -> dict[str, Any]:
        """Return the states of the moving average and of the soup for a checkpoint."""
        averages = {"ema": self._ema, "soup": self._soup}
        return {name: of.state_dict() if of else None for name, of in averages.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the averages from a checkpoint."""
        if self._ema:
            self._ema.load_state_dict(state["ema"])
        if self._soup:
            self._soup.load_state_dict(state["soup"])


def interpolate(
    initial: MixedPrecision,
    selected: MixedPrecision,
    trained: Weights,
    validation: Split,
    recipe: TrainSettings,
    seed: int,
) -> tuple[dict[str, Tensor], float]:
    """Interpolate between two sets of weights, by the factor with the lowest loss.

    This is WiSE-FT (Wortsman et al. 2022, "Robust fine-tuning of zero-shot models"). The
    validation images need no labels.

    The loss is measured on validation images. It is a weighted sum of two
    divergences from the predictions of the initial network for these images:
    that of the predictions of the interpolated network for the same images, and
    that of its predictions for the images in the light of the augmentation, or of a projector if
    the augmentation is no light. Their weights are those of distillation and of consistency in the
    recipe. Return the interpolated weights on the CPU, and the factor, which is the smallest of
    equally good ones.
    """
    # Weights of the losses of unchanged and of relit images.
    weights = (recipe.distillation_weight or 1.0, recipe.consistency_weight)
    device = device_of(initial)
    initial_weights = {name: value.cpu() for name, value in initial.network.state_dict().items()}
    targets = predict(initial, validation, device)
    # The loss at each factor: 0 gives the initial weights, and 1 the trained ones.
    losses = {}
    for factor in FACTORS:
        selected.network.load_state_dict(mix(initial_weights, trained, factor))
        unchanged = predict(selected, validation, device)
        # All factors are tried in the same light, of which these are the keys of random numbers.
        relit = predict(selected, validation, device, seed, "validation", light=recipe.augmentation)
        divergences = [kl_divergence(logits, targets).mean() for logits in (unchanged, relit)]
        losses[factor] = weights[0] * float(divergences[0]) + weights[1] * float(divergences[1])
    factor = min(losses, key=losses.__getitem__)
    console.info("weights: %.0f%% trained, %.0f%% original", 100 * factor, 100 * (1 - factor))
    return mix(initial_weights, trained, factor), factor


def mix(initial: Weights, trained: Weights, factor: float) -> dict[str, Tensor]:
    """Interpolate linearly between the weights of two networks.

    The factor 0 gives `initial`. Integers, such as counters, are those of `trained`.
    """
    floats = {name: value for name, value in trained.items() if value.is_floating_point()}
    mixed: Any = copy(trained)
    mixed.update({name: initial[name].to(of).lerp(of, factor) for name, of in floats.items()})
    return mixed


def predict(
    model: Model, split: Split, device: torch.device, *light_key: int | str, light: str = RELIGHT
) -> Float[Tensor, "N classes"]:
    """Compute the logits of a network for images, as they are or in the light of an augmentation.

    Without a key for the random stream of the light, they are shown as they are. The logits are on
    the CPU.
    """
    batches = torch.arange(len(split)).split(BATCH)
    shown = progress(split.squares(batches), f"{len(split)} images", len(batches))
    if light_key:
        shown = (
            relit(images, stream_seed(*light_key, index, "relit"), light)
            for index, images in enumerate(shown)
        )
    return compute_outputs(model, shown, BATCH, device).cpu()
