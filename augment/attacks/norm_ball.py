"""Norm-balls in a space of parameters, and the draws and steps of attacks within them."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from renderer.errors import FACTOR, LARGEST, InputError, require_choice, require_range
from renderer.light.ball import Ball, nearest_in_box
from renderer.validation import require_field_types

NORMS = ("linf", "l2")
STEPS = ("unit", "raw", "sign")

# A convex set of values (D,), as a function that finds its nearest points to
# values (A, D). The argument `within` is a ball in which they must lie, too, and
# whose centers are in the set.
Domain = Callable[..., Tensor]


def anywhere(values: Tensor, within: Ball | None = None) -> Tensor:
    """Find the nearest points in the domain of all values.

    Args:
        values: Values, shape (A, D).
        within: Ball in which the points must lie. None for no ball.

    Returns:
        The nearest points, shape (A, D).
    """
    return nearest_in_box(values, -math.inf, math.inf, within)


@dataclass
class StepSettings:
    """Norm-ball of values around the start of an attack, and steps of gradient descent within it.

    Attributes:
        norm: Norm of the ball, "linf" or "l2".
        radius: Radius of the ball. None for no ball. The radii of the paper
            (Section 4.1) are linf 0.1 per coefficient of the light and 0.002
            per axis of a vertex.
        step: Direction of a step: the gradient at unit L2 norm ("unit"), as it
            is ("raw"), or its sign ("sign").
        step_size: Factor of the step.

    Raises:
        InputError: If norm or step is unknown, or the radius is negative.

    Example:
        >>> settings = StepSettings("linf", radius=0.1, step="sign", step_size=0.3)
        >>> start = torch.zeros(1, 3)
        >>> settings.take_step(start, gradient=torch.tensor([[2.0, -5.0, 0.0]]), center=start)
        tensor([[-0.1000,  0.1000,  0.0000]])
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

    def take_step(
        self,
        values: Tensor,
        gradient: Tensor,
        center: Tensor,
        domain: Domain = anywhere,
        length: float | Tensor = 1.0,
    ) -> Tensor:
        """Take a step of projected gradient descent.

        Attacks on scenes and adversarial training on images (PGD, Madry et al.
        2018) both take this step.

        Args:
            values: Values, shape (A, D). With the norm "linf" and a step
                "sign" or "raw", the shape may also be (A, ...).
            gradient: Gradient of the cost with respect to the values, of the
                same shape.
            center: Centers of the balls, of the same shape.
            domain: Feasible values, which contain the centers.
            length: Factor of the step, a number or shape (A, 1).

        Returns:
            Values after the step, which are feasible and lie in the ball.
        """
        moved = values - length * self.along(gradient)
        return self.project(moved, center, domain)

    def along(self, gradient: Tensor) -> Tensor:
        """Scale a gradient to a step, which is to be subtracted.

        Args:
            gradient: Gradient of the cost, shape (A, D).

        Returns:
            Step, shape (A, D). It is zero where the gradient is zero.
        """
        if self.step == "raw":
            return self.step_size * gradient
        if self.step == "sign":
            return self.step_size * gradient.sign()
        # Scaling by the largest entry first keeps tiny gradients from
        # underflowing when squared.
        tiny = torch.finfo(gradient.dtype).tiny
        largest = gradient.abs().amax(1, keepdim=True)
        scaled = gradient / largest.clamp(min=tiny)
        return self.step_size * F.normalize(scaled, eps=tiny)

    def project(self, values: Tensor, center: Tensor, domain: Domain = anywhere) -> Tensor:
        """Find the nearest points that are feasible and lie in the ball.

        Args:
            values: Values, shape (A, D).
            center: Centers of the balls, shape (A, D).
            domain: Feasible values, which contain the centers.

        Returns:
            The nearest points, shape (A, D).
        """
        ball = None if self.radius is None else Ball(center, self.radius, self.norm)
        return domain(values, within=ball)

    def sample(
        self,
        center: Tensor,
        generator: torch.Generator,
        used: Tensor | None = None,
    ) -> Tensor:
        """Draw values uniformly from the ball around each center.

        Args:
            center: Centers of the balls, shape (A, D).
            generator: CPU generator of the random numbers.
            used: Mask of the axes along which values are drawn, shape (A, D).
                None for all axes.

        Returns:
            Values, shape (A, D).

        Raises:
            InputError: If there is no radius.
        """
        if self.radius is None:
            raise InputError("radius=None has no uniform draw: set a radius")
        used_on_cpu = None if used is None else used.cpu()
        if self.norm == "linf":
            offset = 2 * torch.rand(center.shape, generator=generator) - 1
        else:
            offset = _sample_unit_ball(center.shape, generator, used_on_cpu)
        if used_on_cpu is not None:
            offset = offset * used_on_cpu
        return center + self.radius * offset.to(center)


def _sample_unit_ball(shape: torch.Size, generator: torch.Generator, used: Tensor | None) -> Tensor:
    """Draw points (A, D) uniformly from the unit ball of the L2 norm, along the used axes."""
    direction = torch.randn(shape, generator=generator)
    axis_count: int | Tensor = shape[1]
    if used is not None:
        direction = direction * used
        axis_count = used.sum(1, keepdim=True)
    # The volume within a distance grows with its power of the number of axes.
    distance = torch.rand(shape[0], 1, generator=generator) ** (1 / axis_count)
    return direction / direction.norm(dim=1, keepdim=True) * distance
