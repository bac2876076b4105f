"""Read meshes with their colors and textures from files.

The library trimesh reads the formats for which there is no reader of our own.
"""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from renderer.errors import (
    MAX_MAGNITUDE,
    InputError,
    as_path,
    require_choice,
    require_file,
    require_flag,
    single_line,
)
from renderer.io.gltf import read_gltf
from renderer.io.images import eight_bits, identify
from renderer.io.mesh_file import OPAQUE, MeshFile, Part, colored_mesh, require_bounded, unit_colors
from renderer.io.obj import read_obj
from renderer.io.ply_off_stl import read_off, read_ply, read_stl
from renderer.mesh import NO_TEXTURE, Y_UP_TO_Z_UP, Mesh, concatenate, transformed
from renderer.normals import normal_groups

# Suffixes of archive files, which are not read. trimesh could read them,
# but the names of the files inside an archive cannot be checked first.
ARCHIVES = {"zip", "tar.gz", "tar.bz2", "bz2"}
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
    the vertex or face colors, as far as the file has them, as linear values.
    Without any of them, the color is white. A glTF file with transparent parts is cut out where its
    material says so (alphaMode MASK), or refused (BLEND). It has the shape of its
    default morph weights, and the pose of its skins. What changes neither
    the shape nor the base color, such as a normal texture, is ignored,
    and a warning names it. Files beside the mesh are read only below its folder.

    Args:
        path: A .glb, .gltf, .obj, .ply, .off or .stl file, or another format of
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

    Vertices without faces are dropped. `normals` are those of the file, or zero, shape (F, 3, 3).
    They decide which edges are sharp.
    """
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    vertices, vertex_of_corner = np.unique(corners, axis=0, return_inverse=True)
    faces = vertex_of_corner.reshape(-1, 3)
    normal_ids = normal_groups(vertices, faces, normals)
    return replace(mesh, vertices=vertices, faces=faces, normal_ids=normal_ids)


def read_parts(path: Path, gloss: bool = False) -> list[Part]:
    """Read the parts of a mesh file, and warn once of what is ignored or assumed."""
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
        message = single_line(error)
        # The message of a missing key is only this key.
        if isinstance(error, KeyError):
            message = f"the entry {message} is missing or unknown, so export the mesh again"
        raise InputError(f"{path} cannot be read as a mesh: {message}") from error
    file.warn(stacklevel=3)
    return parts


def _read_parts(file: MeshFile, suffix: str) -> list[Part]:
    """Read the parts of a mesh file with trimesh, such as a .dae file."""
    file.assume(f"trimesh reads the format {suffix}, and may leave out colors")
    files = _Images(file)
    scene = trimesh.load(
        io.BytesIO(file.content), file_type=suffix, resolver=files, force="scene", process=False
    )
    # trimesh leaves out an image that it cannot read.
    if files.errors:
        raise files.errors[0]
    parts = {
        name: _as_part(geometry, file)
        for name, geometry in scene.geometry.items()
        # The geometry may also be points or lines, which are skipped.
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)
    }
    # Several nodes of the scene may show the same part at different places.
    placements = [scene.graph[node] for node in scene.graph.nodes_geometry]
    return [parts[name]._replace(matrix=matrix) for matrix, name in placements if name in parts]


class _Images(FilePathResolver):  # type: ignore[misc]  # trimesh counts as untyped, see pyproject.toml
    """Reader through which trimesh reads the images that a mesh file refers to.

    Attributes:
        errors: Errors of images that could not be read.
    """

    def __init__(self, file: MeshFile) -> None:
        super().__init__(str(file.path))
        self.file = file
        self.errors: list[Exception] = []

    def get(self, name: str) -> bytes:
        """Read an image below the folder of the mesh file."""
        try:
            content = self.file.read(name)
            identify(io.BytesIO(content)).load()
        # Pillow can raise almost any exception for a damaged file.
        except Exception as error:
            self.errors.append(error)
            raise
        return content


def _as_part(geometry: trimesh.Trimesh, file: MeshFile) -> Part:
    """Convert a mesh of trimesh to a matte part in the same coordinates."""
    faces = np.array(geometry.faces, dtype=np.int64)
    require_bounded(coordinates=geometry.vertices)
    visual = geometry.visual
    colors = np.full((1, 4), 255, dtype=np.uint8)
    uvs = None
    textures = []
    if visual.kind == "vertex":
        colors = visual.vertex_colors[faces]
    elif visual.kind == "face":
        colors = visual.face_colors[:, None]
    elif visual.kind == "texture":
        factor = visual.material.baseColorFactor
        colors = colors if factor is None else factor[None]
        uvs = None if visual.uv is None else visual.uv[faces, :2]
        if visual.material.baseColorTexture is not None:
            textures = [np.array(eight_bits(visual.material.baseColorTexture).convert("RGB"))]
    unit = unit_colors(colors, file)
    if unit[..., 3:].min(initial=1) < OPAQUE:
        raise ValueError("the file has transparent colors, which are not supported")
    texture_ids = np.zeros(len(faces), dtype=np.int64)
    mesh = colored_mesh(geometry.vertices, faces, unit[..., :3], uvs, texture_ids, textures)
    # trimesh computes `vertex_normals` if the file has none, but not before they are used.
    normals = geometry._cache.cache.get("vertex_normals")
    return Part(mesh, None if normals is None else normals[faces])
