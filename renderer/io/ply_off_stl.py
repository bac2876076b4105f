"""Read .ply, .off and .stl files."""

import re
from typing import NamedTuple

import numpy as np

from renderer.io import mesh_file
from renderer.io.mesh_file import MeshFile, Part

# Types of NumPy by the names of types in the header.
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
# Beginning of the name under which the length of a list is read.
_LENGTH = "length of "
# Byte orders of NumPy. The numbers of an ASCII file become float64 before they are read.
_ASCII = "ascii"
_BYTE_ORDERS = {_ASCII: "=", "binary_little_endian": "<", "binary_big_endian": ">"}
# Names of red, green and blue.
_COLORS = (("red", "green", "blue"), ("r", "g", "b"))
# Beginnings of the names of elements and properties that would change the shape or the color.
# Colors that are read are removed before, so these are incomplete.
_REFUSED = ("tristrips", "material", "multi_texture", "red", "green", "blue", "rgb", "color")
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
    return _parts(file, *_elements(file.content))


def _parts(file: MeshFile, elements: dict[str, _Values], texture_names: list[str]) -> list[Part]:
    """Create a part from the elements of a file, or none if the file has no faces."""
    # `pop` removes what is read. What remains in the end is ignored or refused by name.
    vertex, face = elements.pop("vertex", {}), elements.pop("face", {})
    vertices = _columns(vertex, ("x", "y", "z"))
    faces = face.pop("vertex_indices", face.pop("vertex_index", None))
    # A file without faces is read like one with an empty list of them.
    if not isinstance(faces, _Lists):
        faces = _Lists(np.zeros(0, np.int64), np.zeros(0))
    faces = faces._replace(numbers=_cast(faces.numbers, "i8"))
    corner_uvs = _corner_uvs(vertex, face, faces)
    vertex_colors = _rgb(vertex, file)
    face_colors = _rgb(face, file)
    normals = _columns(vertex, ("nx", "ny", "nz"))
    texture_of_face = face.pop("texnumber", 0)
    if texture_names and (len(set(texture_names)) > 1 or np.any(texture_of_face)):
        raise ValueError("the file has several textures, which is not supported: export it as .glb")
    for name in (*elements, *vertex, *face):
        if name.startswith(_REFUSED):
            raise ValueError(f"{name} is not supported: export the mesh with colors or one texture")
        file.ignore(name)
    if vertices is None:
        return []
    # Places of the corners of each triangle in `faces.numbers`, and its face in the file.
    corners, polygons = mesh_file.triangles_of(file, vertices, faces.numbers, faces.lengths)
    if not len(corners):
        return []
    triangles = faces.numbers[corners]
    colors = np.ones((len(triangles), 3, 3))
    if vertex_colors is not None:
        colors = vertex_colors[triangles]
    if face_colors is not None:
        if vertex_colors is not None:
            file.assume("the colors of faces are taken, and not those of vertices")
        colors = face_colors[polygons, None].repeat(3, axis=1)
    is_textured = np.full(len(triangles), bool(texture_names))
    colors = mesh_file.beside_textures(colors, is_textured, file)
    if not texture_names and np.isfinite(corner_uvs).any():
        file.assume("the mesh is taken as untextured, as the file names no texture")
    textures = [file.texture(name) for name in texture_names[:1]]
    uvs = corner_uvs[corners]
    mesh = mesh_file.colored_mesh(vertices, triangles, colors, uvs, textures=textures)
    return [Part(mesh, np.zeros((*triangles.shape, 3)) if normals is None else normals[triangles])]


def _columns(values: _Values, names: tuple[str, ...]) -> np.ndarray | None:
    """Remove properties from an element, and return them as columns, or None without them."""
    if not all(isinstance(values.get(name), np.ndarray) for name in names):
        return None
    return np.stack([values.pop(name) for name in names], axis=1)


def _rgb(values: _Values, file: MeshFile) -> np.ndarray | None:
    """Remove the colors from an element, and return them as sRGB-encoded values in [0, 1]."""
    colors = [c for names in _COLORS if (c := _columns(values, names)) is not None]
    if not colors:
        return None
    if len(colors) > 1:
        raise ValueError("an element has two kinds of colors, such as red and diffuse_red")
    # Opacity must be 1, because the renderer has no transparency.
    for name in ("alpha", "a"):
        alpha = _columns(values, (name,))
        if alpha is not None and (mesh_file.unit_colors(alpha, file) < mesh_file.OPAQUE).any():
            raise ValueError("the file has transparent colors, which are not supported")
    return mesh_file.unit_colors(colors[0], file)


