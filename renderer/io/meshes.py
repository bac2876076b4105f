"""Meshes from files, as trimesh reads them, with their colors and textures.

trimesh leaves out an image or material that it cannot read, with no more than a line in its log, and ignores parts of
glTF 2.0. Where that would show a wrong surface, the file is refused.
"""

import io
import json
import logging
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

from renderer.errors import LARGEST, InputError, in_one_line, require_choice, require_file
from renderer.geometry.mesh import Y_UP_TO_Z_UP, Mesh, concatenate, transformed
from renderer.image import encode
from renderer.io.images import eight_bits
from renderer.io.skins import skinned, with_skins_as_attributes
from renderer.validation import as_path, require_flag

ARCHIVES = {"zip", "tar.gz", "tar.bz2", "bz2"}  # not read: the names in them cannot be checked first
DEFINED, USED = (re.compile(rb"^[ \t]*%b[ \t]+(.*?)[ \t\r]*$" % key, re.MULTILINE) for key in (b"newmtl", b"usemtl"))
OMISSION = re.compile(r"(unable|failed) to (load|store|convert)|unsupported|index failed")  # in trimesh's log
FLOAT = 5126  # a component type of glTF 2.0 (section 3.6.2.2)
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes of a primitive (section 5.24.4); trimesh skips fans
TRANSFORM = "KHR_texture_transform"
HARMLESS = ("KHR_materials_", "KHR_lights_", "EXT_texture_webp")  # extensions that move no vertex, as they begin


def load_mesh(path: str | Path, up: str = "auto", gloss: bool = False) -> Mesh:
    """Read a mesh with its colors and textures from .glb, .gltf, .obj, .ply, .stl or another format of trimesh.

    All parts of a scene, placed by their nodes, become one mesh; vertices at one position become one vertex, so
    that moving it opens no seam, and unused vertices are dropped. A color is the product of the material's
    color, the texture and the vertex or face colors that the file has, white where it has none; alpha, other
    material properties and the texture's wrap mode are left out. glTF's colors other than textures are linear
    by its standard and are encoded here. Of a glTF with a skin, the mesh has the pose of its nodes, and their joints.

    gloss: read glTF's roughness, metallic (factors and texture) and specularFactor; surfaces are matte otherwise, since
    most files have values that nobody chose. Formats other than glTF are matte.
    up: "y" turns the y axis up to z, "z" leaves the mesh as it is, and "auto" takes y for glTF, z otherwise.
    InputError: missing, unreadable or corrupt file, unknown format or `up`; materials or images that it names and that
    are missing or unreadable; no faces, faces that name missing vertices, coordinates that are not finite, zero area;
    skins without weights, whose weights do not sum to one or that name missing joints.

    >>> renderer.export_mesh(renderer.solid("cup"), "cup.glb")
    >>> load_mesh("cup.glb").faces.shape == renderer.solid("cup").faces.shape
    True
    """
    path = as_path("path", path)
    require_choice(f"{path}: up", up, ("auto", "y", "z"))
    require_flag("gloss", gloss)
    is_gltf = path.suffix.lower() in (".glb", ".gltf")
    placed = [transformed(*part) for part in read_parts(path, is_gltf, gloss)]
    if not placed:
        raise InputError(f"{path} has no faces: give a surface mesh, not points or lines")
    mesh = concatenate(placed)
    points, skin = mesh.vertices, mesh.skin
    if skin is not None:  # vertices that joints carry otherwise come apart
        carried, rows = np.unique(skin.carried, axis=0, return_inverse=True)
        points = np.column_stack([points, rows.ravel()])
    vertices, corners = np.unique(points[mesh.faces].reshape(-1, points.shape[1]), axis=0, return_inverse=True)
    skin = skin and replace(skin, carried=carried[vertices[:, -1].astype(np.int64)])
    mesh = replace(mesh, vertices=vertices[:, :3], faces=corners.reshape(-1, 3), skin=skin)
    if not (np.abs(mesh.vertices) <= LARGEST).all():  # where its nodes put it; NaN is not
        raise InputError(f"{path} has coordinates that are not finite or beyond {LARGEST:g}: export it again")
    if not mesh.face_areas().sum() > 0:
        raise InputError(f"{path} has a surface of zero area: give a mesh with faces of some extent")
    return transformed(mesh, Y_UP_TO_Z_UP) if up == "y" or (up == "auto" and is_gltf) else mesh


