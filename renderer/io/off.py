"""Read .off files with the colors of vertices and faces."""

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
