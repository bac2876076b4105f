"""Base class of the quantities that an attack changes."""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from augment.attacks.norm_ball import project, sample, scale_gradient, unconstrained
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
    def apply(
        self, values: Float[Tensor, "A D"], conditions: Conditions, examples: Int[Tensor, " A"]
    ) -> Conditions:
        """Return a copy of the conditions in which this quantity has the given values.

        Conditions are the light, shape and colors with which examples are rendered. Other
        parameters may have changed the given conditions already. `examples` are indices in the
        scene.
        """

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
