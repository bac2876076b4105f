"""A skinned glTF file for tests.

The file holds an arm with three joints, a glove that hangs on the last joint,
and a stone beside the arm.
"""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

NAMES = ("shoulder", "elbow", "wrist")
# Component types of glTF.
UINT8 = 5121
UINT32 = 5125
FLOAT32 = 5126


def affine(linear: np.ndarray, translation: list[float]) -> np.ndarray:
    """Return the matrix (4, 4) of a linear map (3, 3) and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = translation
    return matrix


def rotation(vector: list[float]) -> np.ndarray:
    """Return the matrix (3, 3) of a rotation vector."""
    return Rotation.from_rotvec(vector).as_matrix()


# Matrix of the root node. It scales by 2.
ROOT = affine(2 * rotation([0.3, 0.2, -0.1]), [0.5, 0.1, -0.3])
# Matrices of the joints relative to their parents. They differ from the pose in
# which the skin was bound.
LOCAL = [
    affine(rotation([0.1, 0, 0]), [0, 0, 0]),
    affine(rotation([0, 0, 0.4]), [0, 1, 0]),
    affine(rotation([0.3, 0.3, 0]), [0, 1, 0]),
]
# Inverse bind matrices: the joints were bound at heights of 0, 1 and 2.
BIND = np.stack([affine(np.eye(3), [0, -height, 0]) for height in range(3)])


def box(low: list[float], high: list[float], divisions: int) -> trimesh.Trimesh:
    """Create a box between two corners whose faces are divided several times."""
    shape = trimesh.creation.box(bounds=[low, high])
    for _ in range(divisions):
        shape = shape.subdivide()
    return shape


ARM = box([-0.2, 0, -0.2], [0.2, 3, 0.2], 3)
GLOVE = box([-0.3, 0.6, -0.3], [0.3, 1.1, 0.3], 0)
STONE = box([0.5, 0, 0], [0.7, 0.3, 0.4], 0)


def joint_weights() -> np.ndarray:
    """Return the weights (V, 3) of the joints at the vertices of the arm.

    Near the heights of 1 and 2 the arm passes from one joint to the next.
    """
    heights = [0, 0.8, 1.2, 1.8, 2.2, 3]
    joint_at_height = np.eye(3).repeat(2, axis=1)
    rows = [np.interp(ARM.vertices[:, 1], heights, row) for row in joint_at_height]
    return np.stack(rows, axis=1)


WEIGHTS = joint_weights()


class GltfArrays:
    """Buffer of a glTF file and the entries that describe its arrays."""

    def __init__(self) -> None:
        self.buffer = b""
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, int]] = []

    def add(self, values: np.ndarray, kind: str, component_type: int) -> int:
        """Append an array, and return the index of its accessor."""
        view = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": values.nbytes}
        accessor = {
            "bufferView": len(self.views),
            "componentType": component_type,
            "count": len(values),
            "type": kind,
        }
        if kind == "VEC3":
            accessor["min"] = values.min(0).tolist()
            accessor["max"] = values.max(0).tolist()
        self.views.append(view)
        self.accessors.append(accessor)
        # glTF aligns arrays to four bytes.
        padding = b"\0" * (-values.nbytes % 4)
        self.buffer += values.tobytes() + padding
        return len(self.accessors) - 1

    def add_shape(self, shape: trimesh.Trimesh, **attributes: int) -> dict[str, Any]:
        """Append a shape, and return its entry in the list of meshes."""
        position = self.add(shape.vertices.astype(np.float32), "VEC3", FLOAT32)
        indices = self.add(shape.faces.astype(np.uint32).reshape(-1, 1), "SCALAR", UINT32)
        all_attributes = {"POSITION": position, **attributes}
        return {"primitives": [{"attributes": all_attributes, "indices": indices}]}


def write(
    path: Path,
    change: Callable[[dict[str, Any]], object] | None = None,
    weights: np.ndarray | None = None,
    joints: np.ndarray | None = None,
) -> Path:
    """Write the file as .glb or .gltf, and return its path.

    `change` changes the JSON tree before. Weights (V, 3) are from 0 to 255.
    """
    arrays = GltfArrays()
    tree = _tree(arrays, weights, joints)
    if change is not None:
        change(tree)
    if path.suffix == ".gltf":
        buffer_path = path.with_suffix(".bin")
        buffer_path.write_bytes(arrays.buffer)
        tree["buffers"][0]["uri"] = buffer_path.name
        path.write_text(json.dumps(tree))
    else:
        path.write_bytes(_glb(tree, arrays.buffer))
    return path


def _tree(
    arrays: GltfArrays, weights: np.ndarray | None, joints: np.ndarray | None
) -> dict[str, Any]:
    """Build the JSON tree, and fill its arrays."""
    if weights is None:
        weights = np.rint(255 * WEIGHTS)
    # The skin lists the joints in the order 2, 0, 1. Three joints leave a fourth
    # column of zeros.
    if joints is None:
        joints = np.tile(np.uint8([1, 2, 0, 0]), (len(weights), 1))
    weights = np.insert(weights, 3, 0, axis=1).astype(np.uint8)
    inverse_bind = BIND[[2, 0, 1]].swapaxes(1, 2).astype(np.float32)
    weights_id = arrays.add(weights, "VEC4", UINT8)
    arrays.accessors[weights_id]["normalized"] = True
    joints_id = arrays.add(joints.astype(np.uint8), "VEC4", UINT8)
    arm = arrays.add_shape(ARM, JOINTS_0=joints_id, WEIGHTS_0=weights_id)
    glove = arrays.add_shape(GLOVE)
    stone = arrays.add_shape(STONE)
    skin = {"joints": [3, 1, 2], "inverseBindMatrices": arrays.add(inverse_bind, "MAT4", FLOAT32)}
    # glTF stores matrices by columns.
    root, shoulder, elbow, wrist = (matrix.T.ravel().tolist() for matrix in (ROOT, *LOCAL))
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 4, 6]}],
        "nodes": [
            {"name": "root", "matrix": root, "children": [1]},
            {"name": NAMES[0], "matrix": shoulder, "children": [2]},
            {"name": NAMES[1], "matrix": elbow, "children": [3]},
            {"name": NAMES[2], "matrix": wrist, "children": [5]},
            # A reader ignores the translation of a skinned node.
            {"name": "arm", "mesh": 0, "skin": 0, "translation": [9, 9, 9]},
            {"name": "glove", "mesh": 1},
            {"name": "stone", "mesh": 2},
        ],
        "meshes": [arm, glove, stone],
        "skins": [skin],
        "accessors": arrays.accessors,
        "bufferViews": arrays.views,
        "buffers": [{"byteLength": len(arrays.buffer)}],
    }


def _glb(tree: dict[str, Any], buffer: bytes) -> bytes:
    """Encode a tree and its buffer as the chunks of a .glb file."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    json_chunk = struct.pack("<I4s", len(text), b"JSON") + text
    buffer_chunk = struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    chunks = json_chunk + buffer_chunk
    header = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks))
    return header + chunks
