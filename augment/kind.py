"""A kind of parameter: flat values (A, D) that become a part of the conditions that a scene is rendered under."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.norm_ball import NormBall, anywhere
from augment.scene import Conditions, Scene
from renderer.arguments import require_fields
from renderer.convex import Ball
from renderer.errors import FACTOR, LARGEST, require_choice, require_range

STEPS = ("unit", "raw", "sign")


@dataclass
class StepSettings(NormBall):
    """A norm-ball, and how far values go in it at once.

    step: the gradient at unit L2 norm, as it is, or its sign. step_size: times that.
    """

    step: str = "unit"
    step_size: float = 0.05

    def __post_init__(self) -> None:
        require_fields(self)
        super().__post_init__()
        require_choice("attack: step", self.step, STEPS)
        require_range("attack: step_size", self.step_size, 1 / LARGEST, FACTOR)


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
    """One kind of parameter of a scene's E examples. `start` (E, D) is where attacks begin and its balls' centre.

    used: (E, D) bool, where examples differ in how many values they use: the others stay as they are. None: all.
    """

    name: str

    def __init__(self, scene: Scene, start: Tensor, settings: StepSettings, used: Tensor | None = None):
        self.scene, self.start, self.settings, self.used = scene, start, settings, used

    @abstractmethod
    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        """The conditions of examples (A,) with this part of them set to values (A, D)."""

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        """The nearest values (A, D) of the examples (A,) within the norm-ball and what is physically possible."""
        return self.settings.project(values, self.start[examples], self.within_domain)

    def sample(self, generator: torch.Generator, examples: Tensor) -> Tensor:
        """Uniform draws (A, D) from the balls of the examples (A,), within the domain."""
        used = None if self.used is None else self.used[examples]
        return self.project(self.settings.sample(self.start[examples], generator, used), examples)

    def sample_as_far(self, values: Tensor, generator: torch.Generator, examples: Tensor) -> Tensor:
        """`sample` where there is a radius; else a random direction at the L2 distance of values (A, D) from the
        start, within the domain."""
        if self.settings.radius is not None:
            return self.sample(generator, examples)
        start = self.start[examples].to(values)
        offset = torch.randn(values.shape, generator=generator).to(values)
        if self.used is not None:
            offset = offset * self.used[examples]
        reach = (values - start).norm(dim=1, keepdim=True)
        return self.within_domain(start + offset * reach / offset.norm(dim=1, keepdim=True))

    def within_domain(self, values: Tensor, within: Ball | None = None) -> Tensor:
        """See `augment.norm_ball.Domain`; by default there is no bound."""
        return anywhere(values, within)

    def step(self, gradient: Tensor) -> Tensor:
        """How far to go down a gradient (A, D)."""
        return self.settings.step_size * direction(gradient, self.settings.step)
