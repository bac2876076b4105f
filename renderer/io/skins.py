"""Read the skins (joints and weights) of glTF files (sections 3.7.3 and 5.28 of glTF 2.0).

trimesh does not read skins, but it reads all vertex attributes whose names begin
with an underscore. `with_skins_as_attributes` copies the skins of a file to such
attributes before trimesh reads the file. `skinned` reads the attributes
afterwards.

Morph targets and animations are ignored. The joints have the pose that the nodes
of the file have.

A part is a mesh with one material, of which a file may hold several (a primitive
of glTF). Shapes use these letters: a part has V vertices, and all skins of the
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

# Name of the vertex attribute to which the inverse bind
# matrices of a glTF skin are copied. An inverse bind
# matrix maps vertices of the mesh to the axes of a joint.
BIND = "_BIND"
# Beginning of the names of the vertex attributes to which
# joints are copied. A number follows, as in _JOINTS_0,
# because each attribute holds four joints per vertex.
JOINTS = "_JOINTS_"
# Beginning of the names of the vertex attributes
# to which weights of joints are copied.
WEIGHTS = "_WEIGHTS_"
# Beginnings of the names of vertex attributes
# in glTF that hold joints or their weights.
JOINTS_OR_WEIGHTS = ("JOINTS", "WEIGHTS")
# The weights of the joints of a vertex should add up to 1. Their sum may
# differ from 1 by at most this much, because weights with 8 bits are rounded.
MAX_WEIGHT_ERROR = 0.01
# Number that marks the JSON chunk of a .glb file: the letters "JSON".
JSON_CHUNK = 0x4E4F534A
# Number of bytes before the JSON text of a .glb file: 12 of
# the file header, and 8 of the header of the JSON chunk.
GLB_HEADER_BYTES = 20


def with_skins_as_attributes(content: bytes, tree: dict[str, Any]) -> bytes:
    """Copy the skins in a .gltf or .glb file to vertex attributes that trimesh reads.

    trimesh reads only the vertex attributes whose names begin with an underscore.
    Each node of the file gets its number as a name, by which `skinned` finds it.

    Args:
        content: Content of the file.
        tree: JSON object of the file, with skins. It is not changed.

    Returns:
        Content of a file in the same format with the new attributes and names.

    Raises:
        ValueError: If a mesh has two skins, or a skin but no weights.
    """
    tree = deepcopy(tree)
    for number, node in enumerate(tree["nodes"]):
        node["name"] = str(number)
        if "skin" in node:
            _copy_skin(tree["meshes"][node["mesh"]], node["skin"], tree["skins"])
    text = json.dumps(tree).encode()
    is_glb = content.startswith(b"glTF")
    return _glb_with_json(content, text) if is_glb else text


def _glb_with_json(content: bytes, text: bytes) -> bytes:
    """Replace the JSON text of a .glb file.

    A .glb file consists of a header of 12 bytes and of chunks. The first chunk is
    the JSON text, with a header of 8 bytes.

    Args:
        content: Content of the .glb file.
        text: New JSON text.

    Returns:
        Content of the new .glb file.
    """
    # The length of the JSON chunk of a .glb file must be a multiple of 4 bytes.
    text += b" " * (-len(text) % 4)
    # The first 4 bytes of the file are "glTF". Then come the version,
    # the length of the file, and the length of the JSON text.
    version, _, old_json_length = struct.unpack_from("<III", content, 4)
    other_chunks = content[GLB_HEADER_BYTES + old_json_length :]
    total_length = GLB_HEADER_BYTES + len(text) + len(other_chunks)
    header = struct.pack("<4sIIII", b"glTF", version, total_length, len(text), JSON_CHUNK)
    return header + text + other_chunks


def _copy_skin(mesh: dict[str, Any], skin: int, skins: list[dict[str, Any]]) -> None:
    """Copy the skin of a glTF mesh to vertex attributes whose names begin with an underscore.

    The skin consists of joints, weights and inverse bind matrices.

    Args:
        mesh: Mesh in the JSON object of a file, changed in place.
        skin: Index of the skin of the mesh.
        skins: All skins of the file.

    Raises:
        ValueError: If the mesh already has another skin, or if it has no weights.
    """
    # Two nodes of a file may show the same mesh with different skins. The mesh
    # therefore remembers the skin of the first node in its entry "extras".
    known_skin = mesh.setdefault("extras", {}).setdefault("skin", skin)
    if known_skin != skin:
        raise ValueError("a mesh has two skins, which is not supported")
    bind_matrices = skins[skin].get("inverseBindMatrices")
    for primitive in mesh["primitives"]:
        attributes = primitive["attributes"]
        if not {"JOINTS_0", "WEIGHTS_0"} <= attributes.keys():
            raise ValueError("a mesh with a skin has no joints and weights (JOINTS_0, WEIGHTS_0)")
        for name in list(attributes):
            if name.startswith(JOINTS_OR_WEIGHTS):
                attributes[f"_{name}"] = attributes[name]
        if bind_matrices is not None:
            attributes[BIND] = bind_matrices


def skinned(part: Mesh, node: str, scene: trimesh.Scene, tree: dict[str, Any]) -> Mesh:
    """Move the vertices of a part by the joints of its file, and add the joints to the part.

    The weights of a part with a skin say how much each joint moves each vertex.
    A part without a skin moves with the nearest joint above its node in the
    scene, if there is one.

    Args:
        part: Mesh with one material, as trimesh read it, with V vertices.
        node: Name of the node that shows the part.
        scene: Scene that trimesh read from a file that `with_skins_as_attributes`
            returned.
        tree: JSON object of the original file.

    Returns:
        Part in the coordinates of the scene, with the J joints of the file.

    Raises:
        ValueError: If weights do not add up to 1, or if a joint does not exist.
    """
    skeleton = _Skeleton(tree, scene)
    node_number = int(node.split("_")[0])
    node_matrix, geometry_name = scene.graph[node]
    joint_count = len(skeleton.joints)
    # Weight with which each joint moves each vertex.
    weights = np.zeros((len(part.vertices), joint_count))
    # Matrix of each joint that maps a vertex of the part to the position in the
    # scene to which this joint alone would move the vertex, shape (J, 4, 4).
    matrices = node_matrix[None].repeat(joint_count, axis=0)
    joints_above = skeleton.joints_from(node_number)
    if "skin" in tree["nodes"][node_number]:
        skin = tree["skins"][tree["nodes"][node_number]["skin"]]
        # Index of each joint of this skin among the J joints of the file.
        joint_indices = np.array([skeleton.index_of[joint] for joint in skin["joints"]])
        attributes = scene.geometry[geometry_name].vertex_attributes
        # glTF stores matrices column by column, so they are transposed.
        bind = attributes[BIND].swapaxes(1, 2) if BIND in attributes else np.eye(4)
        skin_matrices = skeleton.poses[joint_indices] @ bind
        matrices[joint_indices] = skin_matrices
        node_matrix = skin_matrices[0]
        _add_weights(weights, attributes, joint_indices)
        _normalize_weights(weights)
    elif joints_above:
        weights[:, skeleton.index_of[joints_above[0]]] = 1
    return _with_joints(part, node_matrix, skeleton, matrices, weights)


def _with_joints(
    part: Mesh,
    node_matrix: np.ndarray,
    skeleton: "_Skeleton",
    matrices: np.ndarray,
    weights: np.ndarray,
) -> Mesh:
    """Place a part in its scene, and add joints that move its V vertices.

    Args:
        part: Mesh with one material in its own coordinates.
        node_matrix: Affine matrix that places the part in the scene if no joint
            moves it, shape (4, 4). It also decides whether the part is mirrored.
        skeleton: The J joints of the file.
        matrices: For each joint, the matrix that maps a vertex of the part to the
            position in the scene to which this joint alone would move the vertex,
            shape (J, 4, 4).
        weights: Weight with which each joint moves each vertex, shape (V, J).

    Returns:
        Part in the coordinates of the scene, with its joints.
    """
    # Vertex positions (x, y, z, 1), shape (V, 4).
    homogeneous = np.insert(part.vertices, 3, 1, axis=1)
    # Position (x, y, z, 1) of each vertex if
    # each joint alone moved it, shape (V, J, 4).
    moved = np.einsum("jab,vb->vja", matrices, homogeneous)
    carried = (moved * weights[..., None]).astype(np.float32)
    placed = transformed(part, node_matrix)
    if weights.any():
        placed = replace(placed, vertices=carried[..., :3].sum(axis=1, dtype=np.float64))
    skin = Skin(
        names=skeleton.names,
        parents=skeleton.parents,
        pivots=skeleton.poses[:, :3, 3],
        carried=carried,
    )
    return replace(placed, skin=skin)


class _Skeleton:
    """The J joints of all skins of a glTF file.

    Attributes:
        joints: Node number of each joint. Parents come before their children.
        index_of: Index in `joints` of each joint, by the node number of the joint.
        names: Names of the joints.
        parents: Index in `joints` of the parent of each joint, shape (J,). -1 for
            a joint without a parent.
        poses: Matrix from the axes of each joint to scene coordinates,
            shape (J, 4, 4).

    Args:
        tree: JSON object of the file.
        scene: Scene that trimesh read from the file.
    """

    def __init__(self, tree: dict[str, Any], scene: trimesh.Scene) -> None:
        """Collect the joints of all skins of a file, parents before their children."""
        nodes = tree["nodes"]
        self._joint_nodes = {joint for skin in tree["skins"] for joint in skin["joints"]}
        self._parent_node = {}
        for parent, item in enumerate(nodes):
            for child in item.get("children", []):
                self._parent_node[child] = parent
        # A child has more joints above it than
        # its parent, so parents come first.
        self.joints = sorted(
            self._joint_nodes, key=lambda joint: (len(self.joints_from(joint)), joint)
        )
        self.index_of = {joint: index for index, joint in enumerate(self.joints)}
        self.names = tuple(str(nodes[joint].get("name", joint)) for joint in self.joints)
        self.parents = np.array([self._parent_index(joint) for joint in self.joints])
        self.poses = np.stack([scene.graph[str(joint)][0] for joint in self.joints])

    def joints_from(self, node: int) -> list[int]:
        """List the joints on the path from a node up to the root of the scene.

        The node itself is included if it is a joint.

        Args:
            node: Number of the node.

        Returns:
            Node numbers of the joints, the nearest joint first.
        """
        joints_above = []
        if node in self._parent_node:
            joints_above = self.joints_from(self._parent_node[node])
        return [node, *joints_above] if node in self._joint_nodes else joints_above

    def _parent_index(self, joint: int) -> int:
        """Find the parent of a joint: the nearest joint above it in the scene.

        Args:
            joint: Node number of the joint.

        Returns:
            Index of the parent in `joints`, or -1 for a joint without a parent.
        """
        ancestors = self.joints_from(joint)[1:]
        return self.index_of[ancestors[0]] if ancestors else -1


def _add_weights(
    weights: np.ndarray, attributes: dict[str, Any], joint_indices: np.ndarray
) -> None:
    """Add the weights of one skin to an array with the weights of all joints of the file.

    Args:
        weights: Weight with which each of J joints moves each of V vertices,
            shape (V, J). It is changed in place.
        attributes: Vertex attributes with joints and weights. An attribute holds
            four joints, or four weights, for each vertex, shape (V, 4).
        joint_indices: For each joint of the skin, its index among the J joints.

    Raises:
        ValueError: If a vertex has a joint that the skin does not have.
    """
    vertex_rows = np.arange(len(weights))[:, None]
    for name in attributes:
        if not name.startswith(JOINTS):
            continue
        values = attributes[name.replace(JOINTS, WEIGHTS)]
        # The largest value of an unsigned integer
        # type stands for the weight 1 in glTF.
        largest = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1
        values = values / largest
        # A joint with the weight 0 may be any
        # number, so it is replaced by joint 0.
        joints = np.where(values == 0, 0, attributes[name])
        if joints.max() >= len(joint_indices):
            raise ValueError(
                f"a vertex has the joint {joints.max()}, but its skin has {len(joint_indices)} "
                "joints"
            )
        # A vertex may have the same joint twice. `weights[...]
        # += values` would then add only one of both weights.
        np.add.at(weights, (vertex_rows, joint_indices[joints]), values)


def _normalize_weights(weights: np.ndarray) -> None:
    """Divide the weights of each vertex by their sum, in place.

    Args:
        weights: Weight with which each of J joints moves each of V vertices,
            shape (V, J).

    Raises:
        ValueError: If the weights of a vertex do not add up to about 1.
    """
    sums = weights.sum(axis=1)
    deviations = np.abs(sums - 1)
    # A comparison with NaN is False, so `not` also finds NaN.
    if not (deviations <= MAX_WEIGHT_ERROR).all():
        worst = sums[deviations.argmax()]
        raise ValueError(f"the weights of a vertex add up to {worst:g} instead of 1")
    weights /= sums[:, None]
