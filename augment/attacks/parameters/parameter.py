"""Base class of the quantities that an attack changes."""

from abc import ABC, abstractmethod
from typing import ClassVar

from augment.attacks.objective import Examples, Values
from augment.attacks.optimizers import NormBalls
from augment.scene.objects import Conditions


class Parameter(NormBalls, ABC):
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
    """

    name: str
    fits_other_meshes: ClassVar[bool] = True
    fits_other_views: ClassVar[bool] = True

    @abstractmethod
    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions in which this quantity has the given values.

        Conditions are the light, shape and colors with which examples are rendered. Other
        parameters may have changed the given conditions already. `examples` are indices in the
        scene.
        """
