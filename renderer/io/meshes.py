"""Read meshes with their colors and textures from files, and write them to .glb files."""

import json
import math
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from renderer import errors
from renderer.camera import Camera, PerspectiveCamera, showing
from renderer.errors import InputError
from renderer.image import decode
from renderer.io.files import atomic_write
from renderer.io.gltf import read_gltf
from renderer.io.gltf_file import SPECULAR
from renderer.io.images import encode_image
from renderer.io.mesh_file import MeshFile, Part
from renderer.io.obj import read_obj
from renderer.io.ply_off_stl import read_off, read_ply, read_stl
from renderer.mesh import Y_UP_TO_Z_UP, Mesh, by_material, concatenate, require_mesh, transformed
from renderer.normals import normal_groups

# Readers of mesh files by their suffixes.
READERS = {".glb": read_gltf, ".gltf": read_gltf}
READERS |= {".obj": read_obj, ".off": read_off, ".ply": read_ply, ".stl": read_stl}


def load_mesh(path: str | Path, up: str = "auto", gloss: bool = False) -> Mesh:
    """Read a mesh with its colors and textures from a file.

    All parts of a scene become one mesh, in the positions that the scene gives
    them. Vertices at the same position are merged, so that no seam opens when a
    vertex is moved. Unused vertices are dropped.

    Edges are sharp where the normals of the file differ between both sides and, in
    a file without normals, where faces meet at more than 40° (see
    `Mesh.normal_ids`). Apart from this, the normals of the file are not used.

    The color of a surface is the product of the material color, the texture, and
    the vertex colors, as far as the file has them, as linear values. In .obj and .ply
    files, a texture alone is the color, unless `Kd` is no gray, and face colors are preferred to
    vertex colors. `Kd` is sRGB-encoded, and linear in files of Blender.
    Without any color, the surface is white. A glTF file with transparent parts is cut out where its
    material says so (alphaMode MASK), or refused (BLEND). It has the shape of its
    default morph weights, and is refused if it has joints. What changes neither
    the shape nor the base color, such as a normal texture, is ignored,
    and a warning names it. Files beside the mesh are read only below its folder.

    Args:
        path: A .glb, .gltf, .obj, .ply, .off or .stl file.
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
            not finite, or indices of missing vertices.

    Example:
        >>> import norm_balls as nb
        >>> cup = nb.solid("cup")
        >>> nb.export_mesh(cup, "cup.glb")
        >>> nb.load_mesh("cup.glb").faces.shape == cup.faces.shape
        True
    """
    path = errors.as_path("path", path)
    errors.require_choice(f"{path}: up", up, ("auto", "y", "z"))
    errors.require_flag("gloss", gloss)
    parts = read_parts(path, gloss)
    if not parts:
        raise InputError(f"{path} has no faces: give a surface mesh, not points or lines")
    # Meshes in the axes of the scene, and the normals of their corners.
    placed_meshes, normals = zip(*(part.placed() for part in parts), strict=True)
    mesh = concatenate(placed_meshes)
    # Vertices at the same position are merged, and vertices without faces are dropped.
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    vertices, vertex_of_corner = np.unique(corners, axis=0, return_inverse=True)
    faces = vertex_of_corner.reshape(-1, 3)
    # The normals of the file decide which edges are sharp.
    normal_ids = normal_groups(vertices, faces, np.concatenate(normals))
    mesh = replace(mesh, vertices=vertices, faces=faces, normal_ids=normal_ids)
    # The matrices of a scene may have huge numbers or NaN. A
    # comparison with NaN is False, so `not` also finds NaN.
    if not (np.abs(mesh.vertices) <= errors.MAX_MAGNITUDE).all():
        fault = f"{path} has coordinates that are not finite or beyond {errors.MAX_MAGNITUDE:g}"
        raise InputError(f"{fault}: export the mesh again")
    if not mesh.face_areas().sum() > 0:
        raise InputError(f"the surface of {path} has the area 0: give faces with an area")
    is_y_up = up == "y" or (up == "auto" and READERS[path.suffix.lower()] is read_gltf)
    return transformed(mesh, Y_UP_TO_Z_UP) if is_y_up else mesh


def read_parts(path: Path, gloss: bool = False) -> list[Part]:
    """Read the parts of a mesh file, and warn once of what is ignored or assumed."""
    errors.require_file(path, "give the path of a mesh file")
    read = READERS.get(path.suffix.lower())
    if read is None:
        known = ", ".join(sorted(READERS))
        raise InputError(f"{path} is not of a mesh format that is read: convert it to {known}")
    with errors.reading(path, "cannot be read as a mesh"):
        file = MeshFile(path, gloss)
        parts = read(file)
    file.warn(stacklevel=3)
    return parts