def _corner_uvs(vertex: _Values, face: _Values, faces: _Lists) -> np.ndarray:
    """Remove the texture coordinates, and return those of all corners, or NaN, shape (C, 2)."""
    uvs = np.full((len(faces.numbers), 2), np.nan)
    for names in (("s", "t"), ("u", "v")):
        vertex_uvs = _columns(vertex, names)
        if vertex_uvs is not None:
            uvs = vertex_uvs.take(faces.numbers, axis=0, mode="clip")
    # The texture coordinates of the faces are those of their corners, which
    # differ on both sides of a seam. They therefore replace those of vertices.
    face_uvs = face.pop("texcoord", None)
    if isinstance(face_uvs, _Lists):
        # A face without texture coordinates has an empty list. Others have u and v for each corner.
        is_given = face_uvs.lengths > 0
        if not (face_uvs.lengths == 2 * faces.lengths * is_given).all():
            raise ValueError("a face has a texcoord without two numbers for each corner")
        uvs[is_given.repeat(faces.lengths)] = face_uvs.numbers.reshape(-1, 2)
    return uvs


def _elements(content: bytes) -> tuple[dict[str, _Values], list[str]]:
    """Read the values of all elements by name, and the names of the textures."""
    header = re.match(rb"ply[ \t]*(\r\n|\n|\r)(.*?\1)[ \t]*end_header[ \t]*\1", content, re.DOTALL)
    if header is None:
        raise ValueError("the file has no header of PLY that ends with end_header")
    # Kind of the numbers: text, or binary with the low or the high byte first.
    form = ""
    texture_names = []
    # Number of rows and properties of each element.
    layouts: dict[str, tuple[int, list[_Property]]] = {}
    items: list[_Property] = []
    for line in mesh_file.as_utf8(header[2]).decode().split(header[1].decode()):
        match line.split():
            case ["format", form, *_]:
                pass
            case ["comment", key, _, *_] if key.lower() == "texturefile":
                texture_names.append(line.split(None, 2)[2].strip())
            case ["element", name, count] if name not in layouts:
                items = []
                layouts[name] = int(count), items
            # "property list uchar int vertex_indices" has a type of its length, "property float x"
            # none.
            case ["property", *length, type_, name] if {type_, *length[1:]} <= _TYPES.keys():
                # Type of the numbers, then type of the length, if any.
                types = [_TYPES[key] for key in (type_, *length[1:])]
                items.append(_Property(re.sub("^(diffuse|texture)_", "", name.lower()), *types))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"the header has an unknown line: {line}")
    if form not in _BYTE_ORDERS:
        raise ValueError(f"the format is {form}: choose {', '.join(_BYTE_ORDERS)}")
    body = content[header.end() :]
    # Text becomes float64 numbers, which are then read like a binary file.
    if form == _ASCII:
        body = mesh_file.parse_numbers(body, np.float64).tobytes()
    offset = 0
    elements: dict[str, _Values] = {}
    for name, (row_count, items) in layouts.items():
        if len({item.name for item in items}) < max(1, len(items)):
            raise ValueError(f"the element {name} has no properties, or two of one name")
        elements[name], offset = _rows(body, offset, row_count, items, form)
    if form == _ASCII and offset != len(body):
        raise ValueError("the lines have more numbers than the header says")
    return elements, texture_names


