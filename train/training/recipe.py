"""How a network is trained: settings, learning-rate schedules, the optimizer, frozen layers."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from augment.classifiers.adapter import nearest
from renderer.errors import InputError
from train.settings import ALL_BUT_LAST, TrainSettings

# Factors of the learning rate at a fraction of the training: ×0.2 at 30, 60 and 80 % (Zagoruyko and Komodakis 2016: at
# epochs 60, 120 and 160 of 200); half a cosine; up over the first fifth and down, the most from a few epochs.
SCHEDULE_FACTORS: dict[str, Callable[[float], float]] = {
    "step": lambda done: 0.2 ** sum(done >= milestone for milestone in (0.3, 0.6, 0.8)),
    "cosine": lambda done: (1 + math.cos(math.pi * done)) / 2,
    "one_cycle": lambda done: 0.1 + 0.9 * done / 0.2 if done < 0.2 else (1 - done) / 0.8,
}


def learning_rate(settings: TrainSettings, done: float) -> float:
    """Compute the learning rate.

    Args:
        settings: Settings of the training.
        done: Fraction of the training that is done.

    Returns:
        The learning rate.
    """
    return settings.learning_rate * SCHEDULE_FACTORS[settings.schedule](done)


def build_optimizer(model: nn.Module, settings: TrainSettings) -> torch.optim.Optimizer:
    """SGD with Nesterov's momentum, as the paper's, which decays all weights; or AdamW (Loshchilov and Hutter 2019),
    which does not decay biases and the weights of norms, as is usual with it, and has its own two momenta."""
    rate, decay = settings.learning_rate, settings.weight_decay
    if settings.optimizer == "sgd":
        nesterov = settings.momentum > 0
        options: dict[str, Any] = {"momentum": settings.momentum, "weight_decay": decay, "nesterov": nesterov}
        return torch.optim.SGD(model.parameters(), rate, **options, fused=True)
    groups: tuple[list[Tensor], list[Tensor]] = [], []
    for parameter in model.parameters():
        groups[parameter.ndim > 1].append(parameter)
    decays = ({"params": group, "weight_decay": decay * index} for index, group in enumerate(groups))
    return torch.optim.AdamW(decays, rate, fused=True)


def freeze(network: nn.Module, stage: str) -> None:
    """Let the parameters of a network stay as they are, from its first one to the last of the module of that name, or
    to the one before its last layer (ALL_BUT_LAST). InputError: there is no such module, or it has none."""
    names = [name for name, _ in network.named_parameters()]
    if stage == ALL_BUT_LAST:
        frozen = [index for index, name in enumerate(names) if name.rpartition(".")[0] != names[-1].rpartition(".")[0]]
    else:
        frozen = [index for index, name in enumerate(names) if name.startswith(f"{stage}.")]
    if not frozen:
        parts = nearest(stage, sorted({name.rpartition(".")[0] for name in names}))
        raise InputError(f"train.freeze={stage} is no part of the network: choose one, such as {parts}")
    for parameter in list(network.parameters())[: frozen[-1] + 1]:
        parameter.requires_grad_(False)