def files_beside(path: Path) -> list[Path]:
    """List the materials, textures and buffers that a mesh file names, and that exist."""
    read = READERS.get(path.suffix.lower())
    if read is None:
        return []
    # A reader notes each file that it opens in `beside`. `load_mesh` raises the error of a mesh
    # that cannot be read. Some materials can only be read without gloss.
    for gloss in (True, False):
        file = MeshFile(path, gloss)
        with suppress(Exception):
            read(file)
            break
    return sorted(file.beside)


# Types of the numbers and kinds of the rows of arrays in glTF (3.6.2.2).
_TYPES = {"float32": 5126, "uint32": 5125}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}


def export_mesh(
    mesh: Mesh,
    path: str | Path,
    normals: str = "smooth",
    cameras: Sequence[Camera] = (),
    first: int | np.ndarray | None = None,
    aspect: float = 1.0,
) -> None:
    """Write a mesh to a .glb file.

    `load_mesh` reads the same surface from the file, with float32 precision. In
    the file, y points up and colors are linear. Faces with the same texture and
    gloss are written together, so the order of the faces can change. Materials
    are visible from both sides. A vertex is repeated if the faces around it have
    different colors, texture coordinates or normals there.

    Args:
        mesh: Mesh to write.
        path: File to write, with the suffix .glb. Its folder is created.
        normals: Normals with which the renderer shades the mesh, "smooth" or
            "flat".
        cameras: Cameras to write as nodes of the file, in this order. glTF has no
            off-center cameras: such a camera shows a larger image around the given one.
        first: Number of faces at the beginning of the mesh that are written
            before all other faces, or an array with the ascending ends of several
            such parts. Faces of a part are sorted by texture and gloss. None for a
            single part.
        aspect: Width of the images of the cameras, divided by their height.

    Raises:
        InputError: If an argument is invalid.
        OSError: If the file cannot be written.

    >>> import norm_balls as nb
    >>> apple = nb.normalize(nb.solid("apple"))
    >>> cameras = nb.orbit_cameras(views=3, width=2.2)
    >>> nb.export_mesh(apple, "apple.glb", cameras=cameras)
    """
    require_mesh("mesh", mesh)
    path = errors.as_path("path", path)
    given = errors.as_list("cameras", cameras, Camera, "a list of cameras")
    cameras = showing([camera.fixed() for camera in given], mesh.vertices, mesh.faces)
    errors.require_number("aspect", aspect, 1e-3, 1e3)
    ends = [len(mesh.faces)] if first is None else np.atleast_1d(first).tolist()
    for end in ends:
        errors.require_whole("first", end, 0, len(mesh.faces))
    unit_normals = mesh.written_normals(normals)
    if path.suffix.lower() != ".glb":
        raise InputError(f"{path} cannot be written as a mesh: choose a name that ends in .glb")
    tree = _Tree()
    part_of_face = np.searchsorted(ends, np.arange(len(mesh.faces)), side="right")
    # A row vector times this matrix is rotated in the opposite direction: from z up to y up.
    rotation = Y_UP_TO_Z_UP[:3, :3]
    primitives = []
    for is_written, texture_id, gloss in by_material(mesh, part_of_face):
        # Corners with the same values become one vertex: the index of the vertex (1), color (3),
        # texture coordinates (2) and normal (3). float64 does not round the index.
        columns = (mesh.faces[..., None], mesh.corner_colors, mesh.corner_uvs, unit_normals)
        corner_values = np.concatenate([column[is_written] for column in columns], axis=-1)
        values, corners = np.unique(corner_values.reshape(-1, 9), axis=0, return_inverse=True)
        attributes = {
            "POSITION": (mesh.vertices - mesh.origin)[values[:, 0].astype(np.int64)] @ rotation,
            # v points down in glTF.
            "TEXCOORD_0": values[:, 4:6] * [1, -1] + [0, 1],
            "COLOR_0": decode(torch.from_numpy(values[:, 1:4]), "srgb").numpy(),
            "NORMAL": values[:, 6:] @ rotation,
        }
        primitive = {
            "attributes": {n: tree.add_array(a.astype(np.float32)) for n, a in attributes.items()},
            "indices": tree.add_array(corners.astype(np.uint32).ravel()),
            "material": _add_material(tree, mesh, texture_id, gloss),
        }
        primitives.append(primitive)
    node: dict[str, Any] = {"mesh": tree.add("meshes", {"primitives": primitives})}
    if mesh.origin.any():
        node["translation"] = (mesh.origin @ rotation).tolist()
    tree.add("nodes", node)
    for index, camera in enumerate(cameras):
        # The axes of a camera in glTF are the same as ours: right, up and back. glTF stores
        # matrices column by column.
        matrix = (Y_UP_TO_Z_UP.T @ camera.pose()).T.ravel().tolist()
        lens = tree.add("cameras", _gltf_camera(camera, aspect))
        tree.add("nodes", {"camera": lens, "name": f"view {index}", "matrix": matrix})
    tree["scene"] = tree.add("scenes", {"nodes": list(range(len(tree["nodes"])))})
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, tree.content())


