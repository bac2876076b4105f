"""Binary .ply files and polygons."""

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from renderer.errors import InputError
from renderer.io.meshes import load_mesh

NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
CODES = dict(zip((*NAMES, "uint8", "int32", "float64"), "bBhHiIfdBid", strict=True))
# A concave pentagon, a triangle and a quadrilateral, with a color for each vertex.
VERTICES = np.array(
    [[0, 0, 0], [4, 0, 0], [4, 4, 0], [2, 1, 0], [0, 4, 0], [0, 0, 1], [4, 0, 1], [0, 0, 5]]
)
FACES = ([0, 1, 2, 3, 4], [0, 1, 5], [1, 6, 7, 0])
COLORS = np.random.default_rng(0).integers(0, 256, (len(VERTICES), 3))
AREAS = (16 - 6, 2, 12)


def write_ply(
    path: Path, form, faces=FACES, position="float", length="uchar", index="int", line_break="\n"
) -> Path:
    """Write the vertices and faces as ASCII or with struct, without a library for .ply files."""
    lines = ["ply", f"format {form} 1.0", "comment end_header", f"element vertex {len(VERTICES)}"]
    lines += [f"property {position} {axis}" for axis in "xyz"] + ["property short quality"]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines += [f"element face {len(faces)}", f"property list {length} {index} vertex_index"]
    lines += ["property int flag", "end_header", ""]
    rows = [
        *(
            (3 * [position] + ["short"] + 3 * ["uchar"], [*vertex, -7, *color])
            for vertex, color in zip(VERTICES, COLORS, strict=True)
        ),
        *(([length] + len(face) * [index] + ["int"], [len(face), *face, 9]) for face in faces),
    ]
    if form == "ascii":
        lines[-1:] = [" ".join(map(str, values)) for _, values in rows]
        body = b""
    else:
        order = "<" if form == "binary_little_endian" else ">"
        body = b"".join(
            struct.pack(order + "".join(CODES[name] for name in types), *values)
            for types, values in rows
        )
    path.write_bytes(line_break.join(lines).encode() + body)
    return path


FORMS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.filterwarnings("ignore:.*flag, quality")
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("types", "line_break"),
    [
        ({}, "\r\n"),
        ({"position": "double", "length": "int", "index": "ushort"}, "\n"),
        ({"position": "float64", "length": "uint8", "index": "int32"}, "\r"),
        ({"position": "int", "length": "ushort", "index": "char"}, "\n"),
    ],
)
def test_all_encodings_of_a_ply_give_the_same_mesh(tmp_path, form, types, line_break):
    mesh = load_mesh(write_ply(tmp_path / "mesh.ply", form, line_break=line_break, **types))
    assert_array_equal(np.unique(mesh.vertices, axis=0), np.unique(VERTICES, axis=0))
    areas = np.add.reduceat(mesh.face_areas(), [0, 3, 4])
    assert_allclose(areas, AREAS)
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    colors = np.rint(255 * mesh.corner_colors).reshape(-1, 3)
    found = {tuple(corner): tuple(color) for corner, color in zip(corners, colors, strict=True)}
    assert found == {tuple(v): tuple(c) for v, c in zip(VERTICES, COLORS, strict=True)}


@pytest.mark.filterwarnings("ignore:.*flag, quality")
@pytest.mark.parametrize("faces", [[[0, 1, 5], [1, 6, 5]], FACES])
@pytest.mark.parametrize("form", FORMS)
def test_a_truncated_ply_is_refused(tmp_path, form, faces):
    path = write_ply(tmp_path / "mesh.ply", form, faces)
    content = path.read_bytes()
    for length in range(content.index(b"\nend_header") + len("\nend_header\n"), len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(InputError, match=r"mesh\.ply"):
            load_mesh(path)


@pytest.mark.parametrize("length", [-5, 2**31 - 1])
def test_a_list_of_an_impossible_length_is_refused(tmp_path, length):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element face 1\nproperty list int int vertex_indices\nend_header\n"
    numbers = np.array([length, 0, 1, 2], "<i4").tobytes()
    (tmp_path / "mesh.ply").write_bytes(
        header.encode() + np.eye(3, dtype="<f4").tobytes() + numbers
    )
    with pytest.raises(InputError, match="truncated"):
        load_mesh(tmp_path / "mesh.ply")


@pytest.mark.filterwarnings("ignore:.*flag, quality")
@pytest.mark.parametrize("index", [-1, len(VERTICES)])
@pytest.mark.parametrize("form", FORMS)
def test_a_missing_vertex_is_refused(tmp_path, form, index):
    path = write_ply(tmp_path / "mesh.ply", form, [[0, 1, index]])
    with pytest.raises(InputError, match="vertex"):
        load_mesh(path)


@pytest.mark.parametrize("form", FORMS)
def test_more_rows_than_the_file_has_are_refused_before_memory_is_allocated(tmp_path, form):
    path = write_ply(tmp_path / "mesh.ply", form)
    content = path.read_bytes()
    for element in (b"element vertex ", b"element face "):
        path.write_bytes(content.replace(element, element + b"9" * 12))
        with pytest.raises(InputError, match="truncated"):
            load_mesh(path)
