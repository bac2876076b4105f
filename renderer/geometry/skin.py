"""Joints that move the vertices of a mesh: linear blend skinning (glTF 2.0, section 3.7.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float

# Value of `Skin.parents` for a joint without a parent.
NO_PARENT = -1


@dataclass(frozen=True)
class Skin:
    """J joints (bones) that move the V vertices of a mesh.

    The skin describes the mesh in its current pose. `load_mesh` reads the skin
    of a file into `Mesh.skin`. Functions that transform or divide a mesh change
    the skin in the same way, or remove it.

    Attributes:
        names: Names of the joints.
        parents: Index of the parent of each joint, or NO_PARENT, int64,
            shape (J,). Parents come before their children.
        pivots: Points about which the joints rotate, in the axes of the mesh,
            float64, shape (J, 3).
        carried: Homogeneous position (x, y, z, 1) to which each joint would move
            each vertex alone, times the weight of the joint for the vertex,
            float32, shape (V, J, 4). The sum over the joints is the position of
            the vertex. It is 0 for a vertex that no joint moves.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    pivots: np.ndarray
    carried: np.ndarray

    def displacements(self, rotations: Float[Tensor, "J 3 3"]) -> Float[Tensor, "V 3"]:
        """Compute how the V vertices move if the J joints rotate about their pivots.

        A joint also rotates its children. The rotation of a child is applied
        before the rotation of its parent. The result is differentiable with
        respect to the rotations.

        Args:
            rotations: Rotation matrix of each joint in the axes of the mesh,
                shape (J, 3, 3).

        Returns:
            Displacements of the vertices in the axes of the mesh, shape (V, 3).
        """
        # Affine matrices of the joints up to the current one, shape (4, 3) each. The
        # product of a row (x, y, z, 1) and such a matrix is the moved point.
        matrices: list[Tensor] = []
        pivots = torch.from_numpy(self.pivots).to(rotations)
        for parent, pivot, rotation in zip(self.parents, pivots, rotations, strict=True):
            # A rotation about the pivot keeps the pivot in place.
            translation = pivot - rotation @ pivot
            matrix = torch.cat([rotation.T, translation[None]])
            if parent != NO_PARENT:
                # Apply the matrix of the parent afterwards.
                parent_rotation = matrices[parent][:3]
                parent_translation = matrices[parent][3:]
                # Three rows of zeros above the translation give the shape (4, 3).
                padded_translation = torch.nn.functional.pad(parent_translation, (0, 0, 3, 0))
                matrix = matrix @ parent_rotation + padded_translation
            matrices.append(matrix)
        # Multiplying by a matrix minus the identity gives a displacement.
        identity = torch.eye(4, 3).to(rotations)
        # The matrices of the J joints below each other, shape (4 J, 3).
        displacement_matrix = (torch.stack(matrices) - identity).flatten(0, 1)
        # `carried` of the V vertices with the joints along one axis, shape (V, 4 J). The
        # product below therefore sums over the joints.
        carried = torch.from_numpy(self.carried).to(rotations).flatten(1)
        return carried @ displacement_matrix

    def transformed(self, matrix: np.ndarray) -> Skin:
        """Return the skin for a mesh to which an affine transformation is applied.

        Args:
            matrix: Affine matrix of the transformation, shape (4, 4).

        Returns:
            Copy with transformed pivots and positions.
        """
        pivots = self.pivots @ matrix[:3, :3].T + matrix[:3, 3]
        carried = (self.carried @ matrix.T).astype(np.float32)
        return replace(self, pivots=pivots, carried=carried)