def read_parts(path: Path, linear: bool, gloss: bool = False) -> list[tuple[Mesh, np.ndarray]]:
    """Every part of a file in its own coordinates, with the affine matrix (4, 4) that its node places it by;
    where a skin does, it is placed.
    linear: the file's colors, textures aside, are linear. gloss: read that of glTF, too. InputError: as
    `load_mesh`."""
    require_file(path, "give the path of a mesh file")
    suffix = path.suffix.lower().lstrip(".")
    formats = set(trimesh.available_formats()) - ARCHIVES
    if suffix not in formats:
        raise InputError(f"{path} has no known mesh format: use one of {', '.join(sorted(formats))}")
    try:
        content, files = path.read_bytes(), _Files(path)
        tree = _gltf_tree(content) if suffix in ("gltf", "glb") else {}
        rigged = any("skin" in node for node in tree.get("nodes", []))
        if rigged:
            content = with_skins_as_attributes(content, tree)
        textured_parts, strengths = _textured_parts(tree, gloss), _strengths(tree) if gloss else {}
        scene = _load(_utf8(content) if suffix == "obj" else content, suffix, files)
        named = [(name, part) for name, part in scene.geometry.items() if isinstance(part, trimesh.Trimesh)]
        parts = {name: _part(part, linear) for name, part in named if len(part.faces)}
        if gloss:
            parts = {name: _with_gloss(part, scene.geometry[name].visual, strengths) for name, part in parts.items()}
        if sum(len(part.textures) for part in parts.values()) < textured_parts:
            raise ValueError("the image of a texture is missing, or cannot be decoded")
        nodes = [(node, *scene.graph[node]) for node in scene.graph.nodes_geometry]
        if rigged:
            return [(skinned(parts[name], node, scene, tree), np.eye(4)) for node, _, name in nodes if name in parts]
    except Exception as error:  # readers of meshes and images raise almost anything at a damaged file
        raise InputError(f"{path} cannot be read as a mesh: {in_one_line(error)}") from error
    return [(parts[name], matrix) for _, matrix, name in nodes if name in parts]


class _Files(FilePathResolver):  # type: ignore[misc]  # trimesh counts as untyped, see pyproject.toml
    materials = b""  # the content of the .mtl file

    def get(self, name: str) -> bytes:
        """A file by its name from the mesh's folder, with \\ for / and %20 for a blank, or else of its last part.
        FileNotFoundError: there is none. Regular files alone: a pipe would never end."""
        plain = unquote(name.strip('" \t')).replace("\\", "/")
        for file in (Path(self.parent, plain), Path(self.parent, Path(plain).name)):
            if file.is_file() and file.suffix.lower() == ".mtl":
                self.materials = _utf8(file.read_bytes())
                return self.materials
            if file.is_file():
                return file.read_bytes()
        raise FileNotFoundError(f"it names {name}, which is not there")


def _load(content: bytes, suffix: str, files: _Files) -> trimesh.Scene:
    """ValueError where trimesh leaves out a part of the surface, which it writes to its log alone, or less."""
    log, level, omissions = trimesh.util.log, trimesh.util.log.level, []

    def note(record: logging.LogRecord) -> bool:
        if OMISSION.search(record.getMessage()):
            omissions.append(f"{record.getMessage()} {record.exc_info[1] if record.exc_info else ''}")
        return False

    log.addFilter(note)
    log.setLevel(logging.DEBUG)
    try:
        scene = trimesh.load(io.BytesIO(content), file_type=suffix, resolver=files, force="scene", process=False)
    finally:
        log.removeFilter(note)
        log.setLevel(level)
    if suffix == "obj" and b"mtllib" in content:
        unknown = set(USED.findall(content)) - set(DEFINED.findall(files.materials))
        omissions += [f"its first .mtl file does not have the material {name.decode()}" for name in unknown]
    if omissions:
        raise ValueError(omissions[0])
    return scene


