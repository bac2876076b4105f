"""Base class of the quantities that an attack changes."""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor

from augment.attacks.norm_ball import project, sample, take_step, unconstrained
from augment.parameter_settings import StepSettings
from augment.scene.conditions import Conditions
from renderer.light.ball import Ball

# If a parameter has no radius, a search without gradients begins with random changes that are as
# long as this many steps.
STEPS_OF_SEARCH = 4


class Parameter(ABC):
    """Quantity of a scene that an attack changes, such as its lighting.

    Each of the E examples of a scene has D values of the quantity. The
    constructor of a subclass computes the values at which an attack starts. The
    subclass defines `apply`, which puts values into the light, shape and colors
    with which a scene is rendered. If not all values are feasible, it also
    overrides `project_feasible`.

    Attributes:
        name: Name of the quantity in settings, messages and files.
        fits_other_meshes: Whether values can be transferred to another mesh.
            Displacements of vertices, for example, belong to one mesh.
        fits_other_views: Whether values can be transferred to another camera.
            Offsets of pixels, for example, belong to one view.
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

        Conditions are the light, shape and colors with which examples are
        rendered.

        Args:
            values: D values of the quantity in each of A examples, shape (A, D).
            conditions: Conditions of the A examples. Other parameters may have
                changed them already.
            examples: Index of each of the A examples, which are objects with their views, in the
                scene, shape (A,).

        Returns:
            Conditions of the A examples, differentiable with respect to the
            values.
        """

    def project_feasible(self, values: Tensor, within: Ball | None = None) -> Tensor:
        """Find the nearest feasible values. By default, all values are feasible.

        Args:
            values: D values in each of A examples, shape (A, D).
            within: Norm-balls that must contain the result, with feasible
                centers. None for no norm-balls.

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
            values: D values in each of A examples, shape (A, D).
            gradient: Gradient of the cost with respect to the values,
                shape (A, D).
            examples: Index of each of the A examples, which are objects with their views, in the
                scene, shape (A,).
            length: Factor of the step of each example, shape (A, 1).

        Returns:
            Values after the step, which are feasible and lie in the norm-balls,
            shape (A, D).
        """
        center = self.start[examples]
        return take_step(self.settings, values, gradient, center, self.project_feasible, length)

    def search_scale(self, examples: Tensor) -> Tensor:
        """Return how much a search without gradients should change each value at first.

        With the norm "l2", a random change is about as long as the radius. With
        the norm "linf", it changes each value by about half the radius. Without
        a radius, `STEPS_OF_SEARCH` times the step size takes its place.

        Args:
            examples: Index of each of the A examples, which are objects with their views, in the
                scene, shape (A,).

        Returns:
            Standard deviation of the random changes of each value, shape (A, D).
            It is 0 for values that have no effect.
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

    def project(self, values: Tensor, examples: Tensor) -> Tensor:
        """Find the nearest values that are feasible and lie in the norm-balls around the start.

        Args:
            values: D attacked values of each of A examples, shape (A, D).
            examples: Index of each of the A examples, which are objects with their views, in the
                scene, shape (A,).

        Returns:
            Projected values, shape (A, D).
        """
        return project(self.settings, values, self.start[examples], self.project_feasible)

    def sample(self, generator: torch.Generator, reached: Tensor | None = None) -> Tensor:
        """Draw random feasible values for all E examples.

        With a radius, values are drawn uniformly from the norm-balls and then
        projected onto the feasible values. Without a radius, they are drawn in
        random directions, as far from the start as the values of an attack.

        Args:
            generator: CPU generator of the random numbers.
            reached: D values in each example at the end of an attack, shape
                (E, D). Needed only without a radius.

        Returns:
            Random values, shape (E, D).

        Raises:
            InputError: If there is neither a radius nor `reached`.
        """
        if self.settings.radius is None and reached is not None:
            return self._sample_as_far_as(reached, generator)
        drawn = sample(self.settings, self.start, generator, self.used_mask)
        return project(self.settings, drawn, self.start, self.project_feasible)

    def _sample_as_far_as(self, reached: Tensor, generator: torch.Generator) -> Tensor:
        """Draw feasible values in random directions from the start of each example.

        Args:
            reached: Values whose distance from the start the drawn values get, shape (E, D).
            generator: CPU generator of the random numbers.

        Returns:
            Random values, shape (E, D).
        """
        direction = torch.randn(reached.shape, generator=generator).to(reached)
        if self.used_mask is not None:
            direction = direction * self.used_mask
        distance = (reached - self.start).norm(dim=1, keepdim=True)
        offset = direction * distance / direction.norm(dim=1, keepdim=True)
        return self.project_feasible(self.start + offset)
