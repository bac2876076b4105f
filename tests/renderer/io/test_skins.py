"""The pose of skinned glTF files, compared with the formula of glTF.

The file has an arm with three joints, a glove that hangs on the last joint, and a stone.
"""

from typing import Any

import numpy as np
import pytest
import trimesh
from gltf_files import Gltf
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import renderer
from renderer.errors import InputError


def affine(linear: np.ndarray, translation: list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = translation
    return matrix


def rotation(vector: list[float]) -> np.ndarray:
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


def arm_file(weights: np.ndarray | None = None, joints: Any = (1, 2, 0, 0)) -> Gltf:
    """Return the file. Weights (V, 3) are from 0 to 255.

    The skin lists the joints in the order 2, 0, 1. Three joints leave a fourth
    column of zeros.
    """
    gltf = Gltf()
    rows = np.insert(np.rint(255 * WEIGHTS) if weights is None else weights, 3, 0, axis=1)
    skinned = {
        "JOINTS_0": np.tile(np.uint8(joints), (len(rows), 1)),
        "WEIGHTS_0": gltf.array(rows.astype(np.uint8), normalized=True),
    }
    for shape, attributes in ((ARM, skinned), (GLOVE, {}), (STONE, {})):
        positions = shape.vertices.astype(np.float32)
        gltf.mesh({"POSITION": positions, **attributes}, shape.faces.astype(np.uint32).ravel())
    # glTF stores matrices by columns.
    inverse_bind = gltf.array(BIND[[2, 0, 1]].swapaxes(1, 2).astype(np.float32))
    gltf.tree["skins"] = [{"joints": [3, 1, 2], "inverseBindMatrices": inverse_bind}]
    root, shoulder, elbow, wrist = (matrix.T.ravel().tolist() for matrix in (ROOT, *LOCAL))
    gltf.tree["scenes"] = [{"nodes": [0, 4, 6]}]
    gltf.tree["nodes"] = [
        {"matrix": root, "children": [1]},
        {"matrix": shoulder, "children": [2]},
        {"matrix": elbow, "children": [3]},
        {"matrix": wrist, "children": [5]},
        # A reader ignores the translation of a skinned node.
        {"mesh": 0, "skin": 0, "translation": [9, 9, 9]},
        {"mesh": 1},
        {"mesh": 2},
    ]
    return gltf


def transform(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def corners_by_gltf() -> np.ndarray:
    """Compute the corners (F, 3, 3) of the arm, the glove and the stone by the formula of glTF."""
    weights = np.rint(255 * WEIGHTS)
    weights /= weights.sum(1, keepdims=True)
    pose = ROOT
    arm = np.zeros((len(ARM.vertices), 3))
    for joint in range(3):
        pose = pose @ LOCAL[joint]
        arm += weights[:, [joint]] * transform(ARM.vertices, pose @ BIND[joint])
    # The glove hangs on the last joint, and the stone on no joint.
    glove = transform(GLOVE.vertices, pose)
    return np.concatenate([arm[ARM.faces], glove[GLOVE.faces], STONE.vertices[STONE.faces]])


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
def test_vertices_are_those_of_the_formula_of_gltf(tmp_path, suffix):
    mesh = renderer.load_mesh(arm_file().write(tmp_path / f"arm.{suffix}"), up="z")
    expected = corners_by_gltf().reshape(-1, 9)
    # The parts may have another order.
    distances, nearest = KDTree(expected).query(mesh.vertices[mesh.faces].reshape(-1, 9))
    assert distances.max() < 1e-5
    assert len(set(nearest)) == len(expected)


@pytest.mark.parametrize(
    ("change", "arrays"),
    [
        (lambda tree: tree["meshes"][0]["primitives"][0]["attributes"].pop("WEIGHTS_0"), {}),
        (None, {"weights": 0.5 * np.rint(255 * WEIGHTS)}),
        (None, {"joints": (7, 7, 7, 7)}),
        (lambda tree: tree["skins"][0].update(joints=[1, 2, 70]), {}),
        (lambda tree: tree["skins"][0].update(joints=[1, 2]), {}),
        (lambda tree: tree["skins"].clear(), {}),
    ],
    ids=[
        "no weights",
        "half weights",
        "joint out of range",
        "missing node",
        "two of three joints",
        "no skin",
    ],
)
def test_a_damaged_skin_is_refused_by_the_name_of_the_file(tmp_path, change, arrays):
    gltf = arm_file(**arrays)
    if change:
        change(gltf.tree)
    with pytest.raises(InputError, match=r"arm\.glb"):
        renderer.load_mesh(gltf.write(tmp_path / "arm.glb"))
