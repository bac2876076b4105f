"""Norm-balls in a space of parameters: the exact projection into them, uniform draws from them, steps within them."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.errors import FACTOR, LARGEST, InputError, require_choice, require_range
from renderer.light.basis import Ball, nearest_in_box
from renderer.validation import require_field_types

NORMS = ("linf", "l2")
STEPS = ("unit", "raw", "sign")
# A convex set of values (D,): its nearest points to values (A, D), also `within` a ball whose centers it contains.
Domain = Callable[..., Tensor]


def anywhere(values: Tensor, within: Ball | None = None) -> Tensor:
    """The domain without a bound."""
    return nearest_in_box(values, -math.inf, math.inf, within)


@dataclass
class StepSettings:
    """A norm-ball of values (D,) around where an attack begins, and the steps of gradient descent within it.

    norm: "linf" or "l2". radius: of the ball; None is the whole space. The paper's radii (Section 4.1) are linf 0.1
    per lighting coefficient and 0.002 per vertex axis. step: the gradient at unit L2 norm ("unit"), as it is ("raw"),
    or its sign ("sign"). step_size: the step's factor.
    InputError: an unknown norm or step, a radius below zero.
    """

    norm: str = "linf"
    radius: float | None = None
    step: str = "unit"
    step_size: float = 0.05

    def __post_init__(self) -> None:
        require_field_types(self)
        require_choice("norm", self.norm, NORMS)
        require_range("radius", self.radius, 0, FACTOR)
        require_choice("step", self.step, STEPS)
        require_range("step_size", self.step_size, 1 / LARGEST, FACTOR)

    def project(self, values: Tensor, center: Tensor, domain: Domain = anywhere) -> Tensor:
        """The nearest points (A, D) of the ball's intersection with a domain that contains its center (A, D)."""
        return domain(values, within=None if self.radius is None else Ball(center, self.radius, self.norm))

    def sample(self, center: Tensor, generator: torch.Generator, used: Tensor | None = None) -> Tensor:
        """A uniform draw around each center (A, D), on the generator's device. InputError without a radius.

        used: (A, D) bool, the axes along which each is drawn; None for all.
        """
        if self.radius is None:
            raise InputError("radius=None has no uniform draw: set a radius")
        if self.norm == "linf":
            offset = 2 * torch.rand(center.shape, generator=generator) - 1
        else:
            direction = torch.randn(center.shape, generator=generator)
            axes: int | Tensor = center.shape[1]
            if used is not None:
                direction, axes = direction * used.cpu(), used.cpu().sum(1, keepdim=True)
            fraction = torch.rand(len(center), 1, generator=generator) ** (1 / axes)
            offset = direction / direction.norm(dim=1, keepdim=True) * fraction
        if used is not None:
            offset = offset * used.cpu()
        return center + self.radius * offset.to(center)

    def along(self, gradient: Tensor) -> Tensor:
        """The step (A, D) for a gradient (A, D), to be subtracted; a gradient of zero gives a step of zero."""
        if self.step == "raw":
            return self.step_size * gradient
        if self.step == "sign":
            return self.step_size * gradient.sign()
        # Scaling by the largest entry first keeps tiny gradients from underflowing when squared.
        tiny = torch.finfo(gradient.dtype).tiny
        scaled = gradient / gradient.abs().amax(1, keepdim=True).clamp(min=tiny)
        return self.step_size * F.normalize(scaled, eps=tiny)
