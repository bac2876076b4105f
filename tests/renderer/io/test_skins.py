"""The pose of skinned glTF files, compared with the formula of glTF."""

import numpy as np
import pytest
import skinned_arm
from scipy.spatial import KDTree
from skinned_arm import ARM, BIND, GLOVE, LOCAL, ROOT, STONE, WEIGHTS

import renderer
from renderer.errors import InputError


def transform(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Apply an affine matrix (4, 4) to points (V, 3)."""
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
    mesh = renderer.load_mesh(skinned_arm.write(tmp_path / f"arm.{suffix}"), up="z")
    expected = corners_by_gltf().reshape(-1, 9)
    # The parts may have another order.
    distances, nearest = KDTree(expected).query(mesh.vertices[mesh.faces].reshape(-1, 9))
    assert distances.max() < 1e-5
    assert len(set(nearest)) == len(expected)


def remove_weights(tree: dict) -> None:
    """Remove the weights of the arm from a glTF tree."""
    tree["meshes"][0]["primitives"][0]["attributes"].pop("WEIGHTS_0")


@pytest.mark.parametrize(
    ("change", "arrays"),
    [
        (remove_weights, {}),
        (None, {"weights": 0.5 * np.rint(255 * WEIGHTS)}),
        (None, {"joints": np.full((len(WEIGHTS), 4), 7)}),
        (lambda tree: tree["skins"][0].update(joints=[1, 2, 70]), {}),
        (lambda tree: tree["skins"].clear(), {}),
    ],
    ids=["no weights", "half weights", "joint out of range", "missing node", "no skin"],
)
def test_a_damaged_skin_is_refused_by_the_name_of_the_file(tmp_path, change, arrays):
    path = skinned_arm.write(tmp_path / "arm.glb", change, **arrays)
    with pytest.raises(InputError, match=r"arm\.glb"):
        renderer.load_mesh(path)
