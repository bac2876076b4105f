"""Read .obj files and their material libraries, which are .mtl files."""

import re
from contextlib import suppress
from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from renderer.image import decode, encode
from renderer.io import mesh_file
from renderer.io.mesh_file import MeshFile, Part
from renderer.mesh import NO_TEXTURE

# Statements that describe the surface or name groups of faces.
_READ = {"v", "vt", "vn", "f", "usemtl", "mtllib", "g", "o"}
# Statements that do not change the surface, such as lines and points.
_IGNORED = {"l", "p", "s", "vp", "lod", "mg", "bevel", "c_interp", "d_interp", "shadow_obj"}
# Properties of materials, in lower case, that would change the shape or the base color.
_REFUSED_PROPERTIES = {"map_d", "map_tr", "disp", "decal"}
# Keyword at the beginning of a line, and the text after it.
_LINE = re.compile(rb"^[ \t]*(\S+)[ \t]*(.*)", re.MULTILINE)
# Comment of ZBrush with the colors of vertices. Each is a
# mask, red, green and blue in two hexadecimal digits each.
_POLYPAINT = re.compile(rb"^#MRGB[ \t]+((?:[0-9a-fA-F]{8})+)", re.MULTILINE)
# Options of a texture that leave it as it is: a scale of 1 and a shift of 0.
_NEUTRAL_OPTIONS = re.compile(r"(-(s(\s+1(\.0*)?)+|[ot](\s+0(\.0*)?)+)\s+)*", re.IGNORECASE)
# End of the text of a corner that leaves out an index.
_LEFT_OUT = -(10**18)

# Folder of a material library with a final /, whether its colors are linear, and the
# keywords and values of the properties of a material in this library.
_Definition = tuple[str, bool, list[tuple[str, str]]]


class _Lines(NamedTuple):
    """All lines with the same keyword: their numbers in the file, and the texts after it."""

    keyword: str
    numbers: list[int]
    texts: list[bytes]

    def words(self) -> tuple[np.ndarray, bytes]:
        """Return the number of words of each line, and all lines, without keyword and comment."""
        text = mesh_file.without_comments(b"".join([text + b"\n" for text in self.texts]))
        return mesh_file.words_per_line(text), text

    def names(self) -> list[str]:
        """Return the text of each line, which is a name."""
        return [text.decode().strip() for text in self.texts]


class _Material(NamedTuple):
    """Base color of a material.

    Attributes:
        color: sRGB-encoded color.
        texture: Name of the image file, and the folder in which it is sought first,
            with a final /. None without a texture.
    """

    color: tuple[float, ...] = (1.0, 1.0, 1.0)
    texture: tuple[str, str] | None = None


def read_obj(file: MeshFile) -> list[Part]:
    """Read all objects of an .obj file as one part, or none if the file has no faces."""
    lines = {keyword: _Lines(keyword, [], []) for keyword in _READ}
    for number, (word, text) in enumerate(_LINE.findall(_cleaned(file.content))):
        keyword = word.decode()
        if keyword in lines:
            lines[keyword].numbers.append(number)
            lines[keyword].texts.append(text)
        elif keyword in _IGNORED:
            file.ignore(keyword)
        else:
            raise ValueError(f"the statement {keyword[:20]} is not supported: use polygons")
    vertices, vertex_colors = _vertices(lines["v"], file)
    uvs, _ = _table(lines["vt"], (1, 2, 3))
    normals, _ = _table(lines["vn"], (3,))
    mesh_file.require_bounded(texture_coordinates=uvs)
    # Indices of position, texture coordinates and normal of each corner, and corners of each face.
    indices, sizes = _polygons(lines)
    # Places of the corners of each triangle in `indices`, and the line "f" of the triangle.
    corners, polygons = mesh_file.triangles_of(file, vertices, indices[:, 0], sizes)
    if not len(corners):
        return []
    faces, uv_ids, normal_ids = np.moveaxis(indices[corners], 2, 0)
    materials, material_of_polygon = _materials(lines, file)
    material_of_face = material_of_polygon[polygons]
    colors = np.array([material.color for material in materials])[material_of_face, None]
    # Several materials may have the same texture.
    textures = list(dict.fromkeys(item.texture for item in materials if item.texture))
    ids = [textures.index(item.texture) if item.texture else NO_TEXTURE for item in materials]
    texture_ids = np.array(ids)[material_of_face]
    if vertex_colors is not None:
        is_textured = texture_ids != NO_TEXTURE
        used_colors = mesh_file.beside_textures(vertex_colors[faces], is_textured, file)
        first, second = (decode(torch.from_numpy(c), "srgb") for c in (colors, used_colors))
        colors = encode(first * second, "srgb").numpy()
    # The row at the end is for corners without texture coordinates, whose index is -1.
    corner_uvs = np.append(uvs[:, :2], [[np.nan] * 2], axis=0)[uv_ids]
    texels = [file.texture(*texture) for texture in textures]
    mesh = mesh_file.colored_mesh(vertices, faces, colors, corner_uvs, texture_ids, texels)
    return [Part(mesh, np.append(normals, [[0.0] * 3], axis=0)[normal_ids])]


