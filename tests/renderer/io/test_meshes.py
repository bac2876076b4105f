"""Meshes from files of every format that the tests write, with their colors and textures."""

import json
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from gltf_files import Gltf
from numpy.testing import assert_allclose, assert_array_equal
from oracles import corners_of, encoded

from renderer.errors import InputError
from renderer.io.meshes import load_mesh
from renderer.mesh import Mesh

TEXTURE = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
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


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def write_obj(folder: Path, texture: str = "peel.png", library: str = "peel.mtl") -> Path:
    """Write a textured triangle as .obj with its material library, without the texture."""
    folder.mkdir(exist_ok=True)
    write(folder / library, f"newmtl peel\nKd 1 1 1\nmap_Kd {texture}\n")
    return write(folder / "mesh.obj", f"mtllib {library}\n{OBJ}")


def write_ply(folder: Path) -> Path:
    return write(folder / "mesh.ply", PLY)


def write_gltf(folder: Path, image: dict[str, Any] | None = None) -> Path:
    """Write a textured square as .gltf that contains its buffers, by default beside peel.png."""
    gltf = Gltf()
    gltf.square(pbrMetallicRoughness={"baseColorTexture": gltf.texture(TEXTURE)})
    gltf.tree["images"] = [image or {"uri": "peel.png"}]
    return gltf.write(folder / "mesh.gltf")


def has_texture(mesh: Mesh) -> bool:
    return len(mesh.textures) == 1 and np.array_equal(mesh.textures[0], TEXTURE)


def test_facets_of_zeros_at_the_end_of_an_stl_are_left_out(tmp_path):
    """As numpy-stl writes rows that were not filled."""
    ball = trimesh.creation.icosphere(1, radius=0.1).apply_translation([5, 5, 5])
    content = bytearray(ball.export(file_type="stl"))
    content[80:84] = (len(ball.faces) + 3).to_bytes(4, "little")
    write(tmp_path / "ball.stl", bytes(content) + bytes(3 * 50))
    mesh = load_mesh(tmp_path / "ball.stl")
    assert len(mesh.faces) == len(ball.faces) and mesh.vertices.min() > 4


def test_an_stl_is_white_and_its_corners_are_joined(tmp_path):
    """The format repeats a vertex in each of its faces."""
    box = trimesh.creation.box()
    box.export(tmp_path / "box.stl")
    mesh = load_mesh(tmp_path / "box.stl")
    assert len(mesh.vertices) == 8
    assert_array_equal(corners_of(mesh), box.triangles)
    assert_array_equal(mesh.corner_colors, np.ones((12, 3, 3)))


@pytest.mark.parametrize(
    ("suffix", "up", "center"),
    [
        ("glb", "auto", [10, -30, 20]),
        ("glb", "y", [10, -30, 20]),
        ("glb", "z", [10, 20, 30]),
        ("ply", "auto", [10, 20, 30]),
        ("ply", "y", [10, -30, 20]),
    ],
)
def test_the_axis_that_is_up_becomes_z(tmp_path, suffix, up, center):
    """By default, y is up in a .glb file and z in a .ply file."""
    box = trimesh.creation.box((1, 2, 3))
    box.apply_translation([10, 20, 30])
    box.export(tmp_path / f"box.{suffix}")
    mesh = load_mesh(tmp_path / f"box.{suffix}", up)
    assert_allclose(mesh.vertices.mean(axis=0), center, rtol=1e-6)
    # The faces point outward.
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume > 0


def test_unused_vertices_are_removed_and_both_zeros_are_one_position(tmp_path):
    text = VERTICES + "v -0.0 -0.0 -0.0\nv 0 -1 0\nv 99 99 99\nf 1 2 3\nf 4 5 2\n"
    mesh = load_mesh(write(tmp_path / "mesh.obj", text))
    assert len(mesh.vertices) == 4
    assert mesh.faces[0, 0] == mesh.faces[1, 0]


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
def test_textures_of_obj_are_found_by_the_names_of_any_system(tmp_path, texture, library, location):
    folder = tmp_path / "mesh"
    path = write_obj(folder, texture, library)
    (folder / location).parent.mkdir(exist_ok=True)
    write(folder / location, encoded(TEXTURE))
    assert has_texture(load_mesh(path))


