"""Meshes: geometry by closed form, and files of every format that the test writes."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from renderer.albedo import surface_albedo
from renderer.camera import orbit_cameras
from renderer.errors import InputError
from renderer.fragments import build_fragments
from renderer.image import ImageSettings
from renderer.mesh import Mesh, concatenate, load_mesh, normalize
from renderer.rasterizer import choose

DATA = Path(__file__).parents[2].parent / "shared" / "data"
WHITE = (1.0, 1.0, 1.0)
FLOAT32 = dict(rtol=1e-6, atol=1e-6)

TRIANGLE_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY_HEADER = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
{vertex}element face 2
property list uchar int vertex_indices
{face}end_header
"""


def srgb(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def export(mesh: trimesh.Trimesh, path: Path) -> Path:
    """trimesh's own export to .gltf, which is several files, leaves one open."""
    if path.suffix != ".gltf":
        mesh.export(path)
        return path
    for name, content in mesh.export(file_type="gltf").items():
        path.with_name(name).write_bytes(content)
    return path.with_name("model.gltf")


def corner_positions(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces]


def textured(texture: np.ndarray, uvs, color=WHITE) -> Mesh:
    """One triangle with a texture."""
    plain = Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], color)
    return Mesh(
        plain.vertices,
        plain.faces,
        plain.corner_colors,
        corner_uvs=np.array([uvs], dtype=np.float32),
        texture_ids=np.zeros(1, dtype=np.int32),
        textures=(texture,),
    )


def random_texture(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


# The data class


def test_fields_have_the_documented_types():
    mesh = Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    found = {field.name: getattr(mesh, field.name) for field in fields(Mesh)}
    assert {name: (array.dtype.name, array.shape) for name, array in found.items() if name != "textures"} == {
        "vertices": ("float64", (3, 3)),
        "faces": ("int64", (1, 3)),
        "corner_colors": ("float32", (1, 3, 3)),
        "corner_uvs": ("float32", (1, 3, 2)),
        "texture_ids": ("int32", (1,)),
    }


def test_normals_are_outward_units_and_areas_right():
    box = trimesh.creation.box((1, 2, 3))
    mesh = Mesh.plain(box.vertices, box.faces)
    outward = np.sign(np.round(corner_positions(mesh).mean(axis=1) / [0.5, 1, 1.5], 6).astype(int))
    assert_array_equal(mesh.face_normals(), outward)
    assert_array_equal(np.sort(mesh.face_areas()), np.repeat([1, 1.5, 3], 4))


def test_zero_area_faces_have_a_zero_normal():
    mesh = Mesh.plain([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2], [0, 0, 1], [1, 1, 1]])
    assert_array_equal(mesh.face_normals(), np.zeros((3, 3)))
    assert_array_equal(mesh.face_areas(), np.zeros(3))


def test_concatenated_meshes_keep_their_surfaces():
    red, blue = (np.full((2, 2, 3), rgb, dtype=np.uint8) for rgb in ([255, 0, 0], [0, 0, 255]))
    parts = [
        textured(red, np.zeros((3, 2))),
        Mesh.plain(np.eye(3) + 5, [[0, 1, 2]], (0, 1, 0)),
        textured(blue, np.ones((3, 2))),
    ]
    whole = concatenate(parts)
    assert_array_equal(corner_positions(whole), np.concatenate([corner_positions(part) for part in parts]))
    for name in ("corner_colors", "corner_uvs"):
        assert_array_equal(getattr(whole, name), np.concatenate([getattr(part, name) for part in parts]))
    assert whole.texture_ids.tolist() == [0, -1, 1] and whole.texture_ids.dtype == np.int32
    assert [texture[0, 0].tolist() for texture in whole.textures] == [[255, 0, 0], [0, 0, 255]]


# Closed or open

BOX = trimesh.creation.box()
SMALLER = BOX.vertices / 4
AT_A_CORNER = SMALLER + 5 / 8  # a box of a quarter's width, whose lowest corner is the large one's highest
INSIDE_OUT = BOX.faces[:, ::-1]


def beside(*parts) -> Mesh:
    """Boxes with corners and faces of their own."""
    return concatenate([Mesh.plain(vertices, faces) for vertices, faces in parts])


def welded(mesh: Mesh) -> Mesh:
    vertices, ids = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return Mesh.plain(vertices, ids.reshape(-1)[mesh.faces])


def with_face(*face: int) -> Mesh:
    return Mesh.plain(BOX.vertices, np.concatenate([BOX.faces, [face]]))


