"""What every kind of parameter has: where it starts, its norm-ball, and how it steps down a gradient."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.mesh_scene import Conditions, MeshScene
from augment.norm_ball import NormBall
from renderer.errors import FACTOR, LARGEST, InputError, require_range

STEPS = ("unit", "raw", "sign")


@dataclass
class StepSettings:
    """How far values may go and how far they go at once.

    norm, radius: see `NormBall`. step: the gradient at unit L2 norm, as it is, or its sign. step_size: times that.
    """

    norm: str = "linf"
    radius: float | None = None
    step: str = "unit"
    step_size: float = 0.05

    def __post_init__(self):
        NormBall(self.norm, self.radius)
        check_step(self.step, self.step_size)


def check_step(step: str, step_size: float, prefix: str = "") -> None:
    """InputError unless the rule is known and the size positive. prefix: of the settings' names."""
    if step not in STEPS:
        raise InputError(f"{prefix}step={step}: choose one of {', '.join(STEPS)}")
    require_range(f"{prefix}step_size", step_size, 1 / LARGEST, FACTOR)


def direction(gradient: Tensor, step: str) -> Tensor:
    """The gradient (A, D) as a step: unit L2 norm per example (a zero gradient stays zero), raw, or its sign."""
    if step == "raw":
        return gradient
    if step == "sign":
        return gradient.sign()
    # Scaling by the largest entry first keeps tiny gradients from underflowing when squared.
    tiny = torch.finfo(gradient.dtype).tiny
    return F.normalize(gradient / gradient.abs().amax(1, keepdim=True).clamp(min=tiny), eps=tiny)


class Kind(ABC):
    """One kind of parameter of a scene's E examples. `start` (E, D) is where attacks begin and its balls' centre."""

    name: str

    def __init__(self, scene: MeshScene, start: Tensor, settings: StepSettings):
        self.scene, self.start, self.settings = scene, start, settings
        self.ball = NormBall(settings.norm, settings.radius)

    @abstractmethod
    def apply(self, values: Tensor, conditions: Conditions) -> Conditions:
        """The conditions with this part of them set to values (A, D)."""

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        """The nearest values (A, D) of the examples (A,) within the norm-ball and what is physically possible."""
        return self.ball.project(values, self.start[examples], self.within_domain)

    def sample(self, generator: torch.Generator, examples: Tensor) -> Tensor:
        """Uniform draws (A, D) from the balls of the examples (A,), within the domain."""
        return self.project(self.ball.sample(self.start[examples], generator), examples)

    def within_domain(self, values: Tensor) -> Tensor:
        """Values (A, D) moved into their domain, a box around the start; by default there is no bound."""
        return values

    def step(self, gradient: Tensor) -> Tensor:
        """How far to go down a gradient (A, D)."""
        return self.settings.step_size * direction(gradient, self.settings.step)
