"""Meshes as files: .glb with colours and textures, .ply with colours."""

from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from torch.nn.functional import grid_sample
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from renderer.errors import InputError
from renderer.image import decode, encode
from renderer.mesh import Y_UP_TO_Z_UP, Mesh

_COLOR = "_COLOR_0"  # glTF's name for colours after an underscore, under which trimesh writes any attribute


def export_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a mesh to a .glb or .ply file. A vertex whose corners differ in colour or uv is written once for each.

    .glb: `load_mesh` gives back the same surface, to float32: y up, linear colours, one part per texture; a diffuse
    material that is seen from both sides. A mesh of several textures has its faces ordered by texture.
    .ply: z up, colours of 8 bits. The format has no standard texture, so that vertices get their texel's colour, times
    their own in linear light: between them the texture is lost, unless the mesh is subdivided.
    InputError where the suffix is another or the file cannot be written.
    """
    path, writers = Path(path), {".glb": _glb, ".ply": _ply}
    if path.suffix.lower() not in writers:
        raise InputError(f"{path} is no name for a mesh to write: give one that ends in {', '.join(writers)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(writers[path.suffix.lower()](mesh))
    except OSError as error:
        raise InputError(f"mesh {path} cannot be written: {error}") from error


def _glb(mesh: Mesh) -> bytes:
    parts = [_textured_part(mesh, texture_id) for texture_id in np.unique(mesh.texture_ids)]
    return trimesh.Scene(parts).export(file_type="glb", include_normals=False, tree_postprocessor=_as_one_mesh)


def _textured_part(mesh: Mesh, texture_id: int) -> trimesh.Trimesh:
    """The faces of one texture, or of none, y up."""
    here = mesh.texture_ids == texture_id
    corners = np.concatenate([mesh.corner_colors[here], mesh.corner_uvs[here]], axis=-1)
    ids, values, faces = _split(mesh.faces[here], corners)
    material = PBRMaterial(
        name=f"texture {texture_id}",  # trimesh would take images of the same bytes and other sizes for one
        baseColorTexture=Image.fromarray(mesh.textures[texture_id]) if texture_id >= 0 else None,
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    return trimesh.Trimesh(
        mesh.vertices[ids] @ Y_UP_TO_Z_UP[:3, :3],  # the inverse, since it multiplies rows
        faces,
        visual=TextureVisuals(uv=values[:, 3:], material=material),
        vertex_attributes={_COLOR: decode(torch.from_numpy(values[:, :3]), "srgb").float().numpy()},
        process=False,
    )


def _as_one_mesh(tree: dict) -> None:
    """One node with the parts as primitives, in order, and colours of full precision: trimesh's own have 8 bits, too
    few for dark linear ones."""
    primitives = [primitive for mesh in tree["meshes"] for primitive in mesh["primitives"]]
    for primitive in primitives:
        primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop(_COLOR)
    tree["meshes"], tree["nodes"] = [{"primitives": primitives}], [{"mesh": 0}]
    tree["scenes"] = [{"nodes": [0]}]


def _ply(mesh: Mesh) -> bytes:
    ids, colors, faces = _split(mesh.faces, _baked_colors(mesh))
    colors = colors.astype(np.uint8)
    part = trimesh.Trimesh(mesh.vertices[ids], faces, vertex_colors=colors, process=False)
    return part.export(file_type="ply", vertex_normal=False)


def _baked_colors(mesh: Mesh) -> np.ndarray:
    """(F, 3, 3) uint8: corner colour × texture at the corners, sRGB-encoded."""
    linear = decode(torch.from_numpy(mesh.corner_colors), "srgb")
    for index, texture in enumerate(mesh.textures):
        here = torch.from_numpy(mesh.texture_ids == index)
        uvs = torch.from_numpy(mesh.corner_uvs)[here]
        linear[here] *= _sample(texture, uvs.flatten(0, 1)).unflatten(0, (-1, 3))
    return (encode(linear, "srgb") * 255).round().to(torch.uint8).numpy()


def _sample(texture: np.ndarray, uvs: torch.Tensor) -> torch.Tensor:
    """Linear colours (N, 3) of a texture (H, W, 3) that repeats, at uvs (N, 2), interpolated between texels."""
    size = torch.tensor(texture.shape[1::-1])
    framed = torch.from_numpy(np.pad(texture, ((1, 1), (1, 1), (0, 0)), mode="wrap"))
    places = (torch.stack([uvs[:, 0], 1 - uvs[:, 1]], dim=1) % 1 * size + 1) / (size + 2) * 2 - 1
    texels = decode(framed.permute(2, 0, 1).float() / 255, "srgb")
    return grid_sample(texels[None], places[None, None], align_corners=False)[0, :, 0].T


def _split(faces: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One row for each vertex of faces (F, 3) and each of the values (F, 3, D) that its corners have.

    Returns the vertices (N,), the values (N, D) and the faces in terms of these rows, by vertex.
    """
    rows = np.concatenate([faces[..., None], corners], axis=-1)  # float64, which holds either exactly
    rows, index = np.unique(rows.reshape(-1, rows.shape[-1]), axis=0, return_inverse=True)
    return rows[:, 0].astype(np.int64), rows[:, 1:], index.reshape(-1, 3)
