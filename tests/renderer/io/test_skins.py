"""Joints of glTF files, compared with the formula of glTF and with rotations in closed form."""

import numpy as np
import pytest
import skinned_arm
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from skinned_arm import ARM, BIND, GLOVE, LOCAL, ROOT, STONE, WEIGHTS

import renderer
from renderer.errors import InputError
from renderer.mesh import Y_UP_TO_Z_UP, concatenate
from renderer.vectors import rotation_matrices

# Rotation vectors of the three joints.
VECTORS = torch.tensor(
    [[0.3, -0.2, 0.5], [-0.9, 0.4, 0.1], [0.2, 0.8, -0.3]],
    dtype=torch.float64,
)
# The root node of the file scales by this.
ROOT_SCALE = 2


def transform(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Apply an affine matrix (4, 4) to points (V, 3)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def corners_by_gltf(vectors: np.ndarray) -> np.ndarray:
    """Compute the face corners of the posed file by the formula of glTF.

    Args:
        vectors: Rotation vector of each joint in the axes of the file,
            shape (3, 3).

    Returns:
        Corners of the arm, the glove and the stone, shape (F, 3, 3).
    """
    weights = np.rint(255 * WEIGHTS)
    weights /= weights.sum(1, keepdims=True)
    at_rest = ROOT
    posed = ROOT
    arm = np.zeros((len(ARM.vertices), 3))
    for joint, vector in enumerate(vectors):
        at_rest = at_rest @ LOCAL[joint]
        joint_axes = at_rest[:3, :3] / ROOT_SCALE
        rotation = np.eye(4)
        rotation[:3, :3] = joint_axes.T @ Rotation.from_rotvec(vector).as_matrix() @ joint_axes
        posed = posed @ LOCAL[joint] @ rotation
        arm += weights[:, [joint]] * transform(ARM.vertices, posed @ BIND[joint])
    # The glove hangs on the last joint, and the stone on no joint.
    glove = transform(GLOVE.vertices, posed)
    return np.concatenate(
        [
            arm[ARM.faces],
            glove[GLOVE.faces],
            STONE.vertices[STONE.faces],
        ]
    )


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
@pytest.mark.parametrize("vectors", [0 * VECTORS, VECTORS], ids=["rest", "posed"])
def test_vertices_are_those_of_the_formula_of_gltf(tmp_path, suffix, vectors):
    mesh = renderer.load_mesh(skinned_arm.write(tmp_path / f"arm.{suffix}"), up="z")
    moved = mesh.vertices + mesh.skin.displacements(rotation_matrices(vectors.rad2deg())).numpy()
    expected = corners_by_gltf(vectors.numpy()).reshape(-1, 9)
    # The parts may have another order.
    distances, nearest = KDTree(expected).query(moved[mesh.faces].reshape(-1, 9))
    assert distances.max() < 1e-5
    assert len(set(nearest)) == len(expected)


def test_a_skinned_file_keeps_the_names_of_its_joints_and_its_vertices(
    tmp_path,
):
    mesh = renderer.load_mesh(skinned_arm.write(tmp_path / "arm.glb"))
    assert mesh.skin.names == skinned_arm.NAMES
    assert len(mesh.vertices) == sum(len(part.vertices) for part in (ARM, GLOVE, STONE))


def test_the_first_joint_turns_all_that_it_carries_in_a_mesh_that_was_changed(
    tmp_path,
):
    """The mesh was turned up, divided, normalized and joined with another mesh.

    The first joint carries everything except the stone and the other mesh.
    """
    original = renderer.load_mesh(skinned_arm.write(tmp_path / "arm.glb"))
    changed = renderer.normalize(renderer.subdivide(original, 1000))
    mesh = concatenate([changed, renderer.solid("table")])
    scale = np.ptp(changed.vertices[:, 0]) / np.ptp(original.vertices[:, 0])
    original_pivot = (Y_UP_TO_Z_UP @ ROOT @ LOCAL[0])[:3, 3]
    pivot = scale * (original_pivot - original.vertices[0]) + changed.vertices[0]

    rotation = Rotation.from_rotvec([0.4, 0.7, -0.2])
    identity = torch.eye(3, dtype=torch.float64)
    matrices = torch.stack([torch.from_numpy(rotation.as_matrix()), identity, identity])
    moved = mesh.vertices + mesh.skin.displacements(matrices).numpy()
    expected = rotation.apply(mesh.vertices - pivot) + pivot

    is_carried = mesh.skin.carried[:, :, 3].any(axis=1)
    assert 0 < (~is_carried).sum() < is_carried.sum()
    # Skins have float32 precision.
    assert_allclose(moved[is_carried], expected[is_carried], rtol=0, atol=3e-6)
    assert_array_equal(moved[~is_carried], mesh.vertices[~is_carried])


def test_gradients_by_the_rotations_are_finite_differences(tmp_path):
    skin = renderer.load_mesh(skinned_arm.write(tmp_path / "arm.glb")).skin
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(len(skin.carried), 3)))

    def weighted_sum(vectors: torch.Tensor) -> torch.Tensor:
        return (weights * skin.displacements(rotation_matrices(vectors))).sum()

    assert torch.autograd.gradcheck(weighted_sum, VECTORS.clone().requires_grad_())


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
    ids=[
        "no weights",
        "half weights",
        "joint out of range",
        "missing node",
        "no skin",
    ],
)
def test_a_damaged_skin_is_refused_by_the_name_of_the_file(tmp_path, change, arrays):
    path = skinned_arm.write(tmp_path / "arm.glb", change, **arrays)
    with pytest.raises(InputError, match=r"arm\.glb"):
        renderer.load_mesh(path)
