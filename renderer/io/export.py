"""Write meshes to .glb files with colors, textures, normals and cameras."""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import Image

from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError, as_list, as_path, require_whole
from renderer.image import decode
from renderer.io.files import atomic_write
from renderer.mesh import Y_UP_TO_Z_UP, Mesh, require_mesh

if TYPE_CHECKING:
    # Importing trimesh takes half a second,
    # so the functions that need it import it.
    import trimesh
    from trimesh.visual.material import PBRMaterial

# Temporary names of the vertex attributes for colors and normals.
# trimesh writes attributes whose names begin with an underscore
# without changing their values. Before the file is written,
# `_as_one_mesh` renames the attributes to COLOR_0 and NORMAL.
_COLOR = "_COLOR_0"
_NORMAL = "_NORMAL"
# Name of the specular factor of a material in glTF. trimesh
# cannot write this factor. It is first appended to the name
# of the material, and `_as_one_mesh` moves it to its place.
SPECULAR = "specularFactor"
# Roughness and metallic of a material without specular reflection.
MATTE = (1.0, 0.0)


def export_mesh(
    mesh: Mesh,
    path: str | Path,
    normals: str = "smooth",
    cameras: Sequence[Camera] = (),
    first: int | None = None,
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
        cameras: Cameras to write as nodes of the file, in this order.
        first: Number of faces at the beginning of the mesh that are written
            before all other faces. None sorts all faces by texture and gloss.

    Raises:
        InputError: If an argument is invalid, or if the file cannot be written.

    >>> import norm_balls as nb
    >>> apple = nb.normalize(nb.solid("apple"))
    >>> cameras = nb.orbit_cameras(views=3, width=2.2)
    >>> nb.export_mesh(apple, "apple.glb", cameras=cameras)
    """
    require_mesh("mesh", mesh)
    path = as_path("path", path)
    cameras = as_list("cameras", cameras, Camera, "a list of cameras")
    if first is not None:
        require_whole("first", first, 0, len(mesh.faces))
    unit_normals = mesh.written_normals(normals)
    if path.suffix.lower() != ".glb":
        raise InputError(
            f"{path} cannot be written as a mesh: choose a file name that ends in .glb"
        )
    content = _glb(mesh, unit_normals, cameras, first)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, content)
    except OSError as error:
        raise InputError(f"the mesh file {path} cannot be written: {error}") from error


def _glb(
    mesh: Mesh, normals: Float[np.ndarray, "F 3 3"], cameras: Sequence[Camera], first: int | None
) -> bytes:
    """Create the content of a .glb file. The first `first` faces are written before all others."""
    import trimesh

    first_count = len(mesh.faces) if first is None else first
    is_later = np.arange(len(mesh.faces)) >= first_count
    # Faces with the same key are written together. The key
    # is the flag `is_later`, the index of the texture and,
    # if the mesh has gloss, the three values of the gloss.
    keys = np.stack([is_later, mesh.texture_ids], axis=1)
    if mesh.gloss is not None:
        keys = np.concatenate([keys, mesh.gloss], axis=1)
    parts = []
    for key in np.unique(keys, axis=0):
        has_key = (keys == key).all(1)
        material = _material(mesh, int(key[1]), key[2:].tolist())
        parts.append(_part_for_trimesh(mesh, normals, material, has_key))
    return trimesh.Scene(parts).export(
        file_type="glb",
        include_normals=False,
        tree_postprocessor=partial(_as_one_mesh, cameras=cameras),
    )


def _part_for_trimesh(
    mesh: Mesh,
    normals: Float[np.ndarray, "F 3 3"],
    material: "PBRMaterial",
    is_in_part: Bool[np.ndarray, " F"],
) -> "trimesh.Trimesh":
    """Convert the faces of a mesh with one texture and gloss to a mesh of trimesh, with y up."""
    import trimesh
    from trimesh.visual.texture import TextureVisuals

    colors = mesh.corner_colors[is_in_part]
    uvs = mesh.corner_uvs[is_in_part]
    # Eight values for each corner: color (3),
    # texture coordinates (2) and normal (3).
    corner_values = np.concatenate([colors, uvs, normals[is_in_part]], axis=-1)
    vertex_ids, values, faces = _split_vertices(mesh.faces[is_in_part], corner_values)
    linear_colors = decode(torch.from_numpy(values[:, :3]), "srgb")
    y_up_to_z_up = Y_UP_TO_Z_UP[:3, :3]
    # A row vector times this matrix is rotated in
    # the opposite direction: from z up to y up.
    positions = mesh.vertices[vertex_ids] @ y_up_to_z_up
    rotated_normals = values[:, 5:] @ y_up_to_z_up
    return trimesh.Trimesh(
        positions,
        faces,
        visual=TextureVisuals(uv=values[:, 3:5], material=material),
        vertex_attributes={
            _COLOR: linear_colors.float().numpy(),
            _NORMAL: rotated_normals.astype(np.float32),
        },
        process=False,
    )


def _material(mesh: Mesh, texture_id: int, gloss: list[float]) -> "PBRMaterial":
    """Create the glTF material of one texture and gloss. Its name ends with the specular factor.

    The index is NO_TEXTURE (-1) for no texture, and `gloss` is empty for a matte mesh.
    """
    from trimesh.visual.material import PBRMaterial

    texture = None
    gloss_texture = None
    if texture_id >= 0:
        texture = Image.fromarray(mesh.textures[texture_id])
        if mesh.gloss_textures:
            factors = mesh.gloss_textures[texture_id]
            # glTF stores roughness in green and metallic
            # in blue, so an empty red channel is inserted.
            gloss_texture = Image.fromarray(np.insert(factors, 0, 0, axis=2))
    # Materials need different names. Otherwise trimesh would merge two
    # images with the same bytes, even if their widths and heights differ.
    name = f"texture {texture_id}"
    roughness, metallic = MATTE
    if gloss:
        roughness, metallic, specular_factor = gloss
        name = f"{name}, {SPECULAR} {specular_factor}"
    return PBRMaterial(
        name=name,
        baseColorTexture=texture,
        metallicRoughnessTexture=gloss_texture,
        metallicFactor=metallic,
        roughnessFactor=roughness,
        doubleSided=True,
    )


def _as_one_mesh(tree: dict[str, Any], cameras: Sequence[Camera]) -> None:
    """Change the JSON object of a .glb file before trimesh writes the file.

    All meshes become primitives of one glTF mesh. Colors, normals and specular factors get their
    names in glTF, and the cameras are added. trimesh itself would write colors with 8 bits, which
    is too coarse for dark linear colors. The JSON object is changed in place.
    """
    primitives = [primitive for mesh in tree["meshes"] for primitive in mesh["primitives"]]
    for primitive in primitives:
        attributes = primitive["attributes"]
        attributes["COLOR_0"] = attributes.pop(_COLOR)
        attributes["NORMAL"] = attributes.pop(_NORMAL)
    tree["meshes"] = [{"primitives": primitives}]
    tree["nodes"] = [{"mesh": 0}]
    for material in tree["materials"]:
        # trimesh writes no extensions, so the name of a material ends with its factor.
        _, found, specular_factor = material["name"].partition(f", {SPECULAR} ")
        if found:
            material["extensions"] = {"KHR_materials_specular": {SPECULAR: float(specular_factor)}}
            tree["extensionsUsed"] = ["KHR_materials_specular"]
    if cameras:
        tree["cameras"] = [_gltf_camera(camera) for camera in cameras]
    z_up_to_y_up = Y_UP_TO_Z_UP.T
    for index, camera in enumerate(cameras):
        # The axes of a camera in glTF are the same as ours: right, up and back.
        pose = z_up_to_y_up @ camera.pose()
        # glTF stores matrices column by column.
        matrix = pose.T.ravel().tolist()
        tree["nodes"].append({"camera": index, "name": f"view {index}", "matrix": matrix})
    tree["scenes"] = [{"nodes": list(range(len(tree["nodes"])))}]


def _gltf_camera(camera: Camera) -> dict[str, Any]:
    """Describe a camera as glTF does.

    The principal point of a perspective camera in glTF is the image center. If the camera has
    another one, the image in glTF is larger and contains the image of the camera.
    """
    planes = {"znear": camera.near, "zfar": camera.far}
    if isinstance(camera, PerspectiveCamera):
        # Half of the width and of the height that the image shows at a depth
        # of 1. Both grow with the distance of the principal point from the center.
        half_width = math.tan(math.radians(camera.angle) / 2)
        half_height = half_width / camera.pixel_aspect * (1 + abs(camera.principal_up))
        half_width *= 1 + abs(camera.principal_right)
        vertical_angle = 2 * math.atan(half_height)
        aspect_ratio = half_width / half_height
        perspective = {"yfov": vertical_angle, "aspectRatio": aspect_ratio, **planes}
        return {"type": "perspective", "perspective": perspective}
    half_width = camera.width / 2
    orthographic = {"xmag": half_width, "ymag": half_width, **planes}
    return {"type": "orthographic", "orthographic": orthographic}


def _split_vertices(
    faces: Int[np.ndarray, "F 3"], corner_values: Float[np.ndarray, "F 3 D"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Repeat vertices until all face corners at a vertex have the same values.

    In a mesh, two faces may have different colors at the same vertex. In a file,
    each vertex has only one color, one normal and so on. The result is the original vertex (N,)
    and the values (N, D) of each new vertex, and the faces with new indices.
    """
    # Corners with the same key become one new vertex. The key
    # of a corner is its original vertex, followed by its
    # values. Converting the index to float64 does not round it.
    keys = np.concatenate([faces[..., None], corner_values], axis=-1)
    corner_keys = keys.reshape(-1, keys.shape[-1])
    vertex_keys, corner_to_vertex = np.unique(corner_keys, axis=0, return_inverse=True)
    original_vertices = vertex_keys[:, 0].astype(np.int64)
    return original_vertices, vertex_keys[:, 1:], corner_to_vertex.reshape(-1, 3)
