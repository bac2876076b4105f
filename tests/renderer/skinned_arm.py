"""A skinned glTF file: an arm of a box with three joints, a glove that hangs on the last and a stone beside it."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

NAMES = ("shoulder", "elbow", "wrist")
# Matrices of nodes, relative to their parents: of a root, and of the joints, which are not as they were bound.
ROOT = np.block(
    [[2 * Rotation.from_rotvec([0.3, 0.2, -0.1]).as_matrix(), np.array([[0.5], [0.1], [-0.3]])], [0, 0, 0, 1]]
)
LOCAL = [np.eye(4) for _ in NAMES]
for joint, vector in enumerate(([0.1, 0, 0], [0, 0, 0.4], [0.3, 0.3, 0])):
    LOCAL[joint][:3, :3], LOCAL[joint][1, 3] = Rotation.from_rotvec(vector).as_matrix(), float(joint > 0)
BIND = np.eye(4)[None].repeat(3, axis=0)
BIND[:, 1, 3] = -np.arange(3)  # the joints are bound at heights of 0, 1 and 2


def box(low: list[float], high: list[float], divisions: int) -> trimesh.Trimesh:
    shape = trimesh.creation.box(bounds=[low, high])
    for _ in range(divisions):
        shape = shape.subdivide()
    return shape


ARM = box([-0.2, 0, -0.2], [0.2, 3, 0.2], 3)
GLOVE, STONE = box([-0.3, 0.6, -0.3], [0.3, 1.1, 0.3], 0), box([0.5, 0, 0], [0.7, 0.3, 0.4], 0)
WEIGHTS = np.stack(
    [np.interp(ARM.vertices[:, 1], [0, 0.8, 1.2, 1.8, 2.2, 3], row) for row in np.eye(3).repeat(2, 1)], 1
)


def write(path: Path, change: Callable[[dict[str, Any]], object] | None = None, **arrays: np.ndarray) -> Path:
    """The file, as its suffix says; its tree changed, or with other weights or joints."""
    buffers, accessors, views = b"", [], []

    def add(values: np.ndarray, kind: str, component: int) -> int:
        nonlocal buffers
        views.append({"buffer": 0, "byteOffset": len(buffers), "byteLength": values.nbytes})
        bounds = {"min": values.min(0).tolist(), "max": values.max(0).tolist()} if kind == "VEC3" else {}
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind, **bounds}
        )
        buffers += values.tobytes() + b"\0" * (-values.nbytes % 4)
        return len(accessors) - 1

    def part(shape: trimesh.Trimesh, **attributes: int) -> dict[str, Any]:
        position = add(shape.vertices.astype(np.float32), "VEC3", 5126)
        indices = add(shape.faces.astype(np.uint32).reshape(-1, 1), "SCALAR", 5125)
        return {"primitives": [{"attributes": {"POSITION": position, **attributes}, "indices": indices}]}

    weights = np.insert(arrays.get("weights", np.rint(255 * WEIGHTS)), 3, 0, axis=1).astype(np.uint8)
    joints = arrays.get("joints", np.tile(np.uint8([1, 2, 0, 0]), (len(weights), 1))).astype(np.uint8)
    weights, joints = add(weights, "VEC4", 5121), add(joints, "VEC4", 5121)
    accessors[weights]["normalized"] = True
    matrices = [matrix.T.ravel().tolist() for matrix in (ROOT, *LOCAL)]
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 4, 6]}],
        "nodes": [
            {"name": "root", "matrix": matrices[0], "children": [1]},
            {"name": NAMES[0], "matrix": matrices[1], "children": [2]},
            {"name": NAMES[1], "matrix": matrices[2], "children": [3]},
            {"name": NAMES[2], "matrix": matrices[3], "children": [5]},
            {"name": "arm", "mesh": 0, "skin": 0, "translation": [9, 9, 9]},  # which a skin ignores
            {"name": "glove", "mesh": 1},
            {"name": "stone", "mesh": 2},
        ],
        "meshes": [part(ARM, JOINTS_0=joints, WEIGHTS_0=weights), part(GLOVE), part(STONE)],
        "skins": [
            {"joints": [3, 1, 2], "inverseBindMatrices": add(BIND[[2, 0, 1]].swapaxes(1, 2).astype("f4"), "MAT4", 5126)}
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffers)}],
    }
    if change is not None:
        change(tree)
    if path.suffix == ".gltf":
        path.with_suffix(".bin").write_bytes(buffers)
        tree["buffers"][0]["uri"] = path.with_suffix(".bin").name
        path.write_text(json.dumps(tree))
        return path
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(buffers), b"BIN\0") + buffers
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path
