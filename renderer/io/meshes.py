"""Read meshes with their colors and textures from files.

Files are read by trimesh. It leaves out an image or a material that it cannot
read, and only writes a line to its log. It also ignores parts of glTF 2.0. A
file is refused where this would show a wrong surface.
"""

import io
import json
import logging
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
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

from renderer.errors import MAX_MAGNITUDE, InputError, require_choice, require_file, single_line
from renderer.geometry.mesh import Y_UP_TO_Z_UP, Mesh, concatenate, transformed
from renderer.image import encode
from renderer.io.images import eight_bits
from renderer.io.skins import skinned, with_skins_as_attributes
from renderer.validation import as_path, require_flag

# Archives are not read, because the names in them cannot be checked first.
ARCHIVES = {"zip", "tar.gz", "tar.bz2", "bz2"}
# Lines of .mtl and .obj files that define and that use a material.
DEFINED = re.compile(rb"^[ \t]*newmtl[ \t]+(.*?)[ \t\r]*$", re.MULTILINE)
USED = re.compile(rb"^[ \t]*usemtl[ \t]+(.*?)[ \t\r]*$", re.MULTILINE)
# Lines of trimesh's log that say that it left out a part of the surface. Of .obj,
# .ply and .dae files, trimesh keeps no other trace of what it left out.
OMISSION = re.compile(r"(unable|failed) to (load|store|convert)|unsupported|index failed")
# Component type of floating-point numbers in glTF 2.0 (section 3.6.2.2).
FLOAT = 5126
# Modes of a primitive of glTF 2.0 that are triangles (section 5.24.4). trimesh
# skips fans.
TRIANGLES = 4
STRIP = 5
FAN = 6
TRANSFORM = "KHR_texture_transform"
# Beginnings of the names of extensions of glTF that move no vertex.
HARMLESS = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")


def load_mesh(path: str | Path, up: str = "auto", gloss: bool = False) -> Mesh:
    """Read a mesh with its colors and textures from a file.

    All parts of a scene, placed by their nodes, become one mesh. Vertices at one
    position become one vertex, so moving it opens no seam. Unused vertices are
    dropped.

    A color is the product of the material's color, the texture and the vertex or
    face colors that the file has. It is white where the file has none of them.
    Alpha, other material properties and the wrap mode of textures are ignored.
    The colors of glTF other than textures are linear by its standard, and are
    encoded here. A glTF file with a skin has the pose of its nodes, and the mesh
    has their joints.

    Args:
        path: A .glb, .gltf, .obj, .ply or .stl file, or another format of
            trimesh.
        up: "y" turns the y axis to the z axis, "z" leaves the mesh as it is, and
            "auto" turns glTF files only.
        gloss: Whether to read roughness, metallic (factors and texture) and
            `specularFactor` of glTF. Otherwise the mesh is matte, since most
            files have values that nobody chose. Meshes of other formats are
            always matte.

    Returns:
        The mesh.

    Raises:
        InputError: If the file does not exist, is damaged or has an unknown
            format; if a material or an image that it names is missing or
            unreadable; if it has no faces, no area, coordinates that are not
            finite, or indices of missing vertices; or if a skin has no weights,
            weights that do not sum to one, or missing joints.

    Example:
        >>> import norm_balls as nb
        >>> cup = nb.solid("cup")
        >>> nb.export_mesh(cup, "cup.glb")
        >>> nb.load_mesh("cup.glb").faces.shape == cup.faces.shape
        True
    """
    path = as_path("path", path)
    require_choice(f"{path}: up", up, ("auto", "y", "z"))
    require_flag("gloss", gloss)
    is_gltf = path.suffix.lower() in (".glb", ".gltf")
    placed = [transformed(part, matrix) for part, matrix in read_parts(path, is_gltf, gloss)]
    if not placed:
        raise InputError(f"{path} has no faces: give a surface mesh, not points or lines")
    mesh = _merge_vertices(concatenate(placed))
    # The nodes of a scene may move vertices out of range. NaN fails the comparison.
    if not (np.abs(mesh.vertices) <= MAX_MAGNITUDE).all():
        raise InputError(
            f"{path} has coordinates that are not finite or beyond {MAX_MAGNITUDE:g}: "
            "export it again"
        )
    if not mesh.face_areas().sum() > 0:
        raise InputError(
            f"{path} has a surface of zero area: give a mesh with faces of some extent"
        )
    is_y_up = up == "y" or (up == "auto" and is_gltf)
    return transformed(mesh, Y_UP_TO_Z_UP) if is_y_up else mesh


