"""Read meshes with their colors and textures from files.

The library trimesh reads the files. If it cannot read an image or a material, it
leaves the image or material out and only writes a line to its log. It also
ignores some features of glTF 2.0. This module raises an error if the surface
would be wrong because of this.

A part is a mesh with one material, of which a file may hold several.
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

import numpy as np
import torch
import trimesh
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.visual.base import Visuals
from trimesh.visual.material import Material, PBRMaterial, empty_material

from renderer.errors import MAX_MAGNITUDE, InputError, require_choice, require_file, single_line
from renderer.geometry.creases import normal_groups
from renderer.geometry.mesh import Y_UP_TO_Z_UP, Mesh, concatenate, transformed
from renderer.image import encode
from renderer.io.images import eight_bits
from renderer.io.mesh_file import MeshFile, Part
from renderer.io.obj import read_obj
from renderer.io.off import read_off
from renderer.io.ply import read_ply
from renderer.io.skins import skinned, with_skins_as_attributes
from renderer.io.stl import read_stl
from renderer.validation import as_path, require_flag

# Suffixes of archive files, which are not read. trimesh could read them,
# but the names of the files inside an archive cannot be checked first.
ARCHIVES = {"zip", "tar.gz", "tar.bz2", "bz2"}
# Pattern for the messages in trimesh's log that say that
# trimesh left out an image, a material or something else of
# a file. For .obj, .ply and .dae files, only the log tells.
OMISSION = re.compile(r"(unable|failed) to (load|store|convert)|unsupported|index failed")
# Readers of our own. trimesh reads the other formats.
READERS = {"obj": read_obj, "off": read_off, "ply": read_ply, "stl": read_stl}
# Number that stands for the type float32 in glTF 2.0 (section 3.6.2.2).
FLOAT = 5126
# Numbers for the kinds of glTF primitives that consist
# of triangles (glTF 2.0, section 5.24.4): separate
# triangles, triangle strips and triangle fans.
TRIANGLES = 4
STRIP = 5
FAN = 6
# Name of the glTF extension that shifts, scales or rotates a texture.
TRANSFORM = "KHR_texture_transform"
# Beginnings of the names of glTF extensions that a reader
# may ignore, because they do not change the shape of a mesh.
HARMLESS_EXTENSIONS = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")


def load_mesh(path: str | Path, up: str = "auto", gloss: bool = False) -> Mesh:
    """Read a mesh with its colors and textures from a file.

    All parts of a scene become one mesh, in the positions that the scene gives
    them. Vertices at the same position are merged, so that no seam opens when a
    vertex is moved. Unused vertices are dropped.

    Edges are sharp where the normals of the file differ between both sides and, in
    a file without normals, where faces meet at more than 40° (see
    `Mesh.normal_ids`). Apart from this, the normals of the file are not used.

    The color of a surface is the product of the material color, the texture, and
    the vertex or face colors, as far as the file has them. Without any of them,
    the color is white. Alpha, other material properties and the wrap mode of
    textures are ignored. glTF stores all colors except textures as linear values.
    trimesh rounds them to 8 bits, and they are sRGB-encoded here. If a glTF file
    has a skin, the mesh gets the pose and the joints of the file.

    Args:
        path: A .glb, .gltf, .obj, .ply or .stl file, or another format of
            trimesh.
        up: Axis that points up in the file. "y" rotates the y-axis to the
            z-axis, "z" leaves the mesh as it is, and "auto" means "y" for glTF
            files and "z" for other files.
        gloss: True reads the roughness, the metallic value and the specular
            factor of glTF materials, with the metallic-roughness texture. False
            makes the mesh matte, because most files contain default values that
            nobody chose. Meshes of other formats are always matte.

    Returns:
        Mesh in the coordinates of the file, with z up.

    Raises:
        InputError: If the file does not exist, is damaged or has an unknown
            format. If a material or an image of the file is missing or
            unreadable. If the mesh has no faces, no area, coordinates that are
            not finite, or indices of missing vertices. If a skin has no weights,
            weights that do not add up to 1, or missing joints.

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
    parts = read_parts(path, is_gltf, gloss)
    if not parts:
        raise InputError(f"{path} has no faces: give a surface mesh, not points or lines")
    placed_meshes, normals = zip(*(part.placed() for part in parts), strict=True)
    mesh = _merge_vertices(concatenate(placed_meshes), np.concatenate(normals))
    # The matrices of a scene may have huge numbers or NaN. A
    # comparison with NaN is False, so `not` also finds NaN.
    if not (np.abs(mesh.vertices) <= MAX_MAGNITUDE).all():
        raise InputError(
            f"{path} has coordinates that are not finite or beyond {MAX_MAGNITUDE:g}: "
            "export the mesh again"
        )
    if not mesh.face_areas().sum() > 0:
        raise InputError(
            f"the surface of {path} has the area 0: give a mesh whose faces have an area"
        )
    is_y_up = up == "y" or (up == "auto" and is_gltf)
    return transformed(mesh, Y_UP_TO_Z_UP) if is_y_up else mesh


