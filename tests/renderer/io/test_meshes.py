"""What a mesh names: found where other systems put it, and never passed over where it is missing."""

import base64
import io
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from renderer.errors import InputError
from renderer.mesh import Mesh, load_mesh

TEXTURE = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl peel\nf 1/1 2/2 3/3\n"
GLOSSY = "KHR_materials_pbrSpecularGlossiness"
PLY = """ply
format ascii 1.0
comment by {author}
comment TextureFile {texture}
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


def png(texture: np.ndarray = TEXTURE) -> bytes:
    content = io.BytesIO()
    Image.fromarray(texture).save(content, "PNG")
    return content.getvalue()


def obj(folder: Path, texture: str = "peel.png", library: str = "peel.mtl", head: str | None = None) -> Path:
    """An .obj with its materials; its texture is written by whoever wants one."""
    (folder / library).parent.mkdir(parents=True, exist_ok=True)
    (folder / library).write_text(f"newmtl peel\nKd 1 1 1\nmap_Kd {texture}\n")
    (folder / "mesh.obj").write_text((head or f"mtllib {library}\n") + OBJ)
    return folder / "mesh.obj"


def ply(folder: Path) -> Path:
    (folder / "mesh.ply").write_text(PLY.format(author="me", texture="peel.png"))
    return folder / "mesh.ply"


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
    (folder / "mesh.gltf").write_text(json.dumps(tree))
    return folder / "mesh.gltf"


def glb_with_damaged_image(folder: Path) -> Path:
    blob = textured_triangle().export(file_type="glb")
    (folder / "mesh.glb").write_bytes(blob.replace(b"\x89PNG", b"\x89GNP"))
    return folder / "mesh.glb"


def has_texture(mesh: Mesh) -> bool:
    return len(mesh.textures) == 1 and np.array_equal(mesh.textures[0], TEXTURE)


# ---------------------------------------------------------------------------------------- found


@pytest.mark.parametrize(
    ("texture", "library", "place"),
    [
        ("peel.png", "peel.mtl", "peel.png"),
        ("../textures/peel.png", "peel.mtl", "../textures/peel.png"),
        ("textures\\peel.png", "peel.mtl", "textures/peel.png"),
        ("C:\\Users\\me\\peel.png", "peel.mtl", "peel.png"),
        ("/home/me/peel.png", "peel.mtl", "peel.png"),
        ("orange peel.png", "my materials.mtl", "orange peel.png"),
        ("-s 1 1 1 peel.png", "peel.mtl", "peel.png"),
        ("peel.png", "materials/peel.mtl", "materials/peel.png"),
        ('"peel.png"', "peel.mtl", "peel.png"),
        ("schäl.png", "bäume.mtl", "schäl.png"),
    ],
)
def test_a_texture_is_found_where_the_materials_say_also_as_other_systems_say_it(tmp_path, texture, library, place):
    folder = tmp_path / "mesh"
    path = obj(folder, texture, library)
    (folder / place).parent.mkdir(exist_ok=True)
    (folder / place).write_bytes(png())
    assert has_texture(load_mesh(path))


@pytest.mark.parametrize("image", [{"uri": "../textures/orange%20peel.png"}, {"uri": "orange%20peel.png"}, "inside"])
def test_the_image_of_a_gltf_is_found_too(tmp_path, image):
    for folder in ("textures", "mesh"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "orange peel.png").write_bytes(png())
    inside = {"uri": "data:image/png;base64," + base64.b64encode(png()).decode()}
    assert has_texture(load_mesh(gltf(tmp_path / "mesh", inside if image == "inside" else image)))


@pytest.mark.parametrize(
    "head",
    ["mtllib a.mtl b.mtl\n", "mtllib a.mtl\nmtllib b.mtl\n", "# no mtllib c.mtl\nmtllib a.mtl\r\nmtllib b.mtl\r\n"],
)
def test_all_material_files_count(tmp_path, head):
    (tmp_path / "a.mtl").write_text("newmtl other\nmap_Kd nowhere.png\n")  # which no face uses
    path = obj(tmp_path, library="b.mtl", head=head)
    (tmp_path / "peel.png").write_bytes(png())
    assert has_texture(load_mesh(path))


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".off"])
def test_a_byte_of_latin_1_in_a_name_or_comment_is_no_fault(tmp_path, suffix):
    name = "Müller".encode("latin-1")
    triangle = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    if suffix == ".obj":
        content = b"# by " + name + b"\no " + name + b"\n" + OBJ.encode()
    elif suffix == ".ply":
        content = PLY.format(author="@", texture="peel.png").encode().replace(b"@", name)
        (tmp_path / "peel.png").write_bytes(png())
    elif suffix == ".stl":
        content = triangle.export(file_type="stl_ascii").encode().replace(b"solid", b"solid " + name, 1)
    else:
        content = b"OFF\n# by " + name + triangle.export(file_type="off").encode().removeprefix(b"OFF")
    (tmp_path / f"mesh{suffix}").write_bytes(content)
    assert_array_equal(load_mesh(tmp_path / f"mesh{suffix}").vertices, [[0, 0, 0], [0, 1, 0], [1, 0, 0]])


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_materials_in_another_encoding_are_read_with_their_texture(tmp_path, encoding):
    path = obj(tmp_path)
    (tmp_path / "peel.mtl").write_bytes("# Müller\nnewmtl peel\nmap_Kd peel.png\n".encode(encoding))
    (tmp_path / "peel.png").write_bytes(png())
    assert has_texture(load_mesh(path))


# ---------------------------------------------------------------------------------------- refused


@pytest.mark.parametrize("make", [obj, ply, gltf])
@pytest.mark.parametrize(
    ("content", "fault"),
    [(None, "which is not there"), (b"", "which is no image"), (b"GIF99", "which is no image"),
     ("folder", "is not there"), ("pipe", "is not there")],
    ids=["missing", "empty", "garbage", "folder", "pipe"],
)  # fmt: skip
def test_an_image_that_is_missing_or_none_is_refused_by_name(tmp_path, make, content, fault):
    path = make(tmp_path)
    if content == "pipe":
        os.mkfifo(tmp_path / "peel.png")
    elif content == "folder":
        (tmp_path / "peel.png").mkdir()
    elif content is not None:
        (tmp_path / "peel.png").write_bytes(content)
    with pytest.raises(InputError, match=rf"{re.escape(str(path))} names peel\.png, .*{fault}"):
        load_mesh(path)


@pytest.mark.parametrize("pipe", [False, True])
def test_materials_that_are_missing_are_refused_by_name(tmp_path, pipe):
    path = obj(tmp_path)
    (tmp_path / "peel.mtl").unlink()
    if pipe:
        os.mkfifo(tmp_path / "peel.mtl")
    with pytest.raises(InputError, match=r"mesh\.obj names peel\.mtl, which is not there: put it beside"):
        load_mesh(path)


@pytest.mark.parametrize("content", ["", "newmtl other\n", "\0\0"])
def test_a_material_that_its_file_lacks_is_refused_by_name(tmp_path, content):
    path = obj(tmp_path)
    (tmp_path / "peel.mtl").write_text(content)
    with pytest.raises(InputError, match=r"mesh\.obj uses the material peel, which no file"):
        load_mesh(path)


@pytest.mark.parametrize("image", [{"uri": "data:image/png;base64,AAAA"}, {"bufferView": 0, "mimeType": "image/ktx2"}])
def test_an_embedded_image_that_is_none_is_refused(tmp_path, image):
    with pytest.raises(InputError, match=r"mesh\.gltf names .*, which is no image that can be read"):
        load_mesh(gltf(tmp_path, image))


def test_a_damaged_image_in_a_glb_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"mesh\.glb names image 0, which is no image that can be read"):
        load_mesh(glb_with_damaged_image(tmp_path))


def test_a_texture_of_16_bits_is_scaled_and_not_clipped(tmp_path):
    Image.fromarray(TEXTURE[..., 0].astype(np.uint16) * 256).save(tmp_path / "peel.png")
    (texture,) = load_mesh(obj(tmp_path)).textures
    assert_array_equal(texture, np.repeat(TEXTURE[..., :1], 3, axis=2))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda path: path.write_bytes(png()[:-40]), "truncated"),
        (lambda path: Image.fromarray(np.ones((2, 2), np.float32)).save(path, "TIFF"), "no agreed white"),
        (lambda path: Image.new("1", (20_000, 10_000)).save(path), "exceeds limit"),
    ],
)
def test_a_texture_that_cannot_be_decoded_is_named_with_the_reason(tmp_path, damage, reason):
    damage(tmp_path / "peel.png")
    with pytest.raises(InputError, match=rf"names peel\.png, which is no image .*{reason}.*: save it as PNG or JPEG"):
        load_mesh(obj(tmp_path))


def test_an_image_without_texture_coordinates_is_refused(tmp_path):
    path = obj(tmp_path)
    path.write_text(re.sub(r"/\d", "", path.read_text()))
    (tmp_path / "peel.png").write_bytes(png())
    with pytest.raises(InputError, match=r"mesh\.obj cannot be read as a mesh \(an image has no texture coordinates"):
        load_mesh(path)


@pytest.mark.parametrize("color", ["1 0.5", "spectral peel.rfl", "red"])
def test_a_color_that_trimesh_passes_over_is_refused(tmp_path, color):
    path = obj(tmp_path)
    (tmp_path / "peel.mtl").write_text(f"newmtl peel\nKd {color}\n")
    with pytest.raises(InputError, match=rf"mesh\.obj .*the material peel has the color '{color}'"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("keys", "value", "reason"),
    [
        (("extensionsRequired",), ["KHR_draco_mesh_compression"], "needs KHR_draco"),
        (("textures", 0, "source"), -1, "source is -1"),
        (("textures", 0), {"extensions": {"KHR_texture_basisu": {"source": 0}}}, "no image as PNG"),
        (("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "texCoord"), 1, "second set of coordinates"),
        (("materials", 0, "pbrMetallicRoughness", "baseColorFactor"), [float("nan")] * 4, "NaN is no number"),
        (("materials", 0, "extensions"), {GLOSSY: {"diffuseTexture": {"index": 7}}}, "index out of range"),
        (("accessors", 0, "sparse"), {"count": 1}, "sparse accessors"),
        (("accessors", "TEXCOORD_0", "componentType"), 5123, "TEXCOORD_0 are whole numbers"),
    ],
)
def test_what_trimesh_takes_otherwise_than_gltf_means_it_is_refused(tmp_path, keys, value, reason):
    path = gltf(tmp_path)
    (tmp_path / "peel.png").write_bytes(png())
    node = tree = json.loads(path.read_text())
    for key in keys[:-1]:
        node = node[tree["meshes"][0]["primitives"][0]["attributes"][key] if key == "TEXCOORD_0" else key]
    node[keys[-1]] = value
    path.write_text(json.dumps(tree))
    with pytest.raises(InputError, match=rf"mesh\.gltf cannot be read as a mesh \(.*{reason}"):
        load_mesh(path)


@pytest.mark.parametrize("value", ["1e200", "-1e13", "nan"])
@pytest.mark.parametrize("line", ["v {} 0 0", "vt {} 0"])
def test_coordinates_beyond_reason_name_the_file(tmp_path, value, line):
    (tmp_path / "mesh.obj").write_text(OBJ.replace(line.format(1), line.format(value)))
    with pytest.raises(
        InputError, match=r"mesh\.obj cannot be read as a mesh \((texture )?coordinates are not finite or"
    ):
        load_mesh(tmp_path / "mesh.obj")


@pytest.mark.parametrize("color", ["nan 0 0", "inf 0 0"])
def test_a_color_that_is_no_number_names_the_file(tmp_path, color):
    path = obj(tmp_path)
    (tmp_path / "peel.mtl").write_text(f"newmtl peel\nKd {color}\n")
    if "inf" in color:
        assert load_mesh(path).corner_colors[0, 0].tolist() == [1, 0, 0]  # as beyond 1 in any file
    else:
        with pytest.raises(InputError, match=r"mesh\.obj cannot be read as a mesh \(colors are not finite"):
            load_mesh(path)


@pytest.mark.filterwarnings("ignore:.* encountered in:RuntimeWarning")  # trimesh's, on what is then refused
@pytest.mark.parametrize("node", [{"scale": [1e30, 1, 1]}, {"matrix": [1e30] * 16}])
def test_a_node_that_puts_its_mesh_beyond_reason_names_the_file(tmp_path, node):
    path = gltf(tmp_path)
    (tmp_path / "peel.png").write_bytes(png())
    tree = json.loads(path.read_text())
    tree["nodes"] = [{"mesh": 0, **node}]
    tree["scenes"] = [{"nodes": [0]}]
    path.write_text(json.dumps(tree))
    with pytest.raises(InputError, match=r"mesh\.gltf has coordinates that are not finite or beyond"):
        load_mesh(path)


def test_an_archive_is_refused(tmp_path):
    (tmp_path / "mesh.zip").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"mesh\.zip has no known mesh format"):
        load_mesh(tmp_path / "mesh.zip")


# ---------------------------------------------------------------------------------------- anything


@pytest.mark.parametrize("make", [obj, ply, gltf, glb_with_damaged_image])
def test_any_damage_is_a_mesh_or_one_sentence(tmp_path, make):
    path = make(tmp_path)
    (tmp_path / "peel.png").write_bytes(png())
    whole = path.read_bytes()

    @settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(st.integers(0, len(whole) - 1), st.binary(max_size=4), st.integers(0, 6))
    def check(at, inserted, cut):
        path.write_bytes(whole[:at] + inserted + whole[at + cut :])
        try:
            assert np.isfinite(load_mesh(path).vertices).all()
        except InputError as error:
            assert str(path) in str(error)

    check()
