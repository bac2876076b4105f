"""Normals and their derivatives against exact arithmetic and central differences."""

from fractions import Fraction

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import draw
from scipy.spatial.transform import Rotation
from torch.autograd.functional import jacobian

from renderer.geometry.mesh import Mesh
from renderer.geometry.normals import face_normals, vertex_normals

EPS = torch.finfo(torch.float64).eps
ONE = torch.tensor([[0, 1, 2]])


def shape(name: str = "icosahedron") -> tuple[torch.Tensor, torch.Tensor]:
    """Dented."""
    made = {"icosahedron": trimesh.creation.icosahedron, "torus": lambda: trimesh.creation.torus(1, 0.3, 6, 5)}[name]()
    dents = np.random.default_rng(0).normal(scale=0.1, size=made.vertices.shape)
    return torch.from_numpy(made.vertices + dents), torch.from_numpy(made.faces)


def exact(corners: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Normal (3,) and Jacobian (3, 3 corners, 3) in exact arithmetic, rounded at the end; zeros where there is no area.

    The cross product moves by e × dv for a corner v opposite to the edge e; its length turns none of that.
    """
    points = [[Fraction(value) for value in corner] for corner in corners.double().tolist()]
    edges = [[q - p for p, q in zip(points[a], points[b], strict=True)] for a, b in ((1, 2), (2, 0), (0, 1))]
    (x, y, z), (r, s, t) = edges[2], [-value for value in edges[1]]
    cross = [y * t - z * s, z * r - x * t, x * s - y * r]
    largest = max(map(abs, cross))
    if not largest:
        return np.zeros(3), np.zeros((3, 3, 3))
    direction = np.array([float(value / largest) for value in cross])
    normal = direction / np.linalg.norm(direction)
    turned = np.stack([np.cross([float(value) for value in edge], np.eye(3)).T for edge in edges], axis=1)
    tangential = np.eye(3) - np.outer(normal, normal)
    return normal, np.einsum("ad,dcb->acb", tangential, turned) / (np.linalg.norm(direction) * float(largest))


def sliver(height: float, edge: float = 1.0, seed: int = 0) -> torch.Tensor:
    """A triangle with coordinates of order one, turned and moved, so that differences of its corners round, too."""
    corners = edge * np.array([[-0.6, 0, 0], [0.7, 0, 0], [0.1, height, 0]])
    draws = np.random.default_rng(seed)
    return torch.from_numpy(Rotation.random(rng=draws).apply(corners) + draws.uniform(-1, 1, 3))


@pytest.mark.parametrize("function", [face_normals, vertex_normals])
@pytest.mark.parametrize("name", ["icosahedron", "torus"])
def test_derivatives_on_a_mesh_are_central_differences(function, name):
    vertices, faces = shape(name)
    assert torch.autograd.gradcheck(lambda v: function(v, faces), vertices.requires_grad_(True))


@settings(deadline=None, max_examples=100)
@given(height=st.floats(-12, 0), edge=st.floats(-6, 0), seed=st.integers(0, 2**20))
def test_slivers_have_exact_normals_and_derivatives_to_rounding(height, edge, seed):
    """Against exact arithmetic, down to a height of 1e-12 of the edge, where plain float64 is off by 1e-4.

    4 EPS for the two or three roundings of each component's last steps, and twice that where the derivative divides.
    Faces up to some twenty times as wide as high are no slivers yet: plain float64 loses a few times that.
    """
    corners = sliver(10**height, 10**edge, seed)
    plain = 10**height > 1 / 30
    for given_as, ulp in ((corners, (4 if plain else 1) * EPS), (corners.float(), np.finfo(np.float32).eps)):
        normal, slopes = exact(given_as)
        assert np.linalg.norm(face_normals(given_as, ONE)[0].numpy() - normal) <= 4 * ulp
        ours = jacobian(lambda vertices: face_normals(vertices, ONE)[0], given_as).numpy()
        for corner in range(3):
            error = np.linalg.norm(ours[:, corner] - slopes[:, corner])
            assert error <= 8 * ulp * np.linalg.norm(slopes[:, corner])


def test_faces_without_area_have_no_normal_and_no_gradient():
    """One point, two points, three on a line; beside a face that shares their vertices."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 1, 1], [2, 2, 2], [0, 1, 0]], dtype=torch.float64, requires_grad=True)
    flat = torch.tensor([[0, 0, 0], [1, 1, 2], [0, 1, 2]])
    normals = face_normals(vertices, flat)
    assert torch.equal(normals, torch.zeros(3, 3, dtype=torch.float64))
    (gradient,) = torch.autograd.grad(normals.sum(), vertices)
    assert torch.equal(gradient, torch.zeros(4, 3, dtype=torch.float64))

    sound = torch.tensor([[0, 1, 3]])
    for function in (face_normals, vertex_normals):
        rows = slice(-1, None) if function is face_normals else slice(None)
        results = []
        for faces in (sound, torch.cat([flat, sound])):
            kept = function(vertices, faces)[rows]
            results.append((kept, *torch.autograd.grad(kept.sum(), vertices)))
        assert all(torch.equal(alone, among) for alone, among in zip(*results, strict=True))


@pytest.mark.parametrize("function", [face_normals, vertex_normals])
def test_second_derivatives_are_refused_rather_than_wrong(function):
    vertices, faces = shape()
    (gradient,) = torch.autograd.grad(
        function(vertices.requires_grad_(True), faces).pow(2)[:, 0].sum(), vertices, create_graph=True
    )
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.pow(2).sum().backward()


def test_vertex_normals_are_the_sum_of_the_faces_areas():
    vertices, faces = shape("torus")
    mesh = Mesh.plain(vertices.numpy(), faces.numpy())
    summed = np.zeros(vertices.shape)
    for face, normal, area in zip(faces.numpy(), mesh.face_normals(), mesh.face_areas(), strict=True):
        summed[face] += area * normal
    expected = summed / np.linalg.norm(summed, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(vertices, faces), expected, rtol=0, atol=64 * EPS)


@pytest.mark.parametrize("back", [[0, 2, 1], [2, 1, 0], [1, 0, 2]])
def test_vertices_of_no_face_and_those_whose_faces_cancel_have_neither_normal_nor_gradient(back):
    """As on a leaf of two sides: what rounding leaves of the sum has no direction."""
    vertices = draw(4, 3).requires_grad_(True)
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2], back]))
    (gradient,) = torch.autograd.grad(normals.sum(), vertices)
    assert not normals.any() and not gradient.any()
