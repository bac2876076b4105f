"""Joints and weights of glTF files (sections 3.7.3 and 5.28 of glTF 2.0).

trimesh does not read skins, but it reads all attributes whose names begin with
an underscore. `with_skins_as_attributes` copies the skins of a file to such
attributes before trimesh reads it, and `skinned` reads them afterwards.

Morph targets and animations are ignored. The joints have the pose of the nodes.
"""

import json
import struct
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from renderer.geometry.mesh import Mesh, transformed
from renderer.geometry.skin import Skin

# Names of the attributes for inverse bind matrices, joints and weights. The
# number of the set follows the last two, as in _JOINTS_0.
BIND = "_BIND"
JOINTS = "_JOINTS_"
WEIGHTS = "_WEIGHTS_"
# Beginnings of the names of joints and weights in glTF.
JOINTS_OR_WEIGHTS = ("JOINTS", "WEIGHTS")
# The weights of a vertex may differ from a sum of 1 by this, because weights
# may have 8 bits.
TOLERANCE = 0.01
# Type of the first chunk of a .glb file: "JSON" as a number.
JSON_CHUNK = 0x4E4F534A
# Bytes before the content of this chunk: the file header and the chunk header.
GLB_HEADER_BYTES = 20


def with_skins_as_attributes(content: bytes, tree: dict[str, Any]) -> bytes:
    """Copy the skins of a .gltf or .glb file to attributes that trimesh reads.

    Nodes get their numbers as names.

    Args:
        content: Content of the file.
        tree: glTF tree of the file, with skins.

    Returns:
        Content of the changed file.

    Raises:
        ValueError: If a mesh has two skins, or a skin but no weights.
    """
    tree = deepcopy(tree)
    for number, node in enumerate(tree["nodes"]):
        node["name"] = str(number)
        if "skin" in node:
            _copy_skin(tree["meshes"][node["mesh"]], node["skin"], tree["skins"])
    text = json.dumps(tree).encode()
    if not content.startswith(b"glTF"):
        return text
    # The length of a chunk is a multiple of 4 bytes.
    text += b" " * (-len(text) % 4)
    version, _, old_length = struct.unpack_from("<III", content, 4)
    other_chunks = content[GLB_HEADER_BYTES + old_length :]
    total_length = GLB_HEADER_BYTES + len(text) + len(other_chunks)
    header = struct.pack("<4sIIII", b"glTF", version, total_length, len(text), JSON_CHUNK)
    return header + text + other_chunks


def _copy_skin(mesh: dict[str, Any], skin: int, skins: list[dict[str, Any]]) -> None:
    """Copy the joints, weights and bind matrices of a mesh in a glTF tree, in place.

    Args:
        mesh: Mesh of the tree.
        skin: Index of its skin.
        skins: All skins of the tree.

    Raises:
        ValueError: If the mesh has another skin already, or has no weights.
    """
    known_skin = mesh.setdefault("extras", {}).setdefault("skin", skin)
    if known_skin != skin:
        raise ValueError("a mesh with two skins is not supported")
    bind_matrices = skins[skin].get("inverseBindMatrices")
    for part in mesh["primitives"]:
        attributes = part["attributes"]
        if not {"JOINTS_0", "WEIGHTS_0"} <= attributes.keys():
            raise ValueError("a mesh with a skin has no joints and weights (JOINTS_0, WEIGHTS_0)")
        for name in list(attributes):
            if name.startswith(JOINTS_OR_WEIGHTS):
                attributes[f"_{name}"] = attributes[name]
        if bind_matrices is not None:
            attributes[BIND] = bind_matrices