class _Tree(dict[str, Any]):
    """JSON object of a .glb file, with its buffer."""

    def __init__(self) -> None:
        super().__init__(asset={"version": "2.0"})
        self.buffer = bytearray()

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append an entry to a list of the object, such as "materials", and return its index."""
        entries = self.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def add_bytes(self, content: bytes) -> int:
        """Append bytes to the buffer, and return the index of their view."""
        view = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": len(content)}
        # glTF needs multiples of 4 bytes, so zeros are appended.
        self.buffer += content + bytes(-len(content) % 4)
        return self.add("bufferViews", view)

    def add_array(self, values: np.ndarray) -> int:
        """Append an array of float32 or uint32, and return the index of its accessor."""
        rows = values.reshape(len(values), -1)
        accessor = {
            "bufferView": self.add_bytes(values.tobytes()),
            "componentType": _TYPES[values.dtype.name],
            "count": len(rows),
            "type": _KINDS[rows.shape[1]],
            "min": rows.min(axis=0).tolist(),
            "max": rows.max(axis=0).tolist(),
        }
        return self.add("accessors", accessor)

    def add_texture(self, texels: np.ndarray) -> dict[str, int]:
        """Append an image, and return a reference to its texture."""
        # A texture of 2048 pixels is written in a fifth of the time, and gets 1.2 times as large.
        png = encode_image(texels, "PNG", compress_level=1)
        image = {"bufferView": self.add_bytes(png), "mimeType": "image/png"}
        return {"index": self.add("textures", {"source": self.add("images", image)})}

    def content(self) -> bytes:
        """Return the content of the file (4.4)."""
        self["buffers"] = [{"byteLength": len(self.buffer)}]
        text = json.dumps(self).encode()
        # Both chunks have a length of a multiple of 4 bytes. Text is filled up with blanks.
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self.buffer), b"BIN\0") + self.buffer
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _add_material(tree: _Tree, mesh: Mesh, texture_id: int, gloss: list[float]) -> int:
    """Add a material with a texture (-1: none) and gloss (empty: matte), and return its index."""
    roughness, metallic, *specular_factors = gloss or (1.0, 0.0, 0.0)
    model: dict[str, Any] = {"roughnessFactor": roughness, "metallicFactor": metallic}
    if texture_id >= 0:
        model["baseColorTexture"] = tree.add_texture(mesh.textures[texture_id])
        if mesh.gloss_textures:
            # glTF stores roughness in green and metallic in blue, so an empty red channel is
            # inserted.
            factors = np.insert(mesh.gloss_textures[texture_id], 0, 0, axis=2)
            model["metallicRoughnessTexture"] = tree.add_texture(factors)
    material = {"pbrMetallicRoughness": model, "doubleSided": True}
    for specular_factor in specular_factors:
        material["extensions"] = {SPECULAR: {"specularFactor": specular_factor}}
        tree["extensionsUsed"] = [SPECULAR]
    return tree.add("materials", material)


def _gltf_camera(camera: Camera, aspect: float) -> dict[str, Any]:
    """Describe a camera as glTF does: its image is larger if the principal point is off-center."""
    planes = {"znear": camera.near, "zfar": camera.far}
    if isinstance(camera, PerspectiveCamera):
        # Half of the width and of the height that the image shows at a depth
        # of 1. Both grow with the distance of the principal point from the center, because an
        # image of glTF is symmetric around its principal point.
        half_width = math.tan(math.radians(camera.angle) / 2)
        half_height = half_width / camera.pixel_aspect * (1 / aspect + abs(camera.principal_up))
        half_width *= 1 + abs(camera.principal_right)
        vertical_angle = 2 * math.atan(half_height)
        perspective = {"yfov": vertical_angle, "aspectRatio": half_width / half_height, **planes}
        return {"type": "perspective", "perspective": perspective}
    half_width = camera.width / 2
    orthographic = {"xmag": half_width, "ymag": half_width / aspect, **planes}
    return {"type": "orthographic", "orthographic": orthographic}