@pytest.mark.parametrize(
    ("mesh", "closed"),
    [
        (Mesh.plain(BOX.vertices, BOX.faces), True),
        (Mesh.plain(BOX.vertices + 100, BOX.faces), True),
        (Mesh.plain(BOX.vertices, BOX.faces[:, [1, 2, 0]]), True),
        (Mesh.plain(BOX.vertices, INSIDE_OUT), False),
        (Mesh.plain(-BOX.vertices, BOX.faces), False),
        (Mesh.plain(BOX.vertices, BOX.faces[1:]), False),
        (Mesh.plain(BOX.vertices, np.concatenate([BOX.faces[:1, ::-1], BOX.faces[1:]])), False),
        (Mesh.plain(BOX.vertices, np.concatenate([BOX.faces, BOX.faces])), False),
        (Mesh.plain(BOX.vertices, np.concatenate([BOX.faces, INSIDE_OUT])), False),
        (with_face(0, 0, 1), False),
        (Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), False),
        (Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]]), False),
        (beside((BOX.vertices, BOX.faces), (SMALLER + 3, BOX.faces)), True),
        (beside((BOX.vertices, BOX.faces), (BOX.vertices + 0.5, BOX.faces)), True),
        (beside((BOX.vertices, BOX.faces), (SMALLER + 3, INSIDE_OUT)), False),
        (beside((BOX.vertices, BOX.faces), (SMALLER, INSIDE_OUT)), False),
        (welded(beside((BOX.vertices, BOX.faces), (AT_A_CORNER, BOX.faces))), True),
        (welded(beside((BOX.vertices, BOX.faces), (AT_A_CORNER, INSIDE_OUT))), False),
    ],
    ids=[
        "box", "box far away", "corners in another order", "inside out", "mirrored", "a face missing",
        "a face turned round", "every face twice", "every face from both sides", "a face without area", "a triangle",
        "a sheet of two sides", "two boxes", "two that overlap", "one of two inside out", "a hollow",
        "two that touch at a corner", "one of two that touch is inside out",
    ],
)  # fmt: skip
def test_a_mesh_is_closed_if_no_face_of_it_is_ever_seen_from_behind(mesh, closed):
    assert mesh.closed is closed


def test_whether_a_changed_mesh_is_closed_is_told_anew():
    mesh = Mesh.plain(BOX.vertices, BOX.faces)
    assert mesh.closed
    assert not replace(mesh, vertices=-mesh.vertices).closed


# Normalizing


def test_normalize_centers_on_the_centroid_of_the_surface_and_fits_the_unit_cube():
    """trimesh's centroid is the same average of the faces, by their area."""
    cone = trimesh.creation.cone(radius=0.3, height=2)
    cone.apply_translation([7, -3, 11])
    mesh = normalize(Mesh.plain(cone.vertices, cone.faces))
    assert_allclose(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).centroid, 0, atol=2**-25)
    assert np.abs(mesh.vertices).max() == 1
    centered = cone.vertices - cone.centroid
    assert_allclose(mesh.vertices, centered / np.abs(centered).max(), atol=2**-25)  # half of float32's step below 1
    assert_array_equal(mesh.vertices, mesh.vertices.astype(np.float32))


def test_normalize_weights_by_area_not_by_vertex():
    """Two parallel triangles, the second of four times the area: the centroid is 4/5 of the way to it."""
    small = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    vertices = np.concatenate([small, 2 * small + [0, 0, 10]])
    mesh = normalize(Mesh.plain(vertices, [[0, 1, 2], [3, 4, 5]]))
    assert_allclose(mesh.vertices[[0, 3], 2], [-1, 2 / 8], atol=1e-12)


# Loading


