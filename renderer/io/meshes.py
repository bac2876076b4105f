"""Read meshes with their colors and textures from files.

The library trimesh reads the formats for which there is no reader of our own. If
it cannot read an image or a material, it leaves the image or material out and
only writes a line to its log. This module then raises an error.

A part is a mesh with one material, of which a file may hold several.
"""

import io
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.visual.base import Visuals
from trimesh.visual.material import Material, empty_material

from renderer.errors import MAX_MAGNITUDE, InputError, require_choice, require_file, single_line
from renderer.geometry.creases import normal_groups
from renderer.geometry.mesh import NO_TEXTURE, Y_UP_TO_Z_UP, Mesh, concatenate, transformed
from renderer.io.gltf import read_gltf
from renderer.io.images import eight_bits
from renderer.io.mesh_file import MeshFile, Part
from renderer.io.obj import read_obj
from renderer.io.off import read_off
from renderer.io.ply import read_ply
from renderer.io.stl import read_stl
from renderer.validation import as_path, require_flag

# Suffixes of archive files, which are not read. trimesh could read them,
# but the names of the files inside an archive cannot be checked first.
ARCHIVES = {"zip", "tar.gz", "tar.bz2", "bz2"}
# Pattern for the messages in trimesh's log that say that
# trimesh left out an image, a material or something else of
# a file. For .obj, .ply and .dae files, only the log tells.
OMISSION = re.compile(r"(unable|failed) to (load|store|convert)|unsupported|index failed")
# Suffixes of glTF files.
GLTF = ("glb", "gltf")
# Readers of our own. trimesh reads the other formats.
READERS = {"obj": read_obj, "off": read_off, "ply": read_ply, "stl": read_stl}


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
    the color is white. A glTF file with transparent parts is cut out where its
    material says so (alphaMode MASK), or refused (BLEND). It has the shape of its
    default morph weights, and the pose and the joints of its skins. What changes
    neither the shape nor the base color, such as a normal texture, is ignored,
    and a warning names it. Files beside the mesh are read only below its folder.

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
    parts = read_parts(path, gloss)
    if not parts:
        raise InputError(f"{path} has no faces: give a surface mesh, not points or lines")
    placed_meshes, normals = zip(*(part.placed() for part in parts), strict=True)
    mesh = _share_textures(concatenate(placed_meshes))
    mesh = _merge_vertices(mesh, np.concatenate(normals))
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
    is_gltf = path.suffix.lower().lstrip(".") in GLTF
    is_y_up = up == "y" or (up == "auto" and is_gltf)
    return transformed(mesh, Y_UP_TO_Z_UP) if is_y_up else mesh


def _share_textures(mesh: Mesh) -> Mesh:
    """Return a copy of a mesh in which the copies of a part have one texture."""
    pairs = list(zip(mesh.textures, mesh.gloss_textures or mesh.textures, strict=True))
    keys = [(id(texture), id(gloss_texture)) for texture, gloss_texture in pairs]
    pair_of_key = dict(zip(keys, pairs, strict=True))
    index_of_key = {key: index for index, key in enumerate(pair_of_key)}
    # The last entry belongs to the index -1, which is NO_TEXTURE.
    new_ids = np.array([*(index_of_key[key] for key in keys), NO_TEXTURE], dtype=np.int32)
    gloss_textures = tuple(pair[1] for pair in pair_of_key.values())
    return replace(
        mesh,
        texture_ids=new_ids[mesh.texture_ids],
        textures=tuple(pair[0] for pair in pair_of_key.values()),
        gloss_textures=gloss_textures if mesh.gloss_textures else (),
    )


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


def read_parts(path: Path, gloss: bool = False) -> list[Part]:
    """Read the parts of a mesh file, and warn once of what is ignored or assumed.

    Args:
        path: File to read.
        gloss: True reads the specular reflection of glTF materials: roughness,
            metallic and specular factor. False makes the parts matte.

    Returns:
        Parts with one or several materials.

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
        if suffix in GLTF:
            parts = read_gltf(file, gloss)
        elif suffix in READERS:
            parts = READERS[suffix](file)
        else:
            parts = _read_parts(file, suffix)
    except Exception as error:
        raise InputError(f"{path} cannot be read as a mesh: {single_line(error)}") from error
    file.warn(stacklevel=3)
    return parts


def _read_parts(file: MeshFile, suffix: str) -> list[Part]:
    """Read the parts of a mesh file with trimesh."""
    scene = _load(file.content, suffix, _Files(file))
    parts = {}
    for name, geometry in scene.geometry.items():
        # The geometry may also be points or lines, which are skipped.
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            # trimesh computes `vertex_normals` if the file has none, but not before they are used.
            normals = geometry._cache.cache.get("vertex_normals")
            mesh = _as_mesh(geometry)
            parts[name] = Part(mesh, None if normals is None else normals[mesh.faces])
    # Several nodes of the scene may show the same part at different places.
    placements = [scene.graph[node] for node in scene.graph.nodes_geometry]
    return [parts[name]._replace(matrix=matrix) for matrix, name in placements if name in parts]


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


def _as_mesh(geometry: trimesh.Trimesh) -> Mesh:
    """Convert a mesh of trimesh to a `Mesh` without specular reflection.

    Args:
        geometry: Mesh of trimesh.

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
