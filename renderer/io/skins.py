"""Read the skins (joints and weights) of glTF files (sections 3.7.3 and 5.28 of glTF 2.0).

trimesh does not read skins, but it reads all vertex attributes whose names begin
with an underscore. `with_skins_as_attributes` copies the skins of a file to such
attributes before trimesh reads the file. `skinned` reads the attributes
afterwards.

Morph targets and animations are ignored. The joints have the pose that the nodes
of the file have.

Shapes use these letters: a part of a file has V vertices, and all skins of the
file together have J joints.
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

# Name of the attribute to which the inverse bind matrices of a skin are copied. An
# inverse bind matrix maps vertices of the mesh to the axes of a joint.
BIND = "_BIND"
# First letters of the attributes to which joints and weights are copied. A number
# follows, as in _JOINTS_0, because each attribute holds four joints per vertex.
JOINTS = "_JOINTS_"
WEIGHTS = "_WEIGHTS_"
# First letters of the names of joints and weights in glTF.
JOINTS_OR_WEIGHTS = ("JOINTS", "WEIGHTS")
# Largest difference from 1 of the sum of a vertex's weights. Weights with 8 bits may
# differ so much because they are rounded.
TOLERANCE = 0.01
# Number that marks the JSON part of a .glb file: the letters "JSON".
JSON_CHUNK = 0x4E4F534A
# Number of bytes of a .glb file before the JSON: 12 of the file header, and 8 of the
# header of the JSON part.
GLB_HEADER_BYTES = 20


def with_skins_as_attributes(content: bytes, tree: dict[str, Any]) -> bytes:
    """Copy the skins in a .gltf or .glb file to vertex attributes that trimesh reads.

    Each node gets its number as a name, so that `skinned` finds the node.

    Args:
        content: Content of the file.
        tree: JSON object of the file, with skins. It is not changed.

    Returns:
        Content of a changed file.

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
    # The length of the JSON part of a .glb file must be a multiple of 4 bytes.
    text += b" " * (-len(text) % 4)
    version, _, old_json_length = struct.unpack_from("<III", content, 4)
    other_chunks = content[GLB_HEADER_BYTES + old_json_length :]
    total_length = GLB_HEADER_BYTES + len(text) + len(other_chunks)
    header = struct.pack("<4sIIII", b"glTF", version, total_length, len(text), JSON_CHUNK)
    return header + text + other_chunks