def _rows(
    body: bytes, offset: int, count: int, properties: list[_Property], form: str
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
            row = _first_row(body, offset, properties, form)
            # Number of complete rows that the rest of the file can hold.
            most = min(most, (len(body) - offset) // row.itemsize)
            rows = np.frombuffer(body, row, max(1, most), offset)
        # NumPy refuses a list of negative length, or longer than the file.
        except ValueError as error:
            raise ValueError(_TRUNCATED) from error
        lengths = [rows[name] for name in row.names or () if name.startswith(_LENGTH)]
        # True for rows in which a list has another length than in the first row. They start the
        # next block.
        is_other = np.any([column != column[0] for column in lengths], axis=0)
        blocks.append(rows[: is_other.argmax()] if is_other.any() else rows)
        count -= len(blocks[-1])
        offset += blocks[-1].nbytes

    def column(name: str, type_: str) -> np.ndarray:
        """Join a column of all blocks."""
        return _cast(np.concatenate([np.zeros(0), *(rows[name].ravel() for rows in blocks)]), type_)

    values: _Values = {}
    for name, number_type, length_type in properties:
        values[name] = numbers = column(name, number_type)
        if length_type:
            values[name] = _Lists(column(_LENGTH + name, length_type).astype(np.int64), numbers)
    return values, offset


def _first_row(body: bytes, offset: int, properties: list[_Property], form: str) -> np.dtype:
    """Return the type of the first row, in which the length of a list is a field of its own."""
    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for name, *types in properties:
        # Text was converted to float64 (f8). A property that is no list has no type of a length.
        number_type, length_type = (
            type_ and _BYTE_ORDERS[form] + ("f8" if form == _ASCII else type_) for type_ in types
        )
        shape: tuple[int, ...] = ()
        if length_type:
            # The length of the list is stored in front of its numbers.
            start = offset + np.dtype(fields).itemsize
            fields.append((_LENGTH + name, length_type, ()))
            shape = (int(np.frombuffer(body, length_type, 1, start)[0]),)
        fields.append((name, number_type, shape))
    return np.dtype(fields)


def _cast(numbers: np.ndarray, type_: str) -> np.ndarray:
    """Convert numbers to a type, floating-point ones to float64, but change no whole number."""
    if type_.startswith("f"):
        return numbers.astype(np.float64)
    # astype turns NaN into an arbitrary integer, with a warning.
    with np.errstate(invalid="ignore"):
        cast = numbers.astype(type_)
    if (cast != numbers).any():
        raise ValueError("a number is not whole, or does not fit into its type: export it again")
    return cast


# Beginning of a file. Some files have the number of vertices directly after "OFF".
_OFF_HEADER = re.compile(rb"\s*OFF\s*(\d+)\s+(\d+)[^\n]*\n", re.IGNORECASE)


def read_off(file: MeshFile) -> list[Part]:
    """Read an .off file as one part, or none if the file has no faces."""
    text = mesh_file.as_utf8(file.content).replace(b"\r", b"\n") + b"\n"
    text = mesh_file.without_comments(text)
    header = _OFF_HEADER.match(text)
    if header is None:
        raise ValueError("only text that begins with OFF is supported: export the mesh as .ply")
    vertex_count, face_count = map(int, header.groups())
    lines = [line + b"\n" for line in text[header.end() :].split(b"\n") if line.strip()]
    if len(lines) < vertex_count + face_count:
        raise ValueError(_TRUNCATED)
    # What follows the header is the same as in a .ply file.
    rows = b"".join(lines[: vertex_count + face_count])
    sizes = [int(line.split()[0]) for line in lines[vertex_count : vertex_count + face_count]]
    # Three words for each vertex. For each face, the number of its corners, and their indices.
    word_counts = [*[3] * vertex_count, *(1 + size for size in sizes)]
    if mesh_file.words_per_line(rows).tolist() != word_counts:
        raise ValueError("a vertex or a face has colors or other numbers: export the mesh as .ply")
    body = mesh_file.parse_numbers(rows, np.float64).tobytes()
    vertex, offset = _rows(body, 0, vertex_count, [_Property(axis, "f8") for axis in "xyz"], _ASCII)
    face, _ = _rows(body, offset, face_count, [_Property("vertex_indices", "i8", "i8")], _ASCII)
    return _parts(file, {"vertex": vertex, "face": face}, [])


# Face of a binary .stl file. Some programs store a color in `attribute`, and say so by its bit 15,
# or by a color for all other faces in the header, whose last four bytes are the number of faces.
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER_SIZE = 84


def read_stl(file: MeshFile) -> list[Part]:
    """Read an .stl file as one part, or none if the file has no faces."""
    content = file.content
    header = content[:_HEADER_SIZE]
    face_count = int.from_bytes(header[-4:], "little")
    # A binary file may begin with "solid", too, but has NUL bytes.
    if re.match(rb"\W*solid", content, re.IGNORECASE) and b"\0" not in content:
        text = mesh_file.as_utf8(content).replace(b"\r", b"\n")
        has_colors = bool(re.search(rb"^\s*(colou?r|rgb)", text, re.MULTILINE | re.IGNORECASE))
        lines = re.findall(rb"^\s*vertex\b(.*)", text, re.MULTILINE | re.IGNORECASE)
        face_count = len(re.findall(rb"^\s*endfacet\b", text, re.MULTILINE | re.IGNORECASE))
        coordinates = mesh_file.parse_numbers(b"\n".join(lines), np.float64)
        if len(coordinates) != 9 * face_count or len(lines) != 3 * face_count:
            raise ValueError("a facet does not have three vertices with three coordinates")
    elif (excess := len(content) - _HEADER_SIZE - face_count * _STL_FACE.itemsize) < 0:
        raise ValueError(_TRUNCATED)
    else:
        if excess >= _STL_FACE.itemsize:
            file.assume(f"its face count is taken as right and the last {excess} bytes are ignored")
        faces = np.frombuffer(content, _STL_FACE, face_count, _HEADER_SIZE)
        has_colors = bool((faces["attribute"] & 0x8000).any())
        if b"COLOR=" in header:
            # MeshLab writes a color into all headers, and attributes of 0.
            has_colors = bool(faces["attribute"].any())
            file.assume("the surface is taken as white, without the color of the header")
        coordinates = faces["corners"].astype(np.float64)
    if has_colors:
        raise ValueError("colors in .stl files are not supported: export the mesh as .ply")
    mesh_file.require_bounded(coordinates=coordinates)
    corners = coordinates.reshape(-1, 3, 3)
    # Arrays that a program has not filled end with facets of zeros.
    vertices = corners[(corners != corners[:, :1]).any((1, 2))].reshape(-1, 3)
    if not len(vertices):
        return []
    # Files have no shared vertices: each face has three of its own.
    vertex_ids = np.arange(len(vertices)).reshape(-1, 3)
    mesh = mesh_file.colored_mesh(vertices, vertex_ids, np.ones((1, 3)))
    return [Part(mesh, np.zeros_like(mesh.vertices).reshape(-1, 3, 3))]
