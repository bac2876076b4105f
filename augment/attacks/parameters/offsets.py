"""Attacks that add an offset to each vertex (shape), to each face (colors) or to each pixel."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import relu
from torch.nn.utils.rnn import pad_sequence

from augment.attack_settings import StepSettings
from augment.attacks.objective import Examples, Values
from augment.attacks.parameters.material import ROUNDING
from augment.attacks.parameters.parameter import Parameter
from augment.scene.objects import Conditions
from augment.scene.scene import Scene
from renderer.vectors import Ball, nearest_in_box


class MeshParameter(Parameter):
    """Attack with three values for each vertex or each face of an object, such as x, y and z.

    All examples have as many values as the largest mesh needs. Values of
    vertices or faces that a smaller mesh lacks are not used. The mesh of an
    object also contains its props (meshes beside the object) and its table. The
    attack does not change these. The attack starts at zero.
    """

    fits_other_meshes = False

    def __init__(self, scene: Scene, settings: StepSettings, object_masks: Sequence[np.ndarray]):
        """Find the values that each example uses.

        A mask for each object marks the vertices or faces that belong to the object itself, not to
        its props or table.
        """
        # One row for each object, one column for each of the N vertices or faces of the largest
        # mesh. Rows of smaller meshes end with False.
        masks = pad_sequence([torch.from_numpy(mask) for mask in object_masks], batch_first=True)
        # Three values for each vertex or face, shape (E, 3 N).
        used_mask = masks.to(scene.lights.device).repeat_interleave(3, dim=1)[scene.object_of]
        start = scene.lights.new_zeros(used_mask.shape)
        super().__init__(settings, start=start, used_mask=used_mask)

    def offsets(self, values: Values, examples: Examples) -> Float[Tensor, "E N 3"]:
        """Reshape the attack values to one vector for each vertex or face.

        The vectors of unused vertices or faces are zero.
        """
        return (values * self.used_mask[examples]).unflatten(1, (-1, 3))


class Geometry(MeshParameter):
    """Attack on the shape: a displacement of each vertex of the object.

    Displacements are in world units, in which the object spans [-1, 1]. The
    gradient takes into account that normals turn as vertices move. If
    `ImageSettings.silhouettes` is set, it also takes into account that the
    silhouette of the object moves.

    Args:
        scene: Scene to attack. Props and table stay as they are.
        settings: Norm-ball and steps of the attack.
    """

    name = "geometry"

    def __init__(self, scene: Scene, settings: StepSettings):
        self._scene = scene
        super().__init__(scene, settings, [item.own_vertices for item in scene.objects])

    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions with displaced vertices.

        The values are displacements of the N vertices of the largest mesh in world units.
        """
        # Vertices before the attack, shape (E, N, 3).
        vertices = self._scene.vertices[self._scene.object_of[examples]]
        return replace(conditions, vertices=vertices + self.offsets(values, examples))


class Albedo(MeshParameter):
    """Attack on the colors: a linear RGB offset that is added to the albedo of each face.

    The renderer clamps the sum to [0, 1]. The gradient of an offset that a
    restart puts beyond this range is zero, so the offset does not change.

    Args:
        scene: Scene to attack. Props and table stay as they are.
        settings: Norm-ball and steps of the attack.
    """

    name = "albedo"

    def __init__(self, scene: Scene, settings: StepSettings):
        super().__init__(scene, settings, [item.own_faces for item in scene.objects])

    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions with a color offset for each face.

        The values of each of the E examples are D = 3 F numbers: linear RGB offsets of the F faces
        of the largest mesh.
        """
        return replace(conditions, albedo=self.offsets(values, examples))


class Pixels(Parameter):
    """Attack on the pixels: an offset that is added to each pixel value of an image.

    The sum of image and offset is clamped to [0, 1]. With one step of the kind
    "sign" that is as long as the radius, the attack is FGSM (Goodfellow et al.
    2014). With several smaller steps, it is the basic iterative method (Kurakin
    et al. 2016). With random restarts in addition, it is PGD (Madry et al. 2017).

    An attack on the pixels alone keeps the offsets in the range in which nothing
    is clamped. Together with other parameters, the gradient of an offset that a
    restart puts beyond this range is zero, so the offset does not change.

    Args:
        scene: Scene to attack.
        settings: Norm-ball and steps of the attack.
        is_alone: Whether no other parameter changes the images.
    """

    name = "pixels"
    fits_other_meshes = False
    fits_other_views = False

    def __init__(self, scene: Scene, settings: StepSettings, is_alone: bool = False):
        self._images_shape = (scene.views, 3, *scene.settings.shape)
        self._scene = scene
        start = scene.lights.new_zeros(len(scene), math.prod(self._images_shape))
        # Images of all examples before the attack, or NaN until they are needed.
        self._images = torch.full_like(start, math.nan) if is_alone else None
        self._missing = len(scene)  # The number of examples without images.
        super().__init__(settings, start)

    def project_feasible(
        self, values: Values, within: Ball | None = None, examples: Examples | slice = slice(None)
    ) -> Values:
        """Keep the sums of images and offsets in [0, 1], if nothing else changes the images."""
        if self._images is None:
            return super().project_feasible(values, within)
        images = self._images_of(self._images, examples)
        # A sum beyond the limits by rounding would have a gradient of zero.
        low, high = -relu(images - ROUNDING), relu(1 - ROUNDING - images)
        return nearest_in_box(values, low, high, within)

    def apply(self, values: Values, conditions: Conditions, examples: Examples) -> Conditions:
        """Return a copy of the conditions with an offset for each pixel value.

        The values are in the order (V, 3, height, width) of the images.
        """
        return replace(conditions, pixels=values.unflatten(1, self._images_shape))

    def _images_of(self, kept: Float[Tensor, "_ D"], examples: Examples | slice) -> Values:
        """Return the images of examples before the attack, one row for each, and keep them."""
        rows = torch.arange(len(self._scene), device=self.start.device)[examples]
        missing = rows[kept[rows, 0].isnan()] if self._missing else rows[:0]
        with torch.no_grad():
            for group in missing.split(self._scene.group_size) if len(missing) else ():
                images = self._scene.render(self._scene.conditions(group), group)
                kept[group] = images.flatten(1)
                self._missing -= len(group)
        return kept[rows]