def test_an_obj_has_its_texture_times_its_diffuse_color(tmp_path):
    """A square with a seam: its diagonal's corners have other uvs in either face."""
    texture = random_texture(4, 6)
    Image.fromarray(texture).save(tmp_path / "peel.png")
    write(tmp_path / "square.mtl", "newmtl peel\nKd 1.0 0.5 0.25\nmap_Kd peel.png\n")
    uvs = [(0.1, 0.2), (0.9, 0.2), (0.9, 0.8), (0.3, 0.4), (0.6, 0.7), (0.2, 0.9)]
    lines = ["mtllib square.mtl", "usemtl peel", "v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0"]
    lines += [f"vt {u} {v}" for u, v in uvs] + ["f 1/1 2/2 3/3", "f 1/4 3/5 4/6"]
    mesh = load_mesh(write(tmp_path / "square.obj", "\n".join(lines)))

    assert len(mesh.vertices) == 4
    assert_array_equal(corner_positions(mesh)[:, :, :2], [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    assert_allclose(mesh.corner_uvs.reshape(6, 2), uvs, **FLOAT32)
    assert_array_equal(mesh.textures[0], texture)
    assert_array_equal(mesh.texture_ids, [0, 0])
    assert_allclose(mesh.corner_colors, np.broadcast_to([1, 0.5, 0.25], (2, 3, 3)), **FLOAT32)


@pytest.mark.parametrize(
    ("material", "face", "color"),
    [
        ("Kd 0.2 0.4 0.6", "f 1 2 3", (0.2, 0.4, 0.6)),
        ("Ns 10", "f 1 2 3", WHITE),
        ("Ns 10", "f 1/1 2/1 3/1", WHITE),
        (None, "f 1 2 3", WHITE),
        (None, "f 1/1 2/1 3/1", WHITE),
    ],
)
def test_an_obj_without_texture_has_its_diffuse_color_or_white(tmp_path, material, face, color):
    text = TRIANGLE_OBJ + "vt 0 0\n"
    if material:
        write(tmp_path / "plain.mtl", f"newmtl plain\n{material}\n")
        text = f"mtllib plain.mtl\n{text}usemtl plain\n"
    mesh = load_mesh(write(tmp_path / "mesh.obj", text + face))
    assert_allclose(mesh.corner_colors, np.broadcast_to(color, (1, 3, 3)), **FLOAT32)
    assert_array_equal(mesh.texture_ids, [-1])
    assert mesh.textures == ()


RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
PLY_VERTICES = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]
PLY_FACES = ["3 0 1 2", "3 0 2 3"]


def test_a_ply_has_its_vertex_colors(tmp_path):
    colors = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (51, 102, 153)]
    vertices = [f"{xyz} {r} {g} {b}" for xyz, (r, g, b) in zip(PLY_VERTICES, colors, strict=True)]
    text = PLY_HEADER.format(vertex=RGB, face="") + "\n".join(vertices + PLY_FACES) + "\n"
    mesh = load_mesh(write(tmp_path / "mesh.ply", text))
    assert_allclose(mesh.corner_colors, np.array(colors)[[[0, 1, 2], [0, 2, 3]]] / 255, **FLOAT32)


def test_a_ply_has_its_face_colors(tmp_path):
    faces = [f"{face} {color}" for face, color in zip(PLY_FACES, ["255 0 51", "0 102 255"], strict=True)]
    text = PLY_HEADER.format(vertex="", face=RGB) + "\n".join(PLY_VERTICES + faces) + "\n"
    mesh = load_mesh(write(tmp_path / "mesh.ply", text))
    assert_allclose(mesh.corner_colors, [[[1, 0, 0.2]] * 3, [[0, 0.4, 1]] * 3], **FLOAT32)


def test_an_stl_is_white_and_its_corners_are_joined(tmp_path):
    """The format repeats a vertex in each face that has it."""
    box = trimesh.creation.box()
    box.export(tmp_path / "box.stl")
    mesh = load_mesh(tmp_path / "box.stl")
    assert len(mesh.vertices) == 8
    assert_array_equal(corner_positions(mesh), box.triangles)
    assert_array_equal(mesh.corner_colors, np.ones((12, 3, 3)))


def leaf_and_fruit() -> tuple[trimesh.Scene, np.ndarray, np.ndarray]:
    """Two boxes, one textured and mirrored, one plain; and what they are in the scene, y up."""
    texture = Image.fromarray(random_texture(8, 8))
    fruit = trimesh.creation.box()
    uvs = np.random.default_rng(2).random((8, 2))
    fruit.visual = TextureVisuals(uv=uvs, material=PBRMaterial(baseColorTexture=texture))
    leaf = trimesh.creation.box((0.2, 0.4, 0.6))
    leaf.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[51, 102, 255, 255]))
    mirror, move = np.diag([-2.0, 1, 1, 1]), np.eye(4)
    move[:3, 3] = [1, 2, 3]
    scene = trimesh.Scene()
    scene.add_geometry(fruit, geom_name="fruit", transform=mirror)
    scene.add_geometry(leaf, geom_name="leaf", transform=move)
    return scene, fruit.vertices * [-2, 1, 1], leaf.vertices + move[:3, 3]