def test_names_and_comments_of_an_obj_may_be_latin_1(tmp_path):
    write(tmp_path / "peel.mtl", "# Müller\nnewmtl schäl\nmap_Kd peel.png\n".encode("latin-1"))
    write(tmp_path / "peel.png", encoded(TEXTURE))
    content = "# by Müller\nmtllib peel.mtl\n" + OBJ.replace("peel", "schäl")
    assert has_texture(load_mesh(write(tmp_path / "mesh.obj", content.encode("latin-1"))))


def require_refusal(path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(path.name)):
        load_mesh(path)


@pytest.mark.parametrize("writer", [write_obj, write_ply, write_gltf])
@pytest.mark.parametrize(
    "make",
    [
        lambda path: None,
        lambda path: path.write_bytes(b"GIF99"),
        lambda path: path.write_bytes(encoded(TEXTURE)[:-40]),
        os.mkfifo,
    ],
    ids=["missing", "no image", "truncated", "a pipe"],
)
def test_what_is_no_texture_is_refused(tmp_path, writer, make):
    make(tmp_path / "peel.png")
    require_refusal(writer(tmp_path))


def test_a_missing_material_or_library_is_refused(tmp_path):
    path = write_obj(tmp_path)
    write(tmp_path / "peel.mtl", "newmtl other\n")
    require_refusal(path)
    (tmp_path / "peel.mtl").unlink()
    require_refusal(path)


@pytest.mark.parametrize(
    "image", [{"uri": "data:image/png;base64,AAAA"}, {"bufferView": 1, "mimeType": "image/ktx2"}]
)
def test_a_damaged_or_unknown_image_inside_of_a_gltf_is_refused(tmp_path, image):
    require_refusal(write_gltf(tmp_path, image))


def base_color(tree: dict[str, Any]) -> dict[str, Any]:
    return tree["materials"][0]["pbrMetallicRoughness"]


CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "absent uvs": lambda tree: base_color(tree)["baseColorTexture"].update(texCoord=1),
    "NaN": lambda tree: base_color(tree).update(baseColorFactor=[math.nan] * 4),
    "sparse values without places": lambda tree: tree["accessors"][0].update(sparse={"count": 1}),
    "integers that are not normalized": lambda tree: tree["accessors"][1].update(
        componentType=5123
    ),
    "huge": lambda tree: tree.update(
        nodes=[{"mesh": 0, "scale": [1e30, 1, 1]}], scenes=[{"nodes": [0]}]
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_gltf_that_cannot_be_read_correctly_is_refused(tmp_path, change):
    path = write_gltf(tmp_path)
    write(tmp_path / "peel.png", encoded(TEXTURE))
    tree = json.loads(path.read_text())
    CHANGES[change](tree)
    require_refusal(write(path, json.dumps(tree)))


BOX_GLB = trimesh.creation.box().export(file_type="glb")
POINTS_PLY = trimesh.PointCloud(np.eye(3)).export(file_type="ply")
UNUSABLE_FILES = {
    "truncated.glb": BOX_GLB[:500],
    "points.ply": POINTS_PLY,
    "huge_vertex.obj": OBJ.replace("v 1 0 0", "v 1e200 0 0"),
    "huge_uv.obj": OBJ.replace("vt 1 0", "vt -1e13 0"),
    "line.obj": "v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n",
    "image.jpg": "",
}


@pytest.mark.parametrize("name", UNUSABLE_FILES)
def test_a_file_without_a_usable_surface_is_refused(tmp_path, name):
    write_obj(tmp_path)
    write(tmp_path / "peel.png", encoded(TEXTURE))
    require_refusal(write(tmp_path / name, UNUSABLE_FILES[name]))
