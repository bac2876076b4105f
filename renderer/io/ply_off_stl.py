"""Read .ply, .off and .stl files, which have colors of vertices and faces."""

import re
from typing import Any, NamedTuple

import numpy as np

from renderer.io import mesh_file
from renderer.io.mesh_file import MeshFile, Part
from renderer.mesh import NO_TEXTURE

# Types of NumPy by the names of types in the header.
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
# Beginning of the name under which the length of a list is read.
_LENGTH = "length of "
# Byte orders of NumPy. The numbers of an ASCII file become little-endian float64.
_BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
# Names of red, green, blue and alpha.
_COLORS = (
    ("red", "green", "blue", "alpha"),
    ("r", "g", "b", "a"),
    ("diffuse_red", "diffuse_green", "diffuse_blue", "diffuse_alpha"),
)
# Names of the texture coordinates of vertices.
_UVS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
# Names of the vertex indices of a face or a strip.
_INDICES = ("vertex_indices", "vertex_index")
# Beginnings of the names of elements and properties that would change the color.
# Colors that are read are removed before, so these are incomplete.
_REFUSED = ("material", "multi_texture", "red", "green", "blue", "diffuse_", "rgb", "color")
_TRUNCATED = "the file is truncated or damaged: export it again"


class _Lists(NamedTuple):
    """Lists of numbers: the length of each list, and the numbers of all lists."""

    lengths: np.ndarray
    numbers: np.ndarray


class _Property(NamedTuple):
    """Property in the header, with types of NumPy. Only a list has a type of its length."""

    name: str
    type: str
    length_type: str = ""


# Values of the properties of an element by their names.
_Values = dict[str, np.ndarray | _Lists]


def read_ply(file: MeshFile) -> list[Part]:
    """Read a .ply file as one part, or none if the file has no faces."""
    elements, texture_names = _elements(file.content)
    vertex, face, strip = (elements.pop(key, {}) for key in ("vertex", "face", "tristrips"))
    vertices = _columns(vertex, "x", "y", "z")
    faces = _lists(face)
    strips = _lists(strip)
    if strips is not None:
        if faces is not None:
            raise ValueError("the file has faces and strips, which is not supported")
        faces = _unrolled(strips)
    if vertices is None or faces is None:
        return []
    corner_uvs = _corner_uvs(vertex, face, faces)
    texture_ids = _texture_ids(face, len(faces.lengths), texture_names)
    vertex_colors = _rgb(vertex, file)
    face_colors = _rgb(face, file)
    normals = _columns(vertex, "nx", "ny", "nz")
    for name in (*elements, *vertex, *face):
        if name.startswith(_REFUSED):
            raise ValueError(f"{name} is not supported: export the mesh with colors or one texture")
        file.ignore(name)
    corners, polygons = mesh_file.triangles_of(file, vertices, faces.numbers, faces.lengths)
    if not len(corners):
        return []
    triangles = faces.numbers[corners]
    colors = np.ones((1, 3)) if vertex_colors is None else vertex_colors[triangles]
    if face_colors is not None:
        colors = mesh_file.product(colors, face_colors[polygons, None])
    textures = [file.texture(name) for name in texture_names]
    mesh = mesh_file.colored_mesh(
        vertices, triangles, colors, corner_uvs[corners], texture_ids[polygons], textures
    )
    return [Part(mesh, None if normals is None else normals[triangles])]


def _columns(values: _Values, *names: str) -> np.ndarray | None:
    """Remove properties from an element, and return them as columns, or None without them."""
    if not all(isinstance(values.get(name), np.ndarray) for name in names):
        return None
    return np.stack([values.pop(name) for name in names], axis=1)


def _lists(values: _Values) -> _Lists | None:
    """Remove the vertex indices from an element, and return them. None without them."""
    for name in _INDICES:
        indices = values.pop(name, None)
        if isinstance(indices, _Lists) and indices.numbers.dtype.kind in "iu":
            return _Lists(indices.lengths, indices.numbers.astype(np.int64))
    return None


def _unrolled(strips: _Lists) -> _Lists:
    """Divide triangle strips, which may contain the index -1 between two strips, into faces."""
    numbers = np.insert(strips.numbers, np.cumsum(strips.lengths), -1)
    places = np.arange(len(numbers))
    is_end = numbers == -1
    last_ends = np.maximum.accumulate(np.where(is_end, places, -1))
    is_odd = (places - last_ends)[:-2] % 2 == 0
    triangles = np.stack([numbers[:-2], numbers[1:-1], numbers[2:]], axis=1)
    triangles[is_odd] = triangles[is_odd][:, [1, 0, 2]]
    triangles = triangles[(triangles != -1).all(axis=1)]
    return _Lists(np.full(len(triangles), 3), triangles.ravel())


