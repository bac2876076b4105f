"""Normals and their derivatives, against exact arithmetic and central differences."""

from fractions import Fraction
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import example, given
from hypothesis import strategies as st
from oracles import draw
from scipy.spatial.transform import Rotation
from torch.autograd.functional import jacobian

from renderer.mesh import Mesh
from renderer.normals import face_normals, vertex_normals

EPS = torch.finfo(torch.float64).eps
EPS32 = torch.finfo(torch.float32).eps
ONE_FACE = torch.tensor([[0, 1, 2]])
both_functions = pytest.mark.parametrize("function", [face_normals, vertex_normals])


def dented(shape: trimesh.Trimesh) -> tuple[torch.Tensor, torch.Tensor]:
    dents = np.random.default_rng(0).normal(scale=0.1, size=shape.vertices.shape)
    return torch.from_numpy(shape.vertices + dents), torch.from_numpy(shape.faces)


def torus() -> trimesh.Trimesh:
    return trimesh.creation.torus(1, 0.3, 6, 5)


@both_functions
@pytest.mark.parametrize("shape", [trimesh.creation.icosahedron, torus])
def test_derivatives_on_a_mesh_are_central_differences(function, shape):
    vertices, faces = dented(shape())
    vertices.requires_grad_()
    normals = partial(function, faces=faces)
    assert torch.autograd.gradcheck(normals, vertices, fast_mode=True)


def exact_normal(corners: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Compute the normal of a triangle and its derivative (3, 3 corners, 3) in exact arithmetic.

    If a corner moves by dv, the cross product of the edges moves by e × dv, with the opposite edge
    e. The normal moves by the tangential part of it, divided by the length of the cross product.
    """
    a, b, c = np.frompyfunc(Fraction, 1, 1)(corners.double().numpy())
    opposite_edges = np.stack([c - b, a - c, b - a])
    cross = np.cross(opposite_edges[2], -opposite_edges[1])
    # Division by the largest component keeps tiny areas in the range of float64.
    largest = max(abs(cross))
    if not largest:
        return np.zeros(3), np.zeros((3, 3, 3))
    direction = (cross / largest).astype(np.float64)
    length = np.linalg.norm(direction)
    normal = direction / length
    edges = opposite_edges.astype(np.float64)
    by_corner = np.stack([np.cross(edge, np.eye(3)).T for edge in edges], axis=1)
    tangential = np.eye(3) - np.outer(normal, normal)
    slopes = np.einsum("ad,dcb->acb", tangential, by_corner) / (length * float(largest))
    return normal, slopes


def sliver(height: float, edge: float, seed: int) -> torch.Tensor:
    """Return a rotated triangle, of a height relative to its longest edge, of order 1."""
    corners = edge * np.array([[-0.6, 0, 0], [0.7, 0, 0], [0.1, height, 0]])
    rng = np.random.default_rng(seed)
    rotated = Rotation.random(rng=rng).apply(corners)
    return torch.from_numpy(rotated + rng.uniform(-1, 1, 3))


def require_exact(corners: torch.Tensor, tolerance: float) -> None:
    """Check the normal and its derivatives. The derivatives may have twice the tolerance."""
    expected, expected_slopes = exact_normal(corners)
    normal = face_normals(corners, ONE_FACE)[0].numpy()
    assert np.linalg.norm(normal - expected) <= tolerance
    slopes = jacobian(lambda values: face_normals(values, ONE_FACE)[0], corners).numpy()
    for corner in range(3):
        error = np.linalg.norm(slopes[:, corner] - expected_slopes[:, corner])
        assert error <= 2 * tolerance * np.linalg.norm(expected_slopes[:, corner])


@given(log_height=st.floats(-12, 0), log_edge=st.floats(-6, 0), seed=st.integers(0, 2**20))
@example(log_height=-9.220229640656948, log_edge=-5.520005482948768, seed=579921)
def test_slivers_have_exact_normals_and_derivatives_up_to_rounding(log_height, log_edge, seed):
    """Plain float64 would be off by 1e-4. The corners of the example lie on a line in float32."""
    height = 10**log_height
    corners = sliver(height, 10**log_edge, seed)
    is_sliver = height <= 1 / 30
    require_exact(corners, 4 * EPS if is_sliver else 16 * EPS)
    require_exact(corners.float(), 4 * EPS32)


POINTS = torch.tensor([[0.0, 0, 0], [1, 1, 1], [2, 2, 2], [0, 1, 0]], dtype=torch.float64)
# Faces with one point, two points, and three points on a line.
FACES_WITHOUT_AREA = torch.tensor([[0, 0, 0], [1, 1, 2], [0, 1, 2]])
FACE_WITH_AREA = torch.tensor([[0, 1, 3]])


def test_faces_without_area_have_no_normal_and_no_gradient():
    vertices = POINTS.clone().requires_grad_()
    normals = face_normals(vertices, FACES_WITHOUT_AREA)
    [gradient] = torch.autograd.grad(normals.sum(), vertices)
    assert not normals.any()
    assert torch.equal(gradient, torch.zeros_like(POINTS))


@both_functions
def test_faces_without_area_do_not_change_the_normals_of_a_face_beside_them(function):
    vertices = POINTS.clone().requires_grad_()
    faces = torch.cat([FACES_WITHOUT_AREA, FACE_WITH_AREA])
    expected = function(vertices, FACE_WITH_AREA)
    found = function(vertices, faces)
    if function is face_normals:
        found = found[-1:]
    assert torch.equal(found, expected)
    [expected_gradient] = torch.autograd.grad(expected.sum(), vertices)
    [gradient] = torch.autograd.grad(found.sum(), vertices)
    assert torch.equal(gradient, expected_gradient)


@both_functions
def test_second_derivatives_are_refused_instead_of_wrong(function):
    vertices, faces = dented(trimesh.creation.icosahedron())
    vertices.requires_grad_()
    loss = function(vertices, faces).pow(2)[:, 0].sum()
    [gradient] = torch.autograd.grad(loss, vertices, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        gradient.pow(2).sum().backward()


def test_vertex_normals_are_means_of_face_normals_weighted_by_area():
    vertices, faces = dented(torus())
    mesh = Mesh.plain(vertices.numpy(), faces.numpy())
    sums = np.zeros(vertices.shape)
    for face, normal, area in zip(mesh.faces, mesh.face_normals(), mesh.face_areas(), strict=True):
        sums[face] += area * normal
    expected = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(vertices, faces), expected, rtol=0, atol=64 * EPS)


@pytest.mark.parametrize("back", [[0, 2, 1], [2, 1, 0], [1, 0, 2]])
def test_vertices_of_opposite_faces_and_of_no_face_have_no_normal_and_no_gradient(back):
    """The rounding error of a sum that should be zero has no meaningful direction."""
    vertices = draw(4, 3).requires_grad_()
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2], back]))
    [gradient] = torch.autograd.grad(normals.sum(), vertices)
    assert not normals.any()
    assert not gradient.any()