def _merge_vertices(mesh: Mesh, normals: np.ndarray) -> Mesh:
    """Return a copy of a mesh in which vertices at the same position are merged.

    Vertices that joints move in different ways are not merged. Vertices without
    faces are dropped. `normals` are those of the file, or zero, shape (F, 3, 3).
    They decide which edges are sharp.
    """
    # Vertices with equal keys are merged. The key is the position.
    vertex_keys = mesh.vertices
    skin = mesh.skin
    if skin is not None:
        # The key also has a number. It is the same
        # for vertices that all joints move alike.
        distinct_shares, shares_of_vertex = np.unique(skin.carried, axis=0, return_inverse=True)
        vertex_keys = np.column_stack([vertex_keys, shares_of_vertex.ravel()])
    corner_keys = vertex_keys[mesh.faces].reshape(-1, vertex_keys.shape[1])
    merged_keys, vertex_of_corner = np.unique(corner_keys, axis=0, return_inverse=True)
    if skin is not None:
        shares_of_merged = merged_keys[:, -1].astype(np.int64)
        skin = replace(skin, carried=distinct_shares[shares_of_merged])
    faces = vertex_of_corner.reshape(-1, 3)
    vertices = merged_keys[:, :3]
    normal_ids = normal_groups(vertices, faces, normals)
    return replace(mesh, vertices=vertices, faces=faces, skin=skin, normal_ids=normal_ids)


def read_parts(path: Path, linear: bool, gloss: bool = False) -> list[Part]:
    """Read the parts of a mesh file, and warn once of what is ignored or assumed.

    Args:
        path: File to read.
        linear: True if the file stores linear colors, except for textures. False
            if it stores sRGB-encoded colors.
        gloss: True reads the specular reflection of glTF materials: roughness,
            metallic and specular factor. False makes the parts matte.

    Returns:
        Parts with one or several materials. If the file has joints, all parts are
        already in scene coordinates.

    Raises:
        InputError: If the file does not exist, has an unknown format, or cannot
            be read.
    """
    require_file(path, "give the path of a mesh file")
    suffix = path.suffix.lower().lstrip(".")
    formats = (set(trimesh.available_formats()) | READERS.keys()) - ARCHIVES
    if suffix not in formats:
        known = ", ".join(sorted(formats))
        raise InputError(f"{path} has no known mesh format: use one of {known}")
    # trimesh and Pillow can raise almost any exception for a damaged file.
    try:
        file = MeshFile(path)
        if suffix in READERS:
            parts = READERS[suffix](file)
        else:
            parts = _read_parts(file, suffix, linear, gloss)
    except Exception as error:
        raise InputError(f"{path} cannot be read as a mesh: {single_line(error)}") from error
    file.warn(stacklevel=3)
    return parts


def _read_parts(file: MeshFile, suffix: str, linear: bool, gloss: bool) -> list[Part]:
    """Read the parts of a mesh file with trimesh.

    Args:
        file: File to read.
        suffix: Suffix of the file in lower case, without the period.
        linear: True if the file stores linear colors, except for textures.
        gloss: True reads the specular reflection of glTF materials.

    Raises:
        Exception: Any exception, if the file is damaged or not supported.
    """
    content = file.content
    tree = _gltf_tree(content) if suffix in ("gltf", "glb") else {}
    has_skins = any("skin" in node for node in tree.get("nodes", []))
    if has_skins:
        content = with_skins_as_attributes(content, tree)
    textured_count = _count_textured_parts(tree, gloss)
    specular_factors = _specular_factors(tree) if gloss else {}
    scene = _load(content, suffix, _Files(file))
    meshes = {}
    normals = {}
    for name, geometry in scene.geometry.items():
        # The geometry may also be points or lines, which are skipped.
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        mesh = _as_mesh(geometry, linear)
        meshes[name] = _with_gloss(mesh, geometry.visual, specular_factors) if gloss else mesh
        # trimesh computes `vertex_normals` if the file has none, but not before they are used.
        given = geometry._cache.cache.get("vertex_normals")
        normals[name] = None if given is None else given[mesh.faces]
    # trimesh skips a glTF image that it cannot read, and
    # reports no error. Such a file then has too few textures.
    if sum(len(mesh.textures) for mesh in meshes.values()) < textured_count:
        raise ValueError("the image of a texture is missing, or cannot be decoded")
    parts = []
    # Several nodes of the scene may show the same part at different places.
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        if name not in meshes:
            continue
        if has_skins:
            # The normals are those before the joints moved. Their values are only compared.
            parts.append(Part(skinned(meshes[name], node, scene, tree), normals[name]))
        else:
            parts.append(Part(meshes[name], normals[name], matrix))
    return parts