def _rgb(values: _Values, file: MeshFile) -> np.ndarray | None:
    """Remove the colors from an element, and return them as sRGB-encoded values in [0, 1]."""
    found = []
    for *names, alpha_name in _COLORS:
        colors = _columns(values, *names)
        if colors is None:
            continue
        found.append(mesh_file.unit_colors(colors, file))
        alpha = _columns(values, alpha_name)
        if alpha is not None:
            mesh_file.require_opaque(mesh_file.unit_colors(alpha, file))
    if len(found) > 1:
        raise ValueError("an element has two kinds of colors, such as red and diffuse_red")
    return found[0] if found else None


def _corner_uvs(vertex: _Values, face: _Values, faces: _Lists) -> np.ndarray:
    """Remove the texture coordinates, and return those of all corners, or NaN, shape (C, 2)."""
    uvs = np.full((len(faces.numbers), 2), np.nan)
    for names in _UVS:
        vertex_uvs = _columns(vertex, *names)
        if vertex_uvs is not None:
            uvs = vertex_uvs.take(faces.numbers, axis=0, mode="clip")
    # The texture coordinates of the faces are those of their corners, which
    # differ on both sides of a seam. They therefore replace those of vertices.
    face_uvs = face.pop("texcoord", None)
    if isinstance(face_uvs, _Lists):
        is_given = face_uvs.lengths > 0
        if not (face_uvs.lengths == 2 * faces.lengths * is_given).all():
            raise ValueError("a face has a texcoord without two numbers for each corner")
        uvs[is_given.repeat(faces.lengths)] = face_uvs.numbers.reshape(-1, 2)
    return uvs


def _texture_ids(face: _Values, count: int, names: list[str]) -> np.ndarray:
    """Remove the numbers of the textures, and return the index of the texture of each face."""
    numbers = _columns(face, "texnumber")
    if not names:
        return np.full(count, NO_TEXTURE)
    if numbers is None:
        if len(set(names)) > 1:
            raise ValueError("the file has several textures, but its faces have no texnumber")
        return np.zeros(count, dtype=np.int64)
    if not ((numbers >= NO_TEXTURE) & (numbers < len(names))).all():
        raise ValueError(f"a face has a texnumber that is not from 0 to {len(names) - 1}")
    return numbers[:, 0].astype(np.int64)


