"""Norm-balls of attack values: projections, gradient steps and random draws."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from augment.parameter_settings import StepSettings
from renderer.errors import InputError
from renderer.light.ball import Ball, nearest_in_box

# A convex set of vectors, given by its projection. This function takes vectors, shape (A, D), and
# returns the nearest vectors of the set. With the argument `within`, a `Ball` whose center is in
# the set, it returns the nearest vectors that lie in both. `unconstrained` is such a function.
Domain = Callable[..., Tensor]


def unconstrained(
    values: Float[Tensor, " ..."], within: Ball | None = None
) -> Float[Tensor, " ..."]:
    """Project values onto a ball. Without a ball, return them unchanged.

    This is the projection of attacks whose values are all feasible.
    """
    return nearest_in_box(values, -math.inf, math.inf, within)


def take_step(
    settings: StepSettings,
    values: Float[Tensor, " ..."],
    gradient: Tensor,
    center: Tensor,
    domain: Domain = unconstrained,
    length: float | Tensor = 1.0,
) -> Tensor:
    """Take a step of projected gradient descent.

    The values move against the gradient. Then they are replaced by the nearest values that are
    feasible and lie in the norm-ball. Attacks on scenes and adversarial training on images (PGD,
    Madry et al. 2018) both take this step. `domain` projects onto the feasible values, which
    contain the centers, and `length` multiplies the step.
    """
    moved = values - length * scale_gradient(settings, gradient)
    return project(settings, moved, center, domain)


def scale_gradient(
    settings: StepSettings, gradient: Float[Tensor, " ..."]
) -> Float[Tensor, " ..."]:
    """Compute the step that gradient descent subtracts from the values.

    The step is the gradient ("raw"), its sign ("sign") or its direction ("unit"), times the step
    size. A step is zero if its gradient is zero.
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
    settings: StepSettings,
    values: Float[Tensor, " ..."],
    center: Float[Tensor, " ..."],
    domain: Domain = unconstrained,
) -> Float[Tensor, " ..."]:
    """Find the nearest values that are feasible and lie in the norm-ball.

    A radius of None means no ball. `domain` projects onto the feasible values, which contain the
    centers.
    """
    ball = None if settings.radius is None else Ball(center, settings.radius, settings.norm)
    return domain(values, within=ball)


def sample(
    settings: StepSettings,
    center: Float[Tensor, " ..."],
    generator: torch.Generator,
    used: Bool[Tensor, "A D"] | None = None,
) -> Float[Tensor, " ..."]:
    """Draw a vector of values uniformly from the norm-ball around each center.

    Values outside of the mask `used` are those of the center. None draws all values.
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


def _sample_unit_ball(
    shape: torch.Size, generator: torch.Generator, used: Bool[Tensor, "A D"] | None
) -> Float[Tensor, "A D"]:
    """Draw points uniformly from unit balls of the L2 norm."""
    direction = torch.randn(shape, generator=generator)
    dimension_count: int | Tensor = shape[1]
    if used is not None:
        direction = direction * used
        dimension_count = used.sum(1, keepdim=True)
    # A uniform point of the unit ball in n dimensions has a distance below r with probability
    # r^n. Its distance is therefore distributed like the n-th root of a uniform number in [0, 1].
    distance = torch.rand(shape[0], 1, generator=generator) ** (1 / dimension_count)
    return direction / direction.norm(dim=1, keepdim=True) * distance