def _merge_vertices(mesh: Mesh) -> Mesh:
    """Merge vertices at one position, and drop unused ones.

    Vertices that joints carry in different ways are not merged.
    """
    keys = mesh.vertices
    skin = mesh.skin
    if skin is not None:
        carried, row_of_vertex = np.unique(skin.carried, axis=0, return_inverse=True)
        keys = np.column_stack([keys, row_of_vertex.ravel()])
    keys_of_corners = keys[mesh.faces].reshape(-1, keys.shape[1])
    merged, vertex_of_corner = np.unique(keys_of_corners, axis=0, return_inverse=True)
    if skin is not None:
        skin = replace(skin, carried=carried[merged[:, -1].astype(np.int64)])
    faces = vertex_of_corner.reshape(-1, 3)
    return replace(mesh, vertices=merged[:, :3], faces=faces, skin=skin)


def read_parts(path: Path, linear: bool, gloss: bool = False) -> list[tuple[Mesh, np.ndarray]]:
    """Read the parts of a file and how they are placed.

    Args:
        path: The file.
        linear: Whether the colors of the file, except for textures, are linear.
        gloss: Whether to read the gloss of glTF.

    Returns:
        The mesh of each part in its own coordinates, with the affine matrix
        (4, 4) of its node. A part with a skin is placed by the skin, and has the
        identity matrix.

    Raises:
        InputError: See `load_mesh`. Also if the file cannot be read.
    """
    require_file(path, "give the path of a mesh file")
    suffix = path.suffix.lower().lstrip(".")
    formats = set(trimesh.available_formats()) - ARCHIVES
    if suffix not in formats:
        known = ", ".join(sorted(formats))
        raise InputError(f"{path} has no known mesh format: use one of {known}")
    try:
        return _read_parts(path, suffix, linear, gloss)
    except Exception as error:
        # Readers of meshes and images raise almost anything for a damaged file.
        raise InputError(f"{path} cannot be read as a mesh: {single_line(error)}") from error


def _read_parts(
    path: Path, suffix: str, linear: bool, gloss: bool
) -> list[tuple[Mesh, np.ndarray]]:
    """Read the parts of a file of a known format, or raise any error."""
    content = path.read_bytes()
    tree = _gltf_tree(content) if suffix in ("gltf", "glb") else {}
    has_skins = any("skin" in node for node in tree.get("nodes", []))
    if has_skins:
        content = with_skins_as_attributes(content, tree)
    textured_count = _count_textured_parts(tree, gloss)
    strengths = _strengths(tree) if gloss else {}
    if suffix == "obj":
        content = _as_utf8(content)
    scene = _load(content, suffix, _Files(path))
    parts = {}
    for name, geometry in scene.geometry.items():
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        part = _as_mesh(geometry, linear)
        parts[name] = _with_gloss(part, geometry.visual, strengths) if gloss else part
    if sum(len(part.textures) for part in parts.values()) < textured_count:
        raise ValueError("the image of a texture is missing, or cannot be decoded")
    placed = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        if name not in parts:
            continue
        if has_skins:
            placed.append((skinned(parts[name], node, scene, tree), np.eye(4)))
        else:
            placed.append((parts[name], matrix))
    return placed


class _Files(FilePathResolver):  # type: ignore[misc]  # trimesh counts as untyped, see pyproject.toml
    """The files beside a mesh file, which it names.

    Attributes:
        materials: Content of the .mtl file that was read last.
    """

    materials = b""

    def get(self, name: str) -> bytes:
        """Read a file of the mesh's folder, or the file in it with the last part of the name.

        A name may have \\ for / and %20 for a blank. Only regular files are
        read, because reading a pipe would never end.

        Args:
            name: Name of the file, as the mesh file has it.

        Raises:
            FileNotFoundError: If there is no such file.
        """
        plain = unquote(name.strip('" \t')).replace("\\", "/")
        for file in (Path(self.parent, plain), Path(self.parent, Path(plain).name)):
            if file.is_file() and file.suffix.lower() == ".mtl":
                self.materials = _as_utf8(file.read_bytes())
                return self.materials
            if file.is_file():
                return file.read_bytes()
        raise FileNotFoundError(f"it names {name}, which is not there")


def _load(content: bytes, suffix: str, files: _Files) -> trimesh.Scene:
    """Read a scene, or raise `ValueError` if trimesh leaves out a part of the surface."""
    with _recorded_omissions() as omissions:
        scene = trimesh.load(
            io.BytesIO(content), file_type=suffix, resolver=files, force="scene", process=False
        )
    if suffix == "obj" and b"mtllib" in content:
        unknown = set(USED.findall(content)) - set(DEFINED.findall(files.materials))
        for name in unknown:
            omissions.append(f"its first .mtl file does not have the material {name.decode()}")
    if omissions:
        raise ValueError(omissions[0])
    return scene