class _Files(FilePathResolver):  # type: ignore[misc]  # trimesh counts as untyped, see pyproject.toml
    """Reader through which trimesh reads the files that a mesh file refers to."""

    def __init__(self, file: MeshFile) -> None:
        super().__init__(str(file.path))
        self.file = file

    def get(self, name: str) -> bytes:
        """Read a file below the folder of the mesh file."""
        return self.file.read(name)


def _load(content: bytes, suffix: str, files: _Files) -> trimesh.Scene:
    """Read a scene with trimesh, and raise `ValueError` if trimesh left something out."""
    with _recorded_omissions() as omissions:
        scene = trimesh.load(
            io.BytesIO(content), file_type=suffix, resolver=files, force="scene", process=False
        )
    if omissions:
        raise ValueError(omissions[0])
    return scene


@contextmanager
def _recorded_omissions() -> Iterator[list[str]]:
    """Record trimesh's log messages about what it could not read, during a `with` block.

    During the block, trimesh's log shows no messages.

    Yields:
        List of the recorded messages, which grows during the block.
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
    """Log filter that records messages that say that something could not be read from a file.

    Attributes:
        omissions: Recorded messages.
    """

    def __init__(self) -> None:
        super().__init__()
        self.omissions: list[str] = []

    def filter(self, record: logging.LogRecord) -> bool:
        """Record a log message if it says that something could not be read from a file.

        The pattern `OMISSION` recognizes such messages. If an exception was logged
        with the message, its text is recorded, too.

        Args:
            record: Message of the log.

        Returns:
            False, so that the log does not show the message.
        """
        message = record.getMessage()
        if OMISSION.search(message):
            error = record.exc_info[1] if record.exc_info else ""
            self.omissions.append(f"{message} {error}")
        return False


def _gltf_tree(content: bytes) -> dict[str, Any]:
    """Parse the JSON of a .gltf or .glb file.

    Args:
        content: Content of the file.

    Returns:
        Parsed JSON object.

    Raises:
        ValueError: If the JSON is damaged.
        struct.error: If a .glb file is too short.
    """
    if content.startswith(b"glTF"):
        # A .glb file begins with a header of 12 bytes. Then come the length of
        # the JSON text (4 bytes), its type (4 bytes), and the JSON text itself.
        (json_length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + json_length]
    # Python's parser accepts NaN and Infinity, which glTF forbids. It passes
    # these names to `parse_constant`, and `int("NaN")` raises ValueError.
    tree: dict[str, Any] = json.loads(content, parse_constant=int)
    return tree


def _specular_factors(tree: dict[str, Any]) -> dict[str | None, float]:
    """Read the specular factor of each material of a glTF file.

    The factor is in the extension KHR_materials_specular, which trimesh ignores.

    Args:
        tree: JSON object of the file.

    Returns:
        Specular factor of each material by the name of the material. It is 1 for a
        material without the extension.

    Raises:
        ValueError: If two materials with the same name have different specular
            factors, or if a material has a texture of specular factors.
    """
    factor_by_name: dict[str | None, float] = {}
    for material in tree.get("materials", []):
        name = material.get("name")
        specular = material.get("extensions", {}).get("KHR_materials_specular", {})
        if "specularTexture" in specular:
            raise ValueError(f"the material {name} has a specularTexture, which is not supported")
        factor = specular.get("specularFactor", 1.0)
        if factor_by_name.setdefault(name, factor) != factor:
            raise ValueError(f"several materials with the name {name} differ in specularFactor")
    return factor_by_name


def _count_textured_parts(tree: dict[str, Any], gloss: bool) -> int:
    """Count the triangle primitives of a glTF file that have a color texture.

    A primitive is a mesh with one material. Features of the file that trimesh
    does not support raise an error.

    Args:
        tree: JSON object of the file. It is empty for a file of another format,
            which gives 0.
        gloss: True if the textures of roughness and metallic are read, too.

    Returns:
        Number of primitives with a color texture.

    Raises:
        ValueError: If trimesh would read the shape or the texture coordinates
            wrongly, because of a feature that it does not support.
        Exception: Any other exception, if the file is damaged.
    """
    for name in tree.get("extensionsRequired", []):
        if not name.startswith(HARMLESS_EXTENSIONS):
            raise ValueError(f"the file needs the extension {name}, which is not supported")
    textured_count = 0
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            if primitive.get("mode", TRIANGLES) in (TRIANGLES, STRIP, FAN):
                _require_supported_accessors(tree, primitive)
                textured_count += _is_textured(tree, primitive, gloss)
    return textured_count


def _require_supported_accessors(tree: dict[str, Any], primitive: dict[str, Any]) -> None:
    """Raise `ValueError` if trimesh cannot read the arrays of a glTF primitive.

    A primitive is a mesh with one material. An accessor describes how the file
    stores an array, such as the positions.

    Args:
        tree: JSON object of the file.
        primitive: Entry of the primitive in the JSON object.

    Raises:
        ValueError: If the primitive is a triangle fan, has a sparse accessor, or
            has texture coordinates that are not floating-point numbers.
    """
    attributes = primitive["attributes"]
    indices = (*attributes.values(), primitive.get("indices", 0))
    accessors = [tree["accessors"][index] for index in indices]
    if primitive.get("mode") == FAN or any("sparse" in accessor for accessor in accessors):
        raise ValueError("triangle fans and sparse accessors are not supported")
    if "TEXCOORD_0" in attributes:
        texture_coordinates = tree["accessors"][attributes["TEXCOORD_0"]]
        if texture_coordinates["componentType"] != FLOAT:
            raise ValueError(
                "texture coordinates that are not floating-point numbers are not supported"
            )


def _is_textured(tree: dict[str, Any], primitive: dict[str, Any], gloss: bool) -> bool:
    """Tell whether a glTF primitive (a mesh with one material) has a color texture.

    Args:
        tree: JSON object of the file.
        primitive: Entry of the primitive in the JSON object.
        gloss: True if the texture of roughness and metallic is read, too. Its
            texture coordinates are then also checked.

    Returns:
        True if the material of the primitive has a color texture.

    Raises:
        ValueError: If a texture is transformed, or uses a second set of
            texture coordinates.
    """
    material = tree["materials"][primitive["material"]] if "material" in primitive else {}
    extensions = material.get("extensions", {})
    specular_glossiness = extensions.get("KHR_materials_pbrSpecularGlossiness", {})
    metallic_roughness = material.get("pbrMetallicRoughness", {})
    # The two material models of glTF have
    # different names for the color texture.
    candidates = [
        metallic_roughness.get("baseColorTexture"),
        specular_glossiness.get("diffuseTexture"),
    ]
    color_textures = [texture for texture in candidates if texture is not None]
    used_textures = list(color_textures)
    if gloss:
        used_textures.append(metallic_roughness.get("metallicRoughnessTexture") or {})
    for texture in used_textures:
        # "texCoord" is the number of the set of
        # texture coordinates, and 0 by default.
        if texture.get("texCoord") or TRANSFORM in texture.get("extensions", {}):
            raise ValueError(
                "a texture is transformed or uses a second set of texture coordinates, "
                "which is not supported"
            )
    return bool(color_textures)


def _as_mesh(geometry: trimesh.Trimesh, linear: bool) -> Mesh:
    """Convert a mesh of trimesh to a `Mesh` without specular reflection.

    Args:
        geometry: Mesh of trimesh.
        linear: True if its colors are linear, except for textures. False if they
            are sRGB-encoded.

    Returns:
        Matte mesh in the same coordinates.

    Raises:
        ValueError: If coordinates or colors are not finite.
        Exception: Any other exception, if the file is damaged.
    """
    vertices = geometry.vertices
    faces = np.asarray(geometry.faces)
    uvs = getattr(geometry.visual, "uv", None)
    mesh = Mesh.plain(vertices, faces)
    colors, image = _corner_colors(geometry.visual, faces)
    values_by_name = {"coordinates": vertices, "texture coordinates": uvs, "colors": colors}
    for name, values in values_by_name.items():
        # A comparison with NaN is False, so `not` also finds NaN.
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
    """Return a copy of a mesh in which all faces have the same texture.

    Args:
        mesh: Mesh with V vertices and without textures.
        uvs: Texture coordinates of the vertices, shape (V, 2). None if the file
            has none.
        texture: sRGB-encoded texture, uint8, shape (H, W, 3).

    Returns:
        Mesh with the texture.

    Raises:
        ValueError: If there are no texture coordinates.
    """
    if uvs is None:
        raise ValueError("the mesh has a texture, but no texture coordinates")
    return replace(
        mesh,
        corner_uvs=uvs[:, :2].astype(np.float32)[mesh.faces],
        texture_ids=np.zeros(len(mesh.faces), dtype=np.int32),
        textures=(texture,),
    )


def _with_gloss(mesh: Mesh, visual: Visuals, specular_factors: dict[str | None, float]) -> Mesh:
    """Return a copy of a mesh with the specular reflection of its glTF material.

    If the material does not specify roughness, metallic or specular factor, the
    value is 1, as the glTF standard says. A material without any of them is
    therefore a rough metal.

    Args:
        mesh: Mesh without specular reflection.
        visual: Appearance of the mesh, as trimesh read it.
        specular_factors: Specular factor of each material by the name of the
            material.

    Returns:
        Mesh with gloss. The given mesh itself if it has no glTF material.

    Raises:
        ValueError: If there is a texture, but there are no texture coordinates.
    """
    material = getattr(visual, "material", None)
    if not isinstance(material, PBRMaterial):
        return mesh
    given_factors = (
        material.roughnessFactor,
        material.metallicFactor,
        specular_factors.get(material.name),
    )
    factors = [1.0 if factor is None else factor for factor in given_factors]
    gloss_of_face = np.clip(factors, 0, 1).astype(np.float32)
    mesh = replace(mesh, gloss=gloss_of_face[None].repeat(len(mesh.faces), axis=0))
    if material.metallicRoughnessTexture is None:
        return mesh
    if visual.uv is None:
        raise ValueError("the mesh has a texture, but no texture coordinates")
    if not mesh.textures:
        # A gloss texture needs a color texture, so a white texture is added.
        white = np.full((1, 1, 3), 255, dtype=np.uint8)
        mesh = _with_texture(mesh, visual.uv, white)
    texels = np.array(eight_bits(material.metallicRoughnessTexture).convert("RGB"))
    # glTF stores roughness in green and metallic in blue.
    return replace(mesh, gloss_textures=(texels[..., 1:],))


def _corner_colors(visual: Visuals, faces: np.ndarray) -> tuple[np.ndarray, Image.Image | None]:
    """Compute the color at each corner of each face, and find the texture of a mesh.

    The color is the product of the material color and the vertex or face colors,
    as far as the file has them. It is linear or sRGB-encoded, as in the file.

    Args:
        visual: Appearance of the mesh, as trimesh read it.
        faces: Vertex indices of the faces, shape (F, 3).

    Returns:
        A tuple of
        - the colors in [0, 1], shape (F, 3, 3);
        - the image of the texture, or None.
    """
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
    """Read the color and the texture of a material of trimesh.

    Args:
        material: Material of trimesh.

    Returns:
        A tuple of
        - red, green and blue in [0, 1], which are 1 if the file has no color,
          shape (3,);
        - the image of the texture, or None.
    """
    if isinstance(material, PBRMaterial):
        factor = material.baseColorFactor
        color = np.ones(3) if factor is None else _unit_rgb(factor)
        return color, material.baseColorTexture
    # If a material of an .obj file has no image, trimesh inserts a gray image.
    is_placeholder = material.image == empty_material().image
    image = None if is_placeholder else material.image
    # "kd" is the color in the .obj file. trimesh's own
    # attribute would be gray if the file has no color.
    color = material.kwargs.get("kd", np.ones(3))
    return np.clip(color, 0, 1), image


def _unit_rgb(colors: np.ndarray) -> np.ndarray:
    """Convert RGB or RGBA colors to red, green and blue in [0, 1].

    Args:
        colors: Colors as unsigned integers, or as floating-point numbers in
            [0, 1], shape (..., 3) or (..., 4).

    Returns:
        Colors without alpha, shape (..., 3).
    """
    rgb = np.asarray(colors)[..., :3]
    is_integer = rgb.dtype.kind in "ui"
    return rgb / np.iinfo(rgb.dtype).max if is_integer else rgb
