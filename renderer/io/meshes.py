"""The parts of a mesh file, as trimesh reads them, with their colors and textures.

trimesh leaves out, without a word, an image or material that it cannot find or decode, and ignores parts of glTF 2.0.
Where that would show a wrong surface, the file is refused.
"""

import codecs
import io
import json
import re
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
import trimesh
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.visual.base import Visuals
from trimesh.visual.material import Material, PBRMaterial, empty_material

from renderer.errors import LARGEST, InputError, in_one_line, require_file
from renderer.image import encode
from renderer.io.images import eight_bits
from renderer.mesh import Mesh

ARCHIVES = {"zip", "tar.gz", "tar.bz2", "bz2"}  # not read: the names in them cannot be checked first
MATERIALS = "materials.mtl"  # the name under which trimesh gets the used materials of an .obj file
LIBRARY, USED = (re.compile(rf"^[ \t]*{key}[ \t]+(.*?)[ \t\r]*$", re.MULTILINE) for key in ("mtllib", "usemtl"))
NEW_MATERIAL = re.compile(r"^[ \t]*newmtl[ \t]+", re.MULTILINE | re.IGNORECASE)
COLOR, OBJ_IMAGE = (
    re.compile(rf"^[ \t]*{key}[ \t]+(.*?)[ \t\r]*$", re.MULTILINE | re.IGNORECASE) for key in ("kd", "map_kd")
)
PLY_IMAGE = re.compile(r"^comment[ \t]+TextureFile[ \t]+(.*?)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)
FLOAT = 5126  # a component type of glTF 2.0 (section 3.6.2.2)
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes of a primitive (section 5.24.4); trimesh skips fans
HARMLESS = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")  # extensions that move no vertex, as they begin


def read_parts(path: Path, linear: bool) -> list[tuple[Mesh, np.ndarray]]:
    """Every part of a file in its own coordinates, with the affine matrix (4, 4) that its node places it by.

    linear: the file's colors, textures aside, are linear. InputError: as `renderer.mesh.load_mesh`.
    """
    require_file(path, "give the path of a mesh file")
    formats = set(trimesh.available_formats()) - ARCHIVES
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in formats:
        raise InputError(f"{path} has no known mesh format: use one of {', '.join(sorted(formats))}")
    try:
        content, files, textured_parts = _open(path)
        scene = trimesh.load(io.BytesIO(content), file_type=suffix, resolver=files, force="scene", process=False)
        surfaces = {
            name: geometry
            for name, geometry in scene.geometry.items()
            if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)
        }
        parts = {name: _part(geometry, linear) for name, geometry in surfaces.items()}
        if sum(len(part.textures) for part in parts.values()) < textured_parts:
            raise ValueError("the image of a texture is missing, or cannot be decoded")
    except Exception as error:  # readers of meshes and images raise almost anything at a damaged file
        raise InputError(f"{path} cannot be read as a mesh: {in_one_line(error)}") from error
    nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]
    return [(parts[name], matrix) for matrix, name in nodes if name in parts]


class _Files(FilePathResolver):  # type: ignore[misc]  # trimesh counts as untyped, see pyproject.toml
    """Files that a mesh names, also as other systems write paths. Regular files alone: a pipe would never end."""

    def __init__(self, path: Path):
        super().__init__(str(path))
        self.folders, self.materials = [path.parent], ""

    def get(self, name: str) -> bytes | str:
        return self.materials if name == MATERIALS else self.find(name).read_bytes()

    def find(self, name: str) -> Path:
        """FileNotFoundError where no file has the name: with \\ for /, %20 for a blank, or in another's folder.

        Options, as in `map_Kd -s 1 1 1 peel.png`, come before the name.
        """
        plain = name.strip('" \t').replace("\\", "/")
        last = plain.split()[-1] if plain.startswith("-") else plain
        names = dict.fromkeys([plain, unquote(plain), last, plain.lstrip("/"), plain.rpartition("/")[2]])
        for file in (folder / name for folder in self.folders for name in names if name):
            if file.is_file():
                return file
        raise FileNotFoundError(f"it names {name}, which is not there")

    def add_materials(self, text: str) -> str:
        """Gather the materials that an .obj's text uses; returns the text that names them as one file, `MATERIALS`."""
        contents = []
        for line in LIBRARY.findall(text):
            try:
                libraries = [self.find(line)]  # a name may have blanks
            except FileNotFoundError:
                libraries = [self.find(name) for name in line.split()]
            contents += [_decoded(library.read_bytes()) for library in libraries]
            self.folders += [library.parent for library in libraries]
        if not contents:
            return text
        blocks = {block.partition("\n")[0].strip(): block for block in NEW_MATERIAL.split("\n".join(contents))[1:]}
        used = sorted(set(USED.findall(text)))
        if missing := [name for name in used if name not in blocks]:
            raise ValueError(f"it uses the material {missing[0]}, which no file that it names has")
        self.materials = "".join(f"newmtl {blocks[name]}\n" for name in used)
        for color in COLOR.findall(self.materials):
            np.broadcast_to(np.array(color.split(), dtype=np.float64), 3)  # ValueError where trimesh would take white
        return f"mtllib {MATERIALS}\n{text}"


