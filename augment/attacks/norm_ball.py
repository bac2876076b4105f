"""Norm-balls in a space of parameters, and the draws and steps of attacks within them."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.parameter_settings import StepSettings
from renderer.errors import InputError
from renderer.light.ball import Ball, nearest_in_box

# A convex set of vectors of D values, given as a function. The function takes values (A, D) and
# returns the nearest points of the set, shape (A, D). Its argument `within` is a ball that must
# contain these points, too. The center of the ball is in the set. An example is `unconstrained`.
Domain = Callable[..., Tensor]


def unconstrained(values: Tensor, within: Ball | None = None) -> Tensor:
    """Find the nearest points in the domain of all values.

    Args:
        values: Values, shape (A, D).
        within: Ball in which the points must lie. None for no ball.

    Returns:
        The nearest points, shape (A, D).
    """
    return nearest_in_box(values, -math.inf, math.inf, within)


def take_step(
    settings: StepSettings,
    values: Tensor,
    gradient: Tensor,
    center: Tensor,
    domain: Domain = unconstrained,
    length: float | Tensor = 1.0,
) -> Tensor:
    """Take a step of projected gradient descent.

    Attacks on scenes and adversarial training on images (PGD, Madry et al.
    2018) both take this step.

    Args:
        settings: Norm-ball and steps.
        values: Values, shape (A, D). With the norm "linf" and a step
            "sign" or "raw", the shape may also be (A, ...).
        gradient: Gradient of the cost with respect to the values, of the
            same shape.
        center: Centers of the balls, of the same shape.
        domain: Feasible values, which contain the centers.
        length: Factor of the step, a number or shape (A, 1).

    Returns:
        Values after the step, which are feasible and lie in the ball.

    Example:
        >>> settings = StepSettings("linf", radius=0.1, step="sign", step_size=0.3)
        >>> start = torch.zeros(1, 3)
        >>> take_step(settings, start, torch.tensor([[2.0, -5.0, 0.0]]), center=start)
        tensor([[-0.1000,  0.1000,  0.0000]])
    """
    moved = values - length * scale_gradient(settings, gradient)
    return project(settings, moved, center, domain)


def scale_gradient(settings: StepSettings, gradient: Tensor) -> Tensor:
    """Scale a gradient to a step, which is to be subtracted.

    Args:
        settings: Norm-ball and steps.
        gradient: Gradient of the cost, shape (A, D).

    Returns:
        Step, shape (A, D). It is zero where the gradient is zero.
    """
    if settings.step == "raw":
        return settings.step_size * gradient
    if settings.step == "sign":
        return settings.step_size * gradient.sign()
    # The step "unit" has the direction of the gradient and the length `step_size`. The
    # gradient is first divided by its largest entry, because the squares of tiny entries
    # would be rounded to zero.
    tiny = torch.finfo(gradient.dtype).tiny
    largest = gradient.abs().amax(1, keepdim=True)
    scaled = gradient / largest.clamp(min=tiny)
    return settings.step_size * F.normalize(scaled, eps=tiny)


def project(
    settings: StepSettings, values: Tensor, center: Tensor, domain: Domain = unconstrained
) -> Tensor:
    """Find the nearest points that are feasible and lie in the ball.

    Args:
        settings: Norm-ball and steps.
        values: Values, shape (A, D).
        center: Centers of the balls, shape (A, D).
        domain: Feasible values, which contain the centers.

    Returns:
        The nearest points, shape (A, D).
    """
    ball = None if settings.radius is None else Ball(center, settings.radius, settings.norm)
    return domain(values, within=ball)


def sample(
    settings: StepSettings,
    center: Tensor,
    generator: torch.Generator,
    used: Tensor | None = None,
) -> Tensor:
    """Draw values uniformly from the ball around each center.

    Args:
        settings: Norm-ball and steps.
        center: Centers of the balls, shape (A, D).
        generator: CPU generator of the random numbers.
        used: Mask of the axes along which values are drawn, shape (A, D).
            None for all axes.

    Returns:
        Values, shape (A, D).

    Raises:
        InputError: If there is no radius.
    """
    if settings.radius is None:
        raise InputError("random values are drawn from the norm-ball, but radius is None: set it")
    used_on_cpu = None if used is None else used.cpu()
    if settings.norm == "linf":
        offset = 2 * torch.rand(center.shape, generator=generator) - 1
    else:
        offset = _sample_unit_ball(center.shape, generator, used_on_cpu)
    if used_on_cpu is not None:
        offset = offset * used_on_cpu
    return center + settings.radius * offset.to(center)


def _sample_unit_ball(shape: torch.Size, generator: torch.Generator, used: Tensor | None) -> Tensor:
    """Draw points uniformly from the unit ball of the L2 norm.

    Args:
        shape: Shape (A, D) of the points.
        generator: CPU generator of the random numbers.
        used: Mask of the axes along which points are drawn, shape (A, D). Coordinates along
            the other axes are 0. None for all axes.

    Returns:
        Points, shape (A, D).
    """
    direction = torch.randn(shape, generator=generator)
    axis_count: int | Tensor = shape[1]
    if used is not None:
        direction = direction * used
        axis_count = used.sum(1, keepdim=True)
    # With n axes, a ball of radius r has r^n of the volume of the unit ball. The distance of a
    # uniformly drawn point is therefore the n-th root of a uniform number in [0, 1].
    distance = torch.rand(shape[0], 1, generator=generator) ** (1 / axis_count)
    return direction / direction.norm(dim=1, keepdim=True) * distance
