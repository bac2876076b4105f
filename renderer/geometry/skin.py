"""Joints that carry the vertices of a mesh: linear blend skinning, as glTF 2.0 has it (section 3.7.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class Skin:
    """J joints of a mesh of V vertices, in the pose that the mesh has.

    names      J strings
    parents    (J,) int64, of each joint; -1 for none; they come before their children
    pivots     (J, 3) float64, the joints' positions, in the mesh's coordinates
    carried    (V, J, 4) float32, the weight of each joint times the position (x, y, z, 1) to which it carries the
               vertex: their sum is the vertex, or 0 for one that no joint carries

    `Mesh.skin` has it, from `load_mesh`. Whatever moves or divides a mesh does so to its skin, or drops it.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    pivots: np.ndarray
    carried: np.ndarray

    def displacements(self, rotations: Float[Tensor, "J 3 3"]) -> Float[Tensor, "V 3"]:
        """How the vertices move as each joint, and with it what hangs on it, turns about its position by a rotation
        matrix in the mesh's axes; differentiable. Of several, the parents' are applied last."""
        turned: list[Tensor] = []
        pivots = torch.from_numpy(self.pivots).to(rotations)
        for parent, pivot, rotation in zip(self.parents, pivots, rotations, strict=True):
            matrix = torch.cat([rotation.T, (pivot - rotation @ pivot)[None]])  # of rows (x, y, z, 1)
            if parent >= 0:
                matrix = matrix @ turned[parent][:3] + torch.nn.functional.pad(turned[parent][3:], (0, 0, 3, 0))
            turned.append(matrix)
        still = torch.eye(4, 3).to(rotations)
        return torch.from_numpy(self.carried).to(rotations).flatten(1) @ (torch.stack(turned) - still).flatten(0, 1)

    def transformed(self, matrix: np.ndarray) -> Skin:
        """Under an affine matrix (4, 4)."""
        pivots = self.pivots @ matrix[:3, :3].T + matrix[:3, 3]
        return replace(self, pivots=pivots, carried=(self.carried @ matrix.T).astype(np.float32))