@contextmanager
def _recorded_omissions() -> Iterator[list[str]]:
    """Record what trimesh writes to its log about omissions while a `with` block runs.

    The list holds a sentence for each omission.
    """
    recorder = _OmissionRecorder()
    log = trimesh.util.log
    level = log.level
    log.addFilter(recorder)
    log.setLevel(logging.DEBUG)
    try:
        yield recorder.omissions
    finally:
        log.removeFilter(recorder)
        log.setLevel(level)


class _OmissionRecorder(logging.Filter):
    """A filter of a log that records lines about omissions, and shows no line."""

    def __init__(self) -> None:
        super().__init__()
        self.omissions: list[str] = []

    def filter(self, record: logging.LogRecord) -> bool:
        """Record a line if it matches `OMISSION`, with its error if it has one."""
        message = record.getMessage()
        if OMISSION.search(message):
            error = record.exc_info[1] if record.exc_info else ""
            self.omissions.append(f"{message} {error}")
        return False


def _as_utf8(text: bytes) -> bytes:
    """Return text in UTF-8. Bytes that are not UTF-8 are taken for Latin-1."""
    try:
        text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1").encode()
    return text


def _gltf_tree(content: bytes) -> dict[str, Any]:
    """Return the JSON of a .gltf or .glb file, or raise an error if it is damaged."""
    if content.startswith(b"glTF"):
        # A .glb file has a header of 12 bytes. Then comes the length of the JSON,
        # its type, and the JSON itself from byte 20.
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    # JSON has no NaN. `int` raises ValueError for it.
    tree: dict[str, Any] = json.loads(content, parse_constant=int)
    return tree


def _strengths(tree: dict[str, Any]) -> dict[str | None, float]:
    """Return the `specularFactor` of the materials of a glTF file, by name.

    Raises `ValueError` if two materials of a name differ in it, or a material has
    a texture for it.
    """
    strengths: dict[str | None, float] = {}
    for material in tree.get("materials", []):
        name = material.get("name")
        specular = material.get("extensions", {}).get("KHR_materials_specular", {})
        if "specularTexture" in specular:
            raise ValueError(f"its material {name} has a specularTexture, which is not supported")
        factor = specular.get("specularFactor", 1.0)
        if strengths.setdefault(name, factor) != factor:
            raise ValueError(f"materials of the name {name} differ in specularFactor")
    return strengths


def _count_textured_parts(tree: dict[str, Any], gloss: bool) -> int:
    """Return how many parts of a glTF file have an image as their color.

    Raises `ValueError` if the file has features with which trimesh would read the
    shape or the texture coordinates wrongly, and `KeyError` or the like if it is
    damaged.
    """
    for name in tree.get("extensionsRequired", []):
        if not name.startswith(HARMLESS):
            raise ValueError(f"it needs the extension {name}, which is not supported")
    textured_count = 0
    for mesh in tree.get("meshes", []):
        for part in mesh["primitives"]:
            if part.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN):
                _require_supported_accessors(tree, part)
                textured_count += _is_textured(tree, part, gloss)
    return textured_count


def _require_supported_accessors(tree: dict[str, Any], part: dict[str, Any]) -> None:
    """Raise `ValueError` if the numbers of a glTF part are stored in an unsupported way."""
    attributes = part["attributes"]
    indices = (*attributes.values(), part.get("indices", 0))
    accessors = [tree["accessors"][index] for index in indices]
    if part.get("mode") == FAN or any("sparse" in accessor for accessor in accessors):
        raise ValueError("triangle fans and sparse accessors are not supported")
    # The positions take the place of missing texture coordinates. They are floats.
    uvs = tree["accessors"][attributes.get("TEXCOORD_0", attributes["POSITION"])]
    if uvs["componentType"] != FLOAT:
        raise ValueError(
            "texture coordinates that are not floating-point numbers are not supported"
        )


def _is_textured(tree: dict[str, Any], part: dict[str, Any], gloss: bool) -> bool:
    """Return whether a glTF part has an image as its color.

    Raises `ValueError` if a texture has unsupported coordinates. The texture of
    roughness and metallic counts if `gloss` is true.
    """
    material = tree["materials"][part["material"]] if "material" in part else {}
    extensions = material.get("extensions", {})
    specular_glossiness = extensions.get("KHR_materials_pbrSpecularGlossiness", {})
    metallic_roughness = material.get("pbrMetallicRoughness", {})
    candidates = [
        metallic_roughness.get("baseColorTexture"),
        specular_glossiness.get("diffuseTexture"),
    ]
    color_textures = [texture for texture in candidates if texture is not None]
    used_textures = list(color_textures)
    if gloss:
        used_textures.append(metallic_roughness.get("metallicRoughnessTexture") or {})
    for texture in used_textures:
        if texture.get("texCoord") or TRANSFORM in texture.get("extensions", {}):
            raise ValueError(
                "a texture has a second set of coordinates or is transformed, "
                "which is not supported"
            )
    return bool(color_textures)