def _cleaned(text: bytes) -> bytes:
    """Convert text to UTF-8 with one statement per line, without lines of comments."""
    text = mesh_file.as_utf8(text).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    # Comments are removed first, because a backslash
    # at their end does not continue the line.
    if b"#" in text:
        text = re.sub(rb"^[ \t]*#.*", b"", text, flags=re.MULTILINE)
    return re.sub(rb"\\[ \t]*(?:\n|\Z)", b" ", text) + b"\n"


def _table(lines: _Lines, lengths: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Parse N lines of numbers, filled up with zeros, and return how many each has, shape (N,)."""
    counts, text = lines.words()
    wrong = counts[~np.isin(counts, lengths)]
    if len(wrong):
        raise ValueError(f"a line {lines.keyword} has {wrong[0]} numbers, not one of {lengths}")
    table = np.zeros((len(counts), max(lengths)))
    is_given = np.arange(max(lengths)) < counts[:, None]
    table[is_given] = mesh_file.parse_numbers(text, np.float64)
    return table, counts


def _vertices(lines: _Lines, file: MeshFile) -> tuple[np.ndarray, np.ndarray | None]:
    """Parse the vertices and their colors, which are white for vertices without a color."""
    table, counts = _table(lines, (3, 4, 6))
    if (table[counts == 4, 3] != 1).any():
        raise ValueError("vertices with a weight other than 1 are not supported")
    is_colored = counts == 6
    if is_colored.any():
        colors = np.ones((len(table), 3))
        colors[is_colored] = mesh_file.unit_colors(table[is_colored, 3:], file)
        return table[:, :3], colors
    painted = bytes.fromhex(b"".join(_POLYPAINT.findall(file.content)).decode())
    if not painted:
        return table[:, :3], None
    if len(painted) != 4 * len(table):
        raise ValueError("the colors in comments #MRGB are not one for each vertex")
    return table[:, :3], np.frombuffer(painted, np.uint8).reshape(-1, 4)[:, 1:] / 255


def _polygons(lines: dict[str, _Lines]) -> tuple[np.ndarray, np.ndarray]:
    """Parse P faces into position, uv and normal indices (C, 3), -1 for none, and sizes (P,)."""
    sizes, text = lines["f"].words()
    indices = _corners(text.split())
    for column, keyword in enumerate(("v", "vt", "vn")):
        # Indices as they stand in the file.
        written = indices[:, column]
        numbers = lines[keyword].numbers
        # A negative index counts backward from the line of the face.
        counts_before = np.searchsorted(numbers, lines["f"].numbers).repeat(sizes)
        # The file counts from 1, and backward from -1.
        resolved = np.where(written < 0, counts_before + written, written - 1)
        is_given = written != _LEFT_OUT
        wrong = written[is_given & ((resolved < 0) | (resolved >= len(numbers)))]
        if len(wrong):
            raise ValueError(f"a face has the index {wrong[0]} of {len(numbers)} lines {keyword}")
        indices[:, column] = np.where(is_given, resolved, -1)
    return indices, sizes


def _corners(words: list[bytes]) -> np.ndarray:
    """Parse corners such as 1/2/3 or 1//3 as rows of three, with `_LEFT_OUT` for no index."""
    text = b" ".join([*words, b""])
    # Write a number for each index that is left out, so that all corners read alike.
    absent = b"/%d" % _LEFT_OUT
    text = text.replace(b"//", absent + b"/").replace(b"/ ", absent + b" ")
    characters = np.frombuffer(text, dtype=np.uint8)
    # The character after each number, which is a blank at the end of a corner.
    separators = characters[(characters == ord(" ")) | (characters == ord("/"))]
    is_last = separators == ord(" ")
    firsts = np.flatnonzero(np.append(True, is_last[:-1]))
    # Number of the corner to which each number belongs.
    corners = np.cumsum(is_last) - is_last
    # Place of each number in its corner: 0 for v, 1 for vt and 2 for vn.
    columns = np.arange(len(is_last)) - firsts[corners]
    numbers = mesh_file.parse_numbers(text.replace(b"/", b" "), np.int64)
    if columns.max(initial=0) > 2 or len(numbers) != len(columns):
        raise ValueError("a corner of a face is not like 1, 1/2, 1//3 or 1/2/3")
    table = np.full((len(words), 3), _LEFT_OUT)
    table[corners, columns] = numbers
    return table


def _materials(lines: dict[str, _Lines], file: MeshFile) -> tuple[list[_Material], np.ndarray]:
    """Read the used materials, and find the index of the one of each face."""
    library = _library(lines["mtllib"].names(), file)
    # A material may be used by many lines.
    read = cache(lambda name: _material(name, library, file) if name else _Material())
    # Name of the material of each line "usemtl", after "" for faces before these lines. Blender
    # writes a line without a name for faces without a material.
    names = ["", *lines["usemtl"].names()]
    # Each face has the material of the last line "usemtl" before it.
    line_of_face = np.searchsorted(lines["usemtl"].numbers, lines["f"].numbers)
    used_lines, material_of_face = np.unique(line_of_face, return_inverse=True)
    return [read(names[line]) for line in used_lines], material_of_face


def _library(names: list[str], file: MeshFile) -> dict[str, _Definition] | None:
    """Read the properties of all materials by name. None if the file names no library."""
    library: dict[str, _Definition] = {}
    for name in names:
        # The line may name several files, or end with a comment.
        for path in re.findall(r"\S.*?\.mtl(?!\S)", name, re.IGNORECASE) or [name]:
            folder = "".join(path.replace("\\", "/").rpartition("/")[:2])
            # Materials of this .mtl file by name.
            materials_of_file: dict[str, _Definition] = {}
            properties: list[tuple[str, str]] = []
            content = file.read(path)
            # The first line of Blender names it. It writes linear colors.
            is_linear = content.startswith(b"# Blender")
            for word, rest in _LINE.findall(_cleaned(content)):
                keyword, text = word.decode(), rest.decode().strip()
                if keyword.lower() != "newmtl":
                    properties.append((keyword, text))
                    continue
                if text in materials_of_file:
                    raise ValueError(f"an .mtl file defines the material {text} twice")
                properties = []
                materials_of_file[text] = (folder, is_linear, properties)
            # The first file that defines a material counts.
            library = materials_of_file | library
    return library if names else None


def _emitted(properties: list[tuple[str, str]]) -> set[str]:
    """Return the properties with the light of a material that is black otherwise, in lower case.

    Blender writes a texture without shading in this way.
    """
    texts = {keyword.lower(): text.partition("#")[0] for keyword, text in properties}
    if "map_kd" in texts or texts.get("kd", "1").strip("0. "):
        return set()
    emitted = {key for key in ("ke", "map_ke") if texts.get(key, "").strip("0. ")}
    # Words such as "spectral" are no numbers.
    if not re.fullmatch(r"(\s*[\d.]+(e[+-]?\d+)?){3}\s*", texts.get("ke", ""), re.IGNORECASE):
        emitted.discard("ke")
    return emitted


def _material(name: str, library: dict[str, _Definition] | None, file: MeshFile) -> _Material:
    """Find the color and the texture of a material among its properties in the library."""
    if library is None:
        file.assume("materials are white, because the file names no material library")
        return _Material()
    # The name may be followed by a comment.
    definition = library.get(name, library.get(re.split(r"\s+#", name)[0]))
    if definition is None:
        raise ValueError(f"no .mtl file defines the material {name}")
    folder, is_linear, properties = definition
    color, texture = _Material()
    color_key, texture_key = "kd", "map_kd"
    if emitted := _emitted(properties):
        file.assume("the light that a black material emits is taken as its color")
        color_key, texture_key = "ke", "map_ke"
        unused = {"kd", "ke", "map_ke"} - emitted
        properties = [item for item in properties if item[0].lower() not in unused]
    # Opacity ("d") or transparency ("tr"), of which "d" counts if a material has both.
    opacities = {}
    for keyword, text in properties:
        match keyword.lower():
            case key if key == color_key:
                values: list[float] = []
                # Words such as "spectral" are no numbers.
                with suppress(ValueError):
                    values = [*map(float, mesh_file.without_comments(text.encode()).split())]
                if key == "ke":  # The strength of light has no limit.
                    values = [value / max(1.0, *values) for value in values]
                is_color = all(0 <= value <= 1 + mesh_file.TOLERANCE for value in values)
                if len(values) not in (1, 3) or not is_color:
                    raise ValueError(f'"{keyword} {text}" is no color: give R, G, B from 0 to 1')
                color = tuple(min(value, 1.0) for value in values * (3 // len(values)))
            case key if key == texture_key:
                path = _NEUTRAL_OPTIONS.sub("", text, count=1)
                if not path or path.startswith("-"):
                    fault = f'"{keyword} {text}" is not an image alone'
                    raise ValueError(f"{fault}: leave its options out")
                texture = (path, folder)
            case "d" | "tr" as key:
                # A number may follow the option "-halo".
                opacities[key] = float("".join(text.partition(" #")[0].split()[-1:]))
            case key if key in _REFUSED_PROPERTIES:
                raise ValueError(f"the material {name} has {keyword}, which is not supported")
            case _:
                file.ignore(keyword)
    red, green, blue = color
    # Programs write their default gray or black there. Texels are often the color itself.
    if texture and red == green == blue < 1:
        file.assume("a gray Kd beside map_Kd is taken as white, as in Blender")
        color = (1.0, 1.0, 1.0)
    elif is_linear:
        color = tuple(encode(torch.tensor(color, dtype=torch.float64), "srgb").tolist())
    elif not {0, 1}.issuperset(color):
        file.assume("Kd is taken as sRGB-encoded")
    if opacities == {"tr": 1}:
        file.assume("Tr 1 is taken as opaque, as some programs write it")
        opacities = {}
    if not opacities.get("d", 1 - opacities.get("tr", 0)) >= mesh_file.OPAQUE:
        raise ValueError(f"the material {name} is transparent, which is not supported")
    return _Material(color, texture)
