"""Norm-balls of attack values: projections, gradient steps and random draws."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from augment.parameter_settings import StepSettings
from renderer.errors import InputError
from renderer.light.ball import Ball, nearest_in_box

# A convex set of vectors, given by its projection. This function takes vectors, shape (A, D), and
# returns the nearest vectors of the set. With the argument `within`, a `Ball` whose center is in
# the set, it returns the nearest vectors that lie in both. `unconstrained` is such a function.
Domain = Callable[..., Tensor]


def unconstrained(values: Tensor, within: Ball | None = None) -> Tensor:
    """Project values onto a ball. Without a ball, return them unchanged.

    This is the projection of attacks whose values are all feasible.

    Args:
        values: A vectors of D values, shape (A, D).
        within: Ball that must contain the result. None for no ball.

    Returns:
        The nearest vectors in the ball, shape (A, D).
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

    The values move against the gradient. Then they are replaced by the nearest
    values that are feasible and lie in the norm-ball. Attacks on scenes and
    adversarial training on images (PGD, Madry et al. 2018) both take this step.

    Args:
        settings: Norm and radius of the ball, and the kind and size of the step.
        values: A vectors of D values, shape (A, D). With the norm "linf" and a
            step "sign" or "raw", the shape may also be (A, ...).
        gradient: Gradient of the cost with respect to the values, of the
            same shape.
        center: Center of the ball of each vector, of the same shape.
        domain: Projection onto the feasible values, which contain the centers.
            By default, all values are feasible.
        length: Factor of the length of the step, a number or shape (A, 1).

    Returns:
        Values after the step, of the same shape.

    Example:
        >>> settings = StepSettings("linf", radius=0.1, step="sign", step_size=0.3)
        >>> start = torch.zeros(1, 3)
        >>> take_step(settings, start, torch.tensor([[2.0, -5.0, 0.0]]), center=start)
        tensor([[-0.1000,  0.1000,  0.0000]])
    """
    moved = values - length * scale_gradient(settings, gradient)
    return project(settings, moved, center, domain)


def scale_gradient(settings: StepSettings, gradient: Tensor) -> Tensor:
    """Compute the step that gradient descent subtracts from the values.

    The step is the gradient ("raw"), its sign ("sign") or its direction
    ("unit"), times the step size.

    Args:
        settings: Kind and size of the step.
        gradient: Gradients of A costs with respect to D values each, shape (A, D).

    Returns:
        Steps, shape (A, D). A step is zero if its gradient is zero.
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
    """Find the nearest values that are feasible and lie in the norm-ball.

    Args:
        settings: Norm and radius of the ball. A radius of None means no ball.
        values: A vectors of D values, shape (A, D).
        center: Center of the ball of each vector, shape (A, D).
        domain: Projection onto the feasible values, which contain the centers.
            By default, all values are feasible.

    Returns:
        The nearest values, shape (A, D).
    """
    ball = None if settings.radius is None else Ball(center, settings.radius, settings.norm)
    return domain(values, within=ball)


def sample(
    settings: StepSettings,
    center: Tensor,
    generator: torch.Generator,
    used: Tensor | None = None,
) -> Tensor:
    """Draw a vector of values uniformly from the norm-ball around each center.

    Args:
        settings: Norm and radius of the balls.
        center: Centers of A balls of D dimensions, shape (A, D).
        generator: CPU generator of the random numbers.
        used: Mask of the values that are drawn, shape (A, D). The others are
            those of the center. None draws all values.

    Returns:
        Drawn values, shape (A, D).

    Raises:
        InputError: If there is no radius.
    """
    if settings.radius is None:
        raise InputError(
            "radius is None, but random values are drawn from the norm-ball: set radius"
        )
    used_on_cpu = None if used is None else used.cpu()
    if settings.norm == "linf":
        offset = 2 * torch.rand(center.shape, generator=generator) - 1
    else:
        offset = _sample_unit_ball(center.shape, generator, used_on_cpu)
    if used_on_cpu is not None:
        offset = offset * used_on_cpu
    return center + settings.radius * offset.to(center)


def _sample_unit_ball(shape: torch.Size, generator: torch.Generator, used: Tensor | None) -> Tensor:
    """Draw points uniformly from unit balls of the L2 norm.

    Args:
        shape: Shape (A, D): A points with D coordinates each.
        generator: CPU generator of the random numbers.
        used: Mask of the coordinates that are drawn, shape (A, D). The others are 0, so that the
            ball of a point may have fewer dimensions. None draws all coordinates.

    Returns:
        Points, shape (A, D).
    """
    direction = torch.randn(shape, generator=generator)
    dimension_count: int | Tensor = shape[1]
    if used is not None:
        direction = direction * used
        dimension_count = used.sum(1, keepdim=True)
    # A uniform point of the unit ball in n dimensions has a distance below r with probability
    # r^n. Its distance is therefore distributed like the n-th root of a uniform number in [0, 1].
    distance = torch.rand(shape[0], 1, generator=generator) ** (1 / dimension_count)
    return direction / direction.norm(dim=1, keepdim=True) * distance