def _as_mesh(geometry: trimesh.Trimesh, linear: bool) -> Mesh:
    """Convert one geometry of a file, in its own coordinates.

    `linear` says whether its colors, except for textures, are linear. Damaged
    contents raise whatever NumPy or Pillow raise.
    """
    vertices = geometry.vertices
    faces = np.asarray(geometry.faces)
    uvs = getattr(geometry.visual, "uv", None)
    mesh = Mesh.plain(vertices, faces)
    colors, image = _corner_colors(geometry.visual, faces)
    checked = {"coordinates": vertices, "texture coordinates": uvs, "colors": colors}
    for name, values in checked.items():
        # NaN fails the comparison.
        if values is not None and not (np.abs(values) <= MAX_MAGNITUDE).all():
            raise ValueError(f"{name} are not finite or beyond {MAX_MAGNITUDE:g}")
    if linear:
        colors = encode(torch.from_numpy(colors), "srgb").numpy()
    mesh = replace(mesh, corner_colors=colors.astype(np.float32))
    if image is None:
        return mesh
    texture = np.array(eight_bits(image).convert("RGB"))
    return _with_texture(mesh, uvs, texture)


def _with_texture(mesh: Mesh, uvs: np.ndarray | None, texture: np.ndarray) -> Mesh:
    """Return a copy of a mesh with one texture, given coordinates (V, 2) of its vertices."""
    if uvs is None:
        raise ValueError("an image has no texture coordinates")
    return replace(
        mesh,
        corner_uvs=uvs[:, :2].astype(np.float32)[mesh.faces],
        texture_ids=np.zeros(len(mesh.faces), dtype=np.int32),
        textures=(texture,),
    )


def _with_gloss(mesh: Mesh, visual: Visuals, strengths: dict[str | None, float]) -> Mesh:
    """Return a copy of a mesh with the gloss of its glTF material, or the mesh without one.

    Factors that a material leaves out are 1 by the standard: a rough metal.
    """
    material = getattr(visual, "material", None)
    if not isinstance(material, PBRMaterial):
        return mesh
    given = (material.roughnessFactor, material.metallicFactor, strengths.get(material.name))
    factors = [1.0 if factor is None else factor for factor in given]
    row = np.clip(factors, 0, 1).astype(np.float32)
    mesh = replace(mesh, gloss=row[None].repeat(len(mesh.faces), axis=0))
    if material.metallicRoughnessTexture is None:
        return mesh
    if visual.uv is None:
        raise ValueError("an image has no texture coordinates")
    if not mesh.textures:
        white = np.full((1, 1, 3), 255, dtype=np.uint8)
        mesh = _with_texture(mesh, visual.uv, white)
    texels = np.array(eight_bits(material.metallicRoughnessTexture).convert("RGB"))
    # Green is roughness and blue is metallic.
    return replace(mesh, gloss_textures=(texels[..., 1:],))


def _corner_colors(visual: Visuals, faces: np.ndarray) -> tuple[np.ndarray, Image.Image | None]:
    """Return colors (F, 3, 3) in [0, 1] as the file has them, and the texture if there is one."""
    colors = np.ones((len(faces), 3, 3))
    image = None
    if visual.kind == "vertex":
        colors *= _unit_rgb(visual.vertex_colors)[faces]
    elif visual.kind == "face":
        colors *= _unit_rgb(visual.face_colors)[:, None]
    elif visual.kind == "texture":
        color, image = _material_color(visual.material)
        colors *= color
        if "color" in visual.vertex_attributes:
            colors *= _unit_rgb(visual.vertex_attributes["color"])[faces]
    return colors, image


def _material_color(material: Material) -> tuple[np.ndarray, Image.Image | None]:
    """Return the color (3,) of a material in [0, 1], and its image if it has one.

    The color is white if the file gives none.
    """
    if isinstance(material, PBRMaterial):
        factor = material.baseColorFactor
        color = np.ones(3) if factor is None else _unit_rgb(factor)
        return color, material.baseColorTexture
    # trimesh sets a gray color and a gray image if an .obj file has none. It keeps
    # the color of the file itself under the name "kd".
    is_placeholder = material.image == empty_material().image
    image = None if is_placeholder else material.image
    return np.clip(material.kwargs.get("kd", np.ones(3)), 0, 1), image


def _unit_rgb(colors: np.ndarray) -> np.ndarray:
    """Return red, green and blue in [0, 1], given such numbers or integers of any width."""
    rgb = np.asarray(colors)[..., :3]
    is_integer = rgb.dtype.kind in "ui"
    return rgb / np.iinfo(rgb.dtype).max if is_integer else rgb
