"""Meshes from files of every format that the test writes, with the colors and textures that they name."""

import base64
import io
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from oracles import corners_of, srgb_of
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from renderer.errors import InputError
from renderer.geometry.mesh import Mesh
from renderer.io.meshes import load_mesh

TEXTURE = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
WHITE = (1.0, 1.0, 1.0)
FLOAT32 = dict(rtol=1e-6, atol=1e-6)
VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OBJ = VERTICES + "vt 0 0\nvt 1 0\nvt 0 1\nusemtl peel\nf 1/1 2/2 3/3\n"
PLY = """ply
format ascii 1.0
comment TextureFile peel.png
element vertex 3
property float x
property float y
property float z
property float s
property float t
element face 1
property list uchar int vertex_indices
end_header
0 0 0 0 0
1 0 0 1 0
0 1 0 0 1
3 0 1 2
"""


PLAIN_PLY = trimesh.Trimesh(np.eye(3), [[0, 1, 2]]).export(file_type="ply", encoding="ascii")


def png(texture: np.ndarray = TEXTURE) -> bytes:
    content = io.BytesIO()
    Image.fromarray(texture).save(content, "PNG")
    return content.getvalue()


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def obj(folder: Path, texture: str = "peel.png", library: str = "peel.mtl", head: str | None = None) -> Path:
    """An .obj with its materials, without its texture."""
    folder.mkdir(exist_ok=True)
    write(folder / library, f"newmtl peel\nKd 1 1 1\nmap_Kd {texture}\n")
    return write(folder / "mesh.obj", (head or f"mtllib {library}\n") + OBJ)


def ply(folder: Path) -> Path:
    return write(folder / "mesh.ply", PLY)


def textured_triangle() -> trimesh.Scene:
    triangle = trimesh.Trimesh(np.eye(3), [[0, 1, 2]], process=False)
    material = PBRMaterial(baseColorTexture=Image.fromarray(TEXTURE))
    triangle.visual = TextureVisuals(uv=np.eye(3)[:, :2], material=material)
    return triangle.scene()


def gltf(folder: Path, image: dict | None = None) -> Path:
    """A .gltf with its buffers inside, and its image beside it or as given."""
    files = textured_triangle().export(file_type="gltf")
    tree = json.loads(files["model.gltf"])
    for buffer in tree["buffers"]:
        buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(files[buffer["uri"]]).decode()
    tree["images"] = [image or {"uri": "peel.png"}]
    return write(folder / "mesh.gltf", json.dumps(tree))


def has_texture(mesh: Mesh) -> bool:
    return len(mesh.textures) == 1 and np.array_equal(mesh.textures[0], TEXTURE)


# Colors and textures


