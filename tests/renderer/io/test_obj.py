"""Spellings of .obj and .mtl files, and the files that they name."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import corners_of, linear_of, png_of, srgb_of

from renderer.errors import InputError
from renderer.io.meshes import load_mesh
from renderer.mesh import Mesh

RED = (1.0, 0.0, 0.0)
GREEN = (0.0, 1.0, 0.0)
BLUE = (0.0, 0.0, 1.0)
WHITE = (1.0, 1.0, 1.0)
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
# Three objects with a material each, in the plainest spelling.
PLAIN = """mtllib m.mtl
usemtl red
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
usemtl green
f 1 4 3
f 2 3 4
"""
LIBRARY = "newmtl red\nKd 1 0 0\nnewmtl green\nKd 0 1 0\n"


def load(folder: Path, text: str | bytes, **files: str | bytes) -> Mesh:
    """Load an .obj file with material libraries, whose names are the keywords."""
    for name, data in {"m": LIBRARY, **files}.items():
        (folder / f"{name}.mtl").write_bytes(data if isinstance(data, bytes) else data.encode())
    path = folder / "mesh.obj"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_mesh(path)


def face_colors(mesh: Mesh) -> list[tuple[float, ...]]:
    return [tuple(colors) for colors in mesh.corner_colors[:, 0].tolist()]


def lines_with_relative_indices(order: str) -> str:
    lines = []
    for number in range(3):
        lines += [f"v {x + 3 * number} {y} {z}" for x, y, z in TETRAHEDRON]
        for index, face in enumerate(FACES):
            is_relative = order == "relative" or (order == "mixed" and index % 2)
            corners = face - 4 if is_relative else face + 1 + 4 * number
            lines.append("f " + " ".join(map(str, corners)))
    return "\n".join(lines)


@pytest.mark.parametrize("order", ["relative", "absolute", "mixed"])
def test_relative_indices_count_from_the_line_of_the_face(tmp_path, order):
    mesh = load(tmp_path, lines_with_relative_indices(order))
    expected = [TETRAHEDRON[FACES] + [3 * number, 0, 0] for number in range(3)]
    assert_array_equal(corners_of(mesh), np.concatenate(expected))


def test_relative_texture_coordinates_and_normals_count_from_the_line_of_the_face(tmp_path):
    (tmp_path / "red.png").write_bytes(png_of(255, 0, 0))
    triangle = "v 0 0 {0}\nv 1 0 {0}\nv 0 1 {0}\nvt 0 .{0}\nvt 1 .{0}\nf -3/-2 -2/-1 -1/-1\n"
    text = "mtllib t.mtl\nusemtl t\n" + triangle.format(1) + triangle.format(2)
    mesh = load(tmp_path, text, t="newmtl t\nmap_Kd red.png")
    assert_allclose(mesh.corner_uvs[..., 1], [[0.1] * 3, [0.2] * 3])


SPELLINGS = {
    "tabs": PLAIN.replace(" ", "\t"),
    "CRLF": PLAIN.replace("\n", "\r\n"),
    "CR": PLAIN.replace("\n", "\r"),
    "continued lines": PLAIN.replace(" 0 ", " \\\n0 \\\r\n"),
    "comments": PLAIN.replace("\n", "\n# mtllib other.mtl \\\n\t#f 1 2 3\n"),
    "comments at the end": re.sub("^([vf].*)$", r"\1 # usemtl blue", PLAIN, flags=re.MULTILINE),
    "comments after names": PLAIN.replace("m.mtl", "m.mtl # x").replace("red", "red # y"),
    "UTF-8 with BOM": b"\xef\xbb\xbf" + PLAIN.encode(),
    "UTF-16": PLAIN.encode("utf-16"),
    "UTF-16 BE": b"\xfe\xff" + PLAIN.encode("utf-16-be"),
    "late library": PLAIN.replace("mtllib m.mtl\n", "") + "mtllib m.mtl\n",
    "groups": PLAIN.replace("f ", "g one two\no f 1 2 3\nf "),
    "slashes": re.sub(r"^f .*", lambda line: re.sub(r"(\d)", r"\1//", line[0]), PLAIN, flags=re.M),
    "backslash at the end": PLAIN.rstrip("\n") + " \\",
    "normals of NaN": re.sub(
        r"^f .*", lambda line: re.sub(r"(\d)", r"\1//1", line[0]), PLAIN, flags=re.M
    )
    + "vn -nan(ind) nan 1\n",
    "exponents": PLAIN.replace("v 1 0 0", "v 1E+0 0.0e-5 -0."),
    "vertices last": re.sub("^v.*\n", "", PLAIN, flags=re.M)
    + "".join(re.findall("^v.*\n", PLAIN, flags=re.M)),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_all_spellings_of_a_file_give_the_same_mesh(tmp_path, spelling):
    mesh = load(tmp_path, SPELLINGS[spelling])
    assert_array_equal(corners_of(mesh), TETRAHEDRON[FACES])
    assert face_colors(mesh) == [RED, RED, GREEN, GREEN]


@pytest.mark.parametrize(
    "lines",
    [
        "mtllib a.mtl\nmtllib b.mtl",
        "mtllib a.mtl b.mtl",
        "mtllib two words.mtl a.mtl b.mtl",
        "mtllib  a.mtl\t b.mtl ",
        'mtllib "a.mtl"\nmtllib b.mtl',
        "# mtllib c.mtl\nmtllib a.mtl\nmtllib b.mtl",
    ],
)
def test_all_material_libraries_are_read_and_the_first_definition_counts(tmp_path, lines):
    text = PLAIN.replace("mtllib m.mtl", lines)
    libraries = {"a": "newmtl red\nKd 1 0 0", "two words": "newmtl other\nKd 0 0 1"}
    libraries["b"] = "newmtl green\nKd 0 1 0\nnewmtl red\nKd 0 0 1"
    assert face_colors(load(tmp_path, text, **libraries)) == [RED, RED, GREEN, GREEN]


@pytest.mark.parametrize(
    ("name", "library"),
    [
        ("dark  red", LIBRARY.replace("red", "dark  red")),
        ("red", LIBRARY.replace("Kd", "kd").replace("newmtl", "NewMtl")),
        ("red", LIBRARY + "newmtl glass\nd 0.1\nmap_Kd missing.png"),
    ],
    ids=["a name with blanks", "keywords in any case", "a material out of use"],
)
def test_the_materials_in_use_are_found_by_name(tmp_path, name, library):
    mesh = load(tmp_path, PLAIN.replace("red", name), m=library)
    assert face_colors(mesh) == [RED, RED, GREEN, GREEN]


def test_faces_without_a_material_are_white_with_a_warning_if_no_library_is_named(tmp_path):
    text = PLAIN.replace("usemtl red\n", "")
    assert face_colors(load(tmp_path, text)) == [WHITE, WHITE, GREEN, GREEN]
    with pytest.warns(UserWarning, match="no material library"):
        mesh = load(tmp_path, PLAIN.replace("mtllib m.mtl", ""))
    assert face_colors(mesh) == [WHITE] * 4


def test_an_object_without_vertex_colors_does_not_bleach_the_others(tmp_path):
    text = "v 0 0 0 0 0 1\nv 1 0 0 0 0 1\nv 0 1 0 0 0 1\nf 1 2 3\n"
    text += "v 0 0 1\nv 1 0 1\nv 0 1 1\nf -3 -2 -1\n"
    assert face_colors(load(tmp_path, text)) == [BLUE, WHITE]


def test_vertex_colors_from_0_to_255_are_read_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match="255"):
        mesh = load(tmp_path, "v 0 0 0 51 0 255\nv 1 0 0 51 0 255\nv 0 1 0 51 0 255\nf 1 2 3\n")
    assert_allclose(mesh.corner_colors[0], [[0.2, 0, 1]] * 3, atol=1e-7)


# Blender writes linear colors. Other programs write sRGB, or do not say.
@pytest.mark.parametrize(
    ("head", "linear_gray"), [("", linear_of(0.5)), ("# Blender 4.4.0 MTL File: 'None'\n", 0.5)]
)
def test_material_and_vertex_colors_are_multiplied_as_linear_values(tmp_path, head, linear_gray):
    text = "mtllib m.mtl\nusemtl gray\n"
    text += "v 0 0 0 .5 .25 1\nv 1 0 0 .5 .25 1\nv 0 1 0 .5 .25 1\nf 1 2 3\n"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = load(tmp_path, text, m=f"{head}newmtl gray\nKd .5 .5 .5")
    assert bool(caught) == (head == "")
    expected = [srgb_of(linear_gray * linear_of(value)) for value in (0.5, 0.25, 1.0)]
    assert_allclose(mesh.corner_colors[0], [expected] * 3, atol=1e-6)


@pytest.mark.parametrize("gray", ["0.40000000", "0.000000"])
def test_a_gray_color_beside_a_texture_does_not_darken_it(tmp_path, gray):
    (tmp_path / "red.png").write_bytes(png_of(255, 0, 0))
    library = f"newmtl red\nmap_Kd red.png\nKd {gray} {gray} {gray}\nTr 1.000000"
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nmtllib m.mtl\nusemtl red\nf 1/1 2/1 3/1\n"
    with pytest.warns(UserWarning, match="Kd beside map_Kd.*Tr 1"):
        mesh = load(tmp_path, text, m=library)
    assert_array_equal(mesh.corner_colors, np.ones((1, 3, 3)))


def test_faces_of_a_material_without_a_name_are_white(tmp_path):
    assert face_colors(load(tmp_path, PLAIN.replace("usemtl green", "usemtl "))) == [
        *(RED, RED),
        *(WHITE, WHITE),
    ]


@pytest.mark.filterwarnings("ignore:ignored in .obj files", "ignore:.*black material emits")
@pytest.mark.parametrize(
    ("light", "color", "count"),
    [
        ("Ke 0 7 0", GREEN, 0),
        ("Ke spectral a.rfl", (0, 0, 0), 0),
        ("Ke 0 0 0\nmap_Ke t.png", WHITE, 1),
        ("Ke 0.0 0 0", (0, 0, 0), 0),
    ],
)
def test_the_light_of_a_black_material_is_its_color(tmp_path, light, color, count):
    """Blender writes a texture without shading like this."""
    (tmp_path / "t.png").write_bytes(png_of(255, 0, 0))
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nmtllib m.mtl\nusemtl red\nf 1/1 2/1 3/1\n"
    mesh = load(tmp_path, text, m=f"newmtl red\nKd 0.0 0 0\n{light}\n")
    assert face_colors(mesh) == [color] and len(mesh.textures) == count


def test_materials_with_different_textures_keep_them_apart(tmp_path):
    for name, color in (("r", (255, 0, 0)), ("g", (0, 255, 0))):
        (tmp_path / f"{name}.png").write_bytes(png_of(*color))
    library = "newmtl red\nmap_Kd r.png\nnewmtl green\nmap_Kd g.png\nnewmtl again\nmap_Kd r.png\n"
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nmtllib m.mtl\n"
    for name in ("green", "red", "again", "green"):
        text += f"usemtl {name}\nf 1/1 2/1 3/1\n"
    mesh = load(tmp_path, text, m=library)
    found = [mesh.textures[index][0, 0].tolist() for index in mesh.texture_ids]
    assert found == [[0, 255, 0], [255, 0, 0], [255, 0, 0], [0, 255, 0]]
    assert len(mesh.textures) == 2


@pytest.mark.parametrize("library", ["sub/m.mtl", "sub\\m.mtl", "./sub/m.mtl"])
def test_images_are_sought_in_the_folder_of_the_library_then_in_that_of_the_mesh(tmp_path, library):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "a.png").write_bytes(png_of(255, 0, 0))
    (tmp_path / "a.png").write_bytes(png_of(0, 0, 255))
    (tmp_path / "b.png").write_bytes(png_of(0, 255, 0))
    text = f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nmtllib {library}\nmtllib m.mtl\n"
    text += "".join(f"usemtl {name}\nf 1/1 2/1 3/1\n" for name in ("a", "b", "c"))
    (tmp_path / "sub" / "m.mtl").write_text("newmtl a\nmap_Kd a.png\nnewmtl b\nmap_Kd b.png\n")
    mesh = load(tmp_path, text, m="newmtl c\nmap_Kd a.png\n")
    found = [mesh.textures[index][0, 0].tolist() for index in mesh.texture_ids]
    assert found == [[255, 0, 0], [0, 255, 0], [0, 0, 255]]


def test_concave_faces_keep_their_shape_and_their_texture_coordinates(tmp_path):
    (tmp_path / "red.png").write_bytes(png_of(255, 0, 0))
    points = [(2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (2, 0)]
    text = "mtllib m.mtl\nusemtl m\n"
    text += "".join(f"v {x} {y} 0\nvt {x / 2} {y / 2}\n" for x, y in points)
    text += "f " + " ".join(f"{index}/{index}" for index in range(1, 7))
    mesh = load(tmp_path, text, m="newmtl m\nmap_Kd red.png")
    assert mesh.face_areas().sum() == pytest.approx(3)
    assert_allclose(mesh.corner_uvs, corners_of(mesh)[..., :2] / 2)


@pytest.mark.parametrize("written", ["../secret.{}", "sub/../../secret.{}", "{}/secret", "link.{}"])
@pytest.mark.parametrize("kind", ["mtl", "png"])
def test_files_outside_of_the_folder_are_refused(tmp_path, kind, written):
    secret = tmp_path / f"secret.{kind}"
    secret.write_bytes(LIBRARY.encode() if kind == "mtl" else png_of(255, 0, 0))
    folder = tmp_path / "mesh"
    (folder / "sub").mkdir(parents=True)
    (folder / f"link.{kind}").symlink_to(secret)
    name = str(secret) if written == "{}/secret" else written.format(kind)
    library = name if kind == "mtl" else "m.mtl"
    text = f"mtllib {library}\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n"
    with pytest.raises(InputError, match="not below"):
        load(folder, text, m=f"newmtl red\nmap_Kd {name}\n")