def _copy_skin(mesh: dict[str, Any], skin: int, skins: list[dict[str, Any]]) -> None:
    """Copy the joints, weights and inverse bind matrices of a glTF mesh to attributes, in place.

    Args:
        mesh: Mesh in the JSON object of a file, changed in place.
        skin: Index of the skin of the mesh.
        skins: All skins of the file.

    Raises:
        ValueError: If the mesh has another skin already, or has no weights.
    """
    # Two nodes may show the same mesh. Its entry "extras" stores the skin of the first
    # node.
    known_skin = mesh.setdefault("extras", {}).setdefault("skin", skin)
    if known_skin != skin:
        raise ValueError("a mesh has two skins, which is not supported")
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
    """Move the vertices of a part with the joints of the file, and add the joints to the part.

    The weights of a part with a skin say how much each joint moves each vertex.
    A part without a skin moves with the nearest joint above its node in the
    scene, if there is one.

    Args:
        part: Part as trimesh read it, with V vertices.
        node: Name of the node that shows the part.
        scene: Scene that trimesh read from the changed file.
        tree: JSON object of the original file.

    Returns:
        Part in the coordinates of the scene, with its skin.

    Raises:
        ValueError: If weights do not add up to 1, or if a joint does not exist.
    """
    skeleton = _Skeleton(tree, scene)
    node_number = int(node.split("_")[0])
    node_matrix, geometry_name = scene.graph[node]
    joint_count = len(skeleton.joints)
    # Weight of each joint for each vertex.
    weights = np.zeros((len(part.vertices), joint_count))
    # For each joint, the matrix from the coordinates of the part to the positions that
    # vertices have in the scene if only this joint moves them, shape (J, 4, 4).
    matrices = node_matrix[None].repeat(joint_count, axis=0)
    joints_above = skeleton.joints_from(node_number)
    if "skin" in tree["nodes"][node_number]:
        skin = tree["skins"][tree["nodes"][node_number]["skin"]]
        # Index among all J joints of each joint of this skin.
        columns = np.array([skeleton.column[joint] for joint in skin["joints"]])
        attributes = scene.geometry[geometry_name].vertex_attributes
        # glTF stores matrices column by column, so they are transposed.
        bind = attributes[BIND].swapaxes(1, 2) if BIND in attributes else np.eye(4)
        skin_matrices = skeleton.poses[columns] @ bind
        matrices[columns] = skin_matrices
        node_matrix = skin_matrices[0]
        _add_weights(weights, attributes, columns)
        _normalize_weights(weights)
    elif joints_above:
        weights[:, skeleton.column[joints_above[0]]] = 1
    # Positions (x, y, z, 1), shape (V, 4).
    homogeneous = np.insert(part.vertices, 3, 1, axis=1)
    # Positions to which each joint would move each vertex, shape (V, J, 4).
    moved = np.einsum("jab,vb->vja", matrices, homogeneous)
    carried = (moved * weights[..., None]).astype(np.float32)
    # `transformed` reverses the faces if the matrix mirrors the part.
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
    """The J joints of all skins of a glTF file.

    Attributes:
        joints: Number of the node of each joint. Parents come before their
            children.
        column: Index in `joints` of each joint, by the number of its node.
        names: Names of the joints.
        parents: Index in `joints` of the parent of each joint, or -1,
            shape (J,).
        poses: Matrix from the axes of each joint to scene coordinates,
            shape (J, 4, 4).

    Args:
        tree: JSON object of the file.
        scene: Scene that trimesh read from the file.
    """

    def __init__(self, tree: dict[str, Any], scene: trimesh.Scene) -> None:
        """Collect the joints of all skins of a file. A joint comes after its parent."""
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
        """List the joints on the way from a node up to the root of the scene.

        The node itself is included if it is a joint.

        Args:
            node: Number of the node.

        Returns:
            Numbers of the nodes of the joints, the nearest joint first.
        """
        joints_above = []
        if node in self._parent_node:
            joints_above = self.joints_from(self._parent_node[node])
        return [node, *joints_above] if node in self._joint_nodes else joints_above

    def _parent_column(self, joint: int) -> int:
        """Return the index in `joints` of the next joint above a joint, or -1.

        Args:
            joint: Number of the node of the joint.
        """
        ancestors = self.joints_from(joint)[1:]
        return self.column[ancestors[0]] if ancestors else -1


def _add_weights(weights: np.ndarray, attributes: dict[str, Any], columns: np.ndarray) -> None:
    """Add the weights of a skin to an array with all joints of the file, in place.

    Args:
        weights: Weight of each of J joints for each of V vertices, changed in
            place, shape (V, J).
        attributes: Vertex attributes with joints and weights. An attribute holds
            four joints, or four weights, per vertex, shape (V, 4).
        columns: Index among all J joints of each joint of the skin.

    Raises:
        ValueError: If a vertex has a joint that the skin does not have.
    """
    vertex_rows = np.arange(len(weights))[:, None]
    for name in attributes:
        if not name.startswith(JOINTS):
            continue
        values = attributes[name.replace(JOINTS, WEIGHTS)]
        # Unsigned integers are fractions of the largest value of their type.
        largest = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1
        values = values / largest
        # If a weight is 0, the joint may be any number, so it is replaced by 0.
        joints = np.where(values == 0, 0, attributes[name])
        if joints.max() >= len(columns):
            raise ValueError(
                f"a vertex has the joint {joints.max()}, but its skin has {len(columns)} joints"
            )
        # Unlike `weights[...] += values`, np.add.at counts a repeated joint twice.
        np.add.at(weights, (vertex_rows, columns[joints]), values)


def _normalize_weights(weights: np.ndarray) -> None:
    """Divide the weights of each vertex by their sum, in place.

    Args:
        weights: Weight of each of J joints for each of V vertices, shape (V, J).

    Raises:
        ValueError: If the sum of a vertex differs from 1 by more than
            `TOLERANCE`.
    """
    sums = weights.sum(axis=1)
    deviations = np.abs(sums - 1)
    # The comparison is also False for NaN.
    if not (deviations <= TOLERANCE).all():
        worst = sums[deviations.argmax()]
        raise ValueError(f"the weights of a vertex add up to {worst:g} instead of 1")
    weights /= sums[:, None]