def test_an_obj_has_its_texture_times_its_diffuse_color(tmp_path):
    """A square with a seam: the corners of its diagonal have other uvs in either face."""
    write(tmp_path / "peel.png", png())
    write(tmp_path / "square.mtl", "newmtl peel\nKd 1.0 0.5 0.25\nmap_Kd peel.png\n")
    uvs = [(0.1, 0.2), (0.9, 0.2), (0.9, 0.8), (0.3, 0.4), (0.6, 0.7), (0.2, 0.9)]
    lines = ["mtllib square.mtl", "usemtl peel", "v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0"]
    lines += [f"vt {u} {v}" for u, v in uvs] + ["f 1/1 2/2 3/3", "f 1/4 3/5 4/6"]
    mesh = load_mesh(write(tmp_path / "square.obj", "\n".join(lines)))
    assert len(mesh.vertices) == 4
    assert_array_equal(corners_of(mesh)[:, :, :2], [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    assert_allclose(mesh.corner_uvs.reshape(6, 2), uvs, **FLOAT32)
    assert has_texture(mesh)
    assert_array_equal(mesh.texture_ids, [0, 0])
    assert_allclose(mesh.corner_colors, np.broadcast_to([1, 0.5, 0.25], (2, 3, 3)), **FLOAT32)


@pytest.mark.parametrize(
    ("material", "face", "color"),
    [
        ("Kd 0.2 0.4 0.6", "f 1 2 3", (0.2, 0.4, 0.6)),
        ("Ns 10", "f 1/1 2/1 3/1", WHITE),
        (None, "f 1 2 3", WHITE),
        (None, "f 1/1 2/1 3/1", WHITE),
    ],
)
def test_an_obj_without_texture_has_its_diffuse_color_or_white(tmp_path, material, face, color):
    text = VERTICES + "vt 0 0\n"
    if material:
        write(tmp_path / "plain.mtl", f"newmtl plain\n{material}\n")
        text = f"mtllib plain.mtl\n{text}usemtl plain\n"
    mesh = load_mesh(write(tmp_path / "mesh.obj", text + face))
    assert_allclose(mesh.corner_colors, np.broadcast_to(color, (1, 3, 3)), **FLOAT32)
    assert (mesh.texture_ids.tolist(), mesh.textures) == ([-1], ())


def test_a_ply_has_its_vertex_or_face_colors(tmp_path):
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    for kind in ("vertex", "face"):
        colored, colors = square.copy(), np.random.default_rng(0).integers(0, 256, (4 if kind == "vertex" else 2, 3))
        setattr(colored.visual, f"{kind}_colors", colors.astype(np.uint8))
        colored.export(tmp_path / "mesh.ply")
        expected = colors[square.faces] if kind == "vertex" else colors[:, None].repeat(3, axis=1)
        assert_allclose(load_mesh(tmp_path / "mesh.ply").corner_colors, expected / 255, **FLOAT32)


def test_an_stl_is_white_and_its_corners_are_joined(tmp_path):
    """The format repeats a vertex in each face that has it."""
    box = trimesh.creation.box()
    box.export(tmp_path / "box.stl")
    mesh = load_mesh(tmp_path / "box.stl")
    assert len(mesh.vertices) == 8
    assert_array_equal(corners_of(mesh), box.triangles)
    assert_array_equal(mesh.corner_colors, np.ones((12, 3, 3)))


def leaf_and_fruit() -> tuple[trimesh.Scene, np.ndarray, np.ndarray]:
    """Two boxes, one textured and mirrored, one plain; and their vertices in the scene, y up."""
    fruit = trimesh.creation.box()
    uvs = np.random.default_rng(2).random((8, 2))
    fruit.visual = TextureVisuals(uv=uvs, material=PBRMaterial(baseColorTexture=Image.fromarray(TEXTURE)))
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
    assert is_fruit.sum() == 12
    uv_of = dict(zip(map(tuple, fruit), np.random.default_rng(2).random((8, 2)), strict=True))
    expected = [[uv_of[x, z, -y] for x, y, z in face] for face in corners_of(mesh)[is_fruit]]
    assert_allclose(mesh.corner_uvs[is_fruit], expected, **FLOAT32)
    for part, vertices in ((is_fruit, fruit), (~is_fruit, leaf)):
        z_up = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
        corners = np.unique(corners_of(mesh)[part].reshape(-1, 3), axis=0)
        assert_allclose(corners, np.unique(z_up, axis=0), **FLOAT32)
        outward = ((corners_of(mesh)[part].mean(axis=1) - z_up.mean(axis=0)) * mesh.face_normals()[part]).sum(1)
        assert (outward > 0).all()
    encoded = [srgb_of(0.2), srgb_of(0.4), 1]
    assert_allclose(mesh.corner_colors[~is_fruit], np.broadcast_to(encoded, (12, 3, 3)), **FLOAT32)
    assert_array_equal(mesh.corner_colors[is_fruit], np.ones((12, 3, 3)))
    assert has_texture(mesh)


def test_glb_vertex_colors_are_linear_and_multiply_the_material(tmp_path):
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.tile([51, 102, 255, 255], (8, 1))
    box.export(tmp_path / "colors.glb")
    expected = np.broadcast_to([srgb_of(0.2), srgb_of(0.4), 1], (12, 3, 3))
    assert_allclose(load_mesh(tmp_path / "colors.glb").corner_colors, expected, **FLOAT32)

    box.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[102, 255, 51, 255]))
    box.visual.vertex_attributes["color"] = np.tile(np.array([51, 102, 255, 255], dtype=np.uint8), (8, 1))
    box.export(tmp_path / "both.glb")
    expected = np.broadcast_to([srgb_of(0.4 * 0.2), srgb_of(0.4), srgb_of(0.2)], (12, 3, 3))
    assert_allclose(load_mesh(tmp_path / "both.glb").corner_colors, expected, **FLOAT32)


