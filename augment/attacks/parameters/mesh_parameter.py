"""Base class of attacks that add an offset to each vertex or face of an object."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from augment.attack_settings import StepSettings
from augment.attacks.parameters.parameter import Parameter
from augment.scene.scene import Scene


class MeshParameter(Parameter):
    """Attack with three values for each vertex or each face of an object, such as x, y and z.

    All examples have as many values as the largest mesh needs. Values of
    vertices or faces that a smaller mesh lacks are not used. The mesh of an
    object also contains its props (meshes beside the object) and its table. The
    attack does not change these. The attack starts at zero.
    """

    def __init__(self, scene: Scene, settings: StepSettings, object_masks: Sequence[np.ndarray]):
        """Find the values that each example uses.

        A mask for each object marks the vertices or faces that belong to the object itself, not to
        its props or table.
        """
        # One row for each object, one column for each of the N vertices or faces of the largest
        # mesh. Rows of smaller meshes end with False.
        masks = pad_sequence([torch.from_numpy(mask) for mask in object_masks], batch_first=True)
        # Three values for each vertex or face, shape (objects, 3 N).
        value_masks = masks.to(scene.lights.device).repeat_interleave(3, dim=1)
        used_mask = value_masks[scene.object_of]
        start = scene.lights.new_zeros(used_mask.shape)
        super().__init__(settings, start=start, used_mask=used_mask)

    def offsets(
        self, values: Float[Tensor, "A D"], examples: Int[Tensor, " A"]
    ) -> Float[Tensor, "A N 3"]:
        """Reshape the attack values to one vector for each vertex or face.

        The vectors of unused vertices or faces are zero.
        """
        if self.used_mask is not None:
            values = values * self.used_mask[examples]
        return values.unflatten(1, (-1, 3))
