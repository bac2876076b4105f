"""Read .stl files, whose faces may have colors in binary form."""

import re

import numpy as np

from renderer.io.mesh_file import (
    OPAQUE,
    MeshFile,
    Part,
    as_utf8,
    colored_mesh,
    parse_numbers,
    require_bounded,
)

# Face of a binary file. Some programs store a color in `attribute`.
_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
# Size of the header of a binary file, with the number of faces at its end.
_HEADER_SIZE = 84
# Bit of `attribute` that says that the face has a color, or, with
# the convention of Materialise Magics, that it has none of its own.
_FLAG = 0x8000
# First word of a line of a text file that no facet has. Some programs add lines of their own.
_OTHER_LINE = re.compile(
    rb"^\s*(?!(?:solid|facet|outer|vertex|endloop|endfacet|endsolid)\b)([a-z]\w*)",
    re.MULTILINE | re.IGNORECASE,
)


def read_stl(file: MeshFile) -> list[Part]:
    """Read an .stl file as one part, or none if the file has no faces."""
    content = file.content
    header = content[:_HEADER_SIZE]
    face_count = int.from_bytes(header[-4:], "little")
    # A binary file may begin with "solid", too, but has NUL bytes.
    if re.match(rb"\W*solid", content, re.IGNORECASE) and b"\0" not in content:
        corners = _text_corners(content, file)
        colors = np.ones((1, 3))
    elif len(content) < _HEADER_SIZE + face_count * _FACE.itemsize or len(header) < _HEADER_SIZE:
        raise ValueError("the file is truncated: export it again")
    else:
        faces = np.frombuffer(content, _FACE, face_count, _HEADER_SIZE)
        corners = faces["corners"].astype(np.float64)
        colors = _face_colors(header, faces["attribute"].astype(np.int64), file)
    if not len(corners):
        return []
    require_bounded(coordinates=corners)
    vertex_ids = np.arange(corners.size // 3).reshape(-1, 3)
    return [Part(colored_mesh(corners.reshape(-1, 3), vertex_ids, colors))]


def _text_corners(content: bytes, file: MeshFile) -> np.ndarray:
    """Parse the corners of the faces of a text file, shape (F, 3, 3)."""
    text = as_utf8(content).replace(b"\r", b"\n")
    for keyword in dict.fromkeys(_OTHER_LINE.findall(text)):
        if re.match(rb"colou?r|rgb", keyword, re.IGNORECASE):
            raise ValueError("colors in the text form of STL are not supported: export it as PLY")
        file.ignore(keyword.decode())
    vertices = re.findall(rb"^\s*vertex\b(.*)", text, re.MULTILINE | re.IGNORECASE)
    face_count = len(re.findall(rb"^\s*endfacet\b", text, re.MULTILINE | re.IGNORECASE))
    coordinates = parse_numbers(b"\n".join(vertices), np.float64)
    if len(coordinates) != 9 * face_count or len(vertices) != 3 * face_count:
        raise ValueError("a facet does not have three vertices with three coordinates")
    return coordinates.reshape(-1, 3, 3)


def _face_colors(header: bytes, attributes: np.ndarray, file: MeshFile) -> np.ndarray:
    """Decode the color of each face, which is white without a color, shape (F, 1, 3).

    VisCAM and SolidView store blue in the lowest bits. Magics stores red there, and
    the color of faces without a color of their own after "COLOR=" in the header.
    """
    channels = np.stack([attributes >> shift & 31 for shift in (0, 5, 10)], axis=1) / 31
    has_flag = attributes & _FLAG != 0
    default = header[:-4].partition(b"COLOR=")[2][:4]
    if len(default) < 4:
        if attributes[~has_flag].any():
            file.ignore("attributes without a color")
        return np.where(has_flag[:, None], channels[:, ::-1], 1)[:, None]
    if b"MATERIAL=" in header:
        file.ignore("MATERIAL")
    red, green, blue, alpha = np.frombuffer(default, np.uint8) / 255
    if alpha < OPAQUE:
        raise ValueError("the color of the file is transparent, which is not supported")
    return np.where(has_flag[:, None], [red, green, blue], channels)[:, None]
