"""Every feature of a mesh file is read, ignored with a warning, or refused with a sentence.

Ignored features change neither the shape nor the base color.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import png_of

from renderer.errors import InputError
from renderer.io.meshes import load_mesh

RED = (1.0, 0.0, 0.0)
GREEN = (0.0, 1.0, 0.0)
BLUE = (0.0, 0.0, 1.0)
WHITE = (1.0, 1.0, 1.0)
GRAY = (0.5, 0.5, 0.5)
IGNORED = "ignored"
REFUSED = "refused"

Files = Mapping[str, str | bytes]


class Row(NamedTuple):
    """Row of the table.

    Attributes:
        format: Suffix of the mesh file.
        feature: Feature of the format.
        files: Contents of the files. The first file is the mesh, a white triangle
            with the corners (0, 0, 0), (1, 0, 0) and (0, 1, 0), apart from the feature.
        outcome: `IGNORED`, `REFUSED`, or the color of all corners that is read.
    """

    format: str
    feature: str
    files: Files
    outcome: str | tuple[float, ...]


def color_of(folder: Path, files: Files) -> np.ndarray:
    """Load a mesh, and return the colors of its corners times the first texels, (F, 3, 3)."""
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = load_mesh(folder / next(iter(files)))
    texels = np.array([*(texture[0, 0] / 255 for texture in mesh.textures), WHITE])
    assert mesh.face_areas().sum() == pytest.approx(0.5)
    return mesh.corner_colors * texels[mesh.texture_ids][:, None]


def obj(
    statements: str = "", face: str = "f 1 2 3", mtl: str | None = None, vertex: str = ""
) -> dict[str, str | bytes]:
    """Return an .obj file, with a material library if `mtl` has the properties of a material."""
    corners = ("0 0 0", "1 0 0", "0 1 0")
    lines = [f"v {corner} {vertex}" for corner in corners]
    lines += ["vt 0 0", "vt 1 0", "vt 0 1", "vn 0 0 1", statements, face]
    if mtl is None:
        return {"mesh.obj": "\n".join(lines)}
    lines[:0] = ["mtllib m.mtl", "usemtl m"]
    return {
        "mesh.obj": "\n".join(lines),
        "m.mtl": f"newmtl m\n{mtl}\n",
        "red.png": png_of(255, 0, 0),
        "clear.png": png_of(255, 0, 0, 9),
    }


TEXTURED = "f 1/1 2/2 3/3"
ROWS = [
    Row("obj", "triangle", obj(), WHITE),
    Row("obj", "g, o", obj("g part\no thing"), WHITE),
    Row("obj", "vn", obj(face="f 1//1 2//1 3//1"), WHITE),
    Row("obj", "vt without texture", obj(face=TEXTURED), WHITE),
    Row("obj", "vt for some corners", obj(face="f 1/1 2 3//1"), WHITE),
    Row("obj", "vertex colors", obj(vertex="1 0 0"), RED),
    Row("obj", "vertex colors and vt", obj(vertex="1 0 0", face=TEXTURED), RED),
    Row("obj", "weight 1", obj(vertex="1"), WHITE),
    Row("obj", "weight", obj(vertex="2"), REFUSED),
    Row("obj", "color and weight", obj(vertex="1 1 0 0"), REFUSED),
    Row("obj", "color above 1", obj(vertex="1.5 0 0"), REFUSED),
    Row("obj", "negative color", obj(vertex="-1 0 0"), REFUSED),
    Row("obj", "line", obj("l 1 2"), IGNORED),
    Row("obj", "point", obj("p 1"), IGNORED),
    Row("obj", "smoothing group", obj("s 1"), IGNORED),
    Row("obj", "level of detail", obj("lod 3"), IGNORED),
    Row("obj", "face with two corners", obj("f 1 2"), IGNORED),
    *(
        Row("obj", statement, obj(statement), REFUSED)
        for statement in (
            "call other.obj",
            "csh ls",
            "cstype bezier",
            "curv 0 1 1 2 3",
            "surf 0 1 0 1 1 2 3",
            "usemap red.png",
            "polygon 1 2 3",
            "f 1 2 4",
            "f 1 2 -4",
            "f 0 1 2",
            "f 1/9 2 3",
            "f 1/1/1/1 2 3",
            "f 1 / 2 3",
            "f 1 2 3.5",
            "v 1 2",
            "v 1 2 x",
            "vt nan 0",
            "\0",
        )
    ),
    Row("obj", "Kd", obj(mtl="Kd 1 0 0"), RED),
    Row("obj", "Kd of one number", obj(mtl="Kd 0.5"), GRAY),
    Row("obj", "Kd and vertex colors", obj(mtl="Kd 1 1 0", vertex="0 1 1"), GREEN),
    Row("obj", "map_Kd", obj(mtl="map_Kd red.png", face=TEXTURED), RED),
    Row(
        "obj",
        "map_Kd, Kd and vertex colors",
        obj(mtl="map_Kd red.png\nKd 0.5 1 1", vertex="1 0 0", face=TEXTURED),
        (0.5, 0.0, 0.0),
    ),
    Row("obj", "map_Kd without vt", obj(mtl="map_Kd red.png"), REFUSED),
    Row("obj", "map_Kd with some vt", obj(mtl="map_Kd red.png", face="f 1/1 2/2 3"), REFUSED),
    Row("obj", "d 1, Tr 0", obj(mtl="d 1\nTr 0"), WHITE),
    Row("obj", "map_Kd with alpha", obj(mtl="map_Kd clear.png", face=TEXTURED), IGNORED),
    *(
        Row("obj", line, obj(mtl=line), IGNORED)
        for line in (
            "Ns 10",
            "Ks 1 1 1",
            "Ka 1 1 1",
            "Ke 0 0 0",
            "Ni 1.5",
            "illum 2",
            "Tf 1 1 1",
            "Pr 0.5",
            "map_Ks red.png",
            "map_Bump missing.png",
            "bump -bm 0.2 missing.png",
            "norm missing.png",
            "refl -type sphere missing.png",
        )
    ),
    *(
        Row("obj", line, obj(mtl=line, face=TEXTURED), REFUSED)
        for line in (
            "d 0.5",
            "d -halo 0.5",
            "Tr 0.5",
            "map_d red.png",
            "disp red.png",
            "decal red.png",
            "Kd 1 0",
            "Kd red",
            "Kd 2 0 0",
            "Kd -1 0 0",
            "Kd nan 0 0",
            "Kd spectral red.rfl",
            "map_Kd",
            "map_Kd missing.png",
            "map_Kd mesh.obj",
            "newmtl m",
        )
    ),
    *(
        Row("obj", option, obj(mtl=f"map_Kd {option} red.png", face=TEXTURED), RED)
        for option in (
            "-s 1 1 1",
            "-s 1",
            "-o 0 0 0 -s 1 1",
            "-t 0 0 0",
            "-mm 0 1",
            "-cc off",
            "-clamp on",
            "-clamp off",
            "-bm 1.0",
            "-blendu on -blendv off",
            "-texres 256",
            "-boost 2",
        )
    ),
    *(
        Row("obj", option, obj(mtl=f"map_Kd {option} red.png", face=TEXTURED), REFUSED)
        for option in ("-s 2 2 1", "-o 0.5", "-t 1", "-mm 0 2", "-cc on", "-imfchan r")
    ),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.format} {row.feature!r}")
def test_a_feature_is_read_or_ignored_with_a_warning_or_refused(tmp_path, row: Row):
    if row.outcome == REFUSED:
        with pytest.raises(InputError, match=next(iter(row.files))):
            color_of(tmp_path, row.files)
    elif row.outcome == IGNORED:
        with pytest.warns(UserWarning, match="ignored") as caught:
            color_of(tmp_path, row.files)
        assert len(caught) == 1
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            colors = color_of(tmp_path, row.files)
        assert_allclose(colors, np.broadcast_to(row.outcome, colors.shape), atol=1e-6)
