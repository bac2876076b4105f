"""Joints that carry the vertices of a mesh: linear blend skinning (glTF 2.0, section 3.7.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

# Index of the parent of joints without a parent.
NO_PARENT = -1


@dataclass(frozen=True)
class Skin:
    """J joints of a mesh with V vertices, in the pose of the mesh.

    `load_mesh` reads the skin of a file into `Mesh.skin`. Functions that move or
    divide a mesh change its skin accordingly, or remove it.

    Attributes:
        names: Names of the joints.
        parents: Index of the parent of each joint, or NO_PARENT, int64,
            shape (J,). Parents come before their children.
        pivots: Positions of the joints in the coordinates of the mesh, float64,
            shape (J, 3).
        carried: Position (x, y, z, 1) to which each joint carries each vertex,
            times the weight of the joint, float32, shape (V, J, 4). The sum over
            joints is the position of the vertex, or 0 if no joint carries it.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    pivots: np.ndarray
    carried: np.ndarray

    def displacements(self, rotations: Float[Tensor, "J 3 3"]) -> Float[Tensor, "V 3"]:
        """Compute how the vertices move if joints rotate about their positions.

        A joint also moves its children. The rotation of a child is applied
        before the rotation of its parent. The result is differentiable.

        Args:
            rotations: Rotation matrix of each joint in the axes of the mesh,
                shape (J, 3, 3).

        Returns:
            Displacements of the vertices, shape (V, 3).
        """
        # One matrix for each joint so far, which multiplies rows (x, y, z, 1) from
        # the right, shape (4, 3) each.
        matrices: list[Tensor] = []
        pivots = torch.from_numpy(self.pivots).to(rotations)
        for parent, pivot, rotation in zip(self.parents, pivots, rotations, strict=True):
            translation = pivot - rotation @ pivot
            matrix = torch.cat([rotation.T, translation[None]])
            if parent != NO_PARENT:
                parent_rotation = matrices[parent][:3]
                parent_translation = matrices[parent][3:]
                # Three rows of zeros stand above the translation.
                added = torch.nn.functional.pad(parent_translation, (0, 0, 3, 0))
                matrix = matrix @ parent_rotation + added
            matrices.append(matrix)
        identity = torch.eye(4, 3).to(rotations)
        # Shape (4 J, 3).
        changes = (torch.stack(matrices) - identity).flatten(0, 1)
        return torch.from_numpy(self.carried).to(rotations).flatten(1) @ changes

    def transformed(self, matrix: np.ndarray) -> Skin:
        """Return the skin of a mesh that is moved by an affine transform.

        Args:
            matrix: Matrix of the transform, shape (4, 4).

        Returns:
            Skin with moved joints and positions.
        """
        pivots = self.pivots @ matrix[:3, :3].T + matrix[:3, 3]
        carried = (self.carried @ matrix.T).astype(np.float32)
        return replace(self, pivots=pivots, carried=carried)
