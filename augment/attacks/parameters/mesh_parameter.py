"""Base class of attacks that add an offset to each vertex or face of an object."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from augment.attacks.parameters.parameter import Parameter
from augment.parameter_settings import StepSettings
from augment.scene.scene import Scene


class MeshParameter(Parameter):
    """Three values for each vertex or each face of an object, such as x, y and z.

    The mesh of an object also contains its props and its table, which the
    attack leaves as they are. All examples have as many values as the largest
    mesh needs. Values of props, of a table, and of vertices or faces that a
    smaller mesh does not have are not used. The attack starts at zero.

    Args:
        scene: Scene to attack.
        settings: Norm-ball and steps of the attack.
        object_masks: One mask for each object of the scene. It marks the
            vertices or faces of the mesh that belong to the object itself, not
            to its props or table, shape (number of vertices or faces,).
    """

    def __init__(self, scene: Scene, settings: StepSettings, object_masks: Sequence[np.ndarray]):
        # Shape (objects, N), with N vertices or faces in the largest mesh.
        masks = pad_sequence([torch.from_numpy(mask) for mask in object_masks], batch_first=True)
        # Shape (objects, 3 N), three values for each vertex or face.
        value_masks = masks.to(scene.lights.device).repeat_interleave(3, dim=1)
        used_mask = value_masks[scene.object_of]
        start = scene.lights.new_zeros(used_mask.shape)
        super().__init__(settings, start=start, used_mask=used_mask)

    def offsets(self, values: Tensor, examples: Tensor) -> Tensor:
        """Return the values as vectors, one for each vertex or face.

        Args:
            values: Values of A examples, shape (A, 3 N).
            examples: Indices of the examples in the scene, shape (A,).

        Returns:
            Offset of each of the N vertices or faces, shape (A, N, 3). It is
            zero if its values are not used.
        """
        if self.used_mask is not None:
            values = values * self.used_mask[examples]
        return values.unflatten(1, (-1, 3))