def skinned(part: Mesh, node: str, scene: trimesh.Scene, tree: dict[str, Any]) -> Mesh:
    """Move a part of a file with skins to where its joints carry it.

    A part with a skin is moved by its weights. A part without a skin moves with
    the nearest joint above its node, if there is one.

    Args:
        part: Part as trimesh read it, with V vertices.
        node: Name of its node in the scene.
        scene: Scene that trimesh read from the changed file.
        tree: glTF tree of the original file.

    Returns:
        Part in the coordinates of the scene, with its skin.

    Raises:
        ValueError: If weights do not add up to 1, or if a joint does not exist.
    """
    skeleton = _Skeleton(tree, scene)
    node_number = int(node.split("_")[0])
    node_matrix, geometry_name = scene.graph[node]
    joint_count = len(skeleton.joints)
    weights = np.zeros((len(part.vertices), joint_count))
    # Matrices by which each joint moves the vertices, shape (J, 4, 4).
    matrices = node_matrix[None].repeat(joint_count, axis=0)
    joints_above = skeleton.joints_from(node_number)
    if "skin" in tree["nodes"][node_number]:
        skin = tree["skins"][tree["nodes"][node_number]["skin"]]
        # Index among all joints of each joint of the skin.
        columns = np.array([skeleton.column[joint] for joint in skin["joints"]])
        attributes = scene.geometry[geometry_name].vertex_attributes
        # glTF stores matrices by columns.
        bind = attributes[BIND].swapaxes(1, 2) if BIND in attributes else np.eye(4)
        skin_matrices = skeleton.poses[columns] @ bind
        matrices[columns] = skin_matrices
        node_matrix = skin_matrices[0]
        _add_weights(weights, attributes, columns)
        _normalize_weights(weights)
    elif joints_above:
        weights[:, skeleton.column[joints_above[0]]] = 1
    homogeneous = np.insert(part.vertices, 3, 1, axis=1)
    # Positions to which each joint moves each vertex, shape (V, J, 4).
    moved = np.einsum("jab,vb->vja", matrices, homogeneous)
    carried = (moved * weights[..., None]).astype(np.float32)
    # This reverses the faces if the matrix mirrors them.
    placed = transformed(part, node_matrix)
    if weights.any():
        placed = replace(placed, vertices=carried[..., :3].sum(axis=1, dtype=np.float64))
    skin_of_part = Skin(
        names=skeleton.names,
        parents=skeleton.parents,
        pivots=skeleton.poses[:, :3, 3],
        carried=carried,
    )
    return replace(placed, skin=skin_of_part)


class _Skeleton:
    """J joints of a glTF file, of all its skins.

    Attributes:
        joints: Nodes of the joints. Parents come before their children.
        column: Index in `joints` of each joint, by its node.
        names: Names of the joints.
        parents: Index in `joints` of the parent of each joint, or -1,
            shape (J,).
        poses: Poses of the joints in the scene, shape (J, 4, 4).
    """

    def __init__(self, tree: dict[str, Any], scene: trimesh.Scene) -> None:
        nodes = tree["nodes"]
        self._joint_nodes = {joint for skin in tree["skins"] for joint in skin["joints"]}
        self._parent_node = {}
        for parent, item in enumerate(nodes):
            for child in item.get("children", []):
                self._parent_node[child] = parent
        self.joints = sorted(
            self._joint_nodes, key=lambda joint: (len(self.joints_from(joint)), joint)
        )
        self.column = {joint: index for index, joint in enumerate(self.joints)}
        self.names = tuple(str(nodes[joint].get("name", joint)) for joint in self.joints)
        self.parents = np.array([self._parent_column(joint) for joint in self.joints])
        self.poses = np.stack([scene.graph[str(joint)][0] for joint in self.joints])

    def joints_from(self, node: int) -> list[int]:
        """Return the joints on the way from a node to the root, itself included.

        Args:
            node: Number of the node.

        Returns:
            Nodes of the joints, the nearest one first.
        """
        above = []
        if node in self._parent_node:
            above = self.joints_from(self._parent_node[node])
        return [node, *above] if node in self._joint_nodes else above

    def _parent_column(self, joint: int) -> int:
        """Return the index of the next joint above a joint, or -1."""
        ancestors = self.joints_from(joint)[1:]
        return self.column[ancestors[0]] if ancestors else -1


def _add_weights(weights: np.ndarray, attributes: dict[str, Any], columns: np.ndarray) -> None:
    """Add the weights of a skin in place.

    Args:
        weights: Weights of V vertices and all J joints, shape (V, J).
        attributes: Attributes of the vertices, with joints and weights. Each
            set holds four joints of each vertex.
        columns: Index among all joints of each joint of the skin.

    Raises:
        ValueError: If a vertex has a joint that the skin does not have.
    """
    rows = np.arange(len(weights))[:, None]
    for name in attributes:
        if not name.startswith(JOINTS):
            continue
        values = attributes[name.replace(JOINTS, WEIGHTS)]
        # Unsigned integers stand for fractions of their largest value.
        largest = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1
        values = values / largest
        # Entries without weight may have any joint.
        joints = np.where(values == 0, 0, attributes[name])
        if joints.max() >= len(columns):
            raise ValueError(
                f"a vertex has the joint {joints.max()}, but its skin has {len(columns)} joints"
            )
        np.add.at(weights, (rows, columns[joints]), values)


def _normalize_weights(weights: np.ndarray) -> None:
    """Divide weights (V, J) by their sums in place. Raise ValueError if a sum is not about 1."""
    sums = weights.sum(axis=1)
    deviations = np.abs(sums - 1)
    # The comparison is False for NaN.
    if not (deviations <= TOLERANCE).all():
        worst = sums[deviations.argmax()]
        raise ValueError(f"the weights of a vertex add up to {worst:g} instead of 1")
    weights /= sums[:, None]
