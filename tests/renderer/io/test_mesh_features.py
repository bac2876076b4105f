"""Every feature of a mesh file is read, ignored with a warning, or refused with a sentence.

Ignored features change neither the shape nor the base color.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import png_of

from renderer.errors import InputError
from renderer.io.meshes import load_mesh

RED = (1.0, 0.0, 0.0)
GREEN = (0.0, 1.0, 0.0)
WHITE = (1.0, 1.0, 1.0)
GRAY = (0.5, 0.5, 0.5)
IGNORED = "ignored"
REFUSED = "refused"
ASSUMED = "assumed"
# Words in the warnings.
WARNINGS = {IGNORED: "ignored", ASSUMED: "taken as"}
RGB = "uchar red;uchar green;uchar blue"

Files = Mapping[str, str | bytes]


def color_of(folder: Path, files: Files) -> np.ndarray:
    """Load a mesh, and return the colors of its corners times the first texels, (F, 3, 3)."""
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = load_mesh(folder / next(iter(files)))
    texels = np.array([*(texture[0, 0] / 255 for texture in mesh.textures), WHITE])
    assert mesh.face_areas().sum() == pytest.approx(0.5)
    return mesh.corner_colors * texels[mesh.texture_ids][:, None]


def obj(statements="", face="f 1 2 3", mtl=None, vertex="") -> dict[str, str | bytes]:
    """Return an .obj file, with a material library if `mtl` has the properties of a material."""
    corners = ("0 0 0", "1 0 0", "0 1 0")
    lines = [f"v {corner} {vertex}" for corner in corners]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1", "vn 0 0 1", statements, face]
    if mtl is None:
        return {"mesh.obj": "\n".join(lines)}
    lines[:0] = ["mtllib m.mtl", "usemtl m"]
    pictures = {"red.png": png_of(255, 0, 0), "clear.png": png_of(255, 0, 0, 9)}
    return {"mesh.obj": "\n".join(lines), "m.mtl": f"newmtl m\n{mtl}\n"} | pictures


def ply(vertex="", face="", header="", at="", of="", corners=("0 0 0", "1 0 0", "0 1 0"), tail=""):
    """Return a .ply file with more properties, and values at each vertex and of the face."""
    lines = ["ply", "format ascii 1.0", *header.split(";")]
    lines += ["element vertex 3", *(f"property float {axis}" for axis in "xyz")]
    lines += [f"property {name}" for name in vertex.split(";") if name]
    lines += ["element face 1", "property list uchar int vertex_indices"]
    lines += [f"property {name}" for name in face.split(";") if name]
    lines += [*tail.split(";")[:-1], "end_header"]
    lines += [f"{corner} {at}" for corner in corners]
    lines += [f"3 0 1 2 {of}", tail.split(";")[-1]]
    text = "\n".join(line for line in lines if line)
    images = {
        f"{name}.png": png_of(*color) for name, color in (("red", (255, 0, 0)), ("b", (0, 0, 9)))
    }
    return {"mesh.ply": text, **images}


def off(header: str = "OFF", vertex: str = "", face: str = "") -> dict[str, str | bytes]:
    corners = ("0 0 0", "1 0 0", "0 1 0")
    lines = [header, "3 1 0", *(f"{corner} {vertex}" for corner in corners), f"3 0 1 2 {face}"]
    return {"mesh.off": "\n".join(lines)}


def stl(attribute: int, header: bytes = b"", face_count: int = 1) -> dict[str, str | bytes]:
    numbers = np.array([0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0], dtype="<f4").tobytes()
    start = header.ljust(80, b" ") + face_count.to_bytes(4, "little")
    return {"mesh.stl": start + numbers + attribute.to_bytes(2, "little")}


def each(statements: str) -> list[str]:
    return statements.split("|")


STL_TEXT = """solid vertex
facet normal 0 0 1
 outer loop
  vertex 0 0 0
\tVERTEX 1e0 0 0
  vertex 0 1 0
 endloop