def test_a_glb_scene_has_its_parts_placed_z_up_with_their_materials(tmp_path):
    scene, fruit, leaf = leaf_and_fruit()
    scene.export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb")

    is_fruit = mesh.texture_ids == 0
    assert_array_equal(is_fruit.sum(), 12)
    for part, vertices in ((is_fruit, fruit), (~is_fruit, leaf)):
        z_up = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
        corners = np.unique(corner_positions(mesh)[part].reshape(-1, 3), axis=0)
        assert_allclose(corners, np.unique(z_up, axis=0), **FLOAT32)
        outward = ((corner_positions(mesh)[part].mean(axis=1) - z_up.mean(axis=0)) * mesh.face_normals()[part]).sum(1)
        assert (outward > 0).all()
    linear = [srgb(0.2), srgb(0.4), 1]
    assert_allclose(mesh.corner_colors[~is_fruit], np.broadcast_to(linear, (12, 3, 3)), **FLOAT32)
    assert_array_equal(mesh.corner_colors[is_fruit], np.ones((12, 3, 3)))
    assert_array_equal(mesh.textures[0], random_texture(8, 8))


def test_a_mirrored_parts_uvs_stay_with_their_corners(tmp_path):
    scene, fruit, _ = leaf_and_fruit()
    scene.export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb", up="z")
    part = mesh.texture_ids == 0
    uv_of = {tuple(vertex): uv for vertex, uv in zip(fruit, np.random.default_rng(2).random((8, 2)), strict=True)}
    expected = [[uv_of[tuple(corner)] for corner in face] for face in corner_positions(mesh)[part]]
    assert_allclose(mesh.corner_uvs[part], expected, **FLOAT32)


def test_a_part_that_two_nodes_share_appears_twice_and_shares_its_texture(tmp_path):
    scene, _, _ = leaf_and_fruit()
    again = np.eye(4)
    again[:3, 3] = [0, 0, 9]
    scene.graph.update(frame_to="again", geometry="fruit", matrix=again)
    scene.export(tmp_path / "scene.glb")
    mesh = load_mesh(tmp_path / "scene.glb")
    assert len(mesh.faces) == 36
    first, second = mesh.textures
    assert first is second


def test_glb_vertex_colors_are_linear_and_multiply_the_material(tmp_path):
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.tile([51, 102, 255, 255], (8, 1))
    box.export(tmp_path / "colors.glb")
    expected = np.broadcast_to([srgb(0.2), srgb(0.4), 1], (12, 3, 3))
    assert_allclose(load_mesh(tmp_path / "colors.glb").corner_colors, expected, **FLOAT32)

    box.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[102, 255, 51, 255]))
    box.visual.vertex_attributes["color"] = np.tile(np.array([51, 102, 255, 255], dtype=np.uint8), (8, 1))
    box.export(tmp_path / "both.glb")
    expected = np.broadcast_to([srgb(0.4 * 0.2), srgb(0.4), srgb(0.2)], (12, 3, 3))
    assert_allclose(load_mesh(tmp_path / "both.glb").corner_colors, expected, **FLOAT32)


@pytest.mark.parametrize(
    ("suffix", "up", "turned"),
    [
        ("glb", "auto", True),
        ("glb", "y", True),
        ("glb", "z", False),
        ("gltf", "auto", True),
        ("ply", "auto", False),
        ("ply", "y", True),
        ("ply", "z", False),
    ],
)
def test_up_becomes_z(tmp_path, suffix, up, turned):
    box = trimesh.creation.box((1, 2, 3))
    box.apply_translation([10, 20, 30])
    mesh = load_mesh(export(box, tmp_path / f"box.{suffix}"), up)
    assert_allclose(mesh.vertices.mean(axis=0), [10, -30, 20] if turned else [10, 20, 30], **FLOAT32)
    outward = corner_positions(mesh).mean(axis=1) - mesh.vertices.mean(axis=0)
    assert ((outward * mesh.face_normals()).sum(axis=1) > 0).all()