@pytest.mark.parametrize(
    ("suffix", "up", "turned"),
    [("glb", "auto", True), ("glb", "y", True), ("glb", "z", False), ("ply", "auto", False), ("ply", "y", True)],
)
def test_up_becomes_z(tmp_path, suffix, up, turned):
    box = trimesh.creation.box((1, 2, 3))
    box.apply_translation([10, 20, 30])
    box.export(tmp_path / f"box.{suffix}")
    mesh = load_mesh(tmp_path / f"box.{suffix}", up)
    assert_allclose(mesh.vertices.mean(axis=0), [10, -30, 20] if turned else [10, 20, 30], **FLOAT32)
    outward = corners_of(mesh).mean(axis=1) - mesh.vertices.mean(axis=0)
    assert ((outward * mesh.face_normals()).sum(axis=1) > 0).all()


def test_unused_vertices_are_dropped_and_both_zeros_are_one_position(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv -0.0 -0.0 -0.0\nv 0 -1 0\nv 99 99 99\nf 1 2 3\nf 4 5 2\n"
    mesh = load_mesh(write(tmp_path / "mesh.obj", text))
    assert len(mesh.vertices) == 4
    assert mesh.faces[0, 0] == mesh.faces[1, 0]


# Files that a mesh names


@pytest.mark.parametrize(
    ("texture", "library", "location"),
    [
        ("peel.png", "peel.mtl", "peel.png"),
        ("textures\\peel.png", "peel.mtl", "textures/peel.png"),
        ("C:\\Users\\me\\peel.png", "peel.mtl", "peel.png"),
        ("orange peel.png", "my materials.mtl", "orange peel.png"),
        ("schäl.png", "bäume.mtl", "schäl.png"),
    ],
)
def test_a_texture_is_found_under_the_names_that_any_system_writes(tmp_path, texture, library, location):
    folder = tmp_path / "mesh"
    path = obj(folder, texture, library)
    (folder / location).parent.mkdir(exist_ok=True)
    write(folder / location, png())
    assert has_texture(load_mesh(path))


@pytest.mark.parametrize("image", ["../textures/orange%20peel.png", "orange%20peel.png", "data:image/png;base64,"])
def test_the_image_of_a_gltf_is_found(tmp_path, image):
    for folder in ("textures", "mesh"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "orange peel.png", png())
    uri = image + base64.b64encode(png()).decode() if image.startswith("data:") else image
    assert has_texture(load_mesh(gltf(tmp_path / "mesh", {"uri": uri})))


def test_names_and_comments_may_be_latin_1(tmp_path):
    write(tmp_path / "peel.mtl", "# Müller\nnewmtl schäl\nmap_Kd peel.png\n".encode("latin-1"))
    write(tmp_path / "peel.png", png())
    content = "# by Müller\nmtllib peel.mtl\n" + OBJ.replace("peel", "schäl")
    assert has_texture(load_mesh(write(tmp_path / "mesh.obj", content.encode("latin-1"))))


# Refused rather than read wrongly


def require_refusal(path: Path, reason: str = "") -> None:
    with pytest.raises(InputError, match=rf"(?s)^{re.escape(str(path))} .*{reason}"):
        load_mesh(path)


@pytest.mark.parametrize("make", [obj, ply, gltf])
@pytest.mark.parametrize("content", [None, b"GIF99", png()[:-40], "pipe"])
def test_an_image_that_is_missing_or_damaged_is_refused(tmp_path, make, content):
    path = make(tmp_path)
    if content == "pipe":
        os.mkfifo(tmp_path / "peel.png")
    elif content is not None:
        write(tmp_path / "peel.png", content)
    require_refusal(path, "(image|peel)")  # older releases of trimesh name the file alone


@pytest.mark.parametrize(
    "content", [None, "newmtl other\n", *(f"newmtl peel\nKd {x}\n" for x in ("1 0.5", "red", "nan 0 0"))]
)
def test_a_material_that_is_missing_or_has_no_color_is_refused(tmp_path, content):
    path = obj(tmp_path)
    (tmp_path / "peel.mtl").unlink()
    if content is not None:
        write(tmp_path / "peel.mtl", content)
    require_refusal(path)


def test_an_embedded_image_that_is_damaged_or_unknown_is_refused(tmp_path):
    for image in ({"uri": "data:image/png;base64,AAAA"}, {"bufferView": 0, "mimeType": "image/ktx2"}):
        require_refusal(gltf(tmp_path, image), "image")
    blob = leaf_and_fruit()[0].export(file_type="glb")
    start = blob.index(b"IDAT") + 8
    require_refusal(write(tmp_path / "mesh.glb", blob[:start] + b"\xff" * 40 + blob[start + 40 :]))


@pytest.mark.parametrize(
    ("keys", "value", "reason"),
    [
        (("extensionsRequired",), ["KHR_draco_mesh_compression"], "KHR_draco"),
        (("textures", 0), {"extensions": {"KHR_texture_basisu": {"source": 0}}}, "texture"),
        (("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "texCoord"), 1, "second set of coordinates"),
        (("materials", 0, "pbrMetallicRoughness", "baseColorFactor"), [float("nan")] * 4, ""),
        (("accessors", 0, "sparse"), {"count": 1}, "sparse accessors"),
        (("accessors", "TEXCOORD_0", "componentType"), 5123, "texture coordinates"),
        (("meshes", 0, "primitives", 0, "mode"), 6, "triangle fans"),
        (("nodes",), [{"mesh": 0, "scale": [1e30, 1, 1]}], "not finite or beyond"),
    ],
)
@pytest.mark.filterwarnings("ignore:.* encountered in:RuntimeWarning")  # trimesh's
def test_a_gltf_that_trimesh_reads_otherwise_than_meant_is_refused(tmp_path, keys, value, reason):
    path = gltf(tmp_path)
    write(tmp_path / "peel.png", png())
    node = tree = json.loads(path.read_text())
    for key in keys[:-1]:
        node = node[tree["meshes"][0]["primitives"][0]["attributes"][key] if key == "TEXCOORD_0" else key]
    node[keys[-1]] = value
    if keys == ("nodes",):
        tree["scenes"] = [{"nodes": [0]}]
    require_refusal(write(path, json.dumps(tree)), reason)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("missing.glb", None, "does not exist"),
        ("image.jpg", "", "no known mesh format: use one of .*glb"),
        ("truncated.glb", trimesh.creation.box().export(file_type="glb")[:500], "cannot be read"),
        ("beyond.obj", VERTICES + "f 1 2 9\n", "cannot be read"),
        ("negative.ply", PLAIN_PLY.replace(b"3 0 1 2", b"3 0 1 -2"), "faces name vertices that are not there"),
        ("points.ply", trimesh.PointCloud(np.eye(3)).export(file_type="ply"), "no faces"),
        *((f"{x}.obj", OBJ.replace("v 1 0 0", f"v {x} 0 0"), "not finite") for x in ("nan", "1e200")),
        *((f"{x}.obj", OBJ.replace("vt 1 0", f"vt {x} 0"), "not finite") for x in ("nan", "-1e13")),
        ("line.obj", "v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n", "zero area"),
        ("no_uvs.obj", "mtllib peel.mtl\n" + re.sub(r"/\d", "", OBJ), "no texture coordinates"),
    ],
)  # fmt: skip
def test_a_file_without_a_usable_surface_is_refused(tmp_path, name, content, reason):
    obj(tmp_path)
    write(tmp_path / "peel.png", png())
    if content is not None:
        write(tmp_path / name, content)
    require_refusal(tmp_path / name, reason)
