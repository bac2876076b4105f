"""Read .ply files in ASCII and binary form."""

import re
import struct
from typing import NamedTuple

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
)
from renderer.mesh import NO_TEXTURE

# Types of NumPy by the names of types in the header.
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
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
    corners, polygons = triangles_of(file, vertices, faces.numbers, faces.lengths)
    if not len(corners):
        return []
    triangles = faces.numbers[corners]
    colors = np.ones((1, 3)) if vertex_colors is None else vertex_colors[triangles]
    if face_colors is not None:
        colors = product(colors, face_colors[polygons, None])
    textures = [file.texture(name) for name in texture_names]
    mesh = colored_mesh(
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
        found.append(unit_colors(colors, file))
        alpha = _columns(values, alpha_name)
        if alpha is not None and unit_colors(alpha, file).min(initial=1) < OPAQUE:
            raise ValueError("the file has transparent colors, which are not supported")
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
    for line in as_utf8(header[2]).decode().split(header[1].decode()):
        match line.split():
            case ["format", form, *_]:
                pass
            case ["comment", key, _, *_] if key.lower() == "texturefile":
                texture_names.append(line.split(None, 2)[2].strip())
            case ["element", name, count] if name not in counts:
                counts[name] = int(count)
                items = properties[name] = []
            case ["property", "list", length_type, type_, name] if {
                length_type,
                type_,
            } <= _TYPES.keys():
                items.append(_Property(name.lower(), _TYPES[type_], _TYPES[length_type]))
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
        body = parse_numbers(body, np.float64).astype("<f8").tobytes()
    offset = 0
    elements = {}
    for name, items in properties.items():
        if not items:
            raise ValueError(f"the element {name} has no properties")
        if len({item.name for item in items}) < len(items):
            raise ValueError(f"the element {name} has two properties of one name")
        stored = [_Property(item.name, "f8", item.length_type and "f8") for item in items]
        layout = stored if form == "ascii" else items
        values, offset = _rows(body, offset, counts[name], layout, _BYTE_ORDERS[form])
        elements[name] = {
            item.name: _cast(column, item) for column, item in zip(values, items, strict=True)
        }
    if form == "ascii" and offset != len(body):
        raise ValueError("the lines have more numbers than the header says")
    return elements, texture_names


def _rows(
    body: bytes, offset: int, count: int, properties: list[_Property], order: str
) -> tuple[list[np.ndarray | _Lists], int]:
    """Read the values of each property of an element, and find the offset of the next element."""
    # Each value has at least one byte. A damaged header
    # could otherwise announce more rows than fit into memory.
    if not 0 <= count * len(properties) <= len(body) - offset:
        raise ValueError(_TRUNCATED)
    if count:
        # NumPy reads rows at once if their lists are as long as those of the first row.
        try:
            row = _first_row(body, offset, properties, order)
            end = offset + count * row.itemsize
            rows = np.frombuffer(body, row, count if end <= len(body) else 1, offset)
        # NumPy refuses a list of negative length, or longer than the file.
        except ValueError as error:
            raise ValueError(_TRUNCATED) from error
        lengths = {i: rows[f"length {i}"] for i, item in enumerate(properties) if item.length_type}
        if end <= len(body) and all((column == column[0]).all() for column in lengths.values()):
            columns: list[np.ndarray | _Lists] = [rows[str(i)] for i in range(len(properties))]
            for index, column in lengths.items():
                columns[index] = _Lists(column, rows[str(index)].ravel())
            return columns, end
    return _different_rows(body, offset, count, properties, order)


def _first_row(body: bytes, offset: int, properties: list[_Property], order: str) -> np.dtype:
    """Return the type of the first row, with the field "length 1" for a list in the field "1"."""
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for index, item in enumerate(properties):
        shape: tuple[int, ...] = ()
        if item.length_type:
            start = offset + np.dtype(fields).itemsize
            length_type = order + item.length_type
            fields.append((f"length {index}", length_type, ()))
            shape = (int(np.frombuffer(body, length_type, 1, start)[0]),)
        fields.append((str(index), order + item.type, shape))
    return np.dtype(fields)


def _different_rows(
    body: bytes, offset: int, count: int, properties: list[_Property], order: str
) -> tuple[list[np.ndarray | _Lists], int]:
    """Read rows whose lists have different lengths."""
    numbers: list[list[float]] = [[] for _ in properties]
    lengths: list[list[int]] = [[] for _ in properties]
    types = [
        (np.dtype(item.type), item.length_type and np.dtype(item.length_type))
        for item in properties
    ]
    try:
        for _ in range(count):
            for index, (number_type, length_type) in enumerate(types):
                length = 1
                if length_type:
                    length = int(struct.unpack_from(order + length_type.char, body, offset)[0])
                    lengths[index].append(length)
                    offset += length_type.itemsize
                numbers[index] += struct.unpack_from(
                    f"{order}{length}{number_type.char}", body, offset
                )
                offset += length * number_type.itemsize
    except struct.error as error:
        raise ValueError(_TRUNCATED) from error
    columns: list[np.ndarray | _Lists] = []
    for index, item in enumerate(properties):
        column = np.array(numbers[index], dtype=item.type)
        is_list = bool(item.length_type)
        columns.append(_Lists(np.array(lengths[index], np.int64), column) if is_list else column)
    return columns, offset


def _cast(values: np.ndarray | _Lists, item: _Property) -> np.ndarray | _Lists:
    """Convert values to the types in the header, of which an ASCII file may have others."""
    if isinstance(values, _Lists):
        numbers = _as_type(values.numbers, item.type)
        return _Lists(_as_type(values.lengths, item.length_type).astype(np.int64), numbers)
    return _as_type(values, item.type)


def _as_type(values: np.ndarray, name: str) -> np.ndarray:
    """Convert numbers to a type, and refuse whole numbers that would change."""
    if np.dtype(name).kind == "f":
        return values.astype(np.float64)
    # astype turns NaN into an arbitrary integer, with a warning.
    with np.errstate(invalid="ignore"):
        cast = values.astype(name)
    if (cast != values).any():
        raise ValueError("a value does not have the type that the header gives")
    return cast