def _elements(content: bytes) -> tuple[dict[str, _Values], list[str]]:
    """Read the values of all elements by name, and the names of the textures."""
    header = re.match(rb"ply[ \t]*(\r\n|\n|\r)(.*?\1)[ \t]*end_header[ \t]*\1", content, re.DOTALL)
    if header is None:
        raise ValueError("the file has no header of PLY that ends with end_header")
    form = ""
    texture_names = []
    counts: dict[str, int] = {}
    properties: dict[str, list[_Property]] = {}
    items: list[_Property] = []
    for line in mesh_file.as_utf8(header[2]).decode().split(header[1].decode()):
        match line.split():
            case ["format", form, *_]:
                pass
            case ["comment", key, _, *_] if key.lower() == "texturefile":
                texture_names.append(line.split(None, 2)[2].strip())
            case ["element", name, count] if name not in counts:
                counts[name] = int(count)
                items = properties[name] = []
            case ["property", "list", size, type_, name] if {size, type_} <= _TYPES.keys():
                items.append(_Property(name.lower(), _TYPES[type_], _TYPES[size]))
            case ["property", type_, name] if type_ in _TYPES:
                items.append(_Property(name.lower(), _TYPES[type_]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"the header has an unknown line: {line}")
    if form not in _BYTE_ORDERS:
        raise ValueError(f"the format is {form}: choose {', '.join(_BYTE_ORDERS)}")
    body = content[header.end() :]
    if form == "ascii":
        body = mesh_file.parse_numbers(body, np.float64).astype("<f8").tobytes()
    offset = 0
    elements: dict[str, _Values] = {}
    for name, items in properties.items():
        if not items:
            raise ValueError(f"the element {name} has no properties")
        if len({item.name for item in items}) < len(items):
            raise ValueError(f"the element {name} has two properties of one name")
        stored = [_Property(item.name, "f8", item.length_type and "f8") for item in items]
        layout = stored if form == "ascii" else items
        values, offset = _rows(body, offset, counts[name], layout, _BYTE_ORDERS[form])
        elements[name] = {item.name: _cast(values[item.name], item) for item in items}
    if form == "ascii" and offset != len(body):
        raise ValueError("the lines have more numbers than the header says")
    return elements, texture_names


def _rows(
    body: bytes, offset: int, count: int, properties: list[_Property], order: str
) -> tuple[_Values, int]:
    """Read the values of each property of an element, and find the byte after them."""
    # Each value has at least one byte. A damaged header
    # could otherwise announce more rows than fit into memory.
    if not 0 <= count * len(properties) <= len(body) - offset:
        raise ValueError(_TRUNCATED)
    blocks: list[np.ndarray] = []
    while count:
        # NumPy reads rows at once if their lists are as long as those of the first row. A block
        # has up to twice as many rows as the block before, so that few are read in vain.
        most = min(count, 2 * len(blocks[-1]) if blocks else 1)
        try:
            row = _first_row(body, offset, properties, order)
            most = min(most, (len(body) - offset) // row.itemsize)
            rows = np.frombuffer(body, row, max(1, most), offset)
        # NumPy refuses a list of negative length, or longer than the file.
        except ValueError as error:
            raise ValueError(_TRUNCATED) from error
        lengths = [rows[name] for name in row.names or () if name.startswith(_LENGTH)]
        is_other = np.any([column != column[0] for column in lengths], axis=0)
        blocks.append(rows[: is_other.argmax()] if is_other.any() else rows)
        count -= len(blocks[-1])
        offset += blocks[-1].nbytes

    def column(name: str, number_type: str) -> np.ndarray:
        """Join a column of all blocks."""
        return np.concatenate([np.zeros(0, number_type), *(rows[name].ravel() for rows in blocks)])

    values: _Values = {}
    for name, number_type, length_type in properties:
        numbers = column(name, number_type)
        is_list = bool(length_type)
        values[name] = _Lists(column(_LENGTH + name, length_type), numbers) if is_list else numbers
    return values, offset


def _first_row(body: bytes, offset: int, properties: list[_Property], order: str) -> np.dtype:
    """Return the type of the first row, in which the length of a list is a field of its own."""
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for name, number_type, length_type in properties:
        shape: tuple[int, ...] = ()
        if length_type:
            start = offset + np.dtype(fields).itemsize
            fields.append((_LENGTH + name, order + length_type, ()))
            shape = (int(np.frombuffer(body, order + length_type, 1, start)[0]),)
        fields.append((name, order + number_type, shape))
    return np.dtype(fields)


def _cast(values: Any, item: _Property) -> Any:
    """Convert ASCII values to the types in the header, but refuse to change whole numbers."""
    if isinstance(values, _Lists):
        lengths = _cast(values.lengths, _Property("", item.length_type))
        numbers = _cast(values.numbers, _Property("", item.type))
        return _Lists(lengths.astype(np.int64), numbers)
    if item.type.startswith("f"):
        return values.astype(np.float64)
    # astype turns NaN into an arbitrary integer, with a warning.
    with np.errstate(invalid="ignore"):
        cast = values.astype(item.type)
    if (cast != values).any():
        raise ValueError("a value does not have the type that the header gives")
    return cast


# Beginning of a file. It tells whether vertices have texture coordinates (ST), colors
# (C), normals (N), a weight (4) or any number of coordinates (n). Some files have the
# number of vertices directly after "OFF".
_OFF_HEADER = re.compile(rb"\s*(ST)?(C)?(N)?(4)?(n)?(?:OFF|off)")


def read_off(file: MeshFile) -> list[Part]:
    """Read an .off file as one part, or none if the file has no faces."""
    text = mesh_file.as_utf8(file.content).replace(b"\r", b"\n")
    text = mesh_file.without_comments(text)
    header = _OFF_HEADER.match(text)
    if header is None:
        raise ValueError("the file does not begin with OFF")
    has_uvs, has_colors, has_normals, has_weights, has_dimension = map(bool, header.groups())
    lines = [line.split() for line in text[header.end() :].split(b"\n") if line.strip()]
    counts = lines[0] if lines else []
    is_plain = all(count.isdigit() for count in counts) and len(counts) >= 2
    if has_weights or has_dimension or not is_plain:
        raise ValueError("only .off files in ASCII form with three coordinates are supported")
    vertex_count, face_count = map(int, counts[:2])
    if len(lines) < 1 + vertex_count + face_count:
        raise ValueError("the file is truncated: export it again")
    vertex_lines = lines[1 : 1 + vertex_count]
    face_lines = lines[1 + vertex_count : 1 + vertex_count + face_count]
    width = max(map(len, vertex_lines), default=3)
    color_start = 3 + 3 * has_normals
    color_end = width - 2 * has_uvs
    is_even = all(len(line) == width for line in vertex_lines)
    if not is_even or color_end - color_start not in ((3, 4) if has_colors else (0,)):
        raise ValueError(f"the vertices have other numbers than {header[0].decode()} announces")
    table = _numbers(vertex_lines).reshape(-1, width)
    vertices = table[:, :3]
    vertex_colors = _colors([line[color_start:color_end] for line in vertex_lines], file)
    sizes = _numbers([line[:1] for line in face_lines], np.int64)
    corner_words = [line[1 : 1 + size] for line, size in zip(face_lines, sizes, strict=True)]
    color_words = [line[1 + size :] for line, size in zip(face_lines, sizes, strict=True)]
    indices = _numbers(corner_words, np.int64)
    if len(indices) != sizes.sum() or any(len(words) not in (0, 3, 4) for words in color_words):
        raise ValueError("a face is not a number of vertices, the vertices, and maybe a color")
    face_colors = _colors(color_words, file)
    corners, polygons = mesh_file.triangles_of(file, vertices, indices, sizes)
    if not len(corners):
        return []
    faces = indices[corners]
    colors = mesh_file.product(vertex_colors[faces], face_colors[polygons, None])
    normals = table[:, 3:6][faces] if has_normals else None
    return [Part(mesh_file.colored_mesh(vertices, faces, colors), normals)]


def _numbers(lines: list[list[bytes]], dtype: type = np.float64) -> np.ndarray:
    """Parse the words of all lines, shape (N,)."""
    return mesh_file.parse_numbers(b" ".join(word for line in lines for word in line), dtype)


def _colors(lines: list[list[bytes]], file: MeshFile) -> np.ndarray:
    """Convert lines of 3 or 4 words to sRGB-encoded colors, which are white for empty lines."""
    widths = np.array([len(line) for line in lines], dtype=np.int64)
    given = _numbers(lines)
    # Bytes are written as whole numbers, and other colors with a point.
    highest = given.max(initial=0)
    is_whole = (given == given.astype(np.uint8)).all()
    has_point = any(b"." in word for line in lines for word in line)
    # As bytes, colors of only 0 and 1 are almost black, and an opacity of 1 is almost transparent.
    if is_whole and highest == 1 and (widths == 3).any() and not has_point:
        raise ValueError("the color 1 may be white or almost black: write 255 or 1.0 for white")
    colors = np.ones((len(lines), 4))
    values = given.astype(np.uint8) if is_whole and highest > 1 else given
    colors[np.arange(4) < widths[:, None]] = mesh_file.unit_colors(values, file)
    mesh_file.require_opaque(colors[:, 3])
    return colors[:, :3]


# Face of a binary file. Some programs store a color in `attribute`.
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
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
    elif len(content) < _HEADER_SIZE + face_count * _STL_FACE.itemsize:
        raise ValueError("the file is truncated: export it again")
    else:
        faces = np.frombuffer(content, _STL_FACE, face_count, _HEADER_SIZE)
        corners = faces["corners"].astype(np.float64)
        colors = _face_colors(header, faces["attribute"].astype(np.int64), file)
    if not len(corners):
        return []
    mesh_file.require_bounded(coordinates=corners)
    vertex_ids = np.arange(corners.size // 3).reshape(-1, 3)
    return [Part(mesh_file.colored_mesh(corners.reshape(-1, 3), vertex_ids, colors))]


def _text_corners(content: bytes, file: MeshFile) -> np.ndarray:
    """Parse the corners of the faces of a text file, shape (F, 3, 3)."""
    text = mesh_file.as_utf8(content).replace(b"\r", b"\n")
    for keyword in dict.fromkeys(_OTHER_LINE.findall(text)):
        if re.match(rb"colou?r|rgb", keyword, re.IGNORECASE):
            raise ValueError("colors in the text form of STL are not supported: export it as PLY")
        file.ignore(keyword.decode())
    vertices = re.findall(rb"^\s*vertex\b(.*)", text, re.MULTILINE | re.IGNORECASE)
    face_count = len(re.findall(rb"^\s*endfacet\b", text, re.MULTILINE | re.IGNORECASE))
    coordinates = mesh_file.parse_numbers(b"\n".join(vertices), np.float64)
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
    mesh_file.require_opaque(alpha)
    return np.where(has_flag[:, None], [red, green, blue], channels)[:, None]