def test_unused_vertices_are_dropped_and_both_zeros_are_one_position(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv -0.0 -0.0 -0.0\nv 0 -1 0\nv 99 99 99\nf 1 2 3\nf 4 5 2\n"
    mesh = load_mesh(write(tmp_path / "mesh.obj", text))
    assert len(mesh.vertices) == 4
    assert mesh.faces[0, 0] == mesh.faces[1, 0]


# Errors


def points_ply(path: Path) -> None:
    trimesh.PointCloud(np.eye(3)).export(path)


def truncated_glb(path: Path) -> None:
    blob = trimesh.creation.box().export(file_type="glb")
    path.write_bytes(blob[: len(blob) // 2])


def damaged_texture_glb(path: Path) -> None:
    """The image's header is whole, so that only decoding it finds the damage."""
    scene, _, _ = leaf_and_fruit()
    blob = scene.export(file_type="glb")
    at = blob.index(b"IDAT") + 8
    path.write_bytes(blob[:at] + b"\xff" * 40 + blob[at + 40 :])


def ply_with_face(face: str):
    def make(path: Path) -> None:
        path.write_text(PLY_HEADER.format(vertex="", face="") + "\n".join([*PLY_VERTICES, "3 0 1 2", face]) + "\n")

    return make


def text(content: str):
    return lambda path: path.write_text(content)


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("missing.glb", lambda path: None, "does not exist"),
        ("folder.glb", Path.mkdir, "is no file"),
        ("image.jpg", text(""), "no known mesh format: use one of .*glb"),
        ("no_suffix", text(""), "no known mesh format"),
        ("empty.glb", text(""), "cannot be read"),
        ("garbage.glb", text("garbage " * 50), "cannot be read"),
        ("garbage.ply", text("garbage " * 50), "cannot be read"),
        ("truncated.glb", truncated_glb, "cannot be read"),
        ("damaged_texture.glb", damaged_texture_glb, "no image that can be read"),
        ("two_coordinates.obj", text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n"), "cannot be read"),
        ("beyond.obj", text(TRIANGLE_OBJ + "f 1 2 9\n"), "cannot be read"),
        ("beyond.ply", ply_with_face("3 0 1 7"), "faces name vertices that are not there"),
        ("negative.ply", ply_with_face("3 0 1 -2"), "faces name vertices that are not there"),
        ("garbage.obj", text("garbage\n" * 50), "no faces"),
        ("points.obj", text(TRIANGLE_OBJ), "no faces"),
        ("points.ply", points_ply, "no faces"),
        ("nan.obj", text(TRIANGLE_OBJ.replace("1", "nan", 1) + "f 1 2 3\n"), "not finite"),
        ("inf.obj", text(TRIANGLE_OBJ.replace("1", "inf", 1) + "f 1 2 3\n"), "not finite"),
        ("point.obj", text("v 1 2 3\nf 1 1 1\n"), "zero area"),
        ("line.obj", text("v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n"), "zero area"),
    ],
)
def test_what_cannot_be_used_is_refused_with_the_files_name(tmp_path, name, make, message):
    make(tmp_path / name)
    with pytest.raises(InputError, match=message) as raised:
        load_mesh(tmp_path / name)
    assert str(tmp_path / name) in str(raised.value)


def test_an_unknown_up_axis_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"up=x: choose one of auto, y, z"):
        load_mesh(tmp_path / "any.glb", up="x")


# The project's own meshes


@pytest.mark.realdata
@pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data")
@pytest.mark.parametrize(
    ("name", "faces", "textures"),
    [("orange_studio", 1500, [2048]), ("orange_sketchfab", 10412, [1024]), ("orange_leaf", 1728, [])],
)
def test_the_shared_oranges_are_closed_around_their_center_and_orange(name, faces, textures):
    mesh = normalize(load_mesh(DATA / "meshes" / f"{name}.glb"))
    assert len(mesh.faces) == faces
    assert [texture.shape[:2] for texture in mesh.textures] == [(size, size) for size in textures]
    outward = (corner_positions(mesh).mean(axis=1) * mesh.face_normals()).sum(axis=1)
    fruit = np.arange(faces)[-960:] if name == "orange_leaf" else np.arange(faces)
    assert np.average(outward[fruit] > 0, weights=mesh.face_areas()[fruit]) > 0.95
    [fragments] = build_fragments(
        mesh.vertices, mesh.faces, orbit_cameras(1, 2.0), ImageSettings(32, 1), choose("numpy")
    )
    albedo = surface_albedo(mesh, fragments, "linear").numpy()
    red, green, blue = albedo[np.isin(fragments.faces[fragments.face], fruit)].mean(axis=0)
    assert red > 1.4 * green > 1.4 * 2 * blue


@pytest.mark.realdata
@pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data")
def test_the_shared_leaf_is_green():
    mesh = load_mesh(DATA / "meshes" / "orange_leaf.glb")
    red, green, blue = np.unique(mesh.corner_colors.reshape(-1, 3), axis=0)[0]
    assert green > 1.5 * blue
    assert green > 0.9 * red


@pytest.mark.parametrize("faces", [[[0, 1, 9]], [[0, 1, -1]]])
def test_faces_of_vertices_that_are_not_there_are_refused(faces):
    with pytest.raises(InputError, match="faces name vertices that are not there: give indices from 0 to 2"):
        Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], faces)


def test_a_surface_of_zero_area_has_no_size_to_scale():
    with pytest.raises(InputError, match="the mesh has a surface of zero area"):
        normalize(Mesh.plain(np.zeros((3, 3)), [[0, 1, 2]]))
