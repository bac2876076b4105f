"""How a network is trained: conf/train.yaml's `train` as a dataclass."""

import math
from dataclasses import dataclass

from renderer.errors import InputError, require_range
from train.batches import FLIPS
from train.distortions import DISTORTIONS
from train.graphs import COMPILE
from train.schedule import SCHEDULES

MOST = {"epochs": 10**6, "images_per_epoch": 10**9, "batch_size": 10**6, "checkpoint_every": 10**6, "threads": 1024}


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
    averaging: float = 0.0
    precision: str = "auto"
    device: str = "auto"
    threads: int | None = None
    compile: str = "auto"
    deterministic: bool = False
    checkpoint_every: int = 1
    resume: bool = False

    def __post_init__(self):
        choices_of = {"schedule": SCHEDULES, "flips": FLIPS, "distortion": DISTORTIONS, "compile": COMPILE}
        for name, choices in choices_of.items():
            if getattr(self, name) not in choices:
                raise InputError(f"train.{name}={getattr(self, name)}: choose one of {', '.join(choices)}")
        for name, most in MOST.items():
            require_range(f"train.{name}", getattr(self, name), 1, most)
        for name in ("momentum", "label_smoothing", "averaging"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"train.{name}={getattr(self, name)} must be at least 0 and below 1")
        if not 0 < self.learning_rate < math.inf:
            raise InputError(f"train.learning_rate={self.learning_rate} must be positive")
        if not 0 <= self.weight_decay < math.inf:
            raise InputError(f"train.weight_decay={self.weight_decay} must not be negative")
