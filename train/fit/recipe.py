"""How a network is trained: conf/train.yaml's `train` as a dataclass, learning-rate schedules, averaged weights."""

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from renderer.errors import FACTOR, InputError, require_choice, require_range
from train.device import COMPILE
from train.fit.distortions import DISTORTIONS
from train.fit.epoch import FLIPS

Network = TypeVar("Network", bound=nn.Module)

MOST = {"epochs": 10**6, "images_per_epoch": 10**9, "batch_size": 10**6, "checkpoint_every": 10**6, "threads": 1024}


def step(progress: float) -> float:
    """×0.2 at 30, 60 and 80 % of the epochs (Zagoruyko and Komodakis 2016: 60, 120 and 160 of 200)."""
    return 0.2 ** sum(progress >= milestone for milestone in (0.3, 0.6, 0.8))


def cosine(progress: float) -> float:
    """Half a cosine from 1 to 0."""
    return (1 + math.cos(math.pi * progress)) / 2


def one_cycle(progress: float) -> float:
    """Linear from 0.1 to 1 over the first fifth, then linear to 0: the most from a few epochs."""
    return 0.1 + 0.9 * progress / 0.2 if progress < 0.2 else (1 - progress) / 0.8


SCHEDULES = {"step": step, "cosine": cosine, "one_cycle": one_cycle}


class Average(Generic[Network]):
    """A copy of a model whose weights and statistics are the average of those it has taken in: the exponential moving
    one, or the mean where there is no decay.

    As `torch.optim.swa_utils.AveragedModel`, which makes a GPU wait at every step, since it counts them on the CPU.
    """

    def __init__(self, model: Network, decay: float | None = None):
        self.module = deepcopy(model)
        self._decay = decay
        self._taken = 0

    def update(self, model: Network) -> None:
        """Take in what the model has become; the first one counts whole."""
        mean = self._taken / (self._taken + 1)
        average = get_ema_multi_avg_fn(self._decay if self._decay is not None and self._taken else mean)
        own, latest = _tensors(self.module), _tensors(model)
        for dtype in {tensor.dtype for tensor in own}:
            kept, new = ([tensor for tensor in tensors if tensor.dtype == dtype] for tensors in (own, latest))
            average(kept, new, None)
        self._taken += 1

    def restart(self) -> None:
        """Forget what it has taken in."""
        self._taken = 0

    def state_dict(self) -> dict[str, Any]:
        return {"module": self.module.state_dict(), "taken": self._taken}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """What `state_dict` gave."""
        self.module.load_state_dict(state["module"])
        self._taken = state["taken"]


def _tensors(model: nn.Module) -> list[Tensor]:
    """Parameters and buffers, without their gradients' history."""
    return [tensor.detach() for tensor in (*model.parameters(), *model.buffers())]


@dataclass
class TrainSettings:
    """The defaults are the paper's recipe; conf/train.yaml says what each key does."""

    init_from: str | None = None
    epochs: int = 150
    images_per_epoch: int | None = None
    batch_size: int = 128
    learning_rate: float = 0.125
    momentum: float = 0.9
    weight_decay: float = 5e-4
    schedule: str = "step"
    flips: str = "random"
    distortion: str = "none"
    label_smoothing: float = 0.0
    ranking: float = 0.0
    distillation: float = 0.0
    averaging: float = 0.0
    soup: bool = False
    precision: str = "auto"
    device: str = "auto"
    threads: int | None = None
    compile: str = "auto"
    deterministic: bool = False
    checkpoint_every: int = 1
    resume: bool = False

    def __post_init__(self) -> None:
        choices_of = {"schedule": SCHEDULES, "flips": FLIPS, "distortion": DISTORTIONS, "compile": COMPILE}
        for name, choices in choices_of.items():
            require_choice(f"train.{name}", getattr(self, name), choices)
        for name, most in MOST.items():
            require_range(f"train.{name}", getattr(self, name), 1, most)
        for name in ("momentum", "label_smoothing", "averaging"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"train.{name}={getattr(self, name)} must be at least 0 and below 1")
        for name in ("ranking", "distillation", "weight_decay"):
            require_range(f"train.{name}", getattr(self, name), 0, FACTOR)
        for name, use in {"distillation": "holds to", "soup": "comes back to"}.items():
            if getattr(self, name) and not self.init_from:
                raise InputError(
                    f"train.{name}={getattr(self, name)} {use} the network begun with: name one in train.init_from"
                )
        if not 0 < self.learning_rate <= FACTOR:
            raise InputError(f"train.learning_rate={self.learning_rate} must be positive and at most {FACTOR:g}")
