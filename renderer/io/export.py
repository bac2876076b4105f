"""Meshes as .glb files with colors, textures, normals and cameras."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from renderer.camera import Camera, PerspectiveCamera
from renderer.errors import InputError, require_choice, require_range
from renderer.geometry.mesh import Y_UP_TO_Z_UP, Mesh, require_mesh
from renderer.geometry.normals import corner_normals
from renderer.image import decode
from renderer.io.files import write_whole
from renderer.settings import NORMALS
from renderer.validation import as_list, as_path, require_whole

if TYPE_CHECKING:
    import trimesh  # takes half a second: imported where it is used

# glTF's names for colors and normals after an underscore, under which trimesh writes any attribute.
_COLOR, _NORMAL = "_COLOR_0", "_NORMAL"
SPECULAR = "specularFactor"  # in the name of a material, since trimesh does not write it elsewhere


def export_mesh(
    mesh: Mesh, path: str | Path, normals: str = "smooth", cameras: Sequence[Camera] = (), first: int | None = None
) -> None:
    """Write a mesh to a .glb file. A vertex whose corners differ in color, uv or normal is written for each.

    `load_mesh` gives back the same surface, to float32: y up, linear colors, one part per texture and gloss; a material
    that is seen from both sides, diffuse if the mesh is matte. A mesh of several has its faces ordered by texture and
    gloss, the `first` so many of them before the others.
    normals: those that the renderer shades with, "smooth" or "flat". cameras: as nodes of a .glb, in order.
    InputError where the suffix is another or the file cannot be written.

    >>> apple, cameras = renderer.normalize(renderer.solid("apple")), renderer.orbit_cameras(views=3, width=2.2)
    >>> export_mesh(apple, "apple.glb", cameras=cameras)
    """
    require_mesh("mesh", mesh)
    path = as_path("path", path)
    require_choice("normals", normals, NORMALS)
    cameras = as_list("cameras", cameras, Camera, "a list of cameras")
    if first is not None:
        require_whole("first", first)
        require_range("first", first, 0, len(mesh.faces))
    shaded = corner_normals(mesh.vertices, mesh.faces, normals)
    if path.suffix.lower() != ".glb":
        raise InputError(f"{path} cannot be written as a mesh: give a name that ends in .glb")
    content = _glb(mesh, shaded, cameras, first)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)
    except OSError as error:
        raise InputError(f"mesh {path} cannot be written: {error}") from error


def _glb(mesh: Mesh, normals: np.ndarray, cameras: Sequence[Camera], first: int | None) -> bytes:
    import trimesh

    later = np.arange(len(mesh.faces)) >= (len(mesh.faces) if first is None else first)
    order = np.stack([later, mesh.texture_ids], axis=1)
    if mesh.gloss is not None:
        order = np.concatenate([order, mesh.gloss], axis=1)  # float64, which holds either exactly
    parts = [_textured_part(mesh, normals, part, (order == part).all(1)) for part in np.unique(order, axis=0)]
    finish = partial(_as_one_mesh, cameras=cameras)
    return trimesh.Scene(parts).export(file_type="glb", include_normals=False, tree_postprocessor=finish)


def _textured_part(mesh: Mesh, normals: np.ndarray, part: np.ndarray, selected: np.ndarray) -> "trimesh.Trimesh":
    """The selected faces (F,) bool, y up. part: 0 or 1, their texture or -1 and their gloss, if any."""
    import trimesh
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    corners = np.concatenate([mesh.corner_colors[selected], mesh.corner_uvs[selected], normals[selected]], axis=-1)
    ids, values, faces = _split(mesh.faces[selected], corners)
    colors, uvs, normals = values[:, :3], values[:, 3:5], values[:, 5:]
    texture_id, gloss = int(part[1]), part[2:].tolist()
    roughness, metallic = gloss[:2] or (1.0, 0.0)
    factors = mesh.gloss_textures[texture_id] if mesh.gloss_textures and texture_id >= 0 else None
    material = PBRMaterial(  # trimesh would take images of the same bytes and other sizes for one, but for the name
        name=", ".join([f"texture {texture_id}", *(f"{SPECULAR} {strength}" for strength in gloss[2:])]),
        baseColorTexture=Image.fromarray(mesh.textures[texture_id]) if texture_id >= 0 else None,
        metallicRoughnessTexture=None if factors is None else Image.fromarray(np.insert(factors, 0, 0, axis=2)),
        metallicFactor=metallic,
        roughnessFactor=roughness,
        doubleSided=True,
    )
    return trimesh.Trimesh(
        mesh.vertices[ids] @ Y_UP_TO_Z_UP[:3, :3],  # the inverse, since it multiplies rows
        faces,
        visual=TextureVisuals(uv=uvs, material=material),
        vertex_attributes={
            _COLOR: decode(torch.from_numpy(colors), "srgb").float().numpy(),
            _NORMAL: (normals @ Y_UP_TO_Z_UP[:3, :3]).astype(np.float32),
        },
        process=False,
    )


def _as_one_mesh(tree: dict[str, Any], cameras: Sequence[Camera]) -> None:
    """One node with the parts as primitives, in order, and colors of full precision: trimesh's own have 8 bits, too
    few for dark linear ones. A node for each camera."""
    primitives = [primitive for mesh in tree["meshes"] for primitive in mesh["primitives"]]
    for primitive in primitives:
        primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop(_COLOR)
        primitive["attributes"]["NORMAL"] = primitive["attributes"].pop(_NORMAL)
    tree["meshes"], tree["nodes"] = [{"primitives": primitives}], [{"mesh": 0}]
    for material in tree["materials"]:
        _, strength = f"{material['name']}, {SPECULAR} ".split(f", {SPECULAR} ")[:2]
        if strength:
            material["extensions"] = {"KHR_materials_specular": {"specularFactor": float(strength)}}
            tree["extensionsUsed"] = ["KHR_materials_specular"]
    if cameras:
        tree["cameras"] = [_gltf_camera(camera) for camera in cameras]
    for index, camera in enumerate(cameras):
        pose = Y_UP_TO_Z_UP.T @ camera.pose()  # looks along its own -z; stored by columns (glTF 2.0, 3.10)
        tree["nodes"].append({"camera": index, "name": f"view {index}", "matrix": pose.T.ravel().tolist()})
    tree["scenes"] = [{"nodes": list(range(len(tree["nodes"])))}]


def _gltf_camera(camera: Camera) -> dict[str, Any]:
    planes, half = {"znear": camera.near, "zfar": camera.far}, camera.width / 2
    if isinstance(camera, PerspectiveCamera):
        return {"type": "perspective", "perspective": {"yfov": camera.angle, "aspectRatio": 1.0, **planes}}
    return {"type": "orthographic", "orthographic": {"xmag": half, "ymag": half, **planes}}


def _split(faces: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One row for each vertex of faces (F, 3) and each of the values (F, 3, D) that its corners have.
    Returns the vertices (N,), the values (N, D) and the faces in terms of these rows, by vertex."""
    rows = np.concatenate([faces[..., None], corners], axis=-1)  # float64, which holds either exactly
    rows, index = np.unique(rows.reshape(-1, rows.shape[-1]), axis=0, return_inverse=True)
    return rows[:, 0].astype(np.int64), rows[:, 1:], index.reshape(-1, 3)
