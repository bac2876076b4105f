"""Build the optimizer, compute the learning rate, and freeze layers."""

import math
from collections.abc import Callable

import torch
from torch import nn

from augment.classifiers.adapter import nearest
from renderer.errors import InputError
from train.settings import ALL_BUT_LAST, TrainSettings

# "step" multiplies the learning rate by STEP_FACTOR at each of these fractions of
# the training. Zagoruyko and Komodakis (2016) do so at epochs 60, 120 and 160 of
# 200.
MILESTONES = (0.3, 0.6, 0.8)
STEP_FACTOR = 0.2
# "one_cycle" begins with a tenth of the learning rate, and reaches all of it after
# a fifth of the training.
START_FACTOR = 0.1
WARMUP = 0.2


def _step(done: float) -> float:
    """Return the factor of the learning rate in the schedule "step".

    Args:
        done: Fraction of the training that is done, in [0, 1].
    """
    return STEP_FACTOR ** sum(done >= milestone for milestone in MILESTONES)


def _cosine(done: float) -> float:
    """Return the factor of the learning rate in the schedule "cosine".

    The factor falls from 1 to 0 along half a period of a cosine.

    Args:
        done: Fraction of the training that is done, in [0, 1].
    """
    return (1 + math.cos(math.pi * done)) / 2


def _one_cycle(done: float) -> float:
    """Return the factor of the learning rate in the schedule "one_cycle".

    The factor rises linearly to 1, and then falls linearly to 0. The schedule
    suits trainings of few epochs.

    Args:
        done: Fraction of the training that is done, in [0, 1].
    """
    if done < WARMUP:
        return START_FACTOR + (1 - START_FACTOR) * done / WARMUP
    return (1 - done) / (1 - WARMUP)


# Factor of the learning rate after a fraction of the training, by schedule.
SCHEDULE_FACTORS: dict[str, Callable[[float], float]] = {
    "step": _step,
    "cosine": _cosine,
    "one_cycle": _one_cycle,
}


def learning_rate(settings: TrainSettings, done: float) -> float:
    """Compute the learning rate.

    Args:
        settings: Settings of the training.
        done: Fraction of the training that is done, in [0, 1].

    Returns:
        The learning rate.
    """
    return settings.learning_rate * SCHEDULE_FACTORS[settings.schedule](done)


def build_optimizer(model: nn.Module, settings: TrainSettings) -> torch.optim.Optimizer:
    """Build the optimizer.

    "sgd" has Nesterov momentum and decays all weights, as in the paper. "adamw"
    (Loshchilov and Hutter 2019) decays neither biases nor the weights of
    normalizations, as is usual, and ignores `settings.momentum`.

    Args:
        model: Network to train.
        settings: Settings of the training.

    Returns:
        Optimizer of all parameters of the network.
    """
    if settings.optimizer == "sgd":
        return torch.optim.SGD(
            model.parameters(),
            settings.learning_rate,
            momentum=settings.momentum,
            weight_decay=settings.weight_decay,
            nesterov=settings.momentum > 0,
            fused=True,
        )
    # Biases and the weights of normalizations are vectors.
    vectors = [parameter for parameter in model.parameters() if parameter.ndim <= 1]
    matrices = [parameter for parameter in model.parameters() if parameter.ndim > 1]
    groups = [
        {"params": vectors, "weight_decay": 0.0},
        {"params": matrices, "weight_decay": settings.weight_decay},
    ]
    return torch.optim.AdamW(groups, settings.learning_rate, fused=True)


def last_layer(network: nn.Module) -> str:
    """Return the name of the module that has the last parameter of a network.

    Args:
        network: Network with parameters.

    Returns:
        Name, such as "head.fc". Empty for the network itself.
    """
    *_, (name, _) = network.named_parameters()
    # The name of a parameter is that of its module, followed by ".weight" or such.
    return name.rpartition(".")[0]


def freeze(network: nn.Module, stage: str) -> None:
    """Freeze the parameters of a network from the first one to the end of a module.

    Args:
        network: Network, which is changed.
        stage: Name of the last frozen module, such as "blocks.5". With
            ALL_BUT_LAST, everything before the last layer is frozen, which is
            nothing if there is no other layer.

    Raises:
        InputError: If there is no module of this name, or if it has no
            parameters.
    """
    names = [name for name, _ in network.named_parameters()]
    # The module that has each parameter.
    modules = [name.rpartition(".")[0] for name in names]
    # `frozen` holds the indices of parameters of the frozen modules. The last of
    # these indices is where freezing ends.
    if stage == ALL_BUT_LAST:
        last = last_layer(network)
        frozen = [index for index, module in enumerate(modules) if module != last]
        if not frozen:
            return
    else:
        frozen = [index for index, name in enumerate(names) if name.startswith(f"{stage}.")]
    if not frozen:
        parts = nearest(stage, sorted(set(modules)))
        raise InputError(
            f"stage={stage} is no module of the network: choose a module, such as {parts}",
            "stage",
        )
    for parameter in list(network.parameters())[: frozen[-1] + 1]:
        parameter.requires_grad_(False)
