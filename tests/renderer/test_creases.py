"""Sharp edges: which corners share a normal with smooth shading, and that they keep it."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from oracles import corners_of, mesh_of

import norm_balls as nb
from renderer.mesh import concatenate, refine, select_faces, subdivide, transformed
from renderer.normals import doubled_area_vectors, normal_groups

CAN = mesh_of(trimesh.creation.cylinder(0.5, 1.2, sections=48), (0.8, 0.7, 0.6))


def lids(mesh: nb.Mesh) -> np.ndarray:
    """Return a mask (F,) of the faces in the planes of the two lids of the can."""
    return np.ptp(corners_of(mesh)[..., 2], axis=1) == 0


def is_same_partition(ids: np.ndarray, others: np.ndarray) -> bool:
    pairs = np.stack([ids.ravel(), others.ravel()], axis=1)
    return len(np.unique(pairs, axis=0)) == len(np.unique(ids)) == len(np.unique(others))


def folded_strip(angle: float, mirrored: bool = False) -> nb.Mesh:
    """Return two rectangles that meet at an edge, bent by an angle in degrees."""
    turn = np.radians(angle)
    far = [-np.cos(turn), -np.sin(turn)]
    points = [[1, 0], [0, 0], far]
    vertices = [[x, y, z] for x, z in points for y in (0, 1)]
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])[:, ::-1]
    return nb.Mesh.plain(vertices, faces[:, ::-1] if mirrored else faces)


def test_a_can_has_flat_lids_and_a_round_side():
    """The normals of the side are between those of its rectangles, which differ by 7.5°."""
    is_lid = lids(CAN)
    normals = CAN.corner_normals
    upward = np.sign(corners_of(CAN)[..., 2])[is_lid]
    expected = upward[..., None] * [0, 0, 1]
    assert_allclose(normals[is_lid], expected, atol=1e-15)
    radial = corners_of(CAN)[~is_lid] * [2, 2, 0]
    assert_allclose(normals[~is_lid], radial, atol=2 * np.sin(np.radians(7.5) / 4))
    assert len(np.unique(CAN.normal_ids)) == 2 * 48 * 2 + 2


@pytest.mark.parametrize(("angle", "is_sharp"), [(0, 0), (39.9, 0), (40, 0), (40.1, 1), (170, 1)])
def test_an_edge_is_sharp_beyond_40_degrees_or_the_chosen_angle(angle, is_sharp):
    for sign, mirrored in itertools.product((1, -1), (False, True)):
        mesh = folded_strip(sign * angle, mirrored)
        assert mesh.normal_ids.max() + 1 == 6 + 2 * is_sharp
        for crease, count in ((max(angle - 1, 0), 8 if angle else 6), (angle + 1, 6)):
            found = nb.Mesh.plain(mesh.vertices, mesh.faces, crease=crease)
            assert found.normal_ids.max() + 1 == count


def test_a_crease_that_ends_at_a_vertex_divides_only_its_other_end():
    """Around the center, a ridge falls off evenly to both sides, so all faces are one fan there."""
    angles = np.radians(np.arange(-180, 180, 15))
    heights = 0.8 * (1 - np.abs(angles) / np.pi) ** 2 - 0.8
    ring = np.stack([np.cos(angles), np.sin(angles), heights], axis=1)
    vertices = np.concatenate([[[0, 0, 0]], ring])
    faces = [[0, 1 + i, 1 + (i + 1) % 24] for i in range(24)]
    mesh = nb.Mesh.plain(vertices, faces)
    # The ridge leads to the vertex 13, at which the faces 11 and 12 meet.
    a, b = mesh.face_normals()[[11, 12]]
    assert a @ b < np.cos(np.radians(41))
    tip, foot = mesh.normal_ids[:, 0], mesh.normal_ids[[11, 12], [2, 1]]
    assert len(np.unique(tip)) == 1
    assert len(np.unique(foot)) == 2


def test_faces_without_area_neither_divide_nor_join():
    sharp = folded_strip(90)
    round_strip = folded_strip(10)
    for mesh in (sharp, round_strip):
        faces = np.concatenate([mesh.faces, [[2, 3, 3], [2, 2, 2]]])
        ids = normal_groups(mesh.vertices, faces)
        assert is_same_partition(ids[:4], mesh.normal_ids)
        assert ids.max() == mesh.normal_ids.max()


def test_a_fin_does_not_divide_the_plane_on_which_it_stands():
    plane = folded_strip(0)
    vertices = np.concatenate([plane.vertices, [[0, 0, 1], [0, 1, 1]]])
    faces = np.concatenate([[[2, 3, 6], [3, 7, 6]], plane.faces])
    ids = normal_groups(vertices, faces)
    assert is_same_partition(ids[2:], plane.faces)
    assert not np.isin(ids[:2], ids[2:]).any()


@pytest.mark.parametrize("given", [False, True])
def test_both_sides_of_a_curved_leaf_are_smooth(given):
    """A file may give both sides the same normal, so that their own normals cancel."""
    front = folded_strip(20)
    faces = np.concatenate([front.faces, front.faces[:, ::-1]])
    file_normals = np.broadcast_to([0.0, 0.0, 1.0], (8, 3, 3)) if given else None
    ids = normal_groups(front.vertices, faces, file_normals)
    leaf = replace(nb.Mesh.plain(front.vertices, faces), normal_ids=ids)
    assert_allclose(leaf.corner_normals[:4], front.corner_normals, atol=1e-15)
    assert_allclose(leaf.corner_normals[4:], -front.corner_normals[:, ::-1], atol=1e-15)


def test_normals_of_a_file_decide_where_they_are_given():
    """A welded box is smooth, a ball of facets is flat, and a zero or NaN is no normal."""
    box = trimesh.creation.box()
    welded = normal_groups(box.vertices, box.faces, box.vertex_normals[box.faces])
    assert is_same_partition(welded, box.faces)
    ball = trimesh.creation.icosphere(2)
    facets = ball.face_normals[:, None].repeat(3, axis=1)
    assert normal_groups(ball.vertices, ball.faces, facets).max() + 1 == 3 * len(ball.faces)
    for missing in (0.0, np.nan):
        ids = normal_groups(box.vertices, box.faces, np.full((len(box.faces), 3, 3), missing))
        assert is_same_partition(ids, normal_groups(box.vertices, box.faces))


def test_faces_that_a_file_winds_the_other_way_keep_its_normals():
    """A tenth of the faces of a ball is turned around. The normals of the file stay those of it."""
    ball = trimesh.creation.icosphere(3)
    turned = np.random.default_rng(0).random(len(ball.faces)) < 0.1
    faces = np.where(turned[:, None], ball.faces[:, ::-1], ball.faces)
    ids = normal_groups(ball.vertices, faces, ball.vertices[faces])
    mesh = replace(nb.Mesh.plain(ball.vertices, faces), normal_ids=ids)
    cosines = (mesh.corner_normals * ball.vertices[faces]).sum(-1) * np.where(turned, -1, 1)[
        :, None
    ]
    assert cosines.min() > np.cos(np.radians(6))


def test_a_crumpled_surface_keeps_the_normals_of_a_file():
    """As after an attack on the shape: some faces look away from the normals of their corners."""
    ball = trimesh.creation.icosphere(4)
    shifts = np.random.default_rng(0).uniform(-0.1, 0.1, ball.vertices.shape)
    mesh = nb.Mesh.plain(ball.vertices + shifts, ball.faces)
    normals = replace(mesh, normal_ids=ball.faces).corner_normals
    sides = np.einsum("fci,fi->fc", normals, doubled_area_vectors(mesh.vertices, mesh.faces))
    assert (sides < 0).any()
    assert is_same_partition(normal_groups(mesh.vertices, mesh.faces, normals), ball.faces)


@pytest.mark.parametrize("noise", [1e-7, 1e-4, 5e-3])
def test_normals_of_a_file_may_be_rounded(noise):
    ball = trimesh.creation.icosphere(3)
    errors = np.random.default_rng(0).uniform(-noise, noise, (len(ball.faces), 3, 3))
    ids = normal_groups(ball.vertices, ball.faces, 3 * (ball.vertices[ball.faces] + errors))
    assert is_same_partition(ids, ball.faces)


def test_faces_that_only_touch_at_a_vertex_share_its_normal_in_a_file():
    """Two opposite triangles of a tile, whose other faces have vertices in between."""
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0], [-1, -1, 0]]
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    ids = normal_groups(np.array(vertices), faces, np.tile([0.0, 0.0, 2.0], (2, 3, 1)))
    assert ids[0, 0] == ids[1, 0]


def test_subdivided_and_refined_meshes_have_the_same_sharp_edges():
    finer = subdivide(CAN, 1000)
    assert is_same_partition(finer.normal_ids, normal_groups(finer.vertices, finer.faces))
    refined = refine(CAN, 0.005, "linear")
    assert len(np.unique(refined.face_areas().round(9))) > 1
    for mesh in (finer, refined):
        is_lid = lids(mesh)
        assert 0 < is_lid.sum() < len(is_lid)
        assert_array_equal(mesh.corner_normals[is_lid][..., :2], 0)
        assert_allclose(mesh.corner_normals[~is_lid][..., 2], 0, atol=1e-15)


@pytest.mark.parametrize("sign", [1, -1])
def test_normals_turn_with_a_mesh(sign):
    matrix = np.eye(4)
    matrix[:3, :3] = sign * trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    turned = transformed(CAN, matrix)
    order = [0, 1, 2] if sign == 1 else [0, 2, 1]
    expected = CAN.corner_normals[:, order] @ matrix[:3, :3].T
    assert_allclose(turned.corner_normals, expected, atol=1e-14)


def test_joined_and_selected_meshes_keep_their_normals():
    ball = nb.solid("orange")
    both = concatenate([CAN, ball, CAN])
    expected = np.concatenate([mesh.corner_normals for mesh in (CAN, ball, CAN)])
    assert_array_equal(both.corner_normals, expected)
    # A normal of the selection is the mean over the selected faces.
    assert_array_equal(select_faces(both, slice(len(CAN.faces))).corner_normals, CAN.corner_normals)


def test_moved_vertices_keep_the_sharp_edges_of_the_mesh():
    """A flattened rim stays sharp, so that images have no jump as the vertices move."""
    moved = replace(CAN, vertices=CAN.vertices * [1, 1, 0.01])
    assert_array_equal(moved.normal_ids, CAN.normal_ids)
    light = nb.load_light("grace").double()
    camera = nb.OrthographicCamera(50.0, 20.0, 1.6)
    vertices = torch.from_numpy(moved.vertices)
    options = {"size": 16, "rasterizer": "numpy"}
    found = nb.render(CAN, camera, light, vertices=vertices, **options)
    torch.testing.assert_close(found, nb.render(moved, camera, light, **options))


def test_parts_of_a_file_share_the_normals_where_they_meet(tmp_path):
    """The lower half of an ellipsoid is the mirrored upper half, which is turned and stretched."""
    octahedron = trimesh.convex.convex_hull(np.concatenate([np.eye(3), -np.eye(3)]))
    ball = octahedron.subdivide().subdivide().subdivide()
    ball.vertices /= np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    is_above = ball.triangles_center[:, 2] > 0
    half = trimesh.Trimesh(ball.vertices, ball.faces[is_above], process=False)
    half.vertex_normals = ball.vertices
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.7, [0, 0, 1])
    scene.add_geometry(half, transform=np.diag([1, 2, 0.3, 1]) @ turn)
    scene.add_geometry(half, transform=np.diag([1, 2, -0.3, 1]) @ turn)
    scene.export(tmp_path / "halves.glb", include_normals=True)
    loaded = nb.load_mesh(tmp_path / "halves.glb", up="z")
    assert loaded.closed
    assert is_same_partition(loaded.normal_ids, loaded.faces)