def _open(path: Path) -> tuple[bytes, _Files, int]:
    """(content in UTF-8, the files that it names, the least number of textures). Raises almost anything."""
    content, files, images, textured_parts = path.read_bytes(), _Files(path), [], 0
    match path.suffix.lower():
        case ".obj":
            content = files.add_materials(_decoded(content)).encode()
            images = OBJ_IMAGE.findall(files.materials)
        case ".ply":
            header, end, body = content.partition(b"end_header")
            text = _decoded(header)
            content, images = text.encode() + end + body, PLY_IMAGE.findall(text)
        case ".off" | ".stl":
            if len(content) != 84 + 50 * int.from_bytes(content[80:84], "little"):  # as a binary .stl of so many faces
                content = _decoded(content).encode()
        case ".gltf" | ".glb":
            textured_parts = _textured_parts(content)
    for name in images:
        try:
            with Image.open(files.find(name)) as image:
                eight_bits(image)
        except Exception as error:
            raise ValueError(f"its image {name} cannot be read ({error}): save it as PNG or JPEG of 8 bits") from error
    return content, files, textured_parts


def _decoded(content: bytes) -> str:
    """Text in UTF-8, or in UTF-16 with its mark, or else in Latin-1, in which every byte is a character."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16", errors="replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _textured_parts(content: bytes) -> int:
    """How many parts of a glTF file have an image as their color.

    ValueError, KeyError and the like where trimesh would read shape or texture coordinates otherwise than meant.
    """
    if content.startswith(b"glTF"):
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    tree = json.loads(content, parse_constant=int)  # ValueError for NaN, which JSON has not
    for name in tree.get("extensionsRequired", []):
        if not name.startswith(HARMLESS):
            raise ValueError(f"it needs the extension {name}, which is not supported")
    parts = [part for mesh in tree.get("meshes", []) for part in mesh["primitives"]]
    parts = [part for part in parts if part.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN)]
    for part in parts:
        accessors = [tree["accessors"][index] for index in (*part["attributes"].values(), part.get("indices", 0))]
        uvs = tree["accessors"][part["attributes"].get("TEXCOORD_0", part["attributes"]["POSITION"])]
        if part.get("mode") == FAN or any("sparse" in accessor for accessor in accessors):
            raise ValueError("triangle fans and sparse accessors are not supported")
        if uvs["componentType"] != FLOAT:
            raise ValueError("texture coordinates that are not floating-point numbers are not supported")
    textures = [_color_textures(tree["materials"][part["material"]]) for part in parts if "material" in part]
    for texture in (texture for references in textures for texture in references):
        if texture.get("texCoord") or "KHR_texture_transform" in texture.get("extensions", {}):
            raise ValueError("a texture has a second set of coordinates or is transformed, which is not supported")
    return sum(map(bool, textures))


def _color_textures(material: dict[str, Any]) -> list[dict[str, Any]]:
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    both = material.get("pbrMetallicRoughness", {}).get("baseColorTexture"), glossy.get("diffuseTexture")
    return [texture for texture in both if texture is not None]


def _part(geometry: trimesh.Trimesh, linear: bool) -> Mesh:
    """One geometry of a file, in its own coordinates. Raises whatever its contents make NumPy or Pillow raise."""
    vertices, faces, uvs = geometry.vertices, np.asarray(geometry.faces), getattr(geometry.visual, "uv", None)
    mesh = Mesh.plain(vertices, faces)
    colors, image = _corner_colors(geometry.visual, faces)
    for name, values in {"coordinates": vertices, "texture coordinates": uvs, "colors": colors}.items():
        if values is not None and not (np.abs(values) <= LARGEST).all():  # NaN is not
            raise ValueError(f"{name} are not finite or beyond {LARGEST:g}")
    colors = encode(torch.from_numpy(colors), "srgb").numpy() if linear else colors
    mesh = replace(mesh, corner_colors=colors.astype(np.float32))
    if image is None:
        return mesh
    if uvs is None:
        raise ValueError("an image has no texture coordinates")
    return replace(
        mesh,
        corner_uvs=uvs[faces, :2].astype(np.float32),
        texture_ids=np.zeros(len(faces), dtype=np.int32),
        textures=(np.array(eight_bits(image).convert("RGB")),),
    )


def _corner_colors(visual: Visuals, faces: np.ndarray) -> tuple[np.ndarray, Image.Image | None]:
    """(F, 3, 3) colors in [0, 1] as the file has them, and the texture if there is one."""
    colors, image = np.ones((len(faces), 3, 3)), None
    if visual.kind == "vertex":
        colors *= _unit_rgb(visual.vertex_colors)[faces]
    elif visual.kind == "face":
        colors *= _unit_rgb(visual.face_colors)[:, None]
    elif visual.kind == "texture":
        color, image = _material(visual.material)
        colors *= color
        if "color" in visual.vertex_attributes:
            colors *= _unit_rgb(visual.vertex_attributes["color"])[faces]
    return colors, image


def _material(material: Material) -> tuple[np.ndarray, Image.Image | None]:
    """A material's color (3,) in [0, 1], white where the file gives none, and its image."""
    if isinstance(material, PBRMaterial):
        factor, image = material.baseColorFactor, material.baseColorTexture
        return np.ones(3) if factor is None else _unit_rgb(factor), image
    # trimesh puts a gray color, or a gray image, where the file has none; what it has is under its own name.
    image = None if material.image == empty_material().image else material.image
    return np.clip(material.kwargs.get("kd", np.ones(3)), 0, 1), image


def _unit_rgb(colors: np.ndarray) -> np.ndarray:
    """Red, green and blue in [0, 1], from integers of any width or from numbers that are so already."""
    rgb = np.asarray(colors)[..., :3]
    return rgb / np.iinfo(rgb.dtype).max if rgb.dtype.kind in "ui" else rgb
