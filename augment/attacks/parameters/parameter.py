"""Base class of the quantities that an attack changes."""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor

from augment.attacks.norm_ball import project, sample, take_step, unconstrained
from augment.parameter_settings import StepSettings
from augment.scene.conditions import Conditions
from renderer.light.ball import Ball

# Without a radius, the random search begins with changes of this many step sizes.
STEPS_OF_SEARCH = 4


class Parameter(ABC):
    """Quantity of a scene that an attack changes, such as its lighting.

    Each of the E examples of a scene has D values of the quantity. The
    constructor of a subclass computes the values at which an attack starts. The
    subclass defines `apply`, which puts values into the conditions under which
    a scene is rendered. If not all values are feasible, it also overrides
    `project_feasible`.

    Attributes:
        name: Name of the quantity in settings, messages and files.
        fits_other_meshes: Whether the values can be given to another mesh.
        fits_other_views: Whether the values can be given to another view.
        settings: Norm-ball and steps of the attack.
        start: Values at which attacks start and on which the norm-balls are
            centered, shape (E, D).
        used_mask: Mask of the values that an attack may change, shape (E, D).
            The other values have no effect on the image. None if every example
            uses all values.
    """

    name: str
    fits_other_meshes: ClassVar[bool] = True
    fits_other_views: ClassVar[bool] = True

    def __init__(self, settings: StepSettings, start: Tensor, used_mask: Tensor | None = None):
        self.settings = settings
        self.start = start
        self.used_mask = used_mask
        if used_mask is not None and used_mask.all():
            self.used_mask = None

    @abstractmethod
    def apply(self, values: Tensor, conditions: Conditions, examples: Tensor) -> Conditions:
        """Return a copy of the conditions in which this quantity has the given values.

        Args:
            values: Values of the quantity, shape (A, D).
            conditions: Conditions of the A examples. Other parameters may have
                changed them already.
            examples: Indices of the examples in the scene, shape (A,).

        Returns:
            Conditions of the A examples, differentiable with respect to the
            values.
        """

    def project_feasible(self, values: Tensor, within: Ball | None = None) -> Tensor:
        """Find the nearest feasible values. By default, all values are feasible.

        Args:
            values: Values of A examples, shape (A, D).
            within: Norm-ball that must contain the result. Its centers are
                feasible. None for no norm-ball.

        Returns:
            Feasible values, shape (A, D), nearest in the Euclidean sense.
        """
        return unconstrained(values, within)

    def take_step(
        self,
        values: Tensor,
        gradient: Tensor,
        examples: Tensor,
        length: Tensor,
    ) -> Tensor:
        """Take a step of projected gradient descent.

        Args:
            values: Values of A examples, shape (A, D).
            gradient: Gradient of the cost with respect to the values,
                shape (A, D).
            examples: Indices of the examples in the scene, shape (A,).
            length: Factor of the step of each example, shape (A, 1).

        Returns:
            Values after the step, shape (A, D).
        """
        center = self.start[examples]
        return take_step(self.settings, values, gradient, center, self.project_feasible, length)

    def search_scale(self, examples: Tensor) -> Tensor:
        """Return standard deviations of random changes that reach across the norm-ball.

        A change is about as long as the radius of the ball with the norm "l2",
        and half as long in each value with the norm "linf". Without a radius, it
        is about as long as `STEPS_OF_SEARCH` steps.

        Args:
            examples: Indices of the examples in the scene, shape (A,).

        Returns:
            Standard deviation of each value, shape (A, D). Values without effect
            have 0.
        """
        settings = self.settings
        center = self.start[examples]
        if settings.radius is not None:
            length = settings.radius
            is_length_of_value = settings.norm == "linf"
        else:
            length = STEPS_OF_SEARCH * settings.step_size
            is_length_of_value = settings.step == "sign"
        used = torch.ones_like(center)
        if self.used_mask is not None:
            used = self.used_mask[examples].to(center)
        if is_length_of_value:
            return length / 2 * used
        return length * used / used.sum(1, keepdim=True).clamp(min=1).sqrt()

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        """Find the nearest values that are feasible and lie in the norm-balls around the start.

        Args:
            values: Values of A examples, shape (A, D).
            examples: Indices of the examples in the scene, shape (A,).

        Returns:
            Projected values, shape (A, D).
        """
        return project(self.settings, values, self.start[examples], self.project_feasible)

    def sample(self, generator: torch.Generator, reached: Tensor | None = None) -> Tensor:
        """Draw random feasible values for all examples.

        With a radius, values are drawn uniformly from the norm-balls and then
        projected. Without a radius, they are drawn in random directions, as far
        from the start as the values that an attack reached.

        Args:
            generator: CPU generator of the random numbers.
            reached: Values that an attack reached, shape (E, D). Needed only
                without a radius.

        Returns:
            Random values, shape (E, D).

        Raises:
            InputError: If there is neither a radius nor `reached`.
                `StepSettings.sample` raises it.
        """
        if self.settings.radius is None and reached is not None:
            return self._sample_as_far_as(reached, generator)
        drawn = sample(self.settings, self.start, generator, self.used_mask)
        return project(self.settings, drawn, self.start, self.project_feasible)

    def _sample_as_far_as(self, reached: Tensor, generator: torch.Generator) -> Tensor:
        """Draw values in random directions, as far from the start as `reached`, shape (E, D)."""
        direction = torch.randn(reached.shape, generator=generator).to(reached)
        if self.used_mask is not None:
            direction = direction * self.used_mask
        distance = (reached - self.start).norm(dim=1, keepdim=True)
        offset = direction * distance / direction.norm(dim=1, keepdim=True)
        return self.project_feasible(self.start + offset)
