"""How a network is trained: settings, learning-rate schedules, the optimizer, frozen layers."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from augment.classifiers.adapter import nearest
from renderer.errors import FACTOR, InputError, require_choice, require_range
from train.batches import FLIPS
from train.device import COMPILE

TRANSFORMS = ("color_jitter", "trivial_augment", "augmix")
OPTIMIZERS = ("sgd", "adamw")
AUGMENTATIONS = ("none", *TRANSFORMS, "pgd")
ALL_BUT_LAST = "all_but_last"  # of train.freeze: only the last layer learns, as in Kirichenko et al. 2023
LARGEST = dict(
    epochs=10**6, images_per_epoch=10**9, batch_size=10**6, accumulate=10**6, checkpoint_every=10**6, threads=1024
)

# Factors of the learning rate at a fraction of the training: ×0.2 at 30, 60 and 80 % (Zagoruyko and Komodakis 2016: at
# epochs 60, 120 and 160 of 200); half a cosine; up over the first fifth and down, the most from a few epochs.
SCHEDULES: dict[str, Callable[[float], float]] = {
    "step": lambda done: 0.2 ** sum(done >= milestone for milestone in (0.3, 0.6, 0.8)),
    "cosine": lambda done: (1 + math.cos(math.pi * done)) / 2,
    "one_cycle": lambda done: 0.1 + 0.9 * done / 0.2 if done < 0.2 else (1 - done) / 0.8,
}


@dataclass
class TrainSettings:
    """The defaults are the paper's recipe; conf/train.yaml says what each key does."""

    init_from: str | None = None
    epochs: int = 150
    images_per_epoch: int | None = None
    batch_size: int = 128
    accumulate: int = 1
    optimizer: str = "sgd"
    learning_rate: float = 0.125
    momentum: float = 0.9
    weight_decay: float = 5e-4
    clip_gradient: float | None = None
    freeze: str | None = None
    schedule: str = "step"
    flips: str = "random"
    augmentation: str = "none"
    label_smoothing: float = 0.0
    ranking: float = 0.0
    distillation: float = 0.0
    ema_decay: float = 0.0
    soup: bool = False
    eval_mode: bool | None = None
    precision: str = "auto"
    device: str = "auto"
    threads: int | None = None
    compile: str = "auto"
    deterministic: bool = False
    checkpoint_every: int = 1
    resume: bool = False
    cache: str | None = "auto"

    def __post_init__(self) -> None:
        choices = {"schedule": SCHEDULES, "flips": FLIPS, "augmentation": AUGMENTATIONS}
        for name, known in {**choices, "compile": COMPILE, "optimizer": OPTIMIZERS}.items():
            require_choice(name, getattr(self, name), known)
        for name, largest in LARGEST.items():
            require_range(name, getattr(self, name), 1, largest)
        for name in ("momentum", "label_smoothing", "ema_decay"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"{name}={getattr(self, name)} must be at least 0 and below 1")
        for name in ("ranking", "distillation", "weight_decay"):
            require_range(name, getattr(self, name), 0, FACTOR)
        if (self.distillation or self.soup or self.eval_mode) and not self.init_from:
            raise InputError("distillation, soup and eval_mode need a network to begin with: set init_from")
        for name in ("learning_rate", "clip_gradient"):
            if (value := getattr(self, name)) is not None and not 0 < value <= FACTOR:
                raise InputError(f"{name}={value} must be positive and at most {FACTOR:g}")

    def rate(self, done: float) -> float:
        """The learning rate where that fraction of the training is done."""
        return self.learning_rate * SCHEDULES[self.schedule](done)


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
