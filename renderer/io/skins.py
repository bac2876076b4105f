"""Pose the vertices of glTF files by their joints (sections 3.7.3 and 5.28 of glTF 2.0).

The joints have the pose that the nodes of the file have. Shapes use these
letters: a part (a mesh with one material) has V vertices, and all skins of the
file together have J joints.
"""

import numpy as np

from renderer.io.gltf_file import GltfFile
from renderer.skin import NO_PARENT, Skin

# The weights of the joints of a vertex should add up to 1. Their sum may
# differ from 1 by at most this much, because weights with 8 bits are rounded.
MAX_WEIGHT_ERROR = 0.01


class Skeleton:
    """The J joints of all skins of a glTF file.

    Attributes:
        names: Names of the joints. Parents come before their children.
        parents: Index of the parent of each joint, or NO_PARENT, shape (J,).
        pivots: Positions of the joints in the scene, shape (J, 3).
    """

    def __init__(self, file: GltfFile) -> None:
        """Collect the joints, parents before their children."""
        self._file = file
        joints_of_skins = {joint for skin in file.tree["skins"] for joint in skin["joints"]}
        self._index_of: dict[int, int] = {}
        self._names = []
        self._parents = []
        # Parents come before their children in `poses`.
        for node in file.poses:
            if node in joints_of_skins:
                self._parents.append(self._nearest_joint(file.parents.get(node)))
                self._names.append(str(file.tree["nodes"][node].get("name", node)))
                self._index_of[node] = len(self._index_of)

    def __len__(self) -> int:
        """Return the number of joints."""
        return len(self._names)

    def _nearest_joint(self, node: int | None) -> int:
        """Find the joint that a node is, or the nearest one above it, or NO_PARENT."""
        while node is not None:
            if node in self._index_of:
                return self._index_of[node]
            node = self._file.parents.get(node)
        return NO_PARENT

    def posed(
        self, node: int, vertices: np.ndarray, attributes: dict[str, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute how far each joint carries each vertex of a part that a node shows.

        The result is the shares of the joints as in `Skin.carried` (V, J, 4), the vertices in the
        scene, and a matrix (4, 4) that tells whether the part is mirrored.
        """
        node_pose = self._file.poses[node]
        weights = np.zeros((len(vertices), len(self)))
        # Matrix that maps a vertex to where each joint alone would move it.
        matrices = node_pose[None].repeat(len(self), axis=0)
        if "skin" in self._file.tree["nodes"][node]:
            skin = self._file.entry("skins", self._file.tree["nodes"][node]["skin"])
            joint_poses = np.stack([self._file.poses[joint] for joint in skin["joints"]])
            joints = np.array([self._index_of[joint] for joint in skin["joints"]])
            bind = np.eye(4)
            if "inverseBindMatrices" in skin:
                # There may be more matrices than joints.
                bind = self._file.array(skin["inverseBindMatrices"])[: len(joints)]
                if len(bind) < len(joints):
                    raise ValueError(f"a skin has {len(bind)} matrices for {len(joints)} joints")
            matrices[joints] = joint_poses @ bind
            _add_weights(weights, attributes, joints)
            node_pose = matrices[joints[0]]
        elif (joint := self._nearest_joint(node)) != NO_PARENT:
            weights[:, joint] = 1
        homogeneous = np.insert(vertices, 3, 1, axis=1)
        moved = np.einsum("jab,vb->vja", matrices, homogeneous)
        carried = (moved * weights[..., None]).astype(np.float32)
        placed = carried[..., :3].sum(axis=1, dtype=np.float64)
        if not weights.any():
            placed = vertices @ node_pose[:3, :3].T + node_pose[:3, 3]
        return carried, placed, node_pose

    def skin(self, carried: np.ndarray) -> Skin:
        """Return the skin of a mesh in the scene by the shares (V, J, 4) of the joints."""
        pivots = np.stack([self._file.poses[joint][:3, 3] for joint in self._index_of])
        return Skin(tuple(self._names), np.array(self._parents), pivots, carried)


def _add_weights(
    weights: np.ndarray, attributes: dict[str, np.ndarray], joint_indices: np.ndarray
) -> None:
    """Add the weights of one skin to the weights (V, J) of all joints of the file, in place."""
    sets = [name.removeprefix("JOINTS") for name in attributes if name.startswith("JOINTS")]
    for name in sets:
        values = attributes[f"WEIGHTS{name}"]
        # A joint with the weight 0 may be any number, so it is replaced by joint 0.
        joints = np.where(values == 0, 0, attributes[f"JOINTS{name}"])
        if joints.max() >= len(joint_indices):
            raise ValueError(
                f"a vertex has the joint {joints.max()}, but its skin has {len(joint_indices)} "
                "joints"
            )
        # A vertex may have the same joint twice. `weights[...]
        # += values` would then add only one of both weights.
        np.add.at(weights, (np.arange(len(weights))[:, None], joint_indices[joints]), values)
    sums = weights.sum(axis=1)
    deviations = np.abs(sums - 1)
    # A comparison with NaN is False, so `not` also finds NaN.
    if not (deviations <= MAX_WEIGHT_ERROR).all():
        worst = sums[deviations.argmax()]
        raise ValueError(f"the weights of a vertex add up to {worst:g} instead of 1")
    weights /= sums[:, None]
