"""Norm-balls of attack values: projections, gradient steps and random draws."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from augment.attack_settings import StepSettings
from renderer.errors import InputError
from renderer.vectors import Ball, nearest_in_box

# If a parameter has no radius, a search without gradients begins with random changes that are as
# long as this many steps.
STEPS_OF_SEARCH = 4

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


class NormBalls:
    """Values of E examples, in norm-balls around those at which attacks start.

    A subclass whose values are not all feasible overrides `project_feasible`.

    Attributes:
        settings: Norm-ball and steps of the attack.
        start: Values at which attacks start and on which the norm-balls are
            centered, shape (E, D).
        used_mask: Mask of the values that an attack may change, shape (E, D).
            The other values have no effect on the image. None if every example
            uses all values.
    """

    def __init__(self, settings: StepSettings, start: Tensor, used_mask: Tensor | None = None):
        self.settings = settings
        self.start = start
        self.used_mask = used_mask
        if used_mask is not None and used_mask.all():
            self.used_mask = None

    def project_feasible(
        self, values: Float[Tensor, "A D"], within: Ball | None = None
    ) -> Float[Tensor, "A D"]:
        """Find the nearest feasible values. By default, all values are feasible.

        The nearest values are meant in the Euclidean sense, and the centers of `within` are
        feasible.
        """
        return unconstrained(values, within)

    def scale_gradient(self, gradient: Float[Tensor, "A D"]) -> Float[Tensor, "A D"]:
        """Compute the step that gradient descent subtracts from the values."""
        return scale_gradient(self.settings, gradient)

    def search_scale(self, examples: Int[Tensor, " A"]) -> Float[Tensor, "A D"]:
        """Return how much a search without gradients should change each value at first.

        With the norm "l2", a random change is about as long as the radius. With the norm "linf", it
        changes each value by about half the radius. Without a radius, `STEPS_OF_SEARCH` times the
        step size takes its place. The result is 0 for values that have no effect.
        """
        settings = self.settings
        center = self.start[examples]
        if settings.radius is not None:
            length = settings.radius
            limits_each_value = settings.norm == "linf"
        else:
            length = STEPS_OF_SEARCH * settings.step_size
            limits_each_value = settings.step == "sign"
        # 1 for values that have an effect, and 0 for the others, shape (A, D).
        used = torch.ones_like(center)
        if self.used_mask is not None:
            used = self.used_mask[examples].to(center)
        if limits_each_value:
            return length / 2 * used
        # n independent numbers with the standard deviation length / √n form a vector that is
        # about `length` long.
        used_count = used.sum(1, keepdim=True)
        return length * used / used_count.clamp(min=1).sqrt()

    def project(
        self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A D"]:
        """Find the nearest values that are feasible and lie in the norm-balls around the start."""
        return project(self.settings, values, self.start[examples], self.project_feasible)

    def sample(
        self, generator: torch.Generator, reached: Float[Tensor, "E D"] | None = None
    ) -> Float[Tensor, "E D"]:
        """Draw random feasible values for all E examples.

        With a radius, values are drawn uniformly from the norm-balls and then
        projected onto the feasible values. Without a radius, they are drawn in
        random directions, as far from the start as the values of an attack.
        """
        if self.settings.radius is None and reached is not None:
            return self._sample_as_far_as(reached, generator)
        drawn = sample(self.settings, self.start, generator, self.used_mask)
        return project(self.settings, drawn, self.start, self.project_feasible)

    def _sample_as_far_as(
        self, reached: Float[Tensor, "E D"], generator: torch.Generator
    ) -> Float[Tensor, "E D"]:
        """Draw feasible values in random directions from the start of each example."""
        direction = torch.randn(reached.shape, generator=generator).to(reached)
        if self.used_mask is not None:
            direction = direction * self.used_mask
        distance = (reached - self.start).norm(dim=1, keepdim=True)
        offset = direction * distance / direction.norm(dim=1, keepdim=True)
        return self.project_feasible(self.start + offset)
