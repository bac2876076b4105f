"""Read .off and .stl files with the colors of vertices and faces."""

import re

import numpy as np

from renderer.io.mesh_file import (
    OPAQUE,
    MeshFile,
    Part,
    as_utf8,
    colored_mesh,
    parse_numbers,
    product,
    require_bounded,
    triangles_of,
    unit_colors,
    without_comments,
    words_per_line,
)

# Beginning of a file. It tells whether vertices have texture coordinates (ST), colors
# (C), normals (N), a weight (4) or any number of coordinates (n). Some files have the
# number of vertices directly after "OFF".
_HEADER = re.compile(rb"\s*(ST)?(C)?(N)?(4)?(n)?(?:OFF|off)")


def read_off(file: MeshFile) -> list[Part]:
    """Read an .off file as one part, or none if the file has no faces."""
    text = without_comments(as_utf8(file.content).replace(b"\r", b"\n"))
    header = _HEADER.match(text)
    if header is None:
        raise ValueError("the file does not begin with OFF")
    has_uvs, has_colors, has_normals, has_weights, has_dimension = map(bool, header.groups())
    # A text without empty lines, and the end of each line.
    text = re.sub(rb"\n\s*", b"\n", text[header.end() :].strip() + b"\n")
    ends = np.flatnonzero(np.frombuffer(text, dtype=np.uint8) == ord("\n")) + 1
    counts = text[: ends[0]].split()
    is_plain = all(count.isdigit() for count in counts) and len(counts) >= 2
    if has_weights or has_dimension or not is_plain:
        raise ValueError("only .off files in ASCII form with three coordinates are supported")
    vertex_count, face_count = map(int, counts[:2])
    if len(ends) < 1 + vertex_count + face_count:
        raise ValueError("the file is truncated: export it again")
    vertex_text = text[ends[0] : ends[vertex_count]]
    face_text = text[ends[vertex_count] : ends[vertex_count + face_count]]

    lengths = words_per_line(vertex_text)
    width = lengths.max(initial=3)
    color_start = 3 + 3 * has_normals
    color_width = width - color_start - 2 * has_uvs
    if (lengths != width).any() or color_width not in ((3, 4) if has_colors else (0,)):
        raise ValueError(f"the vertices have other numbers than {header[0].decode()} announces")
    table = parse_numbers(vertex_text, np.float64).reshape(-1, width)
    vertices = table[:, :3]
    is_color = np.zeros(table.shape, dtype=bool)
    is_color[:, color_start : color_start + color_width] = True
    color_widths = np.full(vertex_count, color_width)
    vertex_colors = _colors(vertex_text, table.ravel(), is_color.ravel(), color_widths, file)

    numbers = parse_numbers(face_text, np.float64)
    lengths = words_per_line(face_text)
    whole_numbers = numbers.astype(np.int64)
    # Place of each number in its line, in which the number of corners is first.
    places = np.arange(len(numbers)) - (np.cumsum(lengths) - lengths).repeat(lengths)
    sizes = whole_numbers[places == 0]
    is_index = places <= sizes.repeat(lengths)
    color_widths = lengths - 1 - sizes
    if not np.isin(color_widths, (0, 3, 4)).all() or (whole_numbers != numbers)[is_index].any():
        raise ValueError("a face is not a number of vertices, the vertices, and maybe a color")
    face_colors = _colors(face_text, numbers, ~is_index, color_widths, file)
    indices = whole_numbers[is_index & (places > 0)]
    corners, polygons = triangles_of(file, vertices, indices, sizes)
    if not len(corners):
        return []
    faces = indices[corners]
    colors = product(vertex_colors[faces], face_colors[polygons, None])
    normals = table[:, 3:6][faces] if has_normals else None
    return [Part(colored_mesh(vertices, faces, colors), normals)]


def _colors(
    text: bytes, numbers: np.ndarray, is_color: np.ndarray, widths: np.ndarray, file: MeshFile
) -> np.ndarray:
    """Convert rows of 3 or 4 numbers to sRGB-encoded colors, which are white for empty rows.

    The numbers are the words of the text. `is_color` selects those of the colors.
    """
    colors = np.ones((len(widths), 4))
    is_given = np.arange(4) < widths[:, None]
    colors[is_given] = numbers[is_color]
    # Bytes are written as whole numbers, and other colors with a point.
    given = colors[is_given]
    highest = given.max(initial=0)
    is_whole = (given == given.astype(np.uint8)).all()
    # As bytes, colors of only 0 and 1 are almost black, and an opacity of 1 is almost transparent.
    if is_whole and highest == 1 and (widths == 3).any():
        words = np.array(text.split())[is_color]
        if not any(b"." in word for word in words):
            raise ValueError(
                "the colors are only 0 and 1, and 1 may be white or almost black: "
                "write colors from 0 to 255, or with a point such as 1.0"
            )
    values = given.astype(np.uint8) if is_whole and highest > 1 else given
    colors[is_given] = unit_colors(values, file)
    if colors[:, 3].min(initial=1) < OPAQUE:
        raise ValueError("the file has transparent colors, which are not supported")
    return colors[:, :3]


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