def _utf8(text: bytes) -> bytes:
    """Text in UTF-8; other bytes are taken for Latin-1."""
    try:
        text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1").encode()
    return text


def _gltf_tree(content: bytes) -> dict[str, Any]:
    """The JSON of a .gltf or .glb file; ValueError and the like where it is damaged."""
    if content.startswith(b"glTF"):
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    tree: dict[str, Any] = json.loads(content, parse_constant=int)  # ValueError for NaN, which JSON has not
    return tree


def _strengths(tree: dict[str, Any]) -> dict[str | None, float]:
    """The specularFactor of a glTF file's materials, by name; ValueError where a name has two, or a texture."""
    strengths: dict[str | None, float] = {}
    for material in tree.get("materials", []):
        specular = material.get("extensions", {}).get("KHR_materials_specular", {})
        if "specularTexture" in specular:
            raise ValueError(f"its material {material.get('name')} has a specularTexture, which is not supported")
        factor = specular.get("specularFactor", 1.0)
        if strengths.setdefault(material.get("name"), factor) != factor:
            raise ValueError(f"materials of the name {material.get('name')} differ in specularFactor")
    return strengths


def _textured_parts(tree: dict[str, Any], gloss: bool) -> int:
    """How many parts of a glTF file have an image as their color.
    ValueError, KeyError and the like where trimesh would read shape or texture coordinates otherwise than meant."""
    for name in tree.get("extensionsRequired", []):
        if not name.startswith(HARMLESS):
            raise ValueError(f"it needs the extension {name}, which is not supported")
    textured, parts = 0, [part for mesh in tree.get("meshes", []) for part in mesh["primitives"]]
    for part in parts:
        if part.get("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
            continue
        accessors = [tree["accessors"][index] for index in (*part["attributes"].values(), part.get("indices", 0))]
        uvs = tree["accessors"][part["attributes"].get("TEXCOORD_0", part["attributes"]["POSITION"])]
        if part.get("mode") == FAN or any("sparse" in accessor for accessor in accessors):
            raise ValueError("triangle fans and sparse accessors are not supported")
        if uvs["componentType"] != FLOAT:
            raise ValueError("texture coordinates that are not floating-point numbers are not supported")
        material = tree["materials"][part["material"]] if "material" in part else {}
        glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
        roughness = material.get("pbrMetallicRoughness", {})
        colors = roughness.get("baseColorTexture"), glossy.get("diffuseTexture")
        textures = [texture for texture in colors if texture is not None]
        used = [*textures, roughness.get("metallicRoughnessTexture") or {}] if gloss else textures
        if any(texture.get("texCoord") or TRANSFORM in texture.get("extensions", {}) for texture in used):
            raise ValueError("a texture has a second set of coordinates or is transformed, which is not supported")
        textured += bool(textures)
    return textured


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


def _with_gloss(mesh: Mesh, visual: Visuals, strengths: dict[str | None, float]) -> Mesh:
    """A part with the gloss of its glTF material; matte without one. glTF's defaults are a rough metal."""
    material = getattr(visual, "material", None)
    if not isinstance(material, PBRMaterial):
        return mesh
    factors = material.roughnessFactor, material.metallicFactor, strengths.get(material.name)
    row = np.clip([1.0 if factor is None else factor for factor in factors], 0, 1).astype(np.float32)
    mesh = replace(mesh, gloss=row[None].repeat(len(mesh.faces), axis=0))
    if material.metallicRoughnessTexture is None:
        return mesh
    if visual.uv is None:
        raise ValueError("an image has no texture coordinates")
    if not mesh.textures:
        white = np.full((1, 1, 3), 255, dtype=np.uint8)
        uvs, ids = visual.uv[:, :2].astype(np.float32)[mesh.faces], np.zeros(len(mesh.faces), dtype=np.int32)
        mesh = replace(mesh, corner_uvs=uvs, texture_ids=ids, textures=(white,))
    texels = np.array(eight_bits(material.metallicRoughnessTexture).convert("RGB"))
    return replace(mesh, gloss_textures=(texels[..., 1:],))


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