endfacet
endsolid"""
OFF_SQUARE = "OFF\n4 1 0\n0 0 0\n1 0 0\n1 .5 0\n0 .5 0\n4 0 1 2 3"
UV = "list uchar float texcoord"
UVS = "6 0 0 1 0 0 1"
NUMBERED = f"{UV};int texnumber"
IMAGE = "comment TextureFile red.png"
IMAGES = f"{IMAGE};comment TextureFile b.png"
TEXTURED = "f 1/1 2/2 3/3"
# Features, files and outcomes. The first file is the mesh, a white triangle with the corners
# (0, 0, 0), (1, 0, 0) and (0, 1, 0), apart from the feature. The outcome may be the color of all
# corners.
ROWS = [
    ("triangle", obj(), WHITE),
    ("vn", obj(face="f 1//1 2//1 3//1"), WHITE),
    ("vt for some corners", obj(face="f 1/1 2 3//1"), WHITE),
    ("vertex colors", obj(vertex="1 0 0"), RED),
    ("polypaint", obj("#MRGB ffff0000ffff0000\n#MRGB 00ff0000"), RED),
    ("polypaint of two vertices", obj("#MRGB ffff0000ffff0000"), REFUSED),
    ("weight", obj(vertex="2"), REFUSED),
    ("color above 1", obj(vertex="1.5 0 0"), REFUSED),
    ("line", obj("l 1 2"), IGNORED),
    ("smoothing group", obj("s 1"), IGNORED),
    ("face with two corners", obj("f 1 2"), IGNORED),
    *(
        (statement, obj(statement), REFUSED)
        for statement in each(
            "call other.obj|csh ls|cstype bezier|curv 0 1 1 2 3|surf 0 1 0 1 1 2 3|"
            "usemap red.png|polygon 1 2 3|f 1 2 4|f 1 2 -4|f 0 1 2|f 1/9 2 3|f 1/1/1/1 2 3|"
            "f 1 / 2 3|f 1 2 3.5|v 1 2|v 1 2 x|v 0 0 1.#QNAN|vt 0 1.#IND|f 1 /1 2 /1 3 /1|"
            "vt nan 0|\0"
        )
    ),
    ("Kd", obj(mtl="Kd 1 0 0"), RED),
    ("Kd of one number", obj(mtl="Kd 0.5"), ASSUMED),
    ("Kd and vertex colors", obj(mtl="Kd 1 1 0", vertex="0 1 1"), GREEN),
    ("map_Kd", obj(mtl="map_Kd red.png", face=TEXTURED), RED),
    ("map_Kd and Kd", obj(mtl="map_Kd red.png\nKd 0 1 1", face=TEXTURED), (0.0, 0.0, 0.0)),
    # As trimesh, nerfstudio and the models of YCB write them.
    *(
        (f"map_Kd, Kd {gray}", obj(mtl=f"Kd {gray}\nmap_Kd red.png", face=TEXTURED), outcome)
        for gray, outcome in [("1 1 1", RED), ("0.4 0.4 0.4", ASSUMED), ("0 0 0", ASSUMED)]
    ),
    ("Tr 1", obj(mtl="Tr 1"), ASSUMED),
    ("d 0.5, Tr 1", obj(mtl="d 0.5\nTr 1"), REFUSED),
    ("map_Kd without vt", obj(mtl="map_Kd red.png"), REFUSED),
    ("Tr 0", obj(mtl="Tr 0"), WHITE),
    ("d 1, Tr 0", obj(mtl="d 1\nTr 0"), WHITE),
    ("map_Kd with alpha", obj(mtl="map_Kd clear.png", face=TEXTURED), IGNORED),
    *(
        (line, obj(mtl=line), IGNORED)
        for line in each(
            "Ns 10|Ks 1 1 1|Ka 1 1 1|Ke 0 0 0|Ni 1.5|illum 2|Tf 1 1 1|Pr 0.5|map_Ks red.png|"
            "map_Bump missing.png|bump -bm 0.2 missing.png|norm missing.png|"
            "refl -type sphere missing.png"
        )
    ),
    *(
        (line, obj(mtl=line, face=TEXTURED), REFUSED)
        for line in each(
            "d 0.5|d -halo 0.5|Tr 0.5|map_d red.png|disp red.png|decal red.png|Kd 1 0|Kd red|"
            "Kd 2 0 0|Kd -1 0 0|Kd nan 0 0|Kd 1.#IND 0 0|Kd spectral red.rfl|map_Kd|"
            "Kd xyz 1 0 0|\0|map_Kd missing.png|map_Kd mesh.obj|newmtl m"
        )
    ),
    *(
        (option, obj(mtl=f"map_Kd {option} red.png", face=TEXTURED), RED)
        for option in each("-s 1 1 1|-s 1|-o 0 0 0 -s 1 1|-t 0 0.000 0")
    ),
    *(
        (option, obj(mtl=f"map_Kd {option} red.png", face=TEXTURED), REFUSED)
        for option in each("-s 2 2 1|-s 1.5|-o 0.5|-t 1|-mm 0 2|-cc on|-imfchan r|-clamp on")
    ),
    ("triangle", ply(), WHITE),
    ("uchar red", ply(RGB, at="255 0 0"), RED),
    ("float red", ply(RGB.replace("uchar", "float"), at="1 0 0"), RED),
    ("int red", ply(RGB.replace("uchar", "int"), at="255 0 0"), ASSUMED),
    ("float red to 255", ply(RGB.replace("uchar", "float"), at="255 0 0"), ASSUMED),
    ("float red 2.5", ply(RGB.replace("uchar", "float"), at="2.5 0 0"), REFUSED),
    ("red and r", ply(f"uchar r;uchar g;uchar b;{RGB}", at="9 9 9 8 8 8"), REFUSED),
    ("Red", ply(RGB.title().replace("Uchar", "uchar"), at="255 0 0"), RED),
    *(
        (f"only {name}", ply(f"uchar {name}", at="9"), REFUSED)
        for name in ("red", "diffuse_green", "rgb")
    ),
    ("x twice", ply("float x", at="7"), REFUSED),
    ("vertex twice", ply(tail="element vertex 1;property int a;0"), REFUSED),
    ("alpha 255", ply(f"{RGB};uchar alpha", at="255 0 0 255"), RED),
    ("alpha", ply(f"{RGB};uchar alpha", at="255 0 0 25"), REFUSED),
    ("face red", ply(face=RGB, of="255 0 0"), RED),
    ("confidence", ply("float confidence", at="0.5"), IGNORED),
    ("material_index", ply(face="int material_index", of="1"), REFUSED),
    ("materials", ply(tail="element material 1;property int red;0"), REFUSED),
    ("multi_texture_face", ply(tail="element multi_texture_face 1;property int tx;0"), REFUSED),
    *(
        (f"texture, {u}", ply(f"float {u};float {v}", header=IMAGE, at="0 0"), RED)
        for u, v in (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
    ),
    ("s without texture", ply("float s;float t", at="0 0"), ASSUMED),
    ("texture without uvs", ply(header=IMAGE), REFUSED),
    ("texcoord", ply(face=UV, header=IMAGE, of=UVS), RED),
    ("texcoord of no face", ply(face=UV, header=IMAGE, of="0"), REFUSED),
    ("short texcoord", ply(face=UV, header=IMAGE, of="4 0 0 1 1"), REFUSED),
    ("texcoord without texture", ply(face=UV, of=UVS), ASSUMED),
    ("texnumber 0", ply(face=NUMBERED, header=IMAGE, of=f"{UVS} 0"), RED),
    ("texnumber -1", ply(face=NUMBERED, header=IMAGE, of=f"{UVS} -1"), REFUSED),
    ("two textures", ply(face=UV, header=IMAGES, of=UVS), REFUSED),
    ("strips", ply(tail="element tristrips 1;property list int int vertex_indices;0"), REFUSED),
    (
        "missing texture",
        ply("float s;float t", header="comment TextureFile x.png", at="0 0"),
        REFUSED,
    ),
    ("too many numbers", ply(at="0"), REFUSED),
    ("too few numbers", ply("float s;float t", at="0"), REFUSED),
    ("nan", ply(corners=("0 0 nan", "1 0 0", "0 1 0")), REFUSED),
    ("unknown type", ply("quad s", at="0"), REFUSED),
    ("fraction of a byte", ply(RGB, at="0.5 0 0"), REFUSED),
    ("byte 256", ply(RGB, at="256 0 0"), REFUSED),
    ("element without properties", ply(tail="element x 1000000000000;"), REFUSED),
    ("triangle", off(), WHITE),
    ("square", {"mesh.off": OFF_SQUARE}, WHITE),
    ("COFF", off("COFF", "255 0 0 255"), REFUSED),
    ("OFF with colors", off("OFF", "1 0 0"), REFUSED),
    ("4OFF", off("4OFF", "1"), REFUSED),
    ("binary", off("OFF BINARY"), REFUSED),
    ("counts behind OFF", {"mesh.off": off()["mesh.off"].replace("OFF\n", "OFF")}, WHITE),
    ("face color", off(face="1.0 0.0 0.0"), REFUSED),
    ("color of a map", off(face="7"), REFUSED),
    ("fraction of a vertex", {"mesh.off": off()["mesh.off"].replace("1 2 ", "1 2.5 ")}, REFUSED),
    ("lines with CRLF", {"mesh.off": off()["mesh.off"].replace("\n", "\r\n")}, WHITE),
    ("1.#IND", {"mesh.off": off()["mesh.off"].replace("0 0 0", "0 0 0.#IND")}, REFUSED),
    ("comments", off("# OFF\nOFF # 1 2 3\n\n", face="# red"), WHITE),
    ("missing vertex", {"mesh.off": off()["mesh.off"].replace("3 0", "3 9")}, REFUSED),
    ("no faces", {"mesh.off": off()["mesh.off"].rpartition("\n")[0]}, REFUSED),
    ("text", {"mesh.stl": STL_TEXT}, WHITE),
    ("text with CR", {"mesh.stl": STL_TEXT.replace("\n", "\r")}, WHITE),
    *(
        (line, {"mesh.stl": STL_TEXT.replace("outer", f"{line}\nouter")}, outcome)
        for line, outcome in (
            ("color 1 0 0", REFUSED),
            ("  COLOUR 255 0 0", REFUSED),
            ("attribute 31", WHITE),
        )
    ),
    ("four vertices", {"mesh.stl": STL_TEXT.replace(" endl", "vertex 0 0 0\nendl")}, REFUSED),
    ("half a file", {"mesh.stl": STL_TEXT[:90]}, REFUSED),
    ("binary", stl(0), WHITE),
    ("binary that begins with solid", stl(0, b"solid thing"), WHITE),
    ("text with a NUL block", {"mesh.stl": STL_TEXT + "\0" * 99}, REFUSED),
    ("binary with more bytes", {"mesh.stl": b"".join([*stl(0, b"solid").values(), b"12"])}, WHITE),
    ("binary with a face too many", {"mesh.stl": stl(0)["mesh.stl"] + bytes(50)}, ASSUMED),
    ("empty", {"mesh.stl": ""}, REFUSED),
    ("binary that is truncated", stl(0, face_count=2), REFUSED),
    ("VisCAM", stl(0x8000 | 31 << 10), REFUSED),
    ("attribute without a color", stl(31), WHITE),
    ("Magics", stl(31, b"COLOR=\x00\xff\x00\xff"), REFUSED),
    ("MeshLab", stl(0, b"VCG COLOR=\x7f\x7f\x7f\xff MATERIAL="), ASSUMED),
]


# Files in which two things have the same color. Both have RED, or half of it.
TWICE = {
    "map_Kd and vertex colors": obj(mtl="map_Kd red.png", vertex="0.5 0 0", face=TEXTURED),
    "TextureFile and vertex colors": ply(f"{RGB};float s;float t", header=IMAGE, at="128 0 0 0 0"),
    "TextureFile and face colors": ply(face=f"{UV};{RGB}", header=IMAGE, of=f"{UVS} 128 0 0"),
    "face and vertex colors": ply(RGB, RGB, at="128 0 0", of="255 0 0"),
}


@pytest.mark.parametrize("files", TWICE.values(), ids=TWICE)
def test_a_color_that_a_file_has_twice_counts_once(tmp_path, files):
    with pytest.warns(UserWarning, match="taken") as caught:
        colors = color_of(tmp_path, files)
    assert len(caught) == 1
    assert_allclose(colors, np.broadcast_to(RED, colors.shape))


@pytest.mark.parametrize(
    ("files", "outcome"),
    [pytest.param(*row, id=f"{next(iter(row[0]))} {feature!r}") for feature, *row in ROWS],
)
def test_a_feature_is_read_or_ignored_with_a_warning_or_refused(tmp_path, files, outcome):
    if outcome == REFUSED:
        with pytest.raises(InputError, match=next(iter(files))):
            color_of(tmp_path, files)
    elif outcome in WARNINGS:
        with pytest.warns(UserWarning, match=WARNINGS[outcome]) as caught:
            color_of(tmp_path, files)
        assert len(caught) == 1
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            colors = color_of(tmp_path, files)
        assert_allclose(colors, np.broadcast_to(outcome, colors.shape), atol=1e-6)
