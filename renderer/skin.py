"""Joints that move the vertices of a mesh: linear blend skinning (glTF 2.0, section 3.7.3).

Shapes use these letters: a mesh has V vertices, which J joints move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

# Value of `Skin.parents` for a joint without a parent.
NO_PARENT = -1


@dataclass(frozen=True)
class Skin:
    """J joints (bones) that move the V vertices of a mesh by linear blend skinning.

    The skin describes the mesh in its current pose. `load_mesh` reads the skin
    of a file into `Mesh.skin`. Functions that transform or divide a mesh change
    the skin in the same way, or remove it.

    Attributes:
        names: Names of the joints.
        parents: Index of the parent of each joint, or NO_PARENT (-1), int64,
            shape (J,). Parents come before their children.
        pivots: Points about which the joints rotate, in the axes of the mesh,
            float64, shape (J, 3).
        carried: Share of each joint in the position of each vertex, float32,
            shape (V, J, 4). It is the homogeneous position (x, y, z, 1) to which
            the joint alone would move the vertex, times the weight of the joint.
            The sum over the joints is the position of the vertex. All shares are
            0 for a vertex that no joint moves.
    """

    names: tuple[str, ...]
    parents: Int[np.ndarray, " J"]
    pivots: Float[np.ndarray, "J 3"]
    carried: Float[np.ndarray, "V J 4"]

    def displacements(self, rotations: Float[Tensor, "J 3 3"]) -> Float[Tensor, "V 3"]:
        """Compute how far the V vertices move if the J joints rotate about their pivots.

        A joint also rotates its children. The rotation of a child is applied
        before the rotation of its parent. The result is differentiable with
        respect to the rotations. Rotations and displacements are in the axes of the mesh.
        """
        # Subtracting the identity from the matrix of a joint gives a
        # matrix that maps a point (x, y, z, 1) to its displacement.
        identity = torch.eye(4, 3).to(rotations)
        joint_matrices = torch.stack(self._joint_matrices(rotations))
        # Matrices of the J joints, one below the other, shape (4 J, 3).
        displacement_matrix = (joint_matrices - identity).flatten(0, 1)
        # Each row has the shares of all joints in
        # the position of a vertex, shape (V, 4 J).
        carried = torch.from_numpy(self.carried).to(rotations).flatten(1)
        # The matrix product adds up the displacements by all joints.
        return carried @ displacement_matrix

    def _joint_matrices(self, rotations: Float[Tensor, "J 3 3"]) -> list[Tensor]:
        """Compute the affine matrix with which each joint moves points.

        A row (x, y, z, 1) times the (4, 3) matrix of a joint is the point that it and all
        joints above it have moved.
        """
        matrices: list[Tensor] = []
        pivots = torch.from_numpy(self.pivots).to(rotations)
        for parent, pivot, rotation in zip(self.parents, pivots, rotations, strict=True):
            # This translation keeps the pivot at its place.
            translation = pivot - rotation @ pivot
            matrix = torch.cat([rotation.T, translation[None]])
            if parent != NO_PARENT:
                # The parent rotates and shifts the points
                # that the joint has moved.
                parent_rotation = matrices[parent][:3]
                parent_translation = matrices[parent][3:]
                # Three rows of zeros above the
                # translation give the shape (4, 3).
                padded_translation = torch.nn.functional.pad(parent_translation, (0, 0, 3, 0))
                matrix = matrix @ parent_rotation + padded_translation
            matrices.append(matrix)
        return matrices

    def transformed(self, matrix: Float[np.ndarray, "4 4"]) -> Skin:
        """Return the skin of a mesh after an affine transformation of the mesh.

        The product of the matrix and a column (x, y, z, 1) is the new point.
        """
        linear_part = matrix[:3, :3]
        pivots = self.pivots @ linear_part.T + matrix[:3, 3]
        carried = (self.carried @ matrix.T).astype(np.float32)
        return replace(self, pivots=pivots, carried=carried)
