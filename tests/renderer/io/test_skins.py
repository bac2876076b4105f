"""Joints of glTF files: against glTF's own formula, in closed form, and refused where they are damaged."""

import numpy as np
import pytest
import skinned_arm
import torch
from numpy.testing import assert_allclose
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from skinned_arm import ARM, BIND, GLOVE, LOCAL, ROOT, STONE, WEIGHTS

import renderer
from renderer.errors import InputError
from renderer.mesh import Y_UP_TO_Z_UP, concatenate
from renderer.vectors import rotation_matrices

FLOAT32 = dict(rtol=0, atol=3e-6)
VECTORS = torch.tensor([[0.3, -0.2, 0.5], [-0.9, 0.4, 0.1], [0.2, 0.8, -0.3]], dtype=torch.float64)


def by_gltf(vectors: np.ndarray) -> np.ndarray:
    """(F, 3, 3) the corners in the file's axes, of nodes turned by rotation vectors (3, 3) about those axes."""
    weights = np.rint(255 * WEIGHTS)
    weights /= weights.sum(1, keepdims=True)
    at_rest, above, skinned, hung = ROOT, ROOT, np.zeros((len(ARM.vertices), 3)), None
    for joint, vector in enumerate(vectors):
        at_rest = at_rest @ LOCAL[joint]
        axes, turn = at_rest[:3, :3] / 2, np.eye(4)  # the root scales by 2
        turn[:3, :3] = axes.T @ Rotation.from_rotvec(vector).as_matrix() @ axes
        above = above @ LOCAL[joint] @ turn
        matrix = above @ BIND[joint]
        skinned += weights[:, [joint]] * (ARM.vertices @ matrix[:3, :3].T + matrix[:3, 3])
        hung = GLOVE.vertices @ above[:3, :3].T + above[:3, 3]
    parts = (skinned, ARM), (hung, GLOVE), (STONE.vertices, STONE)
    return np.concatenate([vertices[shape.faces] for vertices, shape in parts])


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
@pytest.mark.parametrize("vectors", [0 * VECTORS, VECTORS], ids=["rest", "posed"])
def test_vertices_are_those_of_gltfs_formula(tmp_path, suffix, vectors):
    mesh = renderer.load_mesh(skinned_arm.write(tmp_path / f"arm.{suffix}"), up="z")
    assert mesh.skin.names == skinned_arm.NAMES
    moved = mesh.vertices + mesh.skin.displacements(rotation_matrices(vectors)).numpy()
    expected = by_gltf(vectors.numpy()).reshape(-1, 9)  # parts may come in another order
    distances, nearest = KDTree(expected).query(moved[mesh.faces].reshape(-1, 9))
    assert distances.max() < 1e-5 and len(set(nearest)) == len(expected)
    assert len(mesh.vertices) == sum(len(shape.vertices) for shape in (ARM, GLOVE, STONE))  # none came apart


def test_what_the_first_joint_carries_turns_about_it_as_a_whole_whatever_became_of_the_mesh(tmp_path):
    """All but the stone: turned up, divided, normalized and beside another mesh."""
    whole = renderer.load_mesh(skinned_arm.write(tmp_path / "arm.glb"))
    alone = renderer.normalize(renderer.subdivide(whole, 1000))
    mesh, scale = (
        concatenate([alone, renderer.solid("table")]),
        np.ptp(alone.vertices[:, 0]) / np.ptp(whole.vertices[:, 0]),
    )
    pivot = scale * ((Y_UP_TO_Z_UP @ ROOT @ LOCAL[0])[:3, 3] - whole.vertices[0]) + alone.vertices[0]
    turn = Rotation.from_rotvec([0.4, 0.7, -0.2])
    matrices = torch.stack([torch.from_numpy(turn.as_matrix()), *torch.eye(3).double().expand(2, 3, 3)])
    moved = mesh.vertices + mesh.skin.displacements(matrices).numpy()
    carried = mesh.skin.carried[:, :, 3].any(axis=1)
    assert_allclose(moved[carried], (turn.apply(mesh.vertices - pivot) + pivot)[carried], **FLOAT32)
    assert (moved[~carried] == mesh.vertices[~carried]).all() and 0 < (~carried).sum() < carried.sum()


def test_gradients_by_the_rotations_are_finite_differences(tmp_path):
    skin = renderer.load_mesh(skinned_arm.write(tmp_path / "arm.glb")).skin
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(len(skin.carried), 3)))
    assert torch.autograd.gradcheck(
        lambda vectors: (weights * skin.displacements(rotation_matrices(vectors))).sum(), VECTORS.requires_grad_()
    )


@pytest.mark.parametrize(
    ("change", "arrays", "message"),
    [
        (lambda tree: tree["meshes"][0]["primitives"][0]["attributes"].pop("WEIGHTS_0"), {}, "no joints and weights"),
        (None, {"weights": 0.5 * np.rint(255 * WEIGHTS)}, "add up to 0.49.* instead of 1"),
        (None, {"joints": np.full((len(WEIGHTS), 4), 7)}, "joint 7, but its skin has 3"),
        (lambda tree: tree["skins"][0].update(joints=[1, 2, 70]), {}, "cannot be read as a mesh"),
        (lambda tree: tree["skins"].clear(), {}, "cannot be read as a mesh"),
    ],
)
def test_a_damaged_skin_is_refused_in_one_sentence_that_names_the_file(tmp_path, change, arrays, message):
    with pytest.raises(InputError, match=f"arm.glb.*{message}") as refused:
        renderer.load_mesh(skinned_arm.write(tmp_path / "arm.glb", change, **arrays))
    assert "\n" not in str(refused.value)
